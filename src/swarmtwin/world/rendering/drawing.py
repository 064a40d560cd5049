"""Draws a world from above, as the overhead camera would see it: (height, width, 3) uint8, red, green, blue."""

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np

from swarmtwin.geometry import rotate
from swarmtwin.robot import Arena
from swarmtwin.world.rendering.canvas import COLOURS, Panel, rgb, text_width_px
from swarmtwin.world.rendering.frame import Frame


def is_wide(width: float, height: float) -> bool:
    """Whether pictures of this shape are better put one below another than side by side."""
    return width > 1.4 * height


def side_by_side(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Join pictures of the same size: side by side, or one under the other where they are wide."""
    height, width = pictures[0].shape[:2]
    return np.concatenate(pictures, axis=0 if is_wide(width, height) else 1)


def draw(frame: Frame) -> np.ndarray:
    """Draw one world at one moment."""
    panel = _empty_arena(frame.arena).copied()
    if frame.marks:
        _draw_targets(panel, frame)
    else:
        _draw_covered_ground(panel, frame)
    for *centre, radius_mm in frame.obstacles:
        panel.circle(np.array(centre), radius_mm, COLOURS.obstacle)
        panel.circle(np.array(centre), radius_mm, COLOURS.ink, 0.55, width_px=1)
    for vehicle in range(frame.path.shape[1]):
        _draw_trail(panel, frame, vehicle)
    for vehicle in range(frame.path.shape[1]):
        _draw_vehicle(panel, frame, vehicle)
    _draw_heading(panel, frame)
    return panel.image


@lru_cache(maxsize=4)
def _empty_arena(arena: Arena) -> Panel:
    """Return the arena's ground, with lines every decimetre, or every metre where it is large."""
    panel, low, high = Panel(arena), arena.low_mm, arena.high_mm
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
    panel.polygon(corners[:4], COLOURS.ground)
    spacing_mm = 100.0 if max(high - low) <= 3000.0 else 1000.0
    for axis in range(2):
        for place_mm in np.arange(np.ceil(low[axis] / spacing_mm) * spacing_mm, high[axis], spacing_mm):
            ends = np.array([low, high])
            ends[:, axis] = place_mm
            panel.line(ends, COLOURS.lines)
    panel.line(corners, COLOURS.ink, 0.5, width_px=2)
    return panel


def _draw_targets(panel: Panel, frame: Frame) -> None:
    """Draw the targets with the ring within which a vehicle is at it; the ones not sought now are pale.

    A vehicle's own is in its colour.
    """
    mark_mm = 12 / panel.px_per_mm
    for place, leg, vehicle in frame.marks:
        colour = COLOURS.target if vehicle is None else COLOURS.vehicle(vehicle)
        strength = 1.0 if leg == frame.leg else 0.3
        panel.circle(place, frame.task.reach_mm, colour, 0.10 * strength)
        panel.circle(place, frame.task.reach_mm, colour, 0.65 * strength, width_px=2)
        for direction in np.eye(2):
            panel.line(place + mark_mm * np.array([-direction, direction]), colour, strength, width_px=3)


def _draw_covered_ground(panel: Panel, frame: Frame) -> None:
    """Draw the ground within reach of a vehicle, with each one's ring in its colour."""
    before = panel.image.copy()
    for pose in frame.path[-1]:
        panel.circle(pose[:2], frame.task.reach_mm, COLOURS.target, 0.10)
    for vehicle, pose in enumerate(frame.path[-1]):
        panel.circle(pose[:2], frame.task.reach_mm, COLOURS.vehicle(vehicle), 0.5, width_px=2)
    panel.confine(before)


def _draw_trail(panel: Panel, frame: Frame, vehicle: int, shown_s: float = 30.0) -> None:
    """Draw where a vehicle came from; what is long ago fades."""
    rows = int(shown_s / frame.robot.period_s) + 1
    trail = frame.path[-rows:, vehicle, :2]
    age = np.arange(len(trail) - 2, -1, -1)
    panel.fading_line(trail, COLOURS.vehicle(vehicle), 0.15 + 0.5 * (1 - age / rows), width_px=3)


def _draw_vehicle(panel: Panel, frame: Frame, vehicle: int) -> None:
    """Draw a rounded box of the robot's size with a mark in front and its number; a ring where it collides."""
    pose, colour = frame.path[-1, vehicle], COLOURS.vehicle(vehicle)
    length_mm, width_mm = frame.robot.vehicle_size_mm

    def placed(outline_mm: np.ndarray) -> np.ndarray:
        return pose[:2] + rotate(outline_mm, np.full(len(outline_mm), pose[2]))

    if frame.colliding[vehicle]:
        panel.circle(pose[:2], 0.75 * length_mm, COLOURS.alarm, width_px=4)
    box = _rounded_box(length_mm, width_mm, 0.25 * width_mm)
    edge_mm = 1.5 / panel.px_per_mm
    panel.polygon(placed(box * (1 + 2 * edge_mm / width_mm)), COLOURS.ink, 0.75, colour)
    panel.polygon(placed(box), colour)
    tip, back, side = 0.43 * length_mm, 0.24 * length_mm, 0.2 * width_mm
    panel.polygon(placed(np.array([(tip, 0.0), (back, side), (back, -side)])), COLOURS.ground)
    number, size_px = str(vehicle + 1), max(11, round(0.42 * width_mm * panel.px_per_mm))
    x, y = panel.at(placed(np.array([(-0.12 * length_mm, 0.0)]))[0])
    left = x - text_width_px(number, size_px, 700) / 2
    panel.text(number, (left, y + 0.36 * size_px), size_px, COLOURS.ground, 700)


def _draw_heading(panel: Panel, frame: Frame) -> None:
    """Write title, time and distance, and the status in its colour."""
    baseline = panel.header_px - 22
    left = panel.border_px + panel.text(frame.title, (panel.border_px, baseline), 24, COLOURS.ink, 700) + 18
    facts = f"{frame.time_s:.1f} s" + (f"   farthest {frame.farthest_mm:.0f} mm" if frame.marks else "")
    panel.text(facts, (left, baseline), 19, COLOURS.faint)
    word = frame.status.value
    width = text_width_px(word, 19, 600)
    right, top, bottom = panel.width_px - panel.border_px, baseline - 23, baseline + 11
    colour = rgb(COLOURS.status(frame.status))
    radius = (bottom - top) // 2
    for x in (right - radius, right - width - radius):
        cv2.circle(panel.image, (x, top + radius), radius, colour, cv2.FILLED, cv2.LINE_AA)
    cv2.rectangle(panel.image, (right - width - radius, top), (right - radius, bottom), colour, cv2.FILLED)
    panel.text(word, (right - width - radius, baseline), 19, COLOURS.ground, 600)


@lru_cache(maxsize=8)
def _rounded_box(length_mm: float, width_mm: float, radius_mm: float) -> np.ndarray:
    """Return the outline (n, 2) of a box with round corners about the origin, its length along x."""
    corners = []
    for turn, side in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]):
        angle = np.linspace(0, np.pi / 2, 7) + turn * np.pi / 2
        centre = np.array(side) * (np.array([length_mm, width_mm]) / 2 - radius_mm)
        corners.append(centre + radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    return np.concatenate(corners)
