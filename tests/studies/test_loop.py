"""The loop: what it makes of deployments, and that it goes on where it was; its commands are tested elsewhere."""

import json

import pytest
import yaml

from swarmtwin.configuration import config_folder
from swarmtwin.errors import UserError
from swarmtwin.studies.loop import study
from swarmtwin.studies.loop.table import loop_table


@pytest.fixture
def options(robots, tmp_path):
    values = yaml.safe_load((config_folder() / "experiment" / "loop.yaml").read_text())
    values = {name: value for name, value in values.items() if name not in ("defaults", "hydra")}
    return study.Options.parse(values | {"robot": robots["mgr"], "output": tmp_path, "deployments": 2}, "options")


@pytest.fixture
def stage():
    return study.Stage(name="before", words="as learned", policy="policy", simulation="simulation")


def left_by_deploy(folder, success, ending="done"):
    folder.mkdir(parents=True)
    robots = {"success": success, "collision": False, "reward": -2.5, "reach_time_s": 12.0 if success else None}
    control = {"ending": ending, "reason": "why", "periods": 30, "interventions": 4, "alarms": {"2": 1, "3": 0}}
    (folder / "metrics.json").write_text(json.dumps({"robots": robots, "control": control}))
    (folder / "deployment.yaml").write_text(yaml.safe_dump({"policy": {"digest": "abc"}}))


def test_a_stopped_deployment_is_no_success_and_the_table_counts_it(options, stage):
    place = options.output / "deployments" / "before"
    left_by_deploy(place / "01", True)
    left_by_deploy(place / "02", True, ending="stopped")
    rows = study._rows(options, stage)
    assert [row["success"] for row in rows] == [True, False]
    table = study.pd.DataFrame(rows)
    diagnosis = {"verdict": "unexplained", "causes": []}
    assert study._summary(table, [stage], diagnosis)["stages"]["before"]["success"] == 0.5
    shown = loop_table("robot", [stage], table, diagnosis)
    assert [next(iter(column.cells)) for column in shown.columns][:4] == ["as learned", "2", "1", "1"]


class Running:
    arguments = ("broker=here",)
    placed = 0

    def place(self, seed):
        self.placed += 1


def test_what_is_there_is_not_done_again(options, stage, monkeypatch):
    left_by_deploy(options.output / "deployments" / "before" / "01", True)
    called = []
    monkeypatch.setattr(study, "_swarmtwin", lambda *arguments, may_refuse: called.append(arguments) or 0)
    running = Running()
    study._deploy(options, running, stage)
    (call,) = called
    assert call[0] == "deploy"
    assert call[-1].endswith("before/02")
    assert running.placed == 1


def test_a_recording_that_a_safety_stop_cut_short_is_laid_aside(options, monkeypatch):
    statuses = iter([3, 0])

    def collect(*arguments, may_refuse):
        (options.output / "recording").mkdir()
        return next(statuses)

    monkeypatch.setattr(study, "_swarmtwin", collect)
    study._collect(options, Running())
    assert sorted(path.name for path in options.output.iterdir()) == ["recording", "recording-stopped-1"]


@pytest.mark.parametrize("effects", ["battery_sag", "{name: battery_sag}", "[battery_sag]", "[{"])
def test_what_is_no_list_of_effects_is_one_clear_error(effects):
    with pytest.raises(UserError, match="is no list of effects"):
        study._parsed(effects)
