"""The report: its numbers are the diagnosis's, every verdict has its page, and what is planted is seen where it is."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from drives import header_of
from swarmtwin.dynamics.open_loop import open_loop
from swarmtwin.gap.catalogue import mechanism_class, mechanism_names
from swarmtwin.gap.diagnosis import Cause, Dependence, Diagnosis, Estimate, Gain, Gains, NextRecording
from swarmtwin.gap.figure_fields import Axis, binned, blocks_of, components, field_choices
from swarmtwin.gap.figures import runs_figure
from swarmtwin.gap.finding import Finding
from swarmtwin.gap.report import gain_bars, leading_pictures, write_report
from swarmtwin.gap.report_words import (
    QUESTIONS,
    cause_summary,
    cause_words,
    dependence_words,
    estimate_words,
    gain_words,
    odds_words,
    verdict_words,
)
from swarmtwin.geometry import compose
from swarmtwin.recordings.recording import Recording, Track
from swarmtwin.robot import Robot
from swarmtwin.transitions import from_recording

NOISE = np.array([1.0, 1.0, 0.03])
NAMES = ("left", "right", "third", "fourth", "fifth", "sixth")
DELAY = Cause(
    name="command_delay",
    parameters={"delay_s": Estimate(value=0.1504, low=0.1311, high=0.1697, unit="s")},
    confidence=0.99,
    rivals=("actuator_lag",),
    share_of_gap=0.93,
    evidence="with it the runs are e^312 times as likely; next best: actuator_lag, behind by 2.1 nats",
)
YAW = Cause(
    name="marker_yaw",
    parameters={"angle_rad": Estimate(value=-0.1, low=-0.12, high=-0.08, unit="rad")},
    confidence=1.0,
    rivals=(),
    share_of_gap=0.05,
    evidence="",
)
NEXT = NextRecording(
    separates=("command_delay", "actuator_lag"),
    drive="next_drive.csv",
    runs=20,
    steps=40,
    expected_nats=7.3,
    command="swarmtwin record robot=mgr drive=next_drive.csv runs=20 output=next",
)


def made_robot(columns=2, arena=(1000, 800)):
    """A robot with any number of command columns."""
    return Robot.parse(
        {
            "name": "made",
            "title": "Made-up robot",
            "period_s": 0.5,
            "longest_gap_s": 0.6,
            "command": {name: {"low": -100, "high": 100, "unit": "PWM"} for name in NAMES[:columns]},
            "arena_mm": {"x": [0, arena[0]], "y": [0, arena[1]]},
            "largest_displacement": {"forward_mm": 60, "left_mm": 60, "turn_rad": 2.0},
            "situation": ["command"],
            "kinematics": "differential_drive",
            "vehicle_size_mm": [80, 60],
            "actuators": {"kind": "wheel", "effort": []},
        },
        "made",
    )


def simulated(command):
    """Displacements (N, 3) that the simulation expects of commands (N, m)."""
    ahead, turn = 45 * command.mean(axis=-1) / 100, 0.6 * command[..., -1] / 100
    return np.stack([ahead, np.zeros_like(ahead), turn], axis=-1)


class Simulation:
    """The simulation, as far as a report asks."""

    parts = ("command",)

    def __init__(self, robot):
        self.robot = robot

    def __call__(self, situation):
        return torch.as_tensor(simulated(situation.command.double().numpy()))


def moved_as_simulated(moment):
    return simulated(moment.command)


def moved_late(moment):
    """Three tenths of the period go on under the command before."""
    return 0.7 * simulated(moment.command) + 0.3 * simulated(moment.previous)


def made_finding(diagnosis, moved=moved_as_simulated, robot=None, runs=24, steps=40, vehicles=("1",), seed=0):
    """Drive, and compare with the simulation; the extended simulation knows exactly what moved the vehicles."""
    robot, random = robot or made_robot(), np.random.default_rng(seed)
    tracks, expected = [], []
    for run in range(runs):
        for vehicle in vehicles:
            command = random.uniform(-100, 100, (steps + 1, len(robot.command)))
            inner = robot.arena_mm.low_mm + 220, robot.arena_mm.high_mm - 220
            poses = [np.array([*random.uniform(*inner), random.uniform(-3, 3)])]
            time_s = (run * (steps + 10) + np.arange(steps + 1)) * robot.period_s
            for step in range(steps):
                moment = SimpleNamespace(
                    command=command[step], previous=command[max(step - 1, 0)], pose=poses[-1], run=run / runs
                )
                expected.append(moved(moment))
                poses.append(compose(poses[-1], expected[-1] + NOISE * random.normal(size=3)))
            tracks.append(Track(f"run_{run:03d}", vehicle, time_s, command, np.array(poses)))
    recording = Recording(robot, header_of(robot, vehicles), tuple(tracks))
    transitions, counts = from_recording(recording)
    assert counts.kept == len(expected)
    simulation = Simulation(robot)
    held_out = transitions.run >= 0.7 * runs
    predicted = open_loop(simulation, [track for track in tracks if int(track.run[4:]) >= 0.7 * runs])
    better = [
        run._replace(predicted=run.track.pose + 1.0, rmse_mm=float(np.sqrt(2)))
        if diagnosis.extension != "none"
        else run
        for run in predicted
    ]
    extends = diagnosis.extension != "none"
    before = (transitions.displacement - simulated(transitions.command)) / NOISE
    return Finding(
        diagnosis=diagnosis,
        simulation=simulation,
        extended=simulation if extends else None,
        transitions=transitions,
        held_out=held_out,
        residual_before=before,
        residual_after=(transitions.displacement - np.array(expected)) / NOISE if extends else before,
        runs_before=tuple(predicted),
        runs_after=tuple(better),
        drive=None,
    )


def made_diagnosis(verdict="explained", **changes):
    """A diagnosis of a delay, or of nothing."""
    wrong = verdict != "no_gap"
    depends_on = ("previous_command", "command") if wrong else ()
    tests = tuple(
        Dependence(
            part=part,
            statistic=3.25 if part in depends_on else 0.5,
            p_value=0.0005 if part in depends_on else 0.43,
            explained=0.4 / (1 + index) if part in depends_on else 0.001,
            found=part in depends_on,
        )
        for index, part in enumerate(QUESTIONS)
    )
    content = Diagnosis(
        verdict=verdict,
        causes=(DELAY,) if wrong else (),
        depends_on=depends_on,
        gain=Gains(
            position_mm=Gain(before=8.61, after=1.82, low=6.52, high=7.11),
            orientation_deg=Gain(before=12.4, after=3.05, low=9.1, high=9.6),
            open_loop_mm=Gain(before=214.0, after=31.0, low=160.0, high=205.0),
        )
        if wrong
        else Gains(**{name: Gain(before=1.25, after=1.25, low=0, high=0) for name in Gains.model_fields}),
        next_recording=NEXT if wrong else None,
        left_over=(),
        tests=tests,
        robot="made",
        vehicles=("1",),
        runs={"fitted_to": 17, "held_out": 7},
        transitions={"used": 960, "set_aside": 12},
        extension="mechanisms" if wrong else "none",
        seed=5,
    )
    return content.model_copy(update=changes)


class Page(HTMLParser):
    """What a page loads, what it says, and what it says before anything is unfolded."""

    def __init__(self, text):
        super().__init__()
        self.loaded, self.words, self.open_words, self.depth, self.skipped = [], [], [], 0, 0
        self.feed(text)
        self.text, self.above = " ".join(self.words), " ".join(self.open_words)

    def handle_starttag(self, tag, attrs):
        self.loaded += [value for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        self.depth += tag == "details"
        self.skipped += tag == "style"

    def handle_endtag(self, tag):
        self.depth -= tag == "details"
        self.skipped -= tag == "style"

    def handle_data(self, data):
        if not self.skipped:
            self.words += data.split()
            self.open_words += data.split() if not self.depth else []


def page_of(finding, folder):
    write_report(folder, finding)
    return Page((folder / "report.html").read_text())


def test_the_numbers_on_the_page_are_those_of_the_diagnosis(tmp_path):
    diagnosis = made_diagnosis(causes=(DELAY, YAW))
    page = page_of(made_finding(diagnosis, moved_late), tmp_path)
    assert "because commands act 0.15 s late; and the marker is turned by −5.7° on the vehicle." in page.above
    for said in (
        "Command delay : commands act 0.15 s (0.13 to 0.17) late.",
        "Marker yaw : the marker is turned by −5.7° (−6.9 to −4.6) on the vehicle.",
        "Accounts for 93 % of what can be explained; fits best in 99 % of resampled sessions",
        "It could as well be actuator lag",
        "before 8.61 mm after 1.82 mm −6.8 mm (−7.1 to −6.5), −79",
        "before 12.4° after 3.0° −9.4° (−9.6 to −9.1), −75",
        "before 214 mm after 31 mm −183 mm (−205 to −160), −86",
        "check network, broker and camera for latency",
        "glue the marker on straight",
        "20 runs of 40 steps with the commands in next_drive.csv",
        NEXT.command,
    ):
        assert said in page.above, said
    assert DELAY.evidence in page.text
    assert "previous command yes 0.0005 20.0 % 3.25" in page.text
    assert "17 fitted to, 7 held out" in page.text
    assert "960 used, 12 set aside" in page.text


def test_nobody_must_know_statistics_to_read_what_is_not_folded_away(tmp_path):
    above = page_of(made_finding(made_diagnosis(), moved_late), tmp_path).above.lower()
    for jargon in ("nats", "whitened", "standardised", "likelihood", "p-value", "residual", "bootstrap", "nan"):
        assert not re.search(rf"\b{jargon}\b", above), jargon


@pytest.mark.parametrize(
    ("verdict", "changes", "sentence"),
    [
        ("no_gap", {}, "Nothing is wrong: the simulation does what the robot did"),
        ("explained", {}, "The robot departs from the simulation because commands act"),
        ("unexplained", {}, "partly because commands act 0.15 s late. Something else remains"),
        ("unexplained", {"causes": (), "extension": "learned_residual"}, "and no known cause explains it"),
        ("unexplained", {"causes": (), "extension": "none", "next_recording": None}, "and no known cause explains it"),
    ],
)
def test_every_verdict_has_its_page_and_loads_nothing(tmp_path, verdict, changes, sentence):
    diagnosis = made_diagnosis(verdict, **changes)
    page = page_of(made_finding(diagnosis, moved_late if verdict != "no_gap" else moved_as_simulated), tmp_path)
    assert sentence in page.above
    assert ("before" in page.above.split()) == (diagnosis.extension != "none")
    text = (tmp_path / "report.html").read_text()
    assert f'class="verdict {verdict}"' in text
    assert all(source.startswith("data:image/png;base64,iVBOR") for source in page.loaded)
    for loader in ("@import", "url(", "<script", "<link"):
        assert loader not in text
    files = {file.stem for file in (tmp_path / "figures").glob("*.png")}
    assert len(page.loaded) == len(files)
    assert set(leading_pictures(diagnosis)) <= files


def test_vehicles_may_be_called_anything(tmp_path):
    names = ("<script>alert(1)</script>", "$x_{")
    diagnosis = made_diagnosis(vehicles=names)
    page = page_of(made_finding(diagnosis, moved_late, vehicles=names), tmp_path)
    assert f"vehicle {', '.join(names)}" in page.above
    assert "<script" not in (tmp_path / "report.html").read_text()
    assert (tmp_path / "figures" / "vehicle.png").exists()
    assert (tmp_path / "figures" / "neighbours.png").exists()


@pytest.mark.parametrize("columns", [1, 2, 3, 6])
def test_any_number_of_command_columns_in_any_arena(tmp_path, columns):
    robot = made_robot(columns, arena=(500 + 4000 * (columns == 3), 500 + 9000 * (columns == 6)))
    finding = made_finding(made_diagnosis(), moved_late, robot, runs=6)
    page_of(finding, tmp_path)
    choices = field_choices(finding.transitions, parts_of(finding))
    assert len(choices["command"].axes) == min(2, columns)
    assert all(f"{axis.label}".split(",")[0] in NAMES for axis in choices["command"].axes)


def test_a_page_is_made_of_next_to_nothing(tmp_path):
    finding = made_finding(made_diagnosis("unexplained"), moved_late, runs=2, steps=10)
    nowhere = replace(finding, runs_before=(), runs_after=())
    page = page_of(nowhere, tmp_path)
    assert "Where it shows" not in page.above
    assert [file.name for file in (tmp_path / "figures").iterdir()] == ["spread.png"]


def test_constant_commands_have_no_field(tmp_path):
    finding = made_finding(made_diagnosis("no_gap"))
    still = replace(finding.transitions, command=finding.transitions.command * 0)
    choices = field_choices(still, parts_of(finding))
    assert {"command", "duration", "vehicle", "neighbours"}.isdisjoint(choices)
    assert {"place", "heading", "time"} <= set(choices)


def parts_of(finding):
    """The components of the simulation's residual."""
    transitions = finding.transitions
    return components(transitions, simulated(transitions.command), finding.residual_before)


def test_a_place_where_vehicles_go_less_far_is_seen_there_and_nowhere_else():
    centre, radius_mm = np.array([300.0, 500.0]), 120.0

    def slow_there(moment):
        inside = np.linalg.norm(moment.pose[:2] - centre) < radius_mm
        return simulated(moment.command) * (0.5 if inside else 1.0)

    finding = made_finding(made_diagnosis(), slow_there, runs=150)
    parts = parts_of(finding)
    choice = field_choices(finding.transitions, parts)["place"]
    assert choice.component in ("way", "turning")
    field = binned(choice.axes, parts[choice.component], blocks_of(finding.transitions))
    x, y = np.meshgrid(*[(axis.edges[1:] + axis.edges[:-1]) / 2 for axis in choice.axes], indexing="ij")
    half_bin_mm = np.hypot(*[np.ptp(axis.edges[:2]) / 2 for axis in choice.axes])
    distance_mm = np.hypot(x - centre[0], y - centre[1])
    inside = field.mean[(distance_mm < radius_mm - half_bin_mm) & np.isfinite(field.mean)]
    outside = field.mean[(distance_mm > radius_mm + half_bin_mm) & np.isfinite(field.mean)]
    assert len(inside) >= 1
    assert len(outside) >= 10
    assert inside.max() < -2
    assert np.abs(outside).max() < 1


def test_a_delay_is_seen_over_the_change_of_the_command_and_gone_after_the_extension():
    finding = made_finding(made_diagnosis(), moved_late)
    parts = parts_of(finding)
    choice = field_choices(finding.transitions, parts)["previous_command"]
    assert choice.component in ("forward", "turn")
    block = blocks_of(finding.transitions)
    after = components(finding.transitions, simulated(finding.transitions.command), finding.residual_after)
    before = binned(choice.axes, parts[choice.component], block)
    left_over = binned(choice.axes, after[choice.component], block)
    assert np.nanmax(np.abs(before.mean)) > 5
    assert before.strength > 10
    assert np.nanmax(np.abs(left_over.mean)) < 1
    assert abs(left_over.strength) < 0.05


def test_a_drift_points_where_it_carries():
    def drifting(moment):
        heading_rad = moment.pose[2]
        return simulated(moment.command) + 2.0 * np.array([np.cos(heading_rad), -np.sin(heading_rad), 0.0])

    finding = made_finding(made_diagnosis(), drifting)
    parts = parts_of(finding)
    assert field_choices(finding.transitions, parts)["place"].component == "x"
    assert parts["x"].mean() == pytest.approx(2.0, abs=0.15)
    assert parts["y"].mean() == pytest.approx(0.0, abs=0.15)


def test_means_and_their_errors_are_those_of_blocks():
    random = np.random.default_rng(1)
    runs, steps = 400, 25
    own = random.normal(0, 1, runs)
    block = np.repeat(np.arange(runs), steps)
    values = 0.3 + own[block] + random.normal(0, 1, runs * steps)
    place = np.tile(np.linspace(0, 1, steps), runs)
    axis = Axis("place", place, np.array([0.0, 0.5, 1.0]))
    field = binned([axis], values, block)
    first = place < 0.5
    assert field.mean[0] == pytest.approx(values[first].mean())
    np.testing.assert_array_equal(field.transitions, [first.sum(), (~first).sum()])
    means = values.reshape(runs, steps)[:, : steps // 2].mean(axis=1)
    assert field.standard_error[0] == pytest.approx(means.std(ddof=1) / np.sqrt(runs))
    assert field.standard_error[0] > 2 * values[first].std() / np.sqrt(first.sum())


def test_bins_with_too_little_say_nothing():
    place = np.repeat([0.5, 1.5, 2.5, 3.5], [7, 40, 40, 40])
    block = np.concatenate([np.arange(7), np.zeros(40), np.arange(40), np.arange(40)])
    values = np.concatenate([np.ones(87), np.full(40, np.nan)])
    field = binned([Axis("place", place, np.arange(5.0))], values, block)
    np.testing.assert_array_equal(np.isfinite(field.mean), [False, False, True, False])
    np.testing.assert_array_equal(field.transitions, [7, 40, 40, 0])


def test_a_typical_run_and_a_bad_one_are_drawn():
    finding = made_finding(made_diagnosis(), moved_late, runs=40)
    figure = runs_figure(finding.runs_before, finding.runs_after)
    errors = sorted(run.rmse_mm for run in finding.runs_before)
    shown = [float(re.search(r": (\d+) → 1 mm", panel.get_title(loc="left"))[1]) for panel in figure.axes]
    expected = [errors[round(share * (len(errors) - 1))] for share in (0.5, 0.9)]
    assert shown == [float(f"{error:.0f}") for error in expected]
    assert runs_figure((), ()) is None


@pytest.mark.parametrize(
    ("name", "value", "low", "high", "unit", "said"),
    [
        ("delay_s", 0.1504, 0.1311, 0.1697, "s", "0.15 s (0.13 to 0.17)"),
        ("angle_rad", np.pi / 6, np.pi / 6 - 0.002, np.pi / 6 + 0.002, "rad", "30.00° (29.89 to 30.11)"),
        ("loss", 0.302, 0.281, 0.322, "", "30 % (28 to 32)"),
        ("loss", -0.05, -0.09, -0.01, "", "−5 % (−9 to −1)"),
        ("gain", 1.12, 1.10, 1.14, "", "1.12 (1.10 to 1.14)"),
        ("x_mm", 431.0, 402.0, 460.0, "mm", "431 mm (402 to 460)"),
        ("factor", 1.0, 1.0, 1.0, "", "1.00 (1.00 to 1.00)"),
        ("left_mm", -0.001, -0.5, 0.5, "mm", "0.0 mm (−0.5 to 0.5)"),
    ],
)
def test_numbers_are_as_exact_as_their_intervals(name, value, low, high, unit, said):
    assert (
        estimate_words(name, Estimate(value=value, low=low, high=high, unit=unit)).replace("\N{NO-BREAK SPACE}", " ")
        == said
    )


@pytest.mark.parametrize("name", mechanism_names())
def test_every_cause_of_the_catalogue_has_its_sentence(robots, name):
    for robot in robots.values():
        parameters = {
            parameter: Estimate(value=0.5, low=0.4, high=0.6, unit=unit)
            for parameter, unit in mechanism_class(name).units(robot).items()
        }
        cause = DELAY.model_copy(update={"name": name, "parameters": parameters})
        said = cause_words(cause)
        assert "{" not in said
        assert said.count("(") >= min(1, len(parameters))
        assert cause_summary(cause) in verdict_words(made_diagnosis(causes=(cause,)))
        assert "(" not in cause_summary(cause).replace("(coefficient", "").replace("(within", "")


def test_gains_may_be_losses_and_errors_nothing():
    worse = gain_words(Gain(before=2.0, after=2.1, low=-0.3, high=0.1), "mm")
    assert worse.replace("\N{NO-BREAK SPACE}", " ") == "+0.1 mm (−0.1 to +0.3), +5 %"
    unknown = Gain(before=0, after=0, low=0, high=0)
    gain = made_diagnosis().gain.model_copy(update={"open_loop_mm": unknown})
    bars = gain_bars(made_diagnosis(gain=gain))
    assert [bar.after is not None for bar in bars] == [True, True, False]
    assert bars[2].before == "not known"


def test_odds_are_round_numbers():
    assert [odds_words(nats) for nats in (5.0, 7.3, 1000.0)] == ["100", "1,000", "1,000,000"]


@pytest.mark.parametrize(
    ("name", "depends_on", "leading"),
    [
        ("battery_sag", ("spread", "command", "time"), ["time", "command", "runs"]),
        ("surface_patch", ("command", "wall_distance", "tails"), ["place", "command", "runs"]),
        ("gain_change", ("spread", "command"), ["command", "spread", "runs"]),
        ("marker_yaw", ("previous_command",), ["previous_command", "runs"]),
        ("noise_change", ("spread", "tails"), ["spread", "runs"]),
    ],
)
def test_what_the_cause_looks_at_is_shown_first_where_it_shows(name, depends_on, leading):
    cause = DELAY.model_copy(update={"name": name})
    assert leading_pictures(made_diagnosis(causes=(cause,), depends_on=depends_on)) == leading


def test_what_is_left_is_said_without_a_direction_that_nobody_measured():
    diagnosis = made_diagnosis(depends_on=("time", "spread"), left_over=("position", "spread", "tails"))
    assert dependence_words(diagnosis) == (
        "What is off depends on the time since the session began. Errors scatter more than the ordinary noise. "
        "What the extension leaves depends on the place in the arena. With the extension, how errors scatter and how "
        "common large errors are still differs from the ordinary noise."
    )
    tighter = Dependence(part="spread", statistic=1, p_value=0, explained=-0.2, found=True)
    quiet = made_diagnosis(depends_on=("spread",), tests=(tighter,))
    assert dependence_words(quiet) == "Errors scatter less than the ordinary noise."
