"""What pictures of worlds are drawn on: a picture of one arena under a heading, and the colours of what is in it."""

from copy import copy
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import cv2
import numpy as np

from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED
from swarmtwin.robot import Arena
from swarmtwin.world.rendering.frame import Status


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


@lru_cache(maxsize=1024)
def rgb(colour: str, share: float = 1.0, background: str = COLOURS.ground) -> tuple[int, ...]:
    """Return red, green and blue, 0 to 255, of a share of a colour on a background, both `#rrggbb`."""
    over, under = (bytes.fromhex(name[1:]) for name in (colour, background))
    return tuple(round(share * top + (1 - share) * bottom) for top, bottom in zip(over, under, strict=True))


@dataclass
class Panel:
    """A picture of one arena under a heading; draws in mm, x to the right and y upwards.

    Where a colour is given with a share, it is thinned on the ground's colour.

    Attributes:
        arena: what it shows.
        largest_px: width and height that no picture exceeds.
        header_px: height of the heading.
        border_px: around the arena.
        outside: how much of the surroundings shows on each side, as a share of the arena's longer one.
        subpixel_bits: positions are rounded to 2 to the power of −this, px.
    """

    arena: Arena
    largest_px: tuple[int, int] = (1080, 720)
    header_px: int = 60
    border_px: int = 14
    outside: float = 0.03
    subpixel_bits: int = 4

    def __post_init__(self) -> None:
        outside_mm = self.outside * max(self.arena.high_mm - self.arena.low_mm)
        self.low_mm, self.high_mm = self.arena.low_mm - outside_mm, self.arena.high_mm + outside_mm
        size_mm = self.high_mm - self.low_mm
        edges_px = np.array([2 * self.border_px, self.header_px + self.border_px])
        self.px_per_mm = float(((np.array(self.largest_px) - edges_px) / size_mm).min())
        size_px = (size_mm * self.px_per_mm).astype(int) + edges_px
        self.width_px, self.height_px = (size_px + size_px % 2).tolist()  # a film's pictures have an even size
        self.image = np.full((self.height_px, self.width_px, 3), rgb(COLOURS.paper), np.uint8)

    def copied(self) -> "Panel":
        """Return another panel with what has been drawn so far."""
        other = copy(self)
        other.image = self.image.copy()
        return other

    def at(self, position_mm: np.ndarray) -> np.ndarray:
        """Return where positions (..., 2) lie in the picture, in px."""
        from_left = self.border_px + (position_mm[..., 0] - self.low_mm[0]) * self.px_per_mm
        from_top = self.header_px + (self.high_mm[1] - position_mm[..., 1]) * self.px_per_mm
        return np.stack([from_left, from_top], axis=-1)

    def polygon(
        self, corners_mm: np.ndarray, colour: str, share: float = 1.0, background: str = COLOURS.ground
    ) -> None:
        """Fill a polygon (n, 2)."""
        colours = rgb(colour, share, background)
        cv2.fillPoly(self.image, [self._fixed_point(corners_mm)], colours, cv2.LINE_AA, self.subpixel_bits)

    def line(self, points_mm: np.ndarray, colour: str, share: float = 1.0, width_px: int = 1) -> None:
        """Draw a line through points (n, 2)."""
        points = [self._fixed_point(points_mm)]
        cv2.polylines(self.image, points, False, rgb(colour, share), width_px, cv2.LINE_AA, self.subpixel_bits)

    def fading_line(self, points_mm: np.ndarray, colour: str, shares: np.ndarray, width_px: int = 1) -> None:
        """Draw a line through points (n, 2), each of its n − 1 pieces with a share of its own."""
        points = self._fixed_point(points_mm)
        for index, share in enumerate(shares.tolist()):
            shown = rgb(colour, share)
            piece = [points[index : index + 2]]
            cv2.polylines(self.image, piece, False, shown, width_px, cv2.LINE_AA, self.subpixel_bits)

    def circle(
        self, centre_mm: np.ndarray, radius_mm: float, colour: str, share: float = 1.0, width_px: int = cv2.FILLED
    ) -> None:
        """Draw a circle, or fill it."""
        x, y = self._fixed_point(centre_mm).tolist()
        radius = round(radius_mm * self.px_per_mm * 2**self.subpixel_bits)
        cv2.circle(self.image, (x, y), radius, rgb(colour, share), width_px, cv2.LINE_AA, self.subpixel_bits)

    def confine(self, before: np.ndarray, edge_px: int = 2) -> None:
        """Take back what has been drawn beyond the arena's edge since the picture was `before`."""
        corners = self.at(np.array([self.arena.low_mm, self.arena.high_mm])).round().astype(int)
        (left, bottom), (right, top) = corners[0] + (edge_px, -edge_px), corners[1] + (-edge_px, edge_px)
        inside = self.image[top:bottom, left:right].copy()
        self.image[:] = before
        self.image[top:bottom, left:right] = inside

    def text(self, words: str, place_px: tuple[float, float], size_px: int, colour: str, weight: int = 400) -> int:
        """Write words with their baseline's left end at a place in the picture; return how wide they are, in px."""
        origin = (round(place_px[0]), round(place_px[1]))
        cv2.putText(self.image, words, origin, rgb(colour), _font(), size_px, weight)
        return text_width_px(words, size_px, weight)

    def _fixed_point(self, position_mm: np.ndarray) -> np.ndarray:
        return np.round(self.at(position_mm) * 2**self.subpixel_bits).astype(np.int32)


def text_width_px(words: str, size_px: int, weight: int = 400) -> int:
    """Return how wide words are, in px."""
    box = cv2.getTextSize((4096, 4096), words, (0, 0), _font(), size_px, weight)
    return int(box[2])


@cache
def _font() -> Any:
    return cv2.FontFace("sans")
