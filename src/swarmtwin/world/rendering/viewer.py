"""Roll-outs to play with: one HTML page that loads nothing, in which recorded worlds are played and compared."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from swarmtwin.files import write_text
from swarmtwin.world.rendering.canvas import COLOURS
from swarmtwin.world.rendering.frame import Status
from swarmtwin.world.rollout import NEVER, Rollout


def write_viewer(file: Path, rollouts: Mapping[str, Rollout], speed: float = 4.0, most_worlds: int = 40) -> None:
    """Write the page, whole or not at all.

    Args:
        file: where to.
        rollouts: by the title of what moved the vehicles, all from the same starts; the first one's robot, arena and
            task are those of all.
        speed: how many seconds pass in one second at first.
        most_worlds: so many at most are in the page, which says so.
    """
    environment = Environment(
        loader=PackageLoader("swarmtwin.world.rendering", "."),
        undefined=StrictUndefined,
        autoescape=True,
        trim_blocks=True,
    )
    rollout = next(iter(rollouts.values()))
    page = environment.get_template("viewer.html.jinja").render(
        recorded=recorded_worlds(rollouts, shown_worlds(rollouts, most_worlds)),
        robot=rollout.robot,
        task=rollout.task,
        titles=list(rollouts),
        shown=min(most_worlds, len(rollout)),
        total=len(rollout),
        speed=speed,
        speeds=sorted({1.0, 2.0, 4.0, 8.0, 16.0, speed}),
        colours=COLOURS,
        largest_mm=max(rollout.arena.high_mm - rollout.arena.low_mm),
    )
    write_text(file, page)


def shown_worlds(rollouts: Mapping[str, Rollout], most_worlds: int) -> list[int]:
    """Return the indices of the worlds in the page, evenly from the worst to the best, by what moved them last.

    The worst and the best are among them, and failing is worse than any reward.
    """
    judged = list(rollouts.values())[-1]
    order = np.lexsort((judged.mean_reward, judged.success))
    taken = np.linspace(0, len(order) - 1, min(most_worlds, len(order))).round().astype(int)
    worlds: list[int] = order[taken].tolist()
    return worlds


def recorded_worlds(rollouts: Mapping[str, Rollout], worlds: list[int]) -> dict[str, Any]:
    """Return what the page's script plays, as plain data."""
    rollout = next(iter(rollouts.values()))
    length_mm, width_mm = rollout.robot.vehicle_size_mm
    return {
        "titles": list(rollouts),
        "period_s": rollout.robot.period_s,
        "length_mm": length_mm,
        "width_mm": width_mm,
        "vehicles": rollout.pose.shape[2],
        "arena_mm": {"x": list(rollout.arena.x), "y": list(rollout.arena.y)},
        "reach_mm": rollout.task.reach_mm,
        "vehicle_colours": list(COLOURS.vehicles),
        "status_words": {status.name: status.value for status in Status},
        "worlds": [
            {
                "number": world,
                "targets_mm": rollout.scenario.targets[world].round(1).tolist(),
                "obstacles_mm": rollout.scenario.obstacles[world].round(1).tolist(),
                "plays": [_play(each, world) for each in rollouts.values()],
            }
            for world in worlds
        ],
    }


def _play(rollout: Rollout, world: int) -> dict[str, Any]:
    """Return one world until it ended.

    `moves` are (n + 1) · K · 3 whole numbers, moment by moment and vehicle by vehicle: by how many 0.1 mm, 0.1 mm and
    0.001 rad the pose differs from that of the moment before, the first from 0. So rounding does not add up.
    """
    periods = int(rollout.periods[world])
    pose = rollout.pose[: periods + 1, world].copy()
    pose[..., 2] = np.unwrap(pose[..., 2], axis=0)
    rounded = np.round(pose * (10, 10, 1000)).astype(int)
    return {
        "moves": np.diff(rounded, axis=0, prepend=0).ravel().tolist(),
        "legs": rollout.leg[: periods + 1, world].tolist(),
        "rewards": rollout.reward[:periods, world].mean(axis=1).round(3).tolist(),
        "collisions": np.argwhere(rollout.collided[:periods, world]).tolist(),
        "collided_step": _known(rollout.collided_step[world]),
        "left_step": _known(rollout.left_step[world]),
        "reached_step": _known(rollout.reached_step[world]),
    }


def _known(step: int) -> int | None:
    return None if step == NEVER else int(step)
