"""MR.CLAM files become tracks at the robot's period: planted drives are recovered, real ones are as they are known."""

import logging
from pathlib import Path

import numpy as np
import pytest

from swarmtwin.commands.app import run_command
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose, orientation_error_rad, position_error_mm, wrap_angle
from swarmtwin.recordings.importers.mrclam import Config
from swarmtwin.recordings.reading import read_recording
from swarmtwin.recordings.recording import Recording
from swarmtwin.transitions import from_recording

REAL_DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "mrclam6"
EPOCH_S = 1_248_444_175.0


def unicycle(command, duration_s):
    """Displacements (N, 3) of a unicycle that does exactly what v_mm_s, omega_rad_s (N, 2) say."""
    distance_mm, turn_rad = command[:, 0] * duration_s, command[:, 1] * duration_s
    half = turn_rad / 2
    chord_mm = distance_mm * np.sinc(half / np.pi)
    return np.stack([chord_mm * np.cos(half), chord_mm * np.sin(half), turn_rad], axis=-1)


def write_file(path, rows):
    path.write_text("# Time [s] ...\n" + "".join("\t ".join(f"{value:.8f}" for value in row) + " \n" for row in rows))


@pytest.fixture
def create(robots):
    return robots["create"]


@pytest.fixture
def planted(tmp_path):
    """Robots 1 and 2 drive 40 s as perfect unicycles, commands changing at whole seconds; poses begin 3 s earlier."""
    for number in (1, 2):
        generator = np.random.default_rng(number)
        changes = np.column_stack([generator.uniform(0, 0.09, 40), generator.uniform(-0.5, 0.5, 40)])
        sent_s = np.arange(0, 40, 0.02)
        sent = changes[sent_s.astype(int)]
        step_s = 0.01
        fine_s = np.arange(-3, 40, step_s)
        driven = np.where(fine_s[:, None] < -1e-9, 0.0, changes[np.maximum(fine_s + 1e-9, 0).astype(int)])
        moved = unicycle(driven * [1000, 1], step_s)
        pose = np.empty((len(fine_s), 3))
        pose[0] = [1000.0 * number, 2000.0, 0.5]
        for index in range(len(fine_s) - 1):
            pose[index + 1] = compose(pose[index], moved[index])
        write_file(tmp_path / f"Robot{number}_Odometry.dat", np.column_stack([EPOCH_S + 3 + sent_s, sent]))
        measured = np.column_stack([EPOCH_S + 3 + fine_s, pose[:, :2] / 1000, pose[:, 2]])
        write_file(tmp_path / f"Robot{number}_Groundtruth.dat", measured)
    return tmp_path


def transitions_of(robot, folder, **options):
    header, tracks = Config().read(folder, robot, **options)
    return from_recording(Recording(robot, header, tuple(tracks)))


def test_a_planted_drive_is_recovered(create, planted):
    transitions, counts = transitions_of(create, planted)
    assert counts.dropped == {}
    assert len(transitions) == 2 * 79
    predicted = unicycle(transitions.command, transitions.duration_s)
    assert position_error_mm(predicted, transitions.displacement).max() < 0.01
    assert orientation_error_rad(predicted, transitions.displacement).max() < 1e-4
    assert transitions.time_s.min() == 3.0


def test_commands_are_averaged_over_each_interval(create, planted):
    """At a tick half way between two whole seconds the interval ends at a change; from there it holds the next."""
    odometry = planted / "Robot1_Odometry.dat"
    write_file(odometry, [[EPOCH_S + 3, 0.01, 0.1], [EPOCH_S + 3.4, 0.06, -0.1], [EPOCH_S + 4.0, 0.0, 0.0]])
    _, tracks = Config().read(planted, create, vehicles=("1",))
    np.testing.assert_allclose(tracks[0].command[0], [0.8 * 10 + 0.2 * 60, 0.8 * 0.1 - 0.2 * 0.1], atol=1e-4)
    np.testing.assert_allclose(tracks[0].command[1], [60, -0.1], atol=1e-4)


def test_rows_out_of_order_are_sorted(create, planted):
    reference, _ = transitions_of(create, planted)
    for file in planted.iterdir():
        comment, *rows = file.read_text().splitlines()
        np.random.default_rng(0).shuffle(rows)
        file.write_text("\n".join([comment, *rows]) + "\n")
    shuffled, _ = transitions_of(create, planted)
    np.testing.assert_array_equal(shuffled.displacement, reference.displacement)
    np.testing.assert_array_equal(shuffled.command, reference.command)


def test_runs_are_cut_at_common_times_and_share_the_pose_between_them(create, planted):
    _, tracks = Config().read(planted, create, run_s=10.0)
    assert [(track.run, track.vehicle) for track in tracks] == [
        (f"run_{run:04d}", vehicle) for run in range(1, 6) for vehicle in ("1", "2")
    ]
    for earlier, later in zip(tracks, tracks[2:], strict=False):
        assert earlier.time_s[-1] == later.time_s[0] == 10.0 * int(earlier.run[-1])
        np.testing.assert_array_equal(earlier.pose[-1], later.pose[0])
        assert np.isnan(earlier.command[-1]).all()
    whole, _ = transitions_of(create, planted, run_s=1000.0)
    cut, _ = transitions_of(create, planted, run_s=10.0)
    assert len(cut) == len(whole)


def test_poses_are_not_invented_across_a_gap(create, planted):
    file = planted / "Robot1_Groundtruth.dat"
    comment, *rows = file.read_text().splitlines()
    kept = [row for row in rows if not 10.2 < float(row.split()[0]) - EPOCH_S < 11.7]
    file.write_text("\n".join([comment, *kept]) + "\n")
    reference, _ = transitions_of(create, planted, vehicles=("2",))
    transitions, counts = transitions_of(create, planted, vehicles=("1",))
    assert counts.dropped == {"no_pose": 4}
    lost = sorted(set(reference.time_s) - set(transitions.time_s))
    np.testing.assert_allclose(lost, [10.0, 10.5, 11.0, 11.5])


def test_a_command_is_not_held_for_longer_than_stated(create, planted):
    file = planted / "Robot1_Odometry.dat"
    comment, *rows = file.read_text().splitlines()
    kept = [row for row in rows if not 10.01 < float(row.split()[0]) - EPOCH_S < 12.99]
    file.write_text("\n".join([comment, *kept]) + "\n")
    _, counts = transitions_of(create, planted, vehicles=("1",))
    assert counts.dropped == {"no_command": 4}


def test_the_header_tells_source_and_start(create, planted):
    header, _ = Config().read(planted, create)
    assert (header.robot, header.period_s, header.vehicles) == ("create", 0.5, ("1", "2"))
    assert header.started_at == "2009-07-24T14:02:55.000+00:00"
    assert header.source == f"MR.CLAM, {planted.name} (Leung et al., IJRR 2011)"


# ---- what is refused


def refusal(robot, folder, **options):
    with pytest.raises(UserError) as refused:
        Config().read(folder, robot, **options)
    return str(refused.value)


def test_another_robot_is_refused(robots, planted):
    assert refusal(robots["mgr"], planted) == (
        "MR.CLAM is driven by v_mm_s, omega_rad_s, robot 'mgr' is not: add robot=create"
    )


def test_a_missing_folder_is_refused(create, tmp_path):
    message = f"no MR.CLAM folder {tmp_path}/none: name the one that holds Robot1_Groundtruth.dat"
    assert refusal(create, tmp_path / "none") == message


def test_a_folder_without_such_files_is_refused(create, tmp_path):
    message = f"{tmp_path} holds no MR.CLAM files: name the folder that holds Robot1_Groundtruth.dat"
    assert refusal(create, tmp_path) == message


def test_an_unknown_robot_is_refused(create, planted):
    assert refusal(create, planted, vehicles=("7",)) == f"{planted} holds no robot '7': known: 1, 2"


def test_a_missing_file_is_refused(create, planted):
    (planted / "Robot2_Odometry.dat").unlink()
    message = f"{planted}/Robot2_Odometry.dat is missing: a robot needs its Groundtruth and its Odometry file"
    assert refusal(create, planted) == message


@pytest.mark.parametrize(
    ("row", "fault"),
    [
        ("1248444180.0 0.1", "row 5: 2 numbers instead of 3"),
        ("1248444180.0 0.1 0.2 0.3", "row 5: 4 numbers instead of 3"),
        ("1248444180.0 fast 0.2", "row 5, column 'v': 'fast' is not a number"),
        ("1248444180.0 nan 0.2", "row 5, column 'v': 'nan' is not a number"),
        ("1248444180.0 0.1 inf", "row 5, column 'omega': 'inf' is not a number"),
    ],
)
def test_a_damaged_row_is_refused(create, planted, row, fault):
    file = planted / "Robot1_Odometry.dat"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:4], row, *lines[5:]]) + "\n")
    remedy = "rows hold time, v, omega; copy the file again from the data set"
    assert refusal(create, planted) == f"{file}, {fault}: {remedy}"


def test_an_empty_file_is_refused(create, planted):
    file = planted / "Robot1_Groundtruth.dat"
    file.write_text("# nothing\n")
    assert refusal(create, planted) == f"{file}: there are no rows: copy it again from the data set"


def test_files_of_different_sessions_are_refused(create, planted):
    file = planted / "Robot1_Odometry.dat"
    write_file(file, [[EPOCH_S + 90_000 + second, 0.1, 0.1] for second in range(9)])
    assert refusal(create, planted) == (
        f"{file}: robot 1 has no command while its pose is known: use files of one and the same data set"
    )


def test_a_last_row_cut_off_is_left_out_and_told(create, planted, caplog):
    file = planted / "Robot1_Odometry.dat"
    file.write_text(file.read_text()[:-9])
    with caplog.at_level(logging.WARNING):
        _, counts = transitions_of(create, planted)
    assert caplog.messages == [f"{file}: its last row is cut off and left out"]
    assert counts.kept == 2 * 79


# ---- the real robots


@pytest.mark.skipif(not REAL_DATA.is_dir(), reason="the MR.CLAM files are not beside the repository, in ../shared/data")
def test_real_robots_are_as_far_from_a_unicycle_as_they_are_known_to_be(create):
    """A shift in time or a wrong frame would show: known are 4.4 to 5.0 mm (mean) and 1.5 to 2.4° (RMS) a step."""
    transitions, counts = transitions_of(create, REAL_DATA)
    predicted = unicycle(transitions.command, transitions.duration_s)
    position_mm = position_error_mm(predicted, transitions.displacement)
    turn_rad = wrap_angle(predicted[:, 2] - transitions.displacement[:, 2])
    assert transitions.vehicles == ("1", "2", "3", "4", "5")
    assert set(counts.dropped) <= {"no_pose", "no_command"}
    for vehicle in range(5):
        of_vehicle = transitions.vehicle == vehicle
        assert 1500 <= of_vehicle.sum() <= 1770
        assert 4.35 < position_mm[of_vehicle].mean() < 5.05
        assert 1.45 < np.degrees(np.sqrt(np.mean(turn_rad[of_vehicle] ** 2))) < 2.45


def test_every_command_is_kept_at_the_time_it_was_sent(create, planted, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    imported = ("import", "robot=create", "source=mrclam", f"path={planted}", "output=imported")
    assert run_command(imported[0], list(imported[1:])) == 0
    sent = read_recording(tmp_path / "imported", create).sent
    assert set(sent) == {"1", "2"}
    time_s, command = sent["1"]
    assert len(time_s) == 2000
    np.testing.assert_allclose(np.diff(time_s), 0.02, atol=0.0011)
    track = next(one for one in read_recording(tmp_path / "imported", create).tracks if one.vehicle == "1")
    row = np.flatnonzero(np.isfinite(track.command[:, 0]))[3]
    within = (time_s >= track.time_s[row]) & (time_s < track.time_s[row] + create.period_s)
    np.testing.assert_allclose(command[within].mean(axis=0), track.command[row], rtol=0.05)
