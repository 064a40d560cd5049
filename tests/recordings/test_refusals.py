"""What cannot be read is refused, word for word: file, row, column, what is wrong, remedy."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from edits import edit_header, lines_of, replace_cell, write_lines

from drives import drive, write_drive
from swarmtwin.errors import UserError
from swarmtwin.recordings.reading import read_recording


@pytest.fixture
def mgr(robots):
    return robots["mgr"]


@pytest.fixture
def folder(mgr, tmp_path):
    """A clean recording: runs run_00000 and run_00001 of vehicles 1 and 2, five ticks each."""
    return write_drive(tmp_path / "recording", mgr, drive(mgr, runs=2, steps=4))


def refusal(folder, robot):
    with pytest.raises(UserError) as refused:
        read_recording(folder, robot)
    return str(refused.value)


def test_no_folder(mgr, tmp_path):
    missing = tmp_path / "none"
    assert refusal(missing, mgr) == (
        f"no recording folder {missing}: name a folder that holds recording.yaml and runs/"
    )


def test_no_header(mgr, folder):
    (folder / "recording.yaml").unlink()
    assert refusal(folder, mgr) == f"{folder}/recording.yaml is missing: a recording holds recording.yaml and runs/"


def test_header_is_not_yaml(mgr, folder):
    (folder / "recording.yaml").write_text("robot: mgr\nperiod_s: [0.5\n")
    assert refusal(folder, mgr) == (
        f"{folder}/recording.yaml, row 3: not valid YAML (did not find expected ',' or ']'): correct the file"
    )


def test_header_is_no_mapping(mgr, folder):
    (folder / "recording.yaml").write_text("mgr")
    assert refusal(folder, mgr) == (
        f"{folder}/recording.yaml: there are no fields: write robot, period_s, arena_mm and source, one a line"
    )


@pytest.mark.parametrize(("sign", "name"), [(";", "semicolons"), ("\t", "tabs")])
def test_columns_separated_by_something_else(mgr, folder, sign, name):
    file = folder / "runs" / "run_00000.csv"
    file.write_text(file.read_text().replace(",", sign))
    said = f"columns are separated by {name}: save it again with commas, and points in numbers"
    assert refusal(folder, mgr) == f"{file}, row 1: {said}"


def test_header_with_an_unknown_field(mgr, folder):
    file = edit_header(folder, vehicle=["1"])
    assert refusal(folder, mgr) == (
        f"{file}: unknown field 'vehicle': did you mean 'vehicles'? "
        "known: accept, arena_mm, notes, period_s, robot, source, started_at, vehicles"
    )


def test_header_without_a_field(mgr, folder):
    file = edit_header(folder, period_s="absent")
    assert refusal(folder, mgr) == f"{file}: field 'period_s': Field required"


def test_arena_the_wrong_way_round(mgr, folder):
    file = edit_header(folder, arena_mm={"x": [1030, 0], "y": [0, 1030]})
    assert refusal(folder, mgr) == (
        f"{file}: field 'arena_mm.x': Value error, the lower bound must be below the upper one, got [1030.0, 0.0]"
    )


def test_recording_of_another_robot(mgr, folder):
    file = edit_header(folder, robot="mur")
    assert refusal(folder, mgr) == (
        f"{file}: the recording is of robot 'mur', not of 'mgr': add robot=mur, or choose another recording"
    )


def test_another_period(mgr, folder):
    file = edit_header(folder, period_s=0.1)
    assert refusal(folder, mgr) == (
        f"{file}, column 'period_s': the period is 0.1 s, that of robot 'mgr' is 0.5 s: "
        "correct it, or describe the robot with its own file in conf/robot/"
    )


def test_no_runs_folder(mgr, folder):
    (folder / "runs").rename(folder / "Runs")
    assert refusal(folder, mgr) == (
        f"{folder}/runs is missing: put one file a run there, .csv or .parquet, or all in runs.parquet beside it"
    )


@pytest.fixture
def together(mgr, tmp_path):
    """A recording of two runs in one file."""
    return write_drive(tmp_path / "together", mgr, drive(mgr, runs=2, steps=4), "one_file")


def test_runs_in_a_folder_and_in_one_file(mgr, together):
    (together / "runs").mkdir()
    assert refusal(together, mgr) == f"{together} holds both runs/ and runs.parquet: remove one of them"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop_columns("run"), "column 'run' is missing: add it: the name of the run that each row is of"),
        (
            lambda t: t.take(np.argsort(np.arange(len(t)) % 3, kind="stable")),
            "row 8: the rows of run 'run_00000' do not stand together: sort the rows by run",
        ),
        (
            lambda t: t.set_column(0, "run", pa.array([None, *t["run"].to_pylist()[1:]])),
            "row 1, column 'run': no run is named: write the run's name",
        ),
        (
            lambda t: t.set_column(0, "run", pa.array(np.linspace(0, 1, len(t)))),
            "column 'run': values of type double instead of text: store text",
        ),
        (lambda t: t.slice(0, 0), "there are no rows: record again, or remove the file"),
    ],
)
def test_a_file_of_all_runs_with_a_mistake(mgr, together, change, message):
    file = together / "runs.parquet"
    pyarrow.parquet.write_table(change(pyarrow.parquet.read_table(file)), file)
    said = refusal(together, mgr)
    assert said.startswith(f"{file}")
    assert said.endswith(message)


def test_a_file_of_all_runs_that_breaks_off(mgr, together):
    file = together / "runs.parquet"
    file.write_bytes(file.read_bytes()[:-200])
    assert "the file is damaged or cut off; copy it again" in refusal(together, mgr)


def test_no_runs(mgr, folder):
    for file in (folder / "runs").iterdir():
        file.rename(file.with_suffix(".txt"))
    assert refusal(folder, mgr) == (
        f"{folder}/runs holds no run, only run_00000.txt, run_00001.txt: put one file a run there, .csv or .parquet"
    )


def test_a_run_in_both_formats(mgr, folder):
    (folder / "runs" / "run_00001.parquet").touch()
    assert refusal(folder, mgr) == (
        f"{folder}/runs: run 'run_00001' stands there twice, as CSV and as Parquet: remove one of them"
    )


def test_an_empty_file(mgr, folder):
    file = folder / "runs" / "run_00001.csv"
    file.write_text("")
    assert refusal(folder, mgr) == f"{file}: the file is empty: record the run again, or remove the file"


def test_a_header_alone(mgr, folder):
    file = write_lines(folder, lines_of(folder)[:1])
    assert refusal(folder, mgr) == (f"{file}: there is a header and no rows: record the run again, or remove the file")


def test_a_file_cut_off_in_its_header(mgr, folder):
    file = folder / "runs" / "run_00000.csv"
    file.write_text("time_s,vehicle,le")
    assert refusal(folder, mgr) == (
        f"{file}: the file breaks off in its header: record the run again, or remove the file"
    )


def test_a_missing_column_with_a_near_miss(mgr, folder):
    header, *rows = lines_of(folder)
    file = write_lines(folder, [header.replace("left", "Left"), *rows])
    assert refusal(folder, mgr) == (
        f"{file}, row 1: column 'left' is missing, there are time_s, vehicle, Left, right, x_mm, y_mm, heading_rad: "
        "rename 'Left' to 'left'"
    )


def test_a_missing_column(mgr, folder):
    file = write_lines(folder, [",".join(line.split(",")[:-1]) for line in lines_of(folder)])
    assert refusal(folder, mgr) == (
        f"{file}, row 1: column 'heading_rad' is missing, there are time_s, vehicle, left, right, x_mm, y_mm: "
        "add it; 'mgr' needs them all"
    )


def test_a_missing_column_of_a_robot_that_is_commanded_like_another(mgr, folder):
    own = mgr.model_copy(update={"name": "pupil"})
    edit_header(folder, robot="pupil")
    write_lines(
        folder,
        [",".join(part for place, part in enumerate(line.split(",")) if place != 1) for line in lines_of(folder)],
    )
    assert "row 1: column 'vehicle' is missing, there are time_s, left, right" in refusal(folder, own)


def test_a_column_twice(mgr, folder):
    file = write_lines(folder, [f"{line},{'left' if row == 0 else '1'}" for row, line in enumerate(lines_of(folder))])
    assert refusal(folder, mgr) == f"{file}, row 1: column 'left' stands twice: keep one of them"


def test_the_columns_of_another_robot(robots, tmp_path):
    folder = write_drive(tmp_path / "recording", robots["mur"], drive(robots["mur"]))
    edit_header(folder, robot="mgr", period_s=0.5)
    assert refusal(folder, robots["mgr"]) == (
        f"{folder}/runs/run_00000.csv, row 1: the columns are those of robot 'mur', not of 'mgr': "
        "put the file in a recording of 'mur', and read that one"
    )


def test_text_in_a_number(mgr, folder):
    file = replace_cell(folder, 7, "x_mm", "12 3")
    assert refusal(folder, mgr) == (
        f"{file}, row 7, column 'x_mm': '12 3' is not a number: write a number, or leave the cell empty"
    )


def test_rows_are_counted_as_an_editor_does(mgr, folder):
    header, *rows = lines_of(folder)
    rows[5] = rows[5].replace(rows[5].split(",")[2], "fast")
    file = write_lines(folder, ["", header, *rows[:3], "", "", *rows[3:]])
    assert refusal(folder, mgr).startswith(f"{file}, row 10, column 'left': 'fast' is not a number")


def test_a_fault_far_down_a_long_file(mgr, tmp_path):
    folder = write_drive(tmp_path / "recording", mgr, drive(mgr, runs=1, steps=400_000, vehicles=("1",)))
    file = folder / "runs" / "run_00000.csv"
    content = file.read_bytes()
    assert len(content) > 1 << 24
    file.write_bytes(content[:-2] + b"x\n")
    assert refusal(folder, mgr).startswith(f"{file}, row 400002, column 'heading_rad': ")


def test_a_row_with_too_few_fields(mgr, folder):
    lines = lines_of(folder)
    file = write_lines(folder, [*lines[:4], "1.0,2", *lines[5:]])
    assert refusal(folder, mgr) == (
        f"{file}, row 5: 2 fields instead of 7: give every row the header's columns, separated by commas"
    )


def test_a_damaged_parquet(mgr, tmp_path):
    folder = write_drive(tmp_path / "recording", mgr, drive(mgr), "parquet")
    file = folder / "runs" / "run_00001.parquet"
    file.write_bytes(file.read_bytes()[:-100])
    message = refusal(folder, mgr)
    assert message.startswith(f"{file}: no Parquet file can be read (")
    assert message.endswith("): the file is damaged or cut off; copy it again from where it was recorded")


def test_text_in_a_parquet(mgr, tmp_path):
    folder = write_drive(tmp_path / "recording", mgr, drive(mgr), "parquet")
    file = folder / "runs" / "run_00000.parquet"
    table = pa.parquet.read_table(file)
    pa.parquet.write_table(table.set_column(2, "left", table["left"].cast(pa.string())), file)
    assert refusal(folder, mgr) == f"{file}, column 'left': values of type string instead of numbers: store numbers"


def test_a_parquet_with_numbers_for_vehicles(mgr, tmp_path):
    folder = write_drive(tmp_path / "recording", mgr, drive(mgr), "parquet")
    for file in (folder / "runs").iterdir():
        table = pa.parquet.read_table(file)
        pa.parquet.write_table(table.set_column(1, "vehicle", table["vehicle"].cast(pa.int64())), file)
    assert read_recording(folder, mgr).vehicles == ("1", "2")


def test_a_nul_byte(mgr, folder):
    lines = lines_of(folder)
    file = write_lines(folder, [*lines[:3], lines[3] + "\0", *lines[4:]])
    assert refusal(folder, mgr) == (
        f"{file}, row 4: a NUL byte: the file is damaged or no CSV file; copy it again from where it was recorded"
    )


def test_bytes_that_are_no_text(mgr, folder):
    file = folder / "runs" / "run_00000.csv"
    content = file.read_bytes()
    end_of_row_2 = content.index(b"\n", content.index(b"\n") + 1)
    file.write_bytes(content[: end_of_row_2 + 1] + b"\xff" + content[end_of_row_2 + 1 :])
    assert refusal(folder, mgr) == (
        f"{file}, row 3: bytes that are not UTF-8 text: "
        "save it as UTF-8; or the file is damaged or no CSV file; copy it again from where it was recorded"
    )


def test_a_stray_quotation_mark(mgr, folder):
    file = replace_cell(folder, 6, "vehicle", '"2')
    assert refusal(folder, mgr) == f"{file}, row 6: a quotation mark without its partner: remove it"


def test_time_running_backwards(mgr, folder):
    file = replace_cell(folder, 6, "time_s", "0.25")
    assert refusal(folder, mgr) == (
        f"{file}, row 6, column 'time_s': vehicle '1' goes back in time, from 0.5 s to 0.25 s: "
        "sort the rows by time; where the clock was set back, begin another run; a session is a recording"
    )


def test_two_vehicles_with_one_id(mgr, folder):
    file = replace_cell(folder, 5, "vehicle", "1")
    assert refusal(folder, mgr) == (
        f"{file}, row 5, column 'vehicle': vehicle '1' has two different rows at 0.5 s, as if two vehicles had one id: "
        "give each vehicle its own id"
    )


def test_a_vehicle_that_the_header_does_not_know(mgr, folder):
    file = replace_cell(folder, 5, "vehicle", "02")
    assert refusal(folder, mgr) == (
        f"{file}, row 5, column 'vehicle': vehicle '02' is not among those of recording.yaml (1, 2): "
        "correct the id, or add it there"
    )


def test_a_row_without_a_vehicle(mgr, folder):
    file = replace_cell(folder, 5, "vehicle", "")
    assert refusal(folder, mgr) == f"{file}, row 5, column 'vehicle': no vehicle is named: write the vehicle's id"


def test_an_unreadable_file(mgr, folder):
    file = folder / "runs" / "run_00000.csv"
    file.unlink()
    file.symlink_to(folder / "nowhere")
    assert refusal(folder, mgr) == (
        f"{file}: it cannot be read (No such file or directory): check that it is there and may be read"
    )
