"""`swarmtwin experiment name=hidden_effects`: it goes on where it was interrupted, and writes all tables."""

import importlib.util
import json
import sys

import pandas as pd
import pytest

from case_results import result
from swarmtwin.studies.hidden_effects.proportions import Proportion
from swarmtwin.studies.hidden_effects.results import TrueModelAnswer

STUDY = "swarmtwin.studies.hidden_effects.study"
EXPERIMENT = (
    *("experiment", "name=hidden_effects", "families=[formulas,unruly]", "kinds=[two,clean]", "processes=1"),
    *("count.quick.two=2", "count.quick.clean=4"),
)


def test_the_command_goes_on_where_it_was_interrupted_and_writes_all_tables(swarmtwin, workshop, monkeypatch):
    asked = []

    def examined(case, with_baselines, with_true_model, judged):
        if len(asked) == 7 and "again" not in asked:
            raise KeyboardInterrupt
        asked.append(case.key)
        names = list(case.true_names)
        planted = result(case.kind, case.about, names, robot=case.robot)
        return planted.model_copy(update={"case": case})

    monkeypatch.setattr(f"{STUDY}.score_case", examined)
    study = (*EXPERIMENT, "kinds=[one,two,clean]", "count.quick.one=2", "output=study")
    assert swarmtwin(*study).status == 130
    assert not (workshop / "study").exists()
    first = list(asked)
    asked.append("again")
    answer = swarmtwin(*study)
    assert answer.status == 0, answer.error
    cases = 2 * (2 + 2 + 4)
    assert len(asked) == cases + 1
    assert len(set(asked)) == cases + 1
    assert first == asked[:7]
    folder = workshop / "study"
    table = pd.read_csv(folder / "results.csv")
    assert len(table) == cases
    assert (table.exact == 1).all()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["families"]["unruly"]["two"]["exact"] == Proportion.of([True] * 2).model_dump()
    assert metrics["families"]["formulas"]["clean"]["accused"]["count"] == 0
    pictures = {path.stem for path in folder.glob("*.png")}
    assert pictures == {"confusion", "detection", "calibration", "clean"}  # none of parameters, of which none is said
    for name in (*(f"{name}.png" for name in pictures), "parameters.csv", "report.md"):
        assert (folder / name).stat().st_size > 0
    assert "two causes: both and nothing else" in answer.shown
    assert "2/2 (34.2–100.0 %)" in (folder / "report.md").read_text()


def test_what_other_machines_have_judged_is_taken_over(swarmtwin, workshop, monkeypatch):
    asked = []

    def examined(case, with_baselines, with_true_model, judged):
        asked.append(case.kind)
        return result(case.kind, case.about, list(case.true_names), robot=case.robot).model_copy(update={"case": case})

    monkeypatch.setattr(f"{STUDY}.score_case", examined)
    for kind in ("two", "clean"):
        answer = swarmtwin(*EXPERIMENT, f"kinds=[{kind}]", f"output={kind}")
        assert answer.status == 0, answer.error
    assert asked == ["two"] * 4 + ["clean"] * 8
    others = "judged=[two/results.jsonl,clean/results.jsonl]"
    answer = swarmtwin(*EXPERIMENT, others, "count.quick.clean=5", "output=study")
    assert answer.status == 0, answer.error
    assert asked[12:] == ["clean"] * 2  # those that nobody has judged
    assert len(pd.read_csv(workshop / "study" / "results.csv")) == 4 + 10
    again = swarmtwin(*EXPERIMENT, "judged=[study/results.jsonl]", "count.quick.clean=5", "output=again")
    assert again.status == 0, again.error
    assert len(asked) == 14
    refused = swarmtwin(*EXPERIMENT, "judged=[elsewhere.jsonl]", "output=nothing")
    assert (refused.status, (workshop / "nothing").exists()) == (2, False)
    assert "judged=elsewhere.jsonl: no such file" in refused.error


def test_the_first_sessions_of_each_kind_are_judged_by_other_methods_as_well(swarmtwin, workshop, monkeypatch):
    asked = {}

    def examined(case, with_baselines, with_true_model, judged):
        asked[case.key] = (with_baselines, with_true_model)
        answer = TrueModelAnswer(method="oracle", causes={name: {} for name in case.true_names}, seconds=60.0)
        planted = result(case.kind, case.about, robot=case.robot, true_model=answer if with_true_model else None)
        return planted.model_copy(update={"case": case})

    monkeypatch.setattr(f"{STUDY}.score_case", examined)
    answer = swarmtwin(*EXPERIMENT, "baselines.quick=0.25", "true_model.quick=0.5", "output=study")
    assert answer.status == 0, answer.error
    baselines, true_model = zip(*asked.values(), strict=True)
    assert baselines == (True, False, True, False, False, False) * 2
    assert true_model == (True, False, True, True, False, False) * 2
    assert "with the true model in hand" in answer.shown
    report = (workshop / "study" / "report.md").read_text()
    compared = report[report.index("## formulas: with the true model in hand") :].split("\n\n")[1]
    assert compared.splitlines() == [
        "|  | diagnosis | oracle |",
        "| --- | ---: | ---: |",
        "| sessions | 3 | 3 |",
        "| two: exact | 0 of 1 | 1 of 1 |",
        "| nothing wrong: a cause named | 0 of 2 | 0 of 2 |",
        "| error cut, 10 % or more: median | 25.0 % | – |",
        "| seconds: median, most | 5.0, 5.0 | 60.0, 60.0 |",
        "| failed | 0 of 3 | 0 of 3 |",
    ]


def test_what_two_calls_left_is_put_together_and_asked_for_where_it_lacks_something(swarmtwin, workshop, monkeypatch):
    asked = []

    def examined(case, with_baselines, with_true_model, judged):
        asked.append((judged, with_true_model))
        answer = TrueModelAnswer(method="oracle", seconds=60.0) if with_true_model else None
        planted = judged or result(case.kind, case.about, list(case.true_names), robot=case.robot)
        return planted.model_copy(update={"case": case, "true_model": answer or planted.true_model})

    monkeypatch.setattr(f"{STUDY}.score_case", examined)
    few = (*EXPERIMENT, "families=[formulas]")
    for name, options in {"plain": (), "half": ("true_model.quick=0.5",)}.items():
        assert swarmtwin(*few, *options, f"output={name}").status == 0
    assert [judged for judged, _ in asked] == [None] * 12
    both = "judged=[plain/results.jsonl,half/results.jsonl]"
    answer = swarmtwin(*few, both, "true_model.quick=0.5", "output=both")
    assert (answer.status, len(asked)) == (0, 12)
    answer = swarmtwin(*few, both, "true_model.quick=1", "output=all")
    assert answer.status == 0, answer.error
    assert len(asked) == 12 + 3
    assert all(judged is not None and judged.true_model is None and wanted for judged, wanted in asked[12:])
    table = pd.read_csv(workshop / "all" / "results.csv")
    assert (table.true_model_method == "oracle").all()


def test_a_rigid_body_without_its_toolbox_is_refused_with_what_to_install(swarmtwin, workshop, monkeypatch):
    pytest.importorskip("mujoco")
    monkeypatch.setitem(sys.modules, "mujoco.sysid", None)
    options = ("families=[rigid_body]", "true_model.quick=1", "output=study")
    answer = swarmtwin(*(one for one in EXPERIMENT if not one.startswith("families")), *options)
    assert answer.status == 2
    assert "pip install 'mujoco[sysid]>=4.0.0,<5'" in answer.error
    assert len(answer.error.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["robots=[create]"], "robot 'create' has no stand-in"),
        (["robots=[mrg]"], "robots: no such robot"),
        (["kinds=[tow]"], "kinds: no such kind: 'tow': did you mean 'two'?"),
        (["families=[formula]"], "families: no such family: 'formula': did you mean 'formulas'?"),
        (["true_model.quick=2"], "options: field 'true_model.quick'"),
        (["count.quick.two=-1"], "options: field 'count.quick.two'"),
        (["count.quick.two=0", "count.quick.clean=0"], "no session is left"),
    ],
)
def test_what_makes_no_sense_is_one_line(swarmtwin, workshop, options, message):
    answer = swarmtwin(*EXPERIMENT, *options, "output=study")
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin experiment: {message}"), answer.error
    assert len(answer.error.strip().splitlines()) == 1
    assert not (workshop / "study").exists()


@pytest.mark.services
def test_sessions_judged_on_a_cluster_are_those_judged_here(swarmtwin, workshop):
    pytest.importorskip("ray", reason="pip install 'swarmtwin[ray]'")
    few = ("families=[formulas]", "robots=[mgr]", "kinds=[one,clean]", "count.quick.one=1", "count.quick.clean=1")
    short = "lengths={runs: 12, steps: 40, reference_runs: 16}"
    study = ("experiment", "name=hidden_effects", *few, short)
    for where, output in (("processes=1", "here"), ("cluster=local", "there")):
        answer = swarmtwin(*study, where, f"output={output}")
        assert answer.status == 0, answer.error
    here, there = (pd.read_csv(workshop / output / "results.csv") for output in ("here", "there"))
    measured_anew = ["seconds", "learning_seconds", "memory_mb"]
    pd.testing.assert_frame_equal(here.drop(columns=measured_anew), there.drop(columns=measured_anew))


def test_a_cluster_without_ray_is_one_line(swarmtwin, workshop):
    if importlib.util.find_spec("ray"):
        pytest.skip("Ray is installed")
    answer = swarmtwin(*EXPERIMENT, "cluster=local", "output=study")
    assert answer.status == 2
    assert "cluster=local needs what is not installed here, ray: pip install 'swarmtwin[ray]'" in answer.error
