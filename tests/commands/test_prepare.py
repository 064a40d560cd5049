"""`swarmtwin prepare` leaves transitions, scaling and counts, the same every time, or nothing at all."""

import json

import mlflow
import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest

from drives import drive, write_drive
from swarmtwin.commands import prepare
from swarmtwin.errors import UserError
from swarmtwin.recordings.reading import read_recording
from swarmtwin.tracking.store import use_store
from swarmtwin.transitions import SPLITS, from_recording, load_preparation, load_transitions

SPLIT = {"fractions": {"train": 0.85, "validation": 0.05, "test": 0.10}, "seed": 1}


@pytest.fixture
def recording(robots, tmp_path):
    """Twenty runs of ten transitions, with a pose lost, a command lost and a row twice in the first."""
    folder = write_drive(tmp_path / "monday", robots["mgr"], drive(robots["mgr"], runs=20, vehicles=("1",)))
    file = folder / "runs" / "run_00000.csv"
    rows = [line.split(",") for line in file.read_text().splitlines()]
    rows[3][2:4] = ["", ""]
    rows[6][4:7] = ["", "", ""]
    rows.insert(8, rows[7])
    file.write_text("".join(",".join(row) + "\n" for row in rows))
    return folder


@pytest.fixture
def options(robots, recording, tmp_path):
    def with_changes(**changes):
        chosen = {
            "robot": robots["mgr"].model_dump(),
            "recording": str(recording),
            "split": SPLIT,
            "pictures": True,
            "output": str(tmp_path / "prepared"),
            "overwrite": False,
        }
        return prepare.Options.parse(chosen | changes, "swarmtwin prepare")

    return with_changes


def test_the_folder_holds_what_the_recording_gives(robots, recording, options, tmp_path):
    prepare.run(options())
    found = load_transitions(tmp_path / "prepared")
    expected, counts = from_recording(read_recording(recording, robots["mgr"]))
    np.testing.assert_array_equal(found.displacement, expected.displacement)
    np.testing.assert_array_equal(found.previous_command, expected.previous_command)
    preparation = load_preparation(tmp_path / "prepared")
    assert preparation.counts.dropped == counts.dropped == {"no_command": 1, "no_pose": 2}
    assert preparation.counts.dropped_rows == {"duplicate_row": 1}
    assert [len(preparation.runs[split]) for split in SPLITS] == [17, 1, 2]
    assert preparation.recording == "monday"


def test_preparing_twice_gives_the_same_bytes(options, tmp_path):
    prepare.run(options())
    prepare.run(options(output=str(tmp_path / "again")))
    for name in ("transitions.parquet", "preparation.json"):
        assert (tmp_path / "prepared" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_nothing_but_the_provenance_knows_where_the_recording_lay(recording, options, tmp_path):
    prepare.run(options())
    moved = recording.rename(tmp_path / "deeper").rename(tmp_path / "monday")
    prepare.run(options(recording=str(moved), output=str(tmp_path / "again")))
    for name in ("transitions.parquet", "preparation.json"):
        content = (tmp_path / "prepared" / name).read_bytes()
        assert str(tmp_path).encode() not in content
        assert content == (tmp_path / "again" / name).read_bytes()


def test_the_tables_say_what_was_kept_and_dropped_and_why(options, capsys):
    prepare.run(options())
    shown = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in shown.splitlines() if line.startswith("│")]
    assert rows == [
        ["rows read", "220", ""],
        ["duplicate_row", "1", "a row that repeats the one before it is left out"],
        ["pairs of rows", "200", ""],
        ["no_command", "1", "no command at the start"],
        ["no_pose", "2", "no pose at the start or at the end"],
        ["transitions kept", "197", "98.50%"],
        ["train", "17", "167", "84.8%"],
        ["validation", "1", "10", "5.1%"],
        ["test", "2", "20", "10.2%"],
    ]


def test_too_few_runs_leave_nothing_behind(robots, options, tmp_path):
    short = write_drive(tmp_path / "short", robots["mgr"], drive(robots["mgr"], runs=2))
    with pytest.raises(UserError, match=r"^2 runs with transitions cannot be split .*: record at least 3 runs"):
        prepare.run(options(recording=str(short)))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["monday", "short"]


def test_the_recording_is_never_overwritten(recording, options, tmp_path):
    for output in (recording, tmp_path):
        with pytest.raises(UserError) as refused:
            prepare.run(options(output=str(output), overwrite=True))
        assert str(refused.value) == f"output {output} would replace the input {recording}: choose another folder"
    assert (recording / "recording.yaml").exists()


def test_preparing_again_replaces_only_what_was_prepared(options, tmp_path):
    prepare.run(options())
    with pytest.raises(UserError, match="already holds something"):
        prepare.run(options(split=SPLIT | {"seed": 2}))
    prepare.run(options(split=SPLIT | {"seed": 2}, overwrite=True))
    assert load_preparation(tmp_path / "prepared").seed == 2
    assert json.loads((tmp_path / "prepared" / "provenance.json").read_text())["command"] == "prepare"


def test_unknown_and_wrong_options_are_refused(options):
    with pytest.raises(UserError, match=r"swarmtwin prepare: unknown field 'outptu': did you mean 'output'\?"):
        options(outptu="x")
    with pytest.raises(UserError, match=r"must sum to 1, not 0\.9"):
        options(split={"fractions": {"train": 0.8, "validation": 0.0, "test": 0.1}, "seed": 1})


def test_a_warning_stays_with_what_is_prepared_and_learned(swarmtwin, workshop):
    for file in (workshop / "reference" / "runs").iterdir():
        rows = pd.read_csv(file)
        rows[["x_mm", "y_mm"]] *= 0.6
        rows.to_csv(file, index=False)
    answer = swarmtwin("prepare", "recording=reference", "output=prepared", "pictures=false")
    assert answer.status == 0, answer.error
    (warning,) = load_preparation(workshop / "prepared").warnings
    assert "from its origin on: are they in pixels?" in warning
    assert f"warning: {warning}" in answer.shown
    options = ("model=kinematic", "model.steps=5", "seeds=1", "register=false", "pictures=false")
    assert swarmtwin("train", "transitions=prepared", *options, "output=model").status == 0
    use_store()
    (run,) = mlflow.search_runs(experiment_names=["swarmtwin/dynamics"], output_format="list")
    assert run.data.tags["recording.warnings"] == warning


@pytest.mark.parametrize(
    ("column", "factor", "said"),
    [
        (["x_mm", "y_mm"], 0.001, "are they in metres? Multiply x_mm, y_mm by 1000"),
        (["heading_rad"], 180 / np.pi, "are headings in degrees? Multiply heading_rad by 0.0174533"),
        (["time_s"], 1000, "are times in milliseconds? Multiply time_s by 0.001"),
        (["left", "right"], 1 / 120, "are left, right shares of the limits? Multiply them by the limits"),
    ],
)
def test_a_wrong_unit_is_one_line_and_leaves_nothing(swarmtwin, workshop, column, factor, said):
    for file in (workshop / "reference" / "runs").iterdir():
        rows = pd.read_csv(file)
        rows[column] *= factor
        rows.to_csv(file, index=False)
    answer = swarmtwin("prepare", "recording=reference", "output=prepared")
    assert answer.status == 2
    assert answer.error.startswith("swarmtwin prepare: reference: ")
    assert said in answer.error
    assert answer.error.count("\n") == 1
    assert not (workshop / "prepared").exists()


@pytest.mark.parametrize("command", ["prepare", "train"])
def test_a_recording_damaged_in_the_middle_leaves_nothing(swarmtwin, robots, workshop, command):
    folder = write_drive(workshop / "monday", robots["mgr"], drive(robots["mgr"], runs=60, steps=30), "one_file")
    file = folder / "runs.parquet"
    table = pyarrow.parquet.read_table(file)
    pyarrow.parquet.write_table(table, file, row_group_size=100, write_page_checksum=True, use_dictionary=False)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(content)
    before = sorted(path.name for path in workshop.iterdir())
    answer = swarmtwin(command, "robot=mgr", "recording=monday", "output=out")
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin {command}: monday/runs.parquet: no Parquet file can be read (")
    assert answer.error.endswith("): the file is damaged or cut off; copy it again from where it was recorded\n")
    assert sorted(path.name for path in workshop.iterdir()) == before
