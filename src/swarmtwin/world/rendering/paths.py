"""The paths of a group on paper, with the group drawn at a few moments (figures 15 to 17)."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Patch, Rectangle
from matplotlib.transforms import Affine2D

from swarmtwin.plotting import style
from swarmtwin.world.rendering.canvas import COLOURS
from swarmtwin.world.rendering.drawing import is_wide
from swarmtwin.world.rendering.frame import Frame, frame_of
from swarmtwin.world.rollout import NEVER, Rollout


def paths_figure(rollouts: Mapping[str, Rollout], world: int, moments: int = 5, panel_inches: float = 4.2) -> Figure:
    """Draw one world of each roll-out until it was decided how it ends; wide panels stand one below another.

    Args:
        rollouts: by the title of what moved the vehicles.
        world: which of their worlds.
        moments: how often the group is drawn along its paths.
        panel_inches: the shorter side of a panel.
    """
    arena = next(iter(rollouts.values())).arena
    across, up = arena.high_mm - arena.low_mm
    wide = is_wide(across, up)
    rows, columns = (len(rollouts), 1) if wide else (1, len(rollouts))
    scale = 1.6 * panel_inches / across if wide else panel_inches / min(across, up)
    with style():
        size = (columns * (scale * across + 0.6), rows * (scale * up + 0.7))
        figure = Figure(figsize=size, layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel, (title, rollout) in zip(panels, rollouts.items(), strict=True):
            _draw_rollout(panel, rollout, world, title, moments)
    return figure


def _draw_rollout(panel: Axes, rollout: Rollout, world: int, title: str, moments: int) -> None:
    decisive = _decisive_period(rollout, world)
    frame = frame_of(rollout, world, decisive, title)
    _draw_surroundings(panel, frame)
    for vehicle in range(frame.path.shape[1]):
        x_mm, y_mm = frame.path[:, vehicle, 0], frame.path[:, vehicle, 1]
        panel.plot(x_mm, y_mm, color=COLOURS.vehicle(vehicle), linewidth=1.3, alpha=0.75, solid_capstyle="round")
    for moment, strength in zip(_moments(frame, moments), np.linspace(0.25, 1, moments), strict=True):
        for vehicle, pose in enumerate(frame.path[moment]):
            _draw_vehicle(panel, frame, pose, vehicle, strength)
    panel.set_title(f"{title}: {frame.status.value} after {frame.time_s:.1f} s", color=COLOURS.ink)
    panel.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    panel.grid(False)


def _decisive_period(rollout: Rollout, world: int) -> int:
    """Return the period in which it was decided how a roll-out stands: its first failure, its success, or its end."""
    for steps in (rollout.collided_step, rollout.left_step, rollout.reached_step):
        if steps[world] != NEVER:
            return int(steps[world])
    return int(rollout.periods[world])


def _moments(frame: Frame, count: int) -> np.ndarray:
    """Return the rows at which the group has covered equal shares of its paths, the first and the last among them."""
    steps_mm = np.hypot(*np.moveaxis(np.diff(frame.path[:, :, :2], axis=0), -1, 0)).mean(axis=1)
    covered = np.concatenate([[0.0], np.cumsum(steps_mm)])
    return np.searchsorted(covered, np.linspace(0, covered[-1], count)).clip(max=len(frame.path) - 1)


def _draw_surroundings(panel: Axes, frame: Frame) -> None:
    arena = frame.arena
    size = arena.high_mm - arena.low_mm
    ground = Rectangle(tuple(arena.low_mm), *size, facecolor=COLOURS.ground, edgecolor=COLOURS.faint)
    panel.add_patch(ground)
    for place, leg, vehicle in frame.marks:
        colour = COLOURS.target if vehicle is None else COLOURS.vehicle(vehicle)
        strength = 1.0 if leg == frame.leg else 0.5
        _draw_reach(panel, frame, place, colour, strength)
        panel.plot(*place, "+", color=colour, markersize=9, markeredgewidth=2, alpha=strength)
        if len(frame.targets) > 1:
            panel.annotate(str(leg + 1), tuple(place), (5, 5), textcoords="offset points", color=colour)
    if not frame.marks:
        for vehicle, pose in enumerate(frame.path[-1]):
            for patch in _draw_reach(panel, frame, pose[:2], COLOURS.vehicle(vehicle), 1.0):
                patch.set_clip_path(ground)
    for x_mm, y_mm, radius_mm in frame.obstacles:
        panel.add_patch(Circle((x_mm, y_mm), radius_mm, facecolor=COLOURS.obstacle, edgecolor=COLOURS.ink))
    panel.set(xlim=(arena.x[0] - 0.03 * size[0], arena.x[1] + 0.03 * size[0]))
    panel.set(ylim=(arena.y[0] - 0.03 * size[1], arena.y[1] + 0.03 * size[1]))


def _draw_reach(panel: Axes, frame: Frame, place: np.ndarray, colour: str, strength: float) -> list[Patch]:
    """Draw the ring within which a vehicle is at a target, or within which it covers the ground; return its parts."""
    reach_mm = frame.task.reach_mm
    shade = Circle(tuple(place), reach_mm, facecolor=colour, alpha=0.10 * strength, linewidth=0)
    ring = Circle(tuple(place), reach_mm, fill=False, edgecolor=colour, alpha=0.6 * strength)
    return [panel.add_patch(shade), panel.add_patch(ring)]


def _draw_vehicle(panel: Axes, frame: Frame, pose: np.ndarray, vehicle: int, strength: float) -> None:
    """Draw a vehicle as a rounded box with a mark in front; `strength` is its opacity."""
    length_mm, width_mm = frame.robot.vehicle_size_mm
    place = Affine2D().rotate(pose[2]).translate(pose[0], pose[1]) + panel.transData
    rounding = f"round,pad=0,rounding_size={0.25 * width_mm}"
    box = FancyBboxPatch(
        (-length_mm / 2, -width_mm / 2),
        length_mm,
        width_mm,
        boxstyle=rounding,
        facecolor=COLOURS.vehicle(vehicle),
        edgecolor=COLOURS.ground,
        alpha=strength,
        zorder=3,
        transform=place,
    )
    panel.add_patch(box)
    panel.plot([0.1 * length_mm, 0.38 * length_mm], [0, 0], color=COLOURS.ground, transform=place, zorder=4)
