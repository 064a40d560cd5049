import json

import pytest
import yaml

from swarmtwin.errors import UserError
from swarmtwin.studies.deployed_trials import deployed_trials


@pytest.fixture
def deployment(tmp_path):
    """Make a folder as `deploy` leaves it."""

    def make(name, policy="a", robot="mgr", success=True, ending="done", robots=True):
        folder = tmp_path / name
        folder.mkdir()
        about = {"robot": {"name": robot}, "policy": {"digest": policy, "source": "here"}}
        (folder / "deployment.yaml").write_text(yaml.safe_dump(about))
        figures = {"success": success, "collision": not success, "reward": -2.5}
        metrics = {"control": {"ending": ending}} | ({"robots": figures} if robots else {})
        (folder / "metrics.json").write_text(json.dumps(metrics))
        return folder

    return make


def test_each_policy_is_judged_by_its_own_deployments(robots, deployment):
    folders = [deployment("1"), deployment("2", success=False), deployment("3", policy="b")]
    found = deployed_trials(folders, robots["mgr"])
    assert {digest: trials.succeeded.tolist() for digest, trials in found.items()} == {"a": [True, False], "b": [True]}
    assert found["a"].collided.tolist() == [False, True]
    assert not found["a"].paired


def test_what_was_stopped_or_never_began_is_no_success(robots, deployment):
    folders = [deployment("1", ending="stopped"), deployment("2", ending="stopped", robots=False)]
    assert not deployed_trials(folders, robots["mgr"])["a"].succeeded.any()


@pytest.mark.parametrize("what", ["another robot", "named twice", "not a deployment"])
def test_what_cannot_be_judged_is_one_clear_error(robots, deployment, tmp_path, what):
    folder = deployment("1", robot="mur" if what == "another robot" else "mgr")
    folders = {"named twice": [folder, folder], "not a deployment": [tmp_path]}.get(what, [folder])
    expected = {"another robot": "of robot 'mur', not of 'mgr'", "named twice": "named twice"}
    with pytest.raises(UserError, match=expected.get(what, "is no deployment of a policy")):
        deployed_trials(folders, robots["mgr"])
