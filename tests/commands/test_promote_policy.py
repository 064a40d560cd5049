"""`swarmtwin promote what=policy`: a policy becomes champion by what it does on stand-ins, and the way back is open."""

import json

import mlflow
import pytest
import yaml

from swarmtwin.tracking import registry
from tiny_policies import save_seeker, simulation

NAME = "mgr-policy"
GATE = ("policy_gate.rollouts=100", "policy_gate.least_success=0.5", "policy_gate.most_collisions=0.3")


@pytest.fixture
def promote(swarmtwin):
    def call(candidate, *options):
        return swarmtwin("promote", "what=policy", f"candidate={candidate}", *GATE, *options)

    return call


def champion_number():
    champion = registry.holder(NAME, "champion", "collective")
    return champion and champion.number


def page_of(number):
    return mlflow.MlflowClient().get_model_version(NAME, str(number)).description


def test_a_policy_that_stands_still_is_refused_and_one_that_arrives_is_not(promote, workshop):
    still = promote(save_seeker(workshop / "still", speed=0.0))
    assert still.status == 3
    assert still.error.startswith(f"swarmtwin promote: {NAME} version 1 is not promoted: success 0.0%, collisions 0.0%")
    assert "success is below 50%" in still.error
    assert champion_number() is None
    answer = promote(save_seeker(workshop / "seeker"))
    assert answer.status == 0, answer.error
    assert "every demand is met" in " ".join(answer.shown.split())
    assert champion_number() == 2
    assert "- **Compared with** no other policy: it is the first champion for its task.\n" in page_of(2)


def test_a_policy_that_is_worse_than_the_champion_is_refused_and_one_as_good_is_not(
    promote, workshop, swarmtwin, crown
):
    crown(save_seeker(workshop / "seeker"), NAME, task="collective")
    worse = promote(save_seeker(workshop / "slow", speed=0.3), "policy_gate.least_success=0")
    assert worse.status == 3
    assert "it may be worse than the champion by more than 5%" in worse.error
    assert worse.error.endswith(f"{NAME} version 1 stays champion\n")
    assert promote(save_seeker(workshop / "equal", success=0.9), "policy_gate.margin=0").status == 0
    assert champion_number() == 3
    page = page_of(3)
    assert "It became champion because it meets every demand (at least 50% success, less than 30% collisions): " in page
    assert "success +0.0% against the champion (95 % interval +0.0% to +0.0%)." in page
    assert "- **Measured on** 100 roll-outs on stand-ins, vehicles 2, 3.\n" in page
    assert f"- **Compared with** {NAME} version 1, the champion before it, from the same starts.\n" in page
    answer = swarmtwin("promote", "what=policy", "rollback=true")
    assert (answer.status, answer.shown) == (0, f"{NAME}: version 1 is champion again, version 3 no longer\n")
    assert champion_number() == 1


@pytest.mark.end_to_end
def test_a_policy_is_judged_by_what_was_found_as_a_gap(promote, workshop, robots):
    digest = registry.folder_digest(simulation(workshop / "kinematic", robots["mgr"]))
    seeker = save_seeker(workshop / "seeker", source="kinematic", digest=digest)
    weak = "policy_gate.randomisation={gain_change: {gain: [0.9, 1.1]}}"
    refused = promote(seeker, weak)
    assert refused.status == 3
    assert "of 100 roll-outs in a randomised simulation: success is below 50%" in refused.error
    both = promote(seeker, weak, "policy_gate.deployments=[x]")
    assert both.status == 2
    assert "policies are judged by deployments or in a randomised simulation: leave one of the two out" in both.error
    answer = promote(seeker, weak, "policy_gate.least_success=0")
    assert answer.status == 0, answer.error
    assert "in a randomised simulation" in " ".join(answer.shown.split())
    page = page_of(champion_number())
    assert "- **Measured on** 100 roll-outs in the simulation that it was learned in, in which `{'gain_change'" in page


@pytest.fixture
def deployed(workshop):
    """Make folders as `deploy` leaves them, of a policy that always arrived; return the option that names them."""

    def make(policy, name, count):
        about = {"robot": {"name": "mgr"}, "policy": {"digest": registry.folder_digest(policy)}}
        robots = {"success": True, "collision": False, "reward": -1.0}
        folders = [workshop / f"{name}_{number}" for number in range(count)]
        for folder in folders:
            folder.mkdir()
            (folder / "deployment.yaml").write_text(yaml.safe_dump(about))
            (folder / "metrics.json").write_text(json.dumps({"control": {"ending": "done"}, "robots": robots}))
        return [folder.name for folder in folders]

    return make


def test_the_page_of_a_champion_says_that_deployments_made_it_one(promote, workshop, crown, deployed):
    first, second, third = (save_seeker(workshop / name, speed=0.9 + n / 100) for n, name in enumerate("abc"))
    crown(first, NAME, task="collective")
    folders = deployed(second, "second", 3)
    gate = ("policy_gate.fewest_deployments=3", f"policy_gate.deployments=[{','.join(folders)}]")
    assert promote(second, *gate).status == 0
    assert "- **Measured on** 3 deployments.\n" in page_of(2)
    assert f"no other policy: {NAME} version 1, the champion before it, was not deployed.\n" in page_of(2)
    folders += deployed(third, "third", 4)
    assert promote(third, gate[0], f"policy_gate.deployments=[{','.join(folders)}]").status == 0
    assert "- **Measured on** 4 deployments.\n" in page_of(3)
    assert f"**Compared with** {NAME} version 2, the champion before it, in deployments of its own.\n" in page_of(3)


def test_a_policy_that_collides_too_often_is_refused(promote, workshop):
    seeker = save_seeker(workshop / "seeker")
    answer = promote(seeker, "policy_gate.most_collisions=0", "policy_gate.least_success=0")
    assert answer.status == 3
    assert "collisions are not below 0%" in answer.error


def test_a_champion_for_the_same_task_with_other_settings_is_not_replaced_by_the_way(promote, workshop, crown):
    crown(save_seeker(workshop / "seeker"), NAME, task="collective")
    other = save_seeker(workshop / "other", reach_mm=260)
    answer = promote(other)
    assert answer.status == 3
    assert answer.error == (
        f"swarmtwin promote: {NAME} version 2 is not promoted: it cannot be compared with {NAME} version 1, the "
        "champion for task 'collective', which has reach_mm 250.0 in place of 260.0: add "
        "policy_gate.other_settings=true to replace it without a comparison\n"
    )
    assert champion_number() == 1
    assert promote(other, "policy_gate.other_settings=true").status == 0
    assert champion_number() == 2
    assert f"no other policy: the task of {NAME} version 1, the champion before it, had other settings." in page_of(2)


def test_a_policy_for_another_task_gets_a_champion_of_its_own(promote, swarmtwin, workshop, crown):
    first = crown(save_seeker(workshop / "seeker"), NAME, task="collective")
    assert promote(save_seeker(workshop / "other", name="gathering", reach_mm=260)).status == 0
    assert {v.number: v.aliases for v in registry.versions(NAME)} == {1: ("champion",), 2: ("champion-gathering",)}
    for version in registry.versions(NAME):
        registry.challenge(version, None)
    for options in (("candidate=challenger",), ("rollback=true",)):
        answer = swarmtwin("promote", "what=policy", *options)
        role = "champion" if "rollback=true" in options else "challenger"
        assert (answer.status, answer.error) == (
            2,
            f"swarmtwin promote: {NAME} has a {role} for each of 2 tasks: add task=gathering or task=collective\n",
        )
    answer = promote("challenger", "task=collective")
    assert (answer.status, answer.shown) == (0, f"{first} is the champion already\n")
    answer = promote(f"models:/{NAME}@champion", "task=gathering")
    assert (answer.status, answer.shown, answer.error) == (0, f"{NAME} version 2 is the champion already\n", "")
    answer = swarmtwin("rollout", f"policy=models:/{NAME}/1", "task=gathering", "output=out")
    assert answer.status == 2
    assert answer.error.endswith(f"not for 'gathering': write models:/{NAME}@champion-gathering\n")
    answer = swarmtwin("rollout", "policy=seeker", "task=gathering", "output=out")
    assert "seeker is a policy for task 'collective', not for 'gathering'" in answer.error


def test_promoting_the_champion_again_changes_nothing(promote, workshop, crown):
    folder = save_seeker(workshop / "seeker")
    registry.challenge(crown(folder, NAME, task="collective"), None)
    for candidate in (folder, 1, "challenger"):
        answer = promote(candidate)
        assert (answer.status, answer.shown) == (0, f"{NAME} version 1 is the champion already\n")
    assert len(registry.versions(NAME)) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["policy_gate.rollouts=99"],
            "99 roll-outs on stand-ins are too few to judge a policy by: ask for 100 or more",
        ),
        (["policy_gate.vehicles=[2]"], "vehicles=[2] are 1, task 'collective' is for 2: give 2 ids, or none"),
        (["robot=mur"], "seeker is a policy of robot 'mgr': add robot=mgr"),
        (["candidate=9"], "no registered model 'mgr-policy'"),
        (["candidate=mlp"], "no policy in mlp: policy.yaml is missing"),
        (["what=polcy"], "options: field 'what': Input should be 'dynamics' or 'policy', got 'polcy'"),
    ],
)
def test_a_mistake_is_one_line_and_changes_nothing(promote, model, workshop, options, message):
    save_seeker(workshop / "seeker")
    model("mlp")
    answer = promote("seeker", *options)
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin promote: {message}")
    assert len(answer.error.strip().splitlines()) == 1
    assert champion_number() is None
