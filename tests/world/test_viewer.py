"""The page in which roll-outs are played: it holds what was recorded, and its script shows what the film shows."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from tiny_worlds import ExactMotion, Still, task_named

from swarmtwin.geometry import wrap_angle
from swarmtwin.world.rendering.frame import frame_of
from swarmtwin.world.rendering.viewer import recorded_worlds, shown_worlds, write_viewer
from swarmtwin.world.rollout import play

WORLDS = 8


def played(task, seed=0):
    """Roll-outs from the same starts by vehicles that drive at random, and by ones that stand."""
    scenario = task.draw(np.random.default_rng(seed), WORLDS)
    random, robot = np.random.default_rng(1), task.robot

    def act(observation):
        return random.uniform(robot.command_low / 3, robot.command_high, (WORLDS, task.vehicles, 2))

    motions = {"simulation": ExactMotion, "stand-ins": Still}
    return {title: play(task, motion(robot, WORLDS, task.vehicles), scenario, act) for title, motion in motions.items()}


@pytest.fixture(scope="module", params=["collective", "obstacle"])
def rollouts(request):
    changes = {"vehicles": 3, "collision_mm": 100, "separation_mm": 110} if request.param == "collective" else {}
    return played(task_named(request.param, **changes))


def page_of(rollouts, folder, **options):
    write_viewer(folder / "page.html", rollouts, **options)
    return (folder / "page.html").read_text()


def content_of(page):
    return json.loads(re.search(r'id="recorded">(.*?)</script>', page, re.DOTALL)[1])


def test_the_page_holds_the_poses_to_a_tenth_of_a_millimetre(rollouts, tmp_path):
    content = content_of(page_of(rollouts, tmp_path))
    assert len(content["worlds"]) == WORLDS
    for world in content["worlds"]:
        for rollout, kept in zip(rollouts.values(), world["plays"], strict=True):
            periods = rollout.periods[world["number"]]
            expected = rollout.pose[: periods + 1, world["number"]]
            pose = np.cumsum(np.reshape(kept["moves"], expected.shape), axis=0) * (0.1, 0.1, 0.001)
            assert np.abs(pose - expected)[..., :2].max() <= 0.05 + 1e-9
            assert np.abs(wrap_angle(pose[..., 2] - expected[..., 2])).max() <= 0.0005 + 1e-9
            assert kept["legs"] == rollout.leg[: periods + 1, world["number"]].tolist()
            reward = rollout.reward[:periods, world["number"]].mean(axis=1)
            assert np.abs(np.array(kept["rewards"]) - reward).max() <= 0.0005 + 1e-9


def test_the_page_loads_nothing_and_says_what_it_holds(rollouts, tmp_path):
    page = page_of(rollouts, tmp_path)
    assert not re.search(r"https?:|//[a-z]|\bsrc=|\bhref=|@import|url\(|fetch\(|import\(", page)
    assert "All 8 roll-outs, from the worst to the best on stand-ins" in page
    few = page_of(rollouts, tmp_path, most_worlds=3)
    assert "3 of 8 roll-outs are in this page, evenly from the worst to the best on stand-ins" in few
    assert len(content_of(few)["worlds"]) == 3


def test_few_worlds_are_taken_evenly_from_the_worst_to_the_best(rollouts):
    order = shown_worlds(rollouts, WORLDS)
    judged = rollouts["stand-ins"]
    ranks = [(judged.success[world], judged.mean_reward[world]) for world in order]
    assert ranks == sorted(ranks)
    assert sorted(order) == list(range(WORLDS))
    assert shown_worlds(rollouts, 2) == [order[0], order[-1]]
    assert shown_worlds(rollouts, 100) == order


def test_what_people_called_things_cannot_break_the_page(rollouts, tmp_path):
    page = page_of({"</script><b>": rollouts["simulation"]}, tmp_path)
    assert "</script><b>" not in page
    assert content_of(page)["titles"] == ["</script><b>"]
    assert page.count("</script>") == 2


ASK = """
const recorded = JSON.parse(require("fs").readFileSync(0, "utf8"));
const answers = recorded.asked.map(([world, motion, periods]) => {
  const play = decoded(recorded.worlds[world].plays[motion], recorded.vehicles);
  const targets = recorded.worlds[world].targets_mm;
  return {
    poses: [...Array(recorded.vehicles).keys()].map((vehicle) => poseAt(play, vehicle, periods)),
    status: recorded.status_words[statusAt(play, periods)],
    farthest_mm: farthestAt(play, targets, periods),
    colliding: [...collidingAt(play, periods)],
  };
});
console.log(JSON.stringify(answers));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="no node to run the page's script")
def test_the_script_shows_what_the_film_shows(rollouts, tmp_path):
    page = page_of(rollouts, tmp_path)
    script = re.search(r"<script>(.*?)</script>", page, re.DOTALL)[1]
    (tmp_path / "ask.js").write_text(script + ASK)
    recorded = recorded_worlds(rollouts, list(range(WORLDS)))
    random = np.random.default_rng(2)
    times = [0.0, 1.0, 7.0, 1e9, *random.uniform(0, 160, 6)]
    asked = [(world, motion, time) for world in range(WORLDS) for motion in range(2) for time in times]
    answers = subprocess.run(
        [shutil.which("node"), tmp_path / "ask.js"],
        input=json.dumps({**recorded, "asked": asked}),
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    seen = set()
    for (world, motion, time), answer in zip(asked, json.loads(answers), strict=True):
        frame = frame_of(list(rollouts.values())[motion], world, time, "")
        poses = np.array(answer["poses"])
        assert np.abs(poses - frame.path[-1])[:, :2].max() < 0.06
        assert np.abs(wrap_angle(poses[:, 2] - frame.path[-1, :, 2])).max() < 0.0006
        assert answer["status"] == frame.status.value
        assert answer["farthest_mm"] == pytest.approx(frame.farthest_mm, abs=0.15)
        assert sorted(answer["colliding"]) == np.flatnonzero(frame.colliding).tolist()
        seen.add(answer["status"])
    assert len(seen) > 1


@pytest.mark.parametrize("width", [1280, 400])
def test_in_a_browser_it_plays_without_errors_and_fits(rollouts, tmp_path, browser, width):
    page_of(rollouts, tmp_path)
    page = browser.open(tmp_path / "page.html", width)
    assert "simulation" in page.text()
    assert "stand-ins" in page.text()
    drawn = "[...document.querySelectorAll('canvas')].map(one => one.toDataURL()).join()"
    before = page.evaluate(drawn)
    page.evaluate("document.getElementById('play').click()")
    page.wait_until("Number(document.getElementById('time').value) > 0")
    page.evaluate("document.getElementById('next').click()")
    assert page.evaluate(drawn) != before
    assert page.errors == []
    assert page.elsewhere() == []
    assert not page.is_wider_than_the_window()
