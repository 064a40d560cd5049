"""The paths of a group on paper, with the group drawn at a few moments (figures 15 to 17)."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Rectangle
from matplotlib.transforms import Affine2D

from swarmtwin.plotting import style
from swarmtwin.world import palette
from swarmtwin.world.palette import vehicle_colour
from swarmtwin.world.rollout import NEVER, Rollout
from swarmtwin.world.shot import Shot, shot_of

SNAPSHOTS = 5
PANEL_INCHES = 4.2
WIDE = 1.4


def paths_figure(rollouts: Mapping[str, Rollout], world: int) -> Figure:
    """Draw one world of each roll-out, by the title of what moved the vehicles, until it was decided how it ends."""
    arena = next(iter(rollouts.values())).robot.arena_mm
    across, up = arena.high_mm - arena.low_mm
    side_by_side = across <= WIDE * up
    rows, columns = (1, len(rollouts)) if side_by_side else (len(rollouts), 1)
    scale = PANEL_INCHES / min(across, up) if side_by_side else 1.6 * PANEL_INCHES / across
    with style():
        size = (columns * (scale * across + 0.6), rows * (scale * up + 0.7))
        figure = Figure(figsize=size, layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel, (title, rollout) in zip(panels, rollouts.items(), strict=True):
            _draw_rollout(panel, rollout, world, title)
    return figure


def _draw_rollout(panel: Axes, rollout: Rollout, world: int, title: str) -> None:
    decisive = _decisive_period(rollout, world)
    shot = shot_of(rollout, world, decisive, title)
    _draw_surroundings(panel, shot)
    for vehicle in range(shot.path.shape[1]):
        x_mm, y_mm = shot.path[:, vehicle, 0], shot.path[:, vehicle, 1]
        panel.plot(x_mm, y_mm, color=vehicle_colour(vehicle), linewidth=1.3, alpha=0.75, solid_capstyle="round")
    for moment, strength in zip(_moments(shot), np.linspace(0.25, 1, SNAPSHOTS), strict=True):
        for vehicle, pose in enumerate(shot.path[moment]):
            _draw_vehicle(panel, shot, pose, vehicle, strength)
    panel.set_title(f"{title}: {shot.status.value} after {shot.time_s:.1f} s", color=palette.INK)
    panel.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    panel.grid(False)


def _decisive_period(rollout: Rollout, world: int) -> int:
    """Return the period in which it was decided how a roll-out stands: its first failure, its success, or its end."""
    for steps in (rollout.collided_step, rollout.left_step, rollout.reached_step):
        if steps[world] != NEVER:
            return int(steps[world])
    return int(rollout.periods[world])


def _moments(shot: Shot) -> np.ndarray:
    """Return the rows at which the group has covered equal shares of its way, the first and the last among them."""
    steps_mm = np.hypot(*np.moveaxis(np.diff(shot.path[:, :, :2], axis=0), -1, 0)).mean(axis=1)
    covered = np.concatenate([[0.0], np.cumsum(steps_mm)])
    return np.searchsorted(covered, np.linspace(0, covered[-1], SNAPSHOTS)).clip(max=len(shot.path) - 1)


def _draw_surroundings(panel: Axes, shot: Shot) -> None:
    arena = shot.robot.arena_mm
    size = arena.high_mm - arena.low_mm
    panel.add_patch(Rectangle(tuple(arena.low_mm), *size, facecolor=palette.GROUND, edgecolor=palette.FAINT))
    for index, target in enumerate(shot.targets):
        strength = 1.0 if index == shot.leg else 0.5
        colour = palette.TARGET
        panel.add_patch(Circle(tuple(target), shot.task.reach_mm, facecolor=colour, alpha=0.10 * strength, linewidth=0))
        panel.add_patch(Circle(tuple(target), shot.task.reach_mm, fill=False, edgecolor=colour, alpha=0.6 * strength))
        panel.plot(*target, "+", color=colour, markersize=9, markeredgewidth=2, alpha=strength)
        if len(shot.targets) > 1:
            panel.annotate(str(index + 1), tuple(target), (5, 5), textcoords="offset points", color=colour)
    for x_mm, y_mm, radius_mm in shot.obstacles:
        panel.add_patch(Circle((x_mm, y_mm), radius_mm, facecolor=palette.OBSTACLE, edgecolor=palette.INK))
    panel.set(xlim=(arena.x[0] - 0.03 * size[0], arena.x[1] + 0.03 * size[0]))
    panel.set(ylim=(arena.y[0] - 0.03 * size[1], arena.y[1] + 0.03 * size[1]))


def _draw_vehicle(panel: Axes, shot: Shot, pose: np.ndarray, vehicle: int, strength: float) -> None:
    """Draw a vehicle as a rounded box with a mark in front; `strength` is its opacity."""
    length_mm, width_mm = shot.robot.vehicle_size_mm
    place = Affine2D().rotate(pose[2]).translate(pose[0], pose[1]) + panel.transData
    rounding = f"round,pad=0,rounding_size={0.25 * width_mm}"
    box = FancyBboxPatch(
        (-length_mm / 2, -width_mm / 2),
        length_mm,
        width_mm,
        boxstyle=rounding,
        facecolor=vehicle_colour(vehicle),
        edgecolor=palette.GROUND,
        alpha=strength,
        zorder=3,
        transform=place,
    )
    panel.add_patch(box)
    panel.plot([0.1 * length_mm, 0.38 * length_mm], [0, 0], color=palette.GROUND, transform=place, zorder=4)
