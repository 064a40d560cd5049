import numpy as np
import pandas as pd
import pytest

from swarmtwin.dynamics.error_plots import comparison_figure, history_figure, scatter_figure
from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.training import train
from swarmtwin.simulation.open_loop import open_loop
from swarmtwin.simulation.open_loop_plots import runs_figure
from swarmtwin.simulation.simulation import Simulation
from toy import recipe, toy_track, toy_transitions


@pytest.fixture(scope="module")
def trained(robots):
    return train(
        toy_transitions(robots["mgr"], 600, noise=(1, 1, 0.03)), config_class("mlp")(steps=10), recipe(), [0, 1]
    )


def test_runs_are_drawn_from_the_best_to_the_worst_with_what_was_measured(robots, trained, tmp_path):
    tracks = [toy_track(robots["mgr"], 20, seed, run=f"run-{seed}") for seed in range(9)]
    runs = sorted(open_loop(Simulation(trained.dynamics), tracks), key=lambda run: run.rmse_mm)
    figure = runs_figure(runs[::-1], robots["mgr"].arena_mm, most=5)
    panels = [panel for panel in figure.axes if panel.get_visible()]
    shown = [runs[rank] for rank in (0, 2, 4, 6, 8)]
    assert [panel.get_title() for panel in panels] == [f"{run.track.run}: RMSE {run.rmse_mm:.0f} mm" for run in shown]
    for panel, run in zip(panels, shown, strict=True):
        lines = {line.get_label(): line.get_xydata() for line in panel.lines}
        np.testing.assert_array_equal(lines["measured"], run.track.pose[:, :2])
        np.testing.assert_array_equal(lines["predicted"], run.predicted[:, :2])
    figure.savefig(tmp_path / "runs.png")


def test_no_runs_give_an_empty_figure(robots, tmp_path):
    runs_figure([], robots["mgr"].arena_mm).savefig(tmp_path / "runs.png")


def test_the_history_shows_every_seed_and_the_epoch_kept(trained):
    rows = [
        {"seed": result.seed, "epoch": number, **epoch._asdict()}
        for result in trained.results
        for number, epoch in enumerate(result.history, start=1)
    ]
    figure = history_figure(pd.DataFrame(rows), {result.seed: result.best for result in trained.results})
    curves = [line for line in figure.axes[0].lines if len(line.get_xdata()) > 1]
    assert len(curves) == 2 * len(trained.results)
    errors = [epoch.validation_position_mm for epoch in trained.results[0].history]
    assert any(np.array_equal(line.get_ydata(), errors) for line in curves)
    dots = {tuple(line.get_xydata()[0]) for line in figure.axes[0].lines if len(line.get_xdata()) == 1}
    kept = [(result.best, result.history[result.best - 1].validation_position_mm) for result in trained.results]
    assert dots == set(kept)


def test_the_scatter_shows_turns_in_degrees():
    measured = np.random.default_rng(0).normal(size=(100, 3))
    figure = scatter_figure(measured + 1, measured, most=50)
    points = figure.axes[2].collections[0].get_offsets()
    assert len(points) == 50
    np.testing.assert_allclose(points[:, 1] - points[:, 0], np.degrees(1))


def test_bars_begin_at_nothing_and_tell_the_ratio_to_the_floor():
    errors = {"mlp": ErrorFigure(3.3, 1, 4.0, 1, 10), "crnet": ErrorFigure(3.6, 1, 5.0, 1, 10)}
    figure = comparison_figure(errors, ErrorFigure(3.0, 1, 4.0, 1, 10), floor_is_estimate=True)
    position = figure.axes[0]
    assert [bar.get_width() for bar in position.patches] == [3.3, 3.6]
    assert position.get_xlim()[0] == 0
    assert [text.get_text() for text in position.texts] == [" 3.30, ×1.100", " 3.60, ×1.200"]
    assert figure.legends[0].get_texts()[0].get_text() == "floor (estimate)"
