"""Which ArUco marker is whose: those on vehicles, and the four on the arena's floor by which a camera finds itself."""

from collections.abc import Sequence
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from swarmtwin.errors import UserError
from swarmtwin.hardware import Marker
from swarmtwin.robot import Arena, Robot
from swarmtwin.strict_model import Positive, StrictModel

MarkerId = Annotated[int, Field(ge=0)]
Point = tuple[float, float]


class ArenaMarkers(StrictModel):
    """Four markers that lie on the floor, near the arena's corners, printed upright as seen along its y axis.

    They are of the same dictionary as the vehicles' and their upper edges point along the arena's y axis. The order is
    that of the corners: low x and low y, high x and low y, high x and high y, low x and high y.

    Attributes:
        ids: of the four; no vehicle has one of them.
        size_mm: length of their black squares' sides.
        outside_mm: how far beyond the arena's corner each centre lies along both axes; less than 0: within the arena.
        centres_mm: where the centres lie instead, x and y in the arena's frame.
    """

    ids: tuple[MarkerId, MarkerId, MarkerId, MarkerId] = (46, 47, 48, 49)
    size_mm: Positive = 80.0
    outside_mm: float = 50.0
    centres_mm: tuple[Point, Point, Point, Point] | None = None

    @model_validator(mode="after")
    def _four(self) -> Self:
        if len(set(self.ids)) < 4:
            raise ValueError("ids: the four markers of the arena must differ")
        return self

    def corners_mm(self, arena: Arena) -> dict[int, np.ndarray]:
        """Return where the corners (4, 2) of each marker lie: upper left, upper right, lower right, lower left."""
        low, high = arena.low_mm - self.outside_mm, arena.high_mm + self.outside_mm
        usual = ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))
        centres = self.centres_mm or usual
        square = square_corners_mm(self.size_mm)
        return {marker: np.add(centre, square) for marker, centre in zip(self.ids, centres, strict=True)}


def arena_markers(robot: Robot, layout: ArenaMarkers | None = None) -> dict[int, np.ndarray]:
    """Return the corners (4, 2) in mm of the markers on the floor of the robot's usual arena, by their ids."""
    return (layout or ArenaMarkers()).corners_mm(robot.arena_mm)


def square_corners_mm(size_mm: float) -> np.ndarray:
    """Return a marker's corners (4, 2) in its own frame: upper left, upper right, lower right, lower left.

    That is OpenCV's order; x points to its right edge, y to its upper one.
    """
    return np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * (size_mm / 2)


def marker_of(robot: Robot) -> Marker:
    """Return how the vehicles of a robot are marked.

    Raises:
        UserError: its file does not say so.
    """
    if robot.marker is None:
        raise UserError(
            f"robot {robot.name} has no marker, so a camera cannot track it: say in conf/robot/{robot.name}.yaml how "
            "large it is, marker: {size_mm: 60}"
        )
    return robot.marker


def vehicle_ids(robot: Robot, vehicles: Sequence[str], layout: ArenaMarkers | None = None) -> dict[int, str]:
    """Return which vehicle carries which marker.

    Args:
        robot: whose vehicles they are.
        vehicles: their names.
        layout: the arena's own markers.

    Raises:
        UserError: the robot has no marker, a vehicle is named twice, its marker's id is nowhere stated, is another's or
            the arena's, or is not in the dictionary.
    """
    marker, layout = marker_of(robot), layout or ArenaMarkers()
    owners: dict[int, str] = {}
    for vehicle in vehicles:
        number = _id_of(marker, vehicle)
        place = f"marker.ids of conf/robot/{robot.name}.yaml"
        if owners.get(number) == vehicle:
            raise UserError(f"vehicle {vehicle!r} is named twice: give each once")
        if number in owners:
            raise UserError(f"vehicles {owners[number]!r} and {vehicle!r} both have marker {number}: correct {place}")
        if number in layout.ids:
            raise UserError(
                f"vehicle {vehicle!r} has marker {number}, which lies on the arena's floor: correct {place}"
            )
        if number >= dictionary_size(marker.dictionary):
            raise UserError(
                f"vehicle {vehicle!r}: marker {number} is not in {marker.dictionary}, which ends at "
                f"{dictionary_size(marker.dictionary) - 1}: correct {place}"
            )
        owners[number] = vehicle
    return owners


def dictionary_size(dictionary: str) -> int:
    """Return how many markers a dictionary of OpenCV holds."""
    return 1024 if dictionary == "DICT_ARUCO_ORIGINAL" else int(dictionary.rpartition("_")[2])


def _id_of(marker: Marker, vehicle: str) -> int:
    if vehicle in marker.ids:
        return marker.ids[vehicle]
    if vehicle.isascii() and vehicle.isdigit():
        return int(vehicle)
    raise UserError(f"vehicle {vehicle!r} is no number, so its marker's id must be stated: marker.ids={{{vehicle}: 7}}")
