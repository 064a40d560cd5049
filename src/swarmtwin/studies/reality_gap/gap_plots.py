"""The pictures of tables 5 and 6, from the folder that the study leaves: the paper's figures 13 to 17, and the gaps."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swarmtwin.files import read_provenance
from swarmtwin.plotting import MEASURED, style
from swarmtwin.simulation.open_loop import OpenLoop
from swarmtwin.simulation.open_loop_storage import load_open_loop
from swarmtwin.studies.reality_gap.gap_rollouts import LEARNED, PolicyRollouts
from swarmtwin.world.rendering.paths import paths_figure
from swarmtwin.world.rollout import chosen_world


def draw_gaps(made: Path, output: Path) -> None:
    """Draw into `output` the gaps, how policies were learned, roll-outs of each, and open loop where it was predicted.

    Raises:
        UserError: `made` is not a folder of swarmtwin's, or its roll-outs or runs cannot be read.
    """
    _, options = read_provenance(made)
    simulations = options["simulations"]
    gaps_figure(pd.read_csv(made / "table.csv"), list(simulations)).savefig(output / "gaps.png")
    learning_figure(pd.read_csv(made / "learning.csv"), list(simulations)).savefig(output / "learning.png")
    shown = options["figures"].get(options["task"]["name"], {"typical": "paths"})
    for file in sorted((made / "rollouts").glob(f"{LEARNED} in *.npz")):
        rollouts = PolicyRollouts.load(file, simulations)
        (simulation,) = rollouts.simulated
        titled = {**rollouts.simulated, **rollouts.real}
        last = list(titled.values())[-1]
        for show, name in shown.items():
            paths_figure(titled, chosen_world(last, show)).savefig(output / f"{name}_{simulation}.png")
    if (made / "open_loop").exists():
        predicted = {name: load_open_loop(made / "open_loop" / f"{name}.parquet")[0] for name in simulations}
        open_loop_figure(predicted).savefig(output / "figure13_open_loop.png")


def gaps_figure(table: pd.DataFrame, simulations: Sequence[str]) -> Figure:
    """Draw the reality gap of each simulation on each group of stand-ins, with its 95 % interval: a panel a policy."""
    real = table[table["where"] != "simulation"]
    policies, groups = list(real.policy.unique()), list(real["where"].unique())
    with style():
        figure = Figure(figsize=(3.4 * len(policies), 0.55 * len(simulations) + 1.6), layout="constrained")
        panels = figure.subplots(1, len(policies), sharey=True, squeeze=False).ravel()
        for panel, policy in zip(panels, policies, strict=True):
            _draw_gaps(panel, real[real.policy == policy], simulations, groups)
            panel.set(title=policy, xlabel="reward on stand-ins less that in simulation")
        panels[0].set_yticks(range(len(simulations)), list(simulations))
        panels[0].invert_yaxis()
        figure.legend(*panels[-1].get_legend_handles_labels(), loc="outside lower center", ncols=len(groups))
    return figure


def _draw_gaps(panel: Axes, rows: pd.DataFrame, simulations: Sequence[str], groups: Sequence[str]) -> None:
    panel.axvline(0.0, color=MEASURED, linewidth=0.8)
    for index, group in enumerate(groups):
        own = rows[rows["where"] == group].set_index("simulation").reindex(list(simulations))
        place = np.arange(len(simulations)) + 0.2 * (index - (len(groups) - 1) / 2)
        reach = np.stack([own.gap - own.gap_low, own.gap_high - own.gap])
        panel.errorbar(own.gap, place, xerr=reach, fmt="o", color=f"C{index}", markersize=4, capsize=2, label=group)


def learning_figure(history: pd.DataFrame, simulations: Sequence[str]) -> Figure:
    """Draw success, collisions and reward in the evaluation scenarios: a colour a simulation, a line a seed."""
    panels = {"success": "success, %", "collision": "collisions, %", "reward": "reward a vehicle and step"}
    with style():
        figure = Figure(figsize=(10, 3.1), layout="constrained")
        for axes, (quantity, label) in zip(figure.subplots(1, 3), panels.items(), strict=True):
            factor = 1 if quantity == "reward" else 100
            for index, simulation in enumerate(simulations):
                seeds = history[history.simulation == simulation].groupby("seed")
                for number, (_, own) in enumerate(seeds):
                    named = None if number else simulation
                    axes.plot(own.step, factor * own[quantity], color=f"C{index}", alpha=0.85, label=named)
            axes.set(xlabel="control periods trained", ylabel=label)
            if quantity != "reward":
                axes.set(ylim=(-3, 103))
        handles = figure.axes[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=len(simulations))
    return figure


def open_loop_figure(predicted: Mapping[str, Sequence[OpenLoop]], most: int = 4) -> Figure:
    """Draw measured runs and what each simulation predicts of them, with its RMSE, as figure 13 does.

    Of more runs than `most`, those at evenly spaced ranks of the last simulation's RMSE are shown.
    """
    runs = {name: {(run.track.run, run.track.vehicle): run for run in own} for name, own in predicted.items()}
    *_, last = runs.values()
    known = [key for key in last if all(key in own and np.isfinite(own[key].rmse_mm) for own in runs.values())]
    ranked = sorted(known, key=lambda key: last[key].rmse_mm)
    shown = [ranked[rank] for rank in np.linspace(0, len(ranked) - 1, min(most, len(ranked))).round().astype(int)]
    with style():
        figure = Figure(figsize=(3 * max(1, len(shown)), 3.9), layout="constrained")
        panels = figure.subplots(1, max(1, len(shown)), squeeze=False).ravel()
        for panel, key in zip(panels, shown, strict=False):
            _draw_runs(panel, {name: own[key] for name, own in runs.items()})
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(runs) + 1)
    return figure


def _draw_runs(panel: Axes, runs: Mapping[str, OpenLoop]) -> None:
    measured = next(iter(runs.values())).track.pose
    panel.plot(measured[:, 0], measured[:, 1], color=MEASURED, label="measured")
    for index, (name, run) in enumerate(runs.items()):
        panel.plot(run.predicted[:, 0], run.predicted[:, 1], color=f"C{index}", linewidth=1.1, label=name)
    errors = " / ".join(f"{run.rmse_mm:.0f}" for run in runs.values())
    title = f"{next(iter(runs.values())).track.run}\nRMSE {errors} mm"
    panel.set(title=title, xlabel="x, mm", ylabel="y, mm")
    panel.set_aspect("equal", adjustable="datalim")
