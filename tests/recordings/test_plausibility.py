"""Recordings judged as a whole: mistakes are refused or warned of, what is unusual and sound is not refused."""

from dataclasses import replace

import numpy as np
import pytest
import whole_recordings
from whole_recordings import Judged, headed, in_unit, logged, posed, scaled, sound, timed, write

from swarmtwin.errors import UserError
from swarmtwin.recordings.reading import read_recording
from swarmtwin.robot import Arena
from swarmtwin.standin.physics import Physics

REFUSED, WARNED, TRUSTED = "refused", "warned", "trusted"


@pytest.fixture(autouse=True, scope="module")
def _quick_stand_ins():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Physics, "bank_rows", 2048)
        yield


@pytest.fixture
def judged(tmp_path):
    """Return what reading makes of a recording: refused, warned or trusted, and what it says."""
    count = iter(range(10_000))

    def judge(recording):
        folder = write(recording, tmp_path / str(next(count)))
        try:
            warnings = read_recording(folder, recording.robot).warnings
        except UserError as error:
            return REFUSED, str(error).removeprefix(f"{folder}: ")
        return WARNED if warnings else TRUSTED, "\n".join(warnings)

    return judge


def outcomes(judged, recordings) -> dict[str, list[Judged]]:
    found: dict[str, list[str]] = {REFUSED: [], WARNED: [], TRUSTED: []}
    for about, recording in recordings:
        outcome, text = judged(recording)
        found[outcome].append(f"{about}: {text}")
    return found


def test_of_200_mistakes_98_percent_are_refused_or_warned_of(judged):
    found = outcomes(judged, whole_recordings.mistaken())
    assert sum(map(len, found.values())) >= 200
    assert len(found[TRUSTED]) <= 0.02 * 200, found[TRUSTED]
    assert len(found[REFUSED]) >= 150


@pytest.mark.claims
def test_none_of_200_unusual_but_sound_recordings_is_refused(judged):
    found = outcomes(judged, whole_recordings.unusual())
    assert sum(map(len, found.values())) >= 200
    assert not found[REFUSED]
    assert len(found[WARNED]) <= 0.1 * 200, found[WARNED]


@pytest.mark.parametrize("robot", ["mgr", "mur", "create"])
@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (scaled(0.001), "are they in metres? Multiply x_mm, y_mm by 1000"),
        (scaled(1 / 25.4), "are they in inches? Multiply x_mm, y_mm by 25.4"),
        (in_unit(180 / np.pi), "are headings in degrees? Multiply heading_rad by 0.0174533"),
        (headed(-1), "do headings count clockwise? Multiply heading_rad by −1"),
        (headed(1, np.pi), "are markers mounted backwards? Add 3.14159 to heading_rad"),
        (posed(lambda pose: pose[:, [1, 0, 2]]), "are x_mm and y_mm exchanged? Exchange the columns"),
        (timed(lambda time_s: time_s * 1000), "are times in milliseconds? Multiply time_s by 0.001"),
    ],
    ids=["metres", "inches", "degrees", "clockwise", "backwards", "exchanged", "milliseconds"],
)
def test_the_refusal_names_the_mistake_and_what_to_do(judged, robot, edit, said):
    outcome, text = judged(edit(sound(robot, seed=3)))
    assert (outcome, said in text) == (REFUSED, True), text


def test_undoing_the_mistake_that_is_named_gives_a_recording_that_is_trusted(judged):
    mirrored = whole_recordings.mirrored_y(sound("mgr", seed=4))
    assert "does y point down" in judged(mirrored)[1]
    assert judged(whole_recordings.mirrored_y(mirrored)) == (TRUSTED, "")


def test_a_contradiction_that_a_person_has_looked_at_is_a_warning(judged):
    recording = headed(-1)(sound("mgr", seed=3))
    header = recording.header.model_copy(update={"accept": ("frame",)})
    outcome, text = judged(type(recording)(recording.robot, header, recording.tracks))
    assert outcome == WARNED
    assert "do headings count clockwise?" in text


def test_an_arena_in_metres_as_well_does_not_hide_that_poses_are(judged):
    recording = scaled(0.001)(sound("mgr", seed=3))
    arena = recording.header.arena_mm
    in_metres = Arena(x=tuple(value / 1000 for value in arena.x), y=tuple(value / 1000 for value in arena.y))
    header = recording.header.model_copy(update={"arena_mm": in_metres})
    outcome, text = judged(replace(recording, header=header))
    assert outcome == REFUSED
    assert "are they in another unit? Bring x_mm, y_mm to mm" in text


def test_too_few_rows_say_nothing(judged):
    recording = scaled(0.001)(sound("mgr", seed=3))
    short = whole_recordings.tracked(
        lambda track: type(track)(track.run, track.vehicle, track.time_s[:30], track.command[:30], track.pose[:30])
    )(recording)
    assert judged(short)[0] == TRUSTED


def test_a_vehicle_whose_marker_is_mounted_backwards_is_named(judged):
    recording = sound("mgr", seed=5, vehicles=3)
    turned = headed(1, np.pi)(recording.where(lambda track: track.vehicle == "2"))
    rest = recording.where(lambda track: track.vehicle != "2")
    mixed = type(recording)(recording.robot, recording.header, rest.tracks + turned.tracks)
    outcome, text = judged(mixed)
    assert outcome == REFUSED
    assert text.startswith("vehicle '2': vehicles move away from where they head")


def test_a_recording_without_commands_is_not_judged_by_them(judged, recwarn):
    recording = whole_recordings.commanded(lambda command: command * np.nan)(sound("mgr", seed=3))
    assert judged(recording)[0] == TRUSTED
    assert not recwarn.list


@pytest.mark.parametrize("robot", ["mgr", "mur", "create"])
@pytest.mark.parametrize(
    ("ahead_s", "outcome", "said"),
    [
        (0.0, TRUSTED, ""),
        (0.05, TRUSTED, ""),
        (7.3, REFUSED, "other commands were in force than the rows of vehicle '1' have: bring the times"),
        (-7.3, REFUSED, "other commands were in force"),
        (1.8e9, REFUSED, "no command of vehicle '1' in the time of any of its rows"),
    ],
)
def test_a_log_of_commands_by_another_clock_is_refused(judged, robot, ahead_s, outcome, said):
    found, text = judged(logged(ahead_s)(sound(robot, seed=3)))
    assert (found, said in text) == (outcome, True), text


def test_a_log_of_other_vehicles_or_of_half_of_the_rows_is_told(judged):
    recording = logged(0.0)(sound("mgr", seed=3))
    (time_s, command), *_ = recording.sent.values()
    found, text = judged(replace(recording, sent={"01": (time_s, command)}))
    assert found == WARNED
    assert "commands.parquet has no commands of vehicle '1', but of '01': the rows' commands are taken" in text
    half = len(time_s) // 2
    found, text = judged(replace(recording, sent={"1": (time_s[:half], command[:half])}))
    assert found == WARNED
    assert "commands.parquet says what was in force in " in text


def test_a_log_that_a_person_has_looked_at_is_a_warning(judged):
    recording = logged(7.3)(sound("mgr", seed=3))
    header = recording.header.model_copy(update={"accept": ("clock",)})
    assert judged(replace(recording, header=header))[0] == WARNED
