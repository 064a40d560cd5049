"""`swarmtwin experiment name=hidden_effects`: it goes on where it was interrupted, and writes all tables."""

import json

import pandas as pd
import pytest

from case_results import result
from swarmtwin.studies.hidden_effects.cases import VARIETIES
from swarmtwin.studies.hidden_effects.metrics import Proportion

STUDY = "swarmtwin.studies.hidden_effects.study"
EXPERIMENT = ("experiment", "name=hidden_effects", "cases=[pair,clean]", "count.pair=2", "count.clean=1", "processes=1")


def test_the_command_goes_on_where_it_was_interrupted_and_writes_all_tables(swarmtwin, workshop, monkeypatch):
    asked = []

    def examined(case, robot, reference, with_baselines):
        if len(asked) == 7 and "again" not in asked:
            raise KeyboardInterrupt
        asked.append(case.key)
        names = list(case.true_names)
        planted = result(case.kind, case.variety, names, robot=case.robot)
        return planted.model_copy(update={"case": case})

    monkeypatch.setattr(f"{STUDY}.score_case", examined)
    monkeypatch.setattr(f"{STUDY}.learned_reference", lambda robot, options, seed: None)
    assert swarmtwin(*EXPERIMENT, "output=study").status == 130
    assert not (workshop / "study").exists()
    first = list(asked)
    asked.append("again")
    answer = swarmtwin(*EXPERIMENT, "output=study")
    assert answer.status == 0, answer.error
    cases = 2 * (2 + len(VARIETIES))
    assert len(asked) == cases + 1
    assert len(set(asked)) == cases + 1
    assert first == asked[:7]
    folder = workshop / "study"
    table = pd.read_csv(folder / "results.csv")
    assert len(table) == cases
    assert (table.exact == 1).all()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["pair"]["exact"] == Proportion.of([True] * 4).model_dump()
    assert metrics["clean"]["accused"]["count"] == 0
    for name in ("confusion.png", "detection.png", "parameters.png", "clean.png", "parameters.csv", "report.md"):
        assert (folder / name).stat().st_size > 0
    assert "two effects: exactly these" in answer.shown
    assert "100.0% (4/4)" in (folder / "report.md").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["robots=[create]"], "robot 'create' has no stand-in"),
        (["robots=[mrg]"], "robots: no such robot"),
        (["cases=[singles]"], "cases: no such kind: 'singles': did you mean 'single'?"),
        (["count.pair=0"], "options: field 'count.pair'"),
    ],
)
def test_what_makes_no_sense_is_one_line(swarmtwin, workshop, options, message):
    answer = swarmtwin(*EXPERIMENT, *options, "output=study")
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin experiment: {message}"), answer.error
    assert len(answer.error.strip().splitlines()) == 1
    assert not (workshop / "study").exists()
