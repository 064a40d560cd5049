"""`swarmtwin evaluate` counts only what a model has not seen, and its figures are those computed by hand."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from safetensors.numpy import load_file, save_file

from swarmtwin.dynamics.model_folder import load_dynamics
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.learning.situation import Situation
from swarmtwin.recordings.reading import read_recording
from swarmtwin.transitions import from_recording

ERRORS = ("one_step", "floor", "model_error")


@pytest.fixture
def evaluate(swarmtwin, workshop, undrawn):
    """Evaluate a model folder; return metrics.json."""

    def call(simulation, recording, *options):
        output = f"evaluation-{len(list(workshop.glob('evaluation-*')))}"
        answer = swarmtwin(
            "evaluate", f"simulation={simulation}", f"recording={recording}", f"output={output}", *options
        )
        assert answer.status == 0, answer.error
        return json.loads((workshop / output / "metrics.json").read_text())

    return call


def transitions_of(robot, folder, runs=None):
    transitions, _ = from_recording(read_recording(folder, robot))
    return (
        transitions if runs is None else transitions.where(np.isin(np.array(transitions.runs)[transitions.run], runs))
    )


def by_hand(predicted, measured):
    """Mean and standard deviation of position and orientation errors, by elementary means."""
    position_mm = np.hypot(*(predicted - measured)[:, :2].T)
    turned = np.angle(np.exp(1j * (predicted - measured)[:, 2]), deg=True)
    return {
        "position_mm": {"mean": position_mm.mean(), "sd": position_mm.std()},
        "orientation_deg": {"mean": abs(turned).mean(), "sd": abs(turned).std()},
    }


def answers(folder, transitions, level):
    """The answer book's mean displacement of each transition, looked up one by one."""
    book = {
        (row.run, row.vehicle, round(row.time_s, 3)): [
            getattr(row, f"{level}_{column}") for column in ("forward_mm", "left_mm", "turn_rad")
        ]
        for row in pd.read_parquet(folder / "truth.parquet").itertuples()
    }
    keys = zip(transitions.run, transitions.vehicle, transitions.time_s, strict=True)
    return np.array(
        [book[transitions.runs[run], transitions.vehicles[vehicle], round(time_s, 3)] for run, vehicle, time_s in keys]
    )


def same_errors(found, expected):
    for name in ("position_mm", "orientation_deg"):
        assert found[name]["mean"] == pytest.approx(expected[name]["mean"], rel=1e-5)
        assert found[name]["sd"] == pytest.approx(expected[name]["sd"], rel=1e-5)


def test_of_its_own_recording_only_test_runs_count(evaluate, model, workshop, robots):
    folder = model("mlp")
    metrics = evaluate(folder, "reference")
    test_runs = Provenance.read(folder).runs["test"]
    part = transitions_of(robots["mgr"], workshop / "reference", test_runs)
    assert metrics["transitions"] == len(part) < len(transitions_of(robots["mgr"], workshop / "reference"))
    assert metrics["held_out_runs"] is True
    assert metrics["open_loop"]["runs"] == len(test_runs)
    dynamics = load_dynamics(folder)
    predicted = dynamics(Situation.from_transitions(part, dynamics.inputs)).detach().numpy().astype(float)
    same_errors(metrics["one_step"], by_hand(predicted, part.displacement))


def test_a_copy_under_another_name_is_still_its_own_recording(evaluate, model, workshop):
    shutil.copytree(workshop / "reference", workshop / "never_seen")
    assert evaluate(model("mlp"), "never_seen")["held_out_runs"] is True


def test_of_another_recording_everything_counts_against_the_exact_mean(evaluate, model, workshop, robots):
    folder = model("mlp")
    metrics = evaluate(folder, "other_vehicle")
    transitions = transitions_of(robots["mgr"], workshop / "other_vehicle")
    dynamics = load_dynamics(folder)
    predicted = dynamics(Situation.from_transitions(transitions, dynamics.inputs)).detach().numpy().astype(float)
    exact = answers(workshop / "other_vehicle", transitions, "situation")
    assert metrics["held_out_runs"] is False
    assert metrics["floor"]["kind"] == "exact"
    same_errors(metrics["one_step"], by_hand(predicted, transitions.displacement))
    same_errors(metrics["floor"], by_hand(exact, transitions.displacement))
    same_errors(metrics["model_error"], by_hand(predicted, exact))


def test_a_model_s_floor_knows_what_the_model_knows(evaluate, model, workshop, robots):
    folder = model("knowing")
    metrics = evaluate(folder, "other_vehicle")
    transitions = transitions_of(robots["mgr"], workshop / "other_vehicle")
    dynamics = load_dynamics(folder)
    predicted = dynamics(Situation.from_transitions(transitions, dynamics.inputs)).detach().numpy().astype(float)
    exact = answers(workshop / "other_vehicle", transitions, "previous_command")
    assert metrics["floor"]["kind"] == "exact"
    assert metrics["floor"]["given"] == ["command", "previous_command"]
    same_errors(metrics["floor"], by_hand(exact, transitions.displacement))
    same_errors(metrics["model_error"], by_hand(predicted, exact))


def test_two_floors_stand_side_by_side(evaluate, model, workshop, robots):
    metrics = evaluate(model("mlp"), "other_vehicle")
    transitions = transitions_of(robots["mgr"], workshop / "other_vehicle")
    for known, level in (("situation", "situation"), ("history", "earlier_command")):
        exact = answers(workshop / "other_vehicle", transitions, level)
        assert metrics["floors"][known]["kind"] == "exact"
        same_errors(metrics["floors"][known], by_hand(exact, transitions.displacement))
    assert metrics["floors"]["situation"] == metrics["floor"]
    assert metrics["floors"]["history"]["given"] == ["command", "previous_command", "earlier_command"]
    lags = [metrics["floors"][known]["position_mm"]["mean"] for known in ("history", "situation")]
    assert lags[0] < 0.85 * lags[1]


def test_beside_an_old_recording_the_floor_given_the_history_is_averaged_and_said_to_be(evaluate, model, workshop):
    """Exact means of older versions are given the true state: a floor must not be that of the state."""
    folder = model("knowing")
    recorded = evaluate(folder, "other_vehicle")["floor"]
    file = workshop / "other_vehicle" / "truth.parquet"
    table = pd.read_parquet(file)
    state = table.filter(like="earlier_command_").to_numpy() + np.random.default_rng(1).normal(0, [2, 2, 0.04])
    kept = table.drop(columns=table.filter(regex="^(previous|earlier)_command_").columns)
    columns = [f"everything_{name}" for name in ("forward_mm", "left_mm", "turn_rad")]
    kept.join(pd.DataFrame(state, columns=columns)).to_parquet(file)
    metrics = evaluate(folder, "other_vehicle")
    assert metrics["floor"]["kind"] == "averaged_exact_means"
    assert metrics["floors"]["situation"]["kind"] == "exact"
    lowest, estimate, highest = (
        figure["position_mm"]["mean"] for figure in (recorded, metrics["floor"], metrics["floors"]["situation"])
    )
    assert lowest < estimate < highest


def test_the_figures_of_the_vehicles_pool_to_the_overall_ones(evaluate, model):
    folder = model("mlp")
    metrics = evaluate(folder, "pair")
    parts = metrics["vehicles"]
    assert sorted(parts) == ["1", "2"]
    assert metrics["transitions"] == sum(part["transitions"] for part in parts.values())
    weights = [part["transitions"] for part in parts.values()]
    for figure in ERRORS:
        for name in ("position_mm", "orientation_deg"):
            means, spreads = (np.array([part[figure][name][key] for part in parts.values()]) for key in ("mean", "sd"))
            mean = np.average(means, weights=weights)
            sd = np.sqrt(np.average(spreads**2 + means**2, weights=weights) - mean**2)
            assert metrics[figure][name]["mean"] == pytest.approx(mean)
            assert metrics[figure][name]["sd"] == pytest.approx(sd)
    loops = [part["open_loop"] for part in parts.values()]
    assert metrics["open_loop"]["runs"] == sum(loop["runs"] for loop in loops) == 12
    mean_mm = np.average([loop["rmse_mm"]["mean"] for loop in loops], weights=[loop["runs"] for loop in loops])
    assert metrics["open_loop"]["rmse_mm"]["mean"] == pytest.approx(mean_mm)
    alone = evaluate(folder, "pair", "vehicles=[2]")
    assert sorted(alone["vehicles"]) == ["2"]
    assert rounded(alone["vehicles"]["2"]) == rounded(parts["2"])


def rounded(figures):
    """Figures to five digits: in single precision a batch of another size adds up in another order."""
    return json.loads(json.dumps(figures), parse_float=lambda text: float(f"{float(text):.5g}"))


def test_of_the_vehicles_that_taught_nothing_all_runs_count(swarmtwin, evaluate, workshop):
    training = ("model=kinematic", "recipe.epochs=2", "seeds=1", "register=false", "pictures=false")
    swarmtwin("train", "recording=pair", "vehicles=1", *training, "output=one")
    metrics = evaluate("one", "pair")
    runs = {vehicle: part["open_loop"]["runs"] for vehicle, part in metrics["vehicles"].items()}
    assert runs == {"1": len(Provenance.read(workshop / "one").runs["test"]), "2": 6}


def test_on_a_real_recording_the_floor_is_an_estimate_and_said_to_be_one(swarmtwin, model, workshop):
    (workshop / "reference" / "truth.parquet").unlink()
    answer = swarmtwin("evaluate", f"simulation={model('mlp')}", "recording=reference", "output=out")
    assert answer.status == 0
    assert "estimate" in answer.shown
    metrics = json.loads((workshop / "out" / "metrics.json").read_text())
    assert metrics["floor"]["kind"] == "nearest_neighbours"
    assert metrics["model_error"] is None


def test_the_estimated_floor_is_about_the_exact_one_and_not_above_the_model(evaluate, model, workshop):
    folder = model("mlp")
    known = evaluate(folder, "other_vehicle")
    (workshop / "other_vehicle" / "truth.parquet").unlink()
    estimated = evaluate(folder, "other_vehicle")
    for name in ("position_mm", "orientation_deg"):
        exact, estimate = known["floor"][name], estimated["floor"][name]
        assert estimate["low"] < exact["mean"], name
        assert estimate["low"] < estimate["mean"] < estimate["high"], name
        assert 0.7 * exact["mean"] < estimate["mean"] <= known["one_step"][name]["mean"], name
    assert "low" not in known["floor"]["position_mm"]


def test_a_registered_model_is_measured_like_its_folder(swarmtwin, evaluate, workshop):
    swarmtwin("train", "recording=reference", "model=mlp", "recipe.epochs=2", "seeds=1", "pictures=false", "output=own")
    expected = evaluate("own", "other_vehicle")
    assert evaluate("models:/mgr-dynamics@challenger", "other_vehicle") == expected
    assert evaluate("models:/mgr-dynamics/1", "other_vehicle") == expected


def test_who_saw_everything_is_refused(swarmtwin, workshop):
    fractions = "split.fractions={train: 0.9, validation: 0.1, test: 0}"
    training = ("model=kinematic", "recipe.epochs=1", "seeds=1", "register=false", "pictures=false", fractions)
    swarmtwin("train", "recording=reference", *training, "output=greedy")
    answer = swarmtwin("evaluate", "simulation=greedy", "recording=reference", "output=out")
    assert answer.status == 2
    assert answer.error == (
        "swarmtwin evaluate: the model was trained on every run of recording 'reference': "
        "evaluate on another recording, or train with a test fraction above 0\n"
    )
    assert not (workshop / "out").exists()


def truncate(folder):
    content = (folder / "weights.safetensors").read_bytes()
    (folder / "weights.safetensors").write_bytes(content[: len(content) // 2])


def poison(folder):
    weights = load_file(folder / "weights.safetensors")
    next(iter(weights.values())).flat[0] = np.nan
    save_file(weights, folder / "weights.safetensors")


def rename_layers(folder):
    description = (folder / "model.yaml").read_text()
    (folder / "model.yaml").write_text(description.replace("  - 128\n  - 128\n", "  - 64\n  - 64\n"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (truncate, "mlp/weights.safetensors is damaged ("),
        (poison, "mlp/weights.safetensors: "),
        (rename_layers, "mlp/weights.safetensors does not belong to model.yaml beside it: train the model anew"),
        (lambda folder: (folder / "weights.safetensors").unlink(), "mlp/weights.safetensors is missing"),
        (lambda folder: (folder / "model.yaml").unlink(), "no model in mlp: model.yaml is missing"),
    ],
)
def test_a_damaged_model_is_refused_in_one_line(swarmtwin, model, workshop, damage, message):
    damage(model("mlp"))
    answer = swarmtwin("evaluate", "simulation=mlp", "recording=other_vehicle", "output=out")
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin evaluate: {message}")
    assert len(answer.error.strip().splitlines()) == 1
    assert not (workshop / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["robot=mur", "simulation=mlp", "recording=other_vehicle"],
            "mlp is a model of robot 'mgr': add robot=mgr",
        ),
        (
            ["simulation=nowhere", "recording=other_vehicle"],
            "no model folder nowhere: give a folder, models:/NAME@ALIAS or models:/NAME/VERSION",
        ),
        (
            ["simulation=models:/mgr-dynamics@champion", "recording=other_vehicle"],
            "no registered model 'mgr-dynamics'; registered: none yet: train one first",
        ),
        (["simulation=mlp", "recording=pair", "vehicles=[1,7]"], "pair: no vehicle '7': known: 1, 2"),
        (["simulation=mlp", "recording=elsewhere"], "no recording folder elsewhere"),
        (
            ["simulation=mlp", "recording=reference"],
            "reference/truth.parquet does not belong to the runs beside it: record them again",
        ),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(swarmtwin, model, workshop, options, message):
    model("mlp")
    shutil.copy("pair/truth.parquet", "reference/truth.parquet")
    answer = swarmtwin("evaluate", *options, "output=out")
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin evaluate: {message}")
    assert len(answer.error.strip().splitlines()) == 1
    assert not (workshop / "out").exists()
