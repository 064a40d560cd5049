"""The platform on robots that nobody simulated: MR.CLAM, five iRobot Create."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from swarmtwin.commands.app import run_command
from swarmtwin.diagnosis.diagnose import diagnose
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.result import Estimate
from swarmtwin.diagnosis.settings import DiagnosisSettings, SearchSettings, VerdictSettings
from swarmtwin.recordings.reading import read_recording
from swarmtwin.transitions import from_recording
from swarmtwin.transitions.inputs import read_vehicles

MRCLAM = Path(__file__).resolve().parents[2] / "shared" / "data" / "mrclam6"

pytestmark = pytest.mark.skipif(
    not MRCLAM.is_dir(), reason="the MR.CLAM data, which are not ours to ship, are not here"
)


def call(*arguments):
    assert run_command(arguments[0], list(arguments[1:])) == 0


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with the recording of all five robots, and the models of robot 1 measured on robots 2 to 5."""
    folder = tmp_path_factory.mktemp("real")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        call("import", "source=mrclam", f"path={MRCLAM}", "output=recording")
        for model in ("kinematic", "mlp"):
            learn = ("recipe.batch_size=256", "model.steps=400", "seeds=1", "register=false")
            call(
                "train",
                "robot=create",
                f"model={model}",
                "recording=recording",
                "vehicles=1",
                *learn,
                f"output={model}",
            )
            measured = ("recording=recording", "vehicles=[2,3,4,5]", f"output=measured/{model}")
            call("evaluate", "robot=create", f"simulation={model}", *measured)
    return folder


@pytest.fixture(scope="module")
def measured(workplace):
    """What `evaluate` found, by model."""
    return {
        model: json.loads((workplace / "measured" / model / "metrics.json").read_text())
        for model in ("kinematic", "mlp")
    }


@pytest.fixture(scope="module")
def unicycle(workplace, robots):
    """The plain unicycle's errors on each transition, (N,) in mm and in degrees, by robot."""
    transitions, _ = from_recording(read_recording(workplace / "recording", robots["create"]))
    speed_mm_s, turn_rate_rad_s = transitions.command.T
    turn_rad = turn_rate_rad_s * transitions.duration_s
    chord_mm = speed_mm_s * transitions.duration_s * np.sinc(turn_rad / 2 / np.pi)
    forward_mm, left_mm = chord_mm * np.cos(turn_rad / 2), chord_mm * np.sin(turn_rad / 2)
    position_mm = np.hypot(transitions.displacement[:, 0] - forward_mm, transitions.displacement[:, 1] - left_mm)
    orientation_deg = abs(np.angle(np.exp(1j * (transitions.displacement[:, 2] - turn_rad)), deg=True))
    names = np.array(transitions.vehicles)[transitions.vehicle]
    return {name: (position_mm[names == name], orientation_deg[names == name]) for name in transitions.vehicles}


def test_there_are_as_many_transitions_as_its_description_says(measured):
    assert sorted(measured["mlp"]["vehicles"]) == ["2", "3", "4", "5"]
    for part in measured["mlp"]["vehicles"].values():
        assert 1500 <= part["transitions"] <= 1770


def test_the_plain_unicycle_errs_as_its_description_says(unicycle):
    """4.4 to 5.0 mm and 1.5 to 2.4 degrees: these are mean positions, but root mean square orientations."""
    position_mm = [round(position.mean(), 1) for position, _ in unicycle.values()]
    orientation_deg = [round(np.sqrt((orientation**2).mean()), 1) for _, orientation in unicycle.values()]
    assert (min(position_mm), max(position_mm)) == (4.4, 5.0)
    assert (min(orientation_deg), max(orientation_deg)) == (1.5, 2.4)


@pytest.mark.parametrize("model", ["kinematic", "mlp"])
def test_nobody_claims_to_know_the_floor_of_real_robots(measured, model):
    figures = measured[model]
    assert figures["floor"]["kind"] == "nearest_neighbours"
    assert figures["model_error"] is None
    assert (
        0.07 < figures["floor"]["position_mm"]["mean"] < figures["one_step"]["position_mm"]["mean"]
    )  # 0.07: the sensor


def test_the_learned_model_predicts_positions_better_than_the_plain_unicycle_on_robots_it_has_never_seen(
    measured, unicycle
):
    """By a tenth on each robot. Orientations it does not predict better: both are where the floor is estimated."""
    for name, part in measured["mlp"]["vehicles"].items():
        assert part["one_step"]["position_mm"]["mean"] < 0.9 * unicycle[name][0].mean()


def test_robots_of_which_nothing_was_learned_count_in_all_their_runs(measured):
    runs = {name: part["open_loop"]["runs"] for name, part in measured["mlp"]["vehicles"].items()}
    assert runs == {"2": 30, "3": 30, "4": 30, "5": 30}


def test_tables_of_the_paper_are_made_of_one_robot_measured_on_the_four_others(workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    vehicles = ("train_vehicle=recording", "train_vehicles=1", "other_vehicle=recording", "other_vehicles=[2,3,4,5]")
    quick = (
        "models=[mlp]",
        "generators=[]",
        "recipe.batch_size=256",
        "scales.quick.steps=100",
        "scales.quick.seeds=2",
        "processes=1",
    )
    call("experiment", "name=table1", "robot=create", *vehicles, *quick, "pictures=false", "output=table1")
    table = pd.read_csv("table1/table.csv").set_index(["title", "recording"])
    assert table.transitions["mlp-R", "other_vehicle"] > 4 * 1500
    assert table.transitions["mlp-R", "train_vehicle"] < 1500 / 4  # held-out blocks of the vehicle learned from
    assert table.floor_command_kind["mlp-R", "other_vehicle"] == "nearest_neighbours"
    assert (table.position_mm < 6).all()
    assert "paper_position_mm" not in table


@pytest.mark.claims
def test_both_halves_of_a_robots_drive_say_what_the_whole_says(workplace, robots):
    """Nobody loses commands, and all act late; robot 2, which is explained, is in each half as in the whole.

    It is as late, speeds up as evenly, and its marker is turned as far. Its causes are named where they leave up to a
    tenth of what they gain, and are four at most; with the usual 4 %, and three, none is.
    """
    verdict, search = VerdictSettings(most_left=0.1), SearchSettings(most_causes=4)
    settings, robot = DiagnosisSettings(verdict=verdict, search=search), robots["create"]
    learned = from_recording(read_vehicles(workplace / "recording", robot, ("1",)))[0]
    reference = Reference.learn(learned, 1, ("command",), settings)
    said = {"command_delay": "delay_s", "actuator_lag": "time_constant_s", "marker_yaw": "angle_rad"}
    found: dict[str, list[Estimate]] = {name: [] for name in said}
    for vehicle in ("2", "3", "4", "5"):
        whole = read_vehicles(workplace / "recording", robot, (vehicle,))
        middle_s = np.median([track.time_s[0] for track in whole.tracks])
        halves = (
            whole.where(lambda track, end_s=middle_s: track.time_s[0] < end_s),
            whole.where(lambda track, begin_s=middle_s: track.time_s[0] >= begin_s),
        )
        for name, part in zip(("whole", "first half", "second half"), (whole, *halves), strict=True):
            result = diagnose(reference, part, 1).result
            likeliest = max(result.posterior, key=lambda one: one.probability)
            print(f"robot {vehicle}, {name}: {result.verdict}, likeliest {', '.join(likeliest.causes)}")
            assert "command_loss" not in likeliest.causes
            assert "command_delay" in likeliest.causes
            if vehicle == "2":
                causes = {cause.name: cause for cause in result.causes}
                assert causes["actuator_lag"].form == {"follows": "evenly"}
                for cause, parameter in said.items():
                    one = causes[cause].parameters[parameter]
                    print(f"    {parameter} {one.value:.3f} ({one.low:.3f} to {one.high:.3f})")
                    found[cause].append(one)
    for alike in found.values():
        assert max(one.low for one in alike) < min(one.high for one in alike)
