"""How near the floor the models come, and at what cost: figures to look at with `pytest -s -m benchmark_figures`."""

import sys
import time

import numpy as np
import pytest
import torch
import yaml
from torch import nn

from swarmtwin.commands.app import config_folder, run_command
from swarmtwin.dynamics.evaluation import floor, model_error, one_step
from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.models.crnet import CRNet
from swarmtwin.dynamics.training import train
from swarmtwin.learning.recipe import Recipe
from swarmtwin.recordings.exact_means import mean_columns, read_exact_means
from swarmtwin.recordings.reading import read_recording
from swarmtwin.simulation.open_loop import open_loop, summary
from swarmtwin.transitions import Fractions, from_recording, split_by_run

SIZES = {"mgr": 55_068, "mur": 15_000}


@pytest.fixture(scope="module")
def recorded(robots, tmp_path_factory):
    """Recordings as large as the paper's, of vehicle 1: transitions, their exact means, and the tracks of test runs."""
    arguments = sys.argv
    loaded = {}

    def load(name):
        if name not in loaded:
            folder = tmp_path_factory.mktemp(name) / "recording"
            options = [f"robot={name}", f"transitions={SIZES[name]}", "steps=60", "seed=1", f"output={folder}"]
            assert run_command("record", options) == 0
            loaded[name] = load_recorded(folder, robots[name])
        return loaded[name]

    yield load
    sys.argv = arguments


def load_recorded(folder, robot):
    recording = read_recording(folder, robot)
    transitions, _ = from_recording(recording)
    transitions = split_by_run(transitions, Fractions(train=0.8, validation=0.1, test=0.1), seed=1)
    exact = read_exact_means(folder)
    exact.index = zip(exact.run, exact.time_s.round(3), strict=True)
    rows = list(zip(np.array(transitions.runs)[transitions.run], transitions.time_s.round(3), strict=True))
    means = exact.loc[rows, mean_columns("situation")].to_numpy(float)
    test_runs = {transitions.runs[index] for index in np.unique(transitions.part("test").run)}
    return transitions, means, [track for track in recording.tracks if track.run in test_runs]


@pytest.mark.benchmark_figures
@pytest.mark.parametrize(
    ("robot", "model", "goal_ratio", "goal_s"),
    [("mgr", "kinematic", 1.06, 10), ("mgr", "mlp", 1.02, 10), ("mgr", "crnet", 1.06, 60), ("mur", "mlp", 1.12, 10)],
)
def test_the_fast_recipe_comes_near_the_floor(recorded, robot, model, goal_ratio, goal_s):
    transitions, means, tracks = recorded(robot)
    recipe = Recipe.parse(yaml.safe_load((config_folder() / "recipe" / "fast.yaml").read_text()), "fast.yaml")
    start = time.process_time()
    dynamics = train(transitions, config_class(model)(), recipe, seeds=[1]).dynamics
    cpu_s = time.process_time() - start
    test = transitions.split == 2
    unseen, exact = transitions.where(test), means[test]
    reached, lowest, distance = one_step(dynamics, unseen), floor(exact, unseen), model_error(dynamics, unseen, exact)
    ratio = reached.position_mm / lowest.position_mm
    print(
        f"\n{robot} {model}: {cpu_s:.1f} s of CPU ({cpu_s / goal_s:.2f} of the goal); "
        f"position {reached.position_mm:.2f} mm ({ratio:.3f} of the floor), "
        f"orientation {reached.orientation_deg:.2f}° ({reached.orientation_deg / lowest.orientation_deg:.3f}), "
        f"model error {distance.position_mm:.2f} mm {distance.orientation_deg:.2f}°, "
        f"open loop {summary(open_loop(dynamics, tracks)).rmse_mm:.0f} mm"
    )
    assert ratio < goal_ratio


class PlainConvolutions(nn.Sequential):
    """CR-Net's convolutions as published, of torch's own layers on (batch, channels, length)."""

    def __init__(self):
        super().__init__(
            *(nn.Conv1d(1, 8, 1, padding=1), nn.BatchNorm1d(8), nn.LeakyReLU()),
            *(nn.Conv1d(8, 64, 1, padding=1), nn.BatchNorm1d(64), nn.LeakyReLU()),
        )


@pytest.mark.benchmark_figures
def test_crnet_convolutions_against_plain_layers():
    values = torch.rand(512, 2)
    ours, plain = CRNet(2, dropout=0.1).convolutions, PlainConvolutions()

    def milliseconds(forward):
        passes = []
        for _ in range(30):
            start = time.perf_counter()
            forward().sum().backward()
            passes.append(1e3 * (time.perf_counter() - start))
        return float(np.median(passes))

    ours_ms, plain_ms = milliseconds(lambda: ours(values[None])), milliseconds(lambda: plain(values[:, None]))
    print(f"\nCR-Net's convolutions, batch 512: {ours_ms:.2f} ms against {plain_ms:.2f} ms, {ours_ms / plain_ms:.2f}")
    assert ours(values[None]).shape == (64, 512, 6)
