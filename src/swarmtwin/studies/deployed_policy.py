"""How a policy did on real vehicles, beside roll-outs in the simulation from the very same start."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from swarmtwin.errors import UserError
from swarmtwin.policies.policy_folder import StoredPolicy
from swarmtwin.policies.rollout_comparison import plain_figures
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.rendering.paths import paths_figure
from swarmtwin.world.rendering.video import pictures, write_video
from swarmtwin.world.rollout import NEVER, Rollout, figures_of, play
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Task

log = logging.getLogger(__name__)


def check_obstacles(task: Task, obstacles: Sequence[Sequence[float]]) -> None:
    """Check that a task's obstacles are told, each (x_mm, y_mm, radius_mm), and that a policy can know such ones.

    Raises:
        UserError: they are not as many as the task has, or one is not within the arena.
    """
    expected = task.draw(np.random.default_rng(0), 1).obstacles.shape[1]
    if len(obstacles) != expected:
        where = "say where they stand: obstacles=[x, y, radius] in mm" if expected else "leave obstacles= out"
        raise UserError(f"task {task.config.name!r} has {expected} obstacles, {len(obstacles)} are told: {where}")
    low, high = task.arena.low_mm, task.arena.high_mm
    for x_mm, y_mm, radius_mm in obstacles:
        if not ((low <= (x_mm, y_mm)) & ((x_mm, y_mm) <= high)).all():
            raise UserError(f"obstacles: {[x_mm, y_mm]} is not within the arena, {low.tolist()} to {high.tolist()} mm")
        least_mm, most_mm = task.config.radius_mm
        if not least_mm <= radius_mm <= most_mm:
            log.warning(
                "the policy has learned with obstacles of a radius from %g to %g mm, and this one has %g mm",
                least_mm,
                most_mm,
                radius_mm,
            )


def scenario_for(
    task: Task, start: np.ndarray, target: Any, obstacles: Sequence[Sequence[float]], seed: int
) -> Scenario:
    """Return what is asked of vehicles that stand at (V, 3): targets as given, or drawn by the task with a seed.

    Args:
        task: what is asked.
        start: (V, 3) where the vehicles stand.
        target: one or several; None: drawn, beside the obstacles.
        obstacles: (x_mm, y_mm, radius_mm) of those that stand there.
        seed: of what is drawn.

    Raises:
        UserError: targets are not as many as the task has, not all within the arena, or not beside the obstacles.
    """
    stand = np.array(obstacles, float).reshape(-1, 3)
    drawn = task.draw(np.random.default_rng(seed), 1 if not len(stand) else 500)
    free = _is_free(task, drawn.targets, stand)
    if target is not None:
        targets = np.array(target, float).reshape(-1, 2)[None]
        if np.isnan(drawn.targets).all():
            raise UserError(f"target: task {task.config.name!r} has no target: leave target= out")
        if targets.shape[1] != task.legs:
            raise UserError(f"target: task {task.config.name!r} has {task.legs} targets, {targets.shape[1]} are given")
        low, high = task.arena.low_mm, task.arena.high_mm
        if not ((targets >= low) & (targets <= high)).all():
            raise UserError(f"target={target} is not within the arena, {low.tolist()} to {high.tolist()} mm")
        if not _is_free(task, targets, stand)[0]:
            raise UserError(f"target={target}: no vehicle can be there without touching the obstacle: give another")
    elif not free.any():
        raise UserError("no target can be drawn beside the obstacles: give target=[x, y]")
    else:
        targets = drawn.targets[np.flatnonzero(free)[:1]]
    return task.beginning(start[None], targets, stand[None])


def _is_free(task: Task, targets: np.ndarray, obstacles: np.ndarray) -> np.ndarray:
    """Return whether vehicles can be at all targets (W, ..., 2) without touching one of the obstacles (O, 3), (W,)."""
    places = targets.reshape(len(targets), -1, 1, 2)
    away = np.linalg.norm(places - obstacles[:, :2], axis=-1) - obstacles[:, 2]
    free: np.ndarray = np.all(away > max(task.robot.vehicle_size_mm) / 2, axis=(1, 2))
    return free


def imagined(
    policy: StoredPolicy, task: Task, simulation: Simulation, scenario: Scenario, count: int, seed: int
) -> Rollout:
    """Roll the policy out `count` times from the start of a deployment, drawn where the simulation knows its spread."""
    knows_spread = simulation.is_extended or simulation.motion_noise is not None
    many = scenario.where(np.zeros(count, int))
    motion = SimulatedMotion(simulation, count, task.vehicles, sampled=knows_spread, seed=seed)
    return play(task, motion, many, policy.policy.act)


def deployment_metrics(real: Rollout | None, simulated: Rollout | None, counters: dict[str, Any]) -> dict[str, Any]:
    """Return all figures of a deployment, as they stand in metrics.json; rewards over as long as the vehicles drove."""
    metrics: dict[str, Any] = {"control": counters}
    if real is not None:
        metrics["robots"] = {
            "reward": float(real.mean_reward[0]),
            "success": bool(real.success[0]),
            "collision": bool(real.collided_step[0] != NEVER),
            "left_arena": bool(real.left_step[0] != NEVER),
            "reach_time_s": None if np.isnan(real.reach_time_s[0]) else float(real.reach_time_s[0]),
            "final_distance_mm": None if np.isnan(real.final_distance_mm[0]) else float(real.final_distance_mm[0]),
        }
    if real is not None and simulated is not None:
        metrics["simulation"] = plain_figures(figures_of(simulated))
        as_long = simulated.until(
            int(real.periods[0])
        )  # a reward is a mean over time: the end, at the target, earns more
        metrics["simulation"]["reward"] = plain_figures(figures_of(as_long))["reward"]
        metrics["simulation_rewards_below"] = float((as_long.mean_reward < real.mean_reward[0]).mean())
    return metrics


def tracked_deployment_figures(metrics: dict[str, Any]) -> dict[str, float]:
    """Return the figures by name and unit, as MLflow keeps them."""
    control = metrics["control"]
    figures = {name: float(control[name]) for name in ("periods", "interventions", "deadlocks", "is_standing")}
    figures["alarms"] = float(sum(control["alarms"].values()))
    for name in ("lateness_ms", "camera_to_command_ms", "decision_ms", "filter_ms"):
        figures |= {f"{name.removesuffix('_ms')}_{which}_ms": value for which, value in control[name].items()}
    if robots := metrics.get("robots"):
        figures |= {f"robots_{name}": float(value) for name, value in robots.items() if value is not None}
    if simulation := metrics.get("simulation"):
        figures |= {
            "simulation_reward": simulation["reward"]["mean"],
            "simulation_success": simulation["success"]["value"],
            "simulation_rewards_below": metrics["simulation_rewards_below"],
        }
    return {name: value for name, value in figures.items() if not np.isnan(value)}


def deployment_table(title: str, metrics: dict[str, Any]) -> Table:
    """Return what a person reads at the end."""
    shown = Table(box=box.SIMPLE_HEAD, title=title)
    shown.add_column("")
    shown.add_column("robots", justify="right")
    simulation, robots = metrics.get("simulation"), metrics.get("robots")
    if simulation:
        shown.add_column(f"simulation, {simulation['rollouts']} roll-outs", justify="right")
    if robots:
        yes = {True: "yes", False: "no"}
        rates = {"success": "success", "collision": "a collision", "left_arena": "left the arena"}
        means = {"reward": "reward a vehicle and period", "reach_time_s": "time to reach, s"}
        means["final_distance_mm"] = "farthest vehicle in the end, mm"
        for name, label in rates.items():
            cells = [f"{simulation[name]['value']:.0%}"] if simulation else []
            shown.add_row(label, yes[robots[name]], *cells)
        for name, label in means.items():
            cells = [_spread(simulation[name])] if simulation else []
            shown.add_row(label, "–" if robots[name] is None else f"{robots[name]:.2f}", *cells)
    control = metrics["control"]
    shown.add_row("periods", str(control["periods"]))
    shown.add_row("commands weakened; deadlocks", f"{control['interventions']}; {control['deadlocks']}")
    for name, label in (("lateness_ms", "lateness of a period"), ("camera_to_command_ms", "camera to command")):
        times = control[name]
        shown.add_row(f"{label}, ms: median; p99", f"{times['median']:.1f}; {times['p99']:.1f}")
    under = [vehicle for vehicle, rung in control["alarms"].items() if rung]
    shown.add_row("not as the simulation expects", ", ".join(f"vehicle {one}" for one in under) or "none")
    seen = "all vehicles stand" if control["is_standing"] else "NOT SEEN TO STAND"
    shown.caption = f"ended: {control['reason']}; {seen}"
    if "simulation_rewards_below" in metrics:
        shown.caption += f"\n{metrics['simulation_rewards_below']:.0%} of the simulated roll-outs earned less"
    return shown


def draw_deployment(folder: Path, real: Rollout, simulated: Rollout | None, video: bool, speed: float) -> None:
    """Draw the paths of the vehicles, beside those of one simulated roll-out, and film them where asked."""
    titled = {"robots": real}
    if simulated is not None:
        typical = int(np.argsort(simulated.mean_reward, kind="stable")[len(simulated) // 2])
        titled["simulation, typical"] = simulated.where(np.array([typical]))
    paths_figure(titled, 0).savefig(folder / "paths.png")
    if video:
        write_video(folder / "deployment.mp4", pictures(titled, 0, speed))


def _spread(figure: dict[str, float | None]) -> str:
    return "none did" if figure["mean"] is None else f"{figure['mean']:.2f} ± {figure['sd']:.2f}"
