"""Draws a world from above, as the overhead camera would see it: (height, width, 3) uint8, red, green, blue."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from swarmtwin.geometry import rotate
from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED
from swarmtwin.robot import Arena
from swarmtwin.world.rendering.frame import Frame, Status

Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Colours:
    """The colours of pictures of worlds, each `#rrggbb`.

    Attributes:
        vehicles: of vehicle 1 and those after it, again from the first where there are more.
        target: of targets, and of the word that they are reached.
        obstacle: of obstacles.
        ink: of outlines and headings.
        faint: of what is said in passing.
        paper: around the arena.
        ground: of the arena.
        lines: on the ground.
        alarm: of what went wrong.
        under_way: of a roll-out that is still going on.
    """

    vehicles: tuple[str, ...] = (
        *(FLOOR, "#d98e32", "#5f9470", "#8a6fa8"),
        *("#b5656b", "#5b7a99", "#a08a4f", "#4f9a9a"),
    )
    target: str = "#3f8f63"
    obstacle: str = "#8d99a6"
    ink: str = MEASURED
    faint: str = "#8a8a8a"
    paper: str = "#f6f6f3"
    ground: str = "#ffffff"
    lines: str = "#ecece8"
    alarm: str = PREDICTED
    under_way: str = "#9aa0a6"

    def vehicle(self, index: int) -> str:
        """Return the colour of a vehicle."""
        return self.vehicles[index % len(self.vehicles)]

    def status(self, status: Status) -> str:
        """Return the colour that tells how a roll-out stands."""
        return {Status.REACHED: self.target, Status.ON_THE_WAY: self.under_way}.get(status, self.alarm)


COLOURS = Colours()


def rgb(colour: str) -> Colour:
    """Return red, green and blue, 0 to 255, of a colour `#rrggbb`."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


@lru_cache(maxsize=4096)
def blended(colour: str, share: float, background: str = COLOURS.ground) -> Colour:
    """Return a share of a colour on a background, as red, green and blue."""
    red, green, blue = (
        round(share * over + (1 - share) * under) for over, under in zip(rgb(colour), rgb(background), strict=True)
    )
    return red, green, blue


@dataclass(frozen=True)
class Layout:
    """How a picture is divided.

    Attributes:
        largest_px: width and height that no picture exceeds.
        header_px: height of the heading.
        border_px: around the arena.
        outside: how much of the surroundings shows on each side, as a share of the arena's longer one.
        trail_s: how long the path behind a vehicle shows.
        subpixel_bits: positions are rounded to 2 to the power of −this, px.
    """

    largest_px: tuple[int, int] = (1080, 720)
    header_px: int = 60
    border_px: int = 14
    outside: float = 0.03
    trail_s: float = 30.0
    subpixel_bits: int = 4


LAYOUT = Layout()


def is_wide(width: float, height: float) -> bool:
    """Whether pictures of this shape are better put one below another than side by side."""
    return width > 1.4 * height


class Panel:
    """A picture of one arena under a heading; draws in mm, x to the right and y upwards."""

    def __init__(self, arena: Arena) -> None:
        outside_mm = LAYOUT.outside * max(arena.high_mm - arena.low_mm)
        self.low_mm, self.high_mm = arena.low_mm - outside_mm, arena.high_mm + outside_mm
        size_mm = self.high_mm - self.low_mm
        room_px = np.array(LAYOUT.largest_px) - (2 * LAYOUT.border_px, LAYOUT.header_px + LAYOUT.border_px)
        self.px_per_mm = float((room_px / size_mm).min())
        width, height = (size_mm * self.px_per_mm).astype(int)
        self.width_px = _even(width + 2 * LAYOUT.border_px)
        self.height_px = _even(height + LAYOUT.header_px + LAYOUT.border_px)
        self.image = np.full((self.height_px, self.width_px, 3), rgb(COLOURS.paper), np.uint8)

    def copied(self) -> "Panel":
        """Return another panel with what has been drawn so far."""
        other = copy(self)
        other.image = self.image.copy()
        return other

    def at(self, position_mm: np.ndarray) -> np.ndarray:
        """Return where positions (..., 2) lie in the picture, in px."""
        from_left = LAYOUT.border_px + (position_mm[..., 0] - self.low_mm[0]) * self.px_per_mm
        from_top = LAYOUT.header_px + (self.high_mm[1] - position_mm[..., 1]) * self.px_per_mm
        return np.stack([from_left, from_top], axis=-1)

    def polygon(self, corners_mm: np.ndarray, colour: Colour) -> None:
        """Fill a polygon (n, 2)."""
        corners = _fixed_point(self.at(corners_mm))
        cv2.fillPoly(self.image, [corners], colour, cv2.LINE_AA, LAYOUT.subpixel_bits)

    def line(self, points_mm: np.ndarray, colour: Colour, width_px: int = 1) -> None:
        """Draw a line through points (n, 2)."""
        points = _fixed_point(self.at(points_mm))
        cv2.polylines(self.image, [points], False, colour, width_px, cv2.LINE_AA, LAYOUT.subpixel_bits)

    def fading_line(self, points_mm: np.ndarray, colours: Sequence[Colour], width_px: int) -> None:
        """Draw a line through points (n, 2), each of its n − 1 pieces in its own colour."""
        points = [(int(x), int(y)) for x, y in _fixed_point(self.at(points_mm))]
        for (start, end), colour in zip(pairwise(points), colours, strict=True):
            cv2.line(self.image, start, end, colour, width_px, cv2.LINE_AA, LAYOUT.subpixel_bits)

    def disc(self, centre_mm: np.ndarray, radius_mm: float, colour: Colour) -> None:
        """Fill a circle."""
        self._circle(centre_mm, radius_mm, colour, cv2.FILLED)

    def ring(self, centre_mm: np.ndarray, radius_mm: float, colour: Colour, width_px: int = 2) -> None:
        """Draw a circle."""
        self._circle(centre_mm, radius_mm, colour, width_px)

    def text(self, words: str, place_px: tuple[float, float], size_px: int, colour: Colour, weight: int = 400) -> int:
        """Write words with their baseline's left end at a place in the picture; return how wide they are, in px."""
        origin = (round(place_px[0]), round(place_px[1]))
        cv2.putText(self.image, words, origin, colour, _font(), size_px, weight)
        return text_width_px(words, size_px, weight)

    def _circle(self, centre_mm: np.ndarray, radius_mm: float, colour: Colour, width_px: int) -> None:
        x, y = (int(value) for value in _fixed_point(self.at(np.asarray(centre_mm))))
        radius = round(radius_mm * self.px_per_mm * 2**LAYOUT.subpixel_bits)
        cv2.circle(self.image, (x, y), radius, colour, width_px, cv2.LINE_AA, LAYOUT.subpixel_bits)


def text_width_px(words: str, size_px: int, weight: int = 400) -> int:
    """Return how wide words are, in px."""
    box = cv2.getTextSize((4096, 4096), words, (0, 0), _font(), size_px, weight)
    return int(box[2])


def draw(frame: Frame) -> np.ndarray:
    """Draw one world at one moment."""
    panel = _empty_arena(frame.arena).copied()
    _draw_targets(panel, frame)
    for *centre, radius_mm in frame.obstacles:
        panel.disc(np.array(centre), radius_mm, rgb(COLOURS.obstacle))
        panel.ring(np.array(centre), radius_mm, blended(COLOURS.ink, 0.55), 1)
    for vehicle in range(frame.path.shape[1]):
        _draw_trail(panel, frame, vehicle)
    for vehicle in range(frame.path.shape[1]):
        _draw_vehicle(panel, frame, vehicle)
    _draw_heading(panel, frame)
    return panel.image


def side_by_side(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Join pictures of the same size: side by side, or one under the other where they are wide."""
    height, width = pictures[0].shape[:2]
    return np.concatenate(pictures, axis=0 if is_wide(width, height) else 1)


@lru_cache(maxsize=4)
def _empty_arena(arena: Arena) -> Panel:
    """Return the arena's ground, with lines every decimetre, or every metre where it is large."""
    panel, low, high = Panel(arena), arena.low_mm, arena.high_mm
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    panel.polygon(corners, rgb(COLOURS.ground))
    spacing_mm = 100.0 if max(high - low) <= 3000.0 else 1000.0
    for x_mm in np.arange(np.ceil(low[0] / spacing_mm) * spacing_mm, high[0], spacing_mm):
        panel.line(np.array([(x_mm, low[1]), (x_mm, high[1])]), rgb(COLOURS.lines))
    for y_mm in np.arange(np.ceil(low[1] / spacing_mm) * spacing_mm, high[1], spacing_mm):
        panel.line(np.array([(low[0], y_mm), (high[0], y_mm)]), rgb(COLOURS.lines))
    panel.line(np.concatenate([corners, corners[:1]]), blended(COLOURS.ink, 0.5), 2)
    return panel


def _draw_targets(panel: Panel, frame: Frame) -> None:
    """Draw the targets with the ring within which a vehicle is at it; the ones not sought now are pale."""
    for index, target in enumerate(frame.targets):
        strength = 1.0 if index == frame.leg else 0.3
        panel.disc(target, frame.task.reach_mm, blended(COLOURS.target, 0.10 * strength))
        panel.ring(target, frame.task.reach_mm, blended(COLOURS.target, 0.65 * strength))
        mark_mm = 12 / panel.px_per_mm
        for direction in np.eye(2):
            cross = target + mark_mm * np.array([-direction, direction])
            panel.line(cross, blended(COLOURS.target, strength), 3)


def _draw_trail(panel: Panel, frame: Frame, vehicle: int) -> None:
    """Draw where a vehicle came from; what is long ago fades."""
    rows = int(LAYOUT.trail_s / frame.robot.period_s) + 1
    trail = frame.path[-rows:, vehicle, :2]
    ages = np.arange(len(trail) - 1)[::-1]
    shades = [blended(COLOURS.vehicle(vehicle), 0.15 + 0.5 * (1 - age / rows)) for age in ages]
    panel.fading_line(trail, shades, 3)


def _draw_vehicle(panel: Panel, frame: Frame, vehicle: int) -> None:
    """Draw a rounded box of the robot's size with a mark in front and its number; a ring where it collides."""
    pose, colour = frame.path[-1, vehicle], COLOURS.vehicle(vehicle)
    length_mm, width_mm = frame.robot.vehicle_size_mm
    if frame.colliding[vehicle]:
        panel.ring(pose[:2], 0.75 * length_mm, rgb(COLOURS.alarm), 4)
    box = _rounded_box(length_mm, width_mm, 0.25 * width_mm)
    edge_mm = 1.5 / panel.px_per_mm
    panel.polygon(_placed(box * (1 + 2 * edge_mm / width_mm), pose), blended(COLOURS.ink, 0.75, colour))
    panel.polygon(_placed(box, pose), rgb(colour))
    tip, back, side = 0.43 * length_mm, 0.24 * length_mm, 0.2 * width_mm
    panel.polygon(_placed(np.array([(tip, 0.0), (back, side), (back, -side)]), pose), rgb(COLOURS.ground))
    _draw_number(panel, str(vehicle + 1), _placed(np.array([(-0.12 * length_mm, 0.0)]), pose)[0], width_mm)


def _draw_number(panel: Panel, number: str, centre_mm: np.ndarray, width_mm: float) -> None:
    size_px = max(11, round(0.42 * width_mm * panel.px_per_mm))
    x, y = panel.at(centre_mm)
    left = x - text_width_px(number, size_px, 700) / 2
    panel.text(number, (left, y + 0.36 * size_px), size_px, rgb(COLOURS.ground), 700)


def _draw_heading(panel: Panel, frame: Frame) -> None:
    """Write title, time and distance, and the status in its colour."""
    baseline = LAYOUT.header_px - 22
    left = LAYOUT.border_px + panel.text(frame.title, (LAYOUT.border_px, baseline), 24, rgb(COLOURS.ink), 700) + 18
    facts = f"{frame.time_s:.1f} s   farthest {frame.farthest_mm:.0f} mm"
    panel.text(facts, (left, baseline), 19, rgb(COLOURS.faint))
    word = frame.status.value
    width = text_width_px(word, 19, 600)
    right, top, bottom = panel.width_px - LAYOUT.border_px, baseline - 23, baseline + 11
    colour = rgb(COLOURS.status(frame.status))
    radius = (bottom - top) // 2
    for x in (right - radius, right - width - radius):
        cv2.circle(panel.image, (x, top + radius), radius, colour, cv2.FILLED, cv2.LINE_AA)
    cv2.rectangle(panel.image, (right - width - radius, top), (right - radius, bottom), colour, cv2.FILLED)
    panel.text(word, (right - width - radius, baseline), 19, rgb(COLOURS.ground), 600)


@lru_cache(maxsize=8)
def _rounded_box(length_mm: float, width_mm: float, radius_mm: float) -> np.ndarray:
    """Return the outline (n, 2) of a box with round corners about the origin, its length along x."""
    quarter = np.linspace(0, np.pi / 2, 7)
    corners = []
    for turn in range(4):
        angle = quarter + turn * np.pi / 2
        side = np.sign(np.round([np.cos(angle[3]), np.sin(angle[3])], 6))
        centre = side * (np.array([length_mm, width_mm]) / 2 - radius_mm)
        corners.append(centre + radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    return np.concatenate(corners)


def _placed(outline_mm: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return an outline (n, 2) in a vehicle's frame as seen from above."""
    return pose[:2] + rotate(outline_mm, np.full(len(outline_mm), pose[2]))


def _fixed_point(place_px: np.ndarray) -> np.ndarray:
    return np.round(place_px * 2**LAYOUT.subpixel_bits).astype(np.int32)


def _even(size: int) -> int:
    return int(size) + int(size) % 2


@lru_cache(maxsize=1)
def _font() -> Any:
    return cv2.FontFace("sans")
