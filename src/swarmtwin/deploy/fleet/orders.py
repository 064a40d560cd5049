"""What a fleet can be told while it runs: where its vehicles are put, and what goes wrong."""

from collections.abc import Mapping, Sequence
from typing import Annotated

from pydantic import Field

from swarmtwin.errors import UserError
from swarmtwin.strict_model import StrictModel

Probability = Annotated[float, Field(ge=0, le=1)]
Seconds = Annotated[float, Field(ge=0, le=60)]


class RobotFaults(StrictModel):
    """What goes wrong with commands on their way to one vehicle.

    Attributes:
        latency_s: they arrive later by so much.
        jitter_s: and by up to so much more, at random: with more than a period they overtake each other.
        loss: probability that one never arrives.
        duplicate: probability that one arrives once more, with a latency of its own.
        reorder: probability that one is held back until the next one has arrived.
        deaf: none arrives at all.
    """

    latency_s: Seconds = 0.0
    jitter_s: Seconds = 0.0
    loss: Probability = 0.0
    duplicate: Probability = 0.0
    reorder: Probability = 0.0
    deaf: bool = False


class CameraFaults(StrictModel):
    """What goes wrong with the camera's pictures.

    Attributes:
        drop: probability that a picture never leaves the camera.
        delay_s: pictures arrive later by so much; their stamps tell.
        silent: none arrives, though the connection stands.
        frozen: the same picture again and again, each with a stamp of its own.
        clock_s: the camera's clock is ahead by so much.
        hidden: vehicles whose markers are not seen.
        swapped: pairs of vehicles of which each wears the other's marker.
        shift_px: somebody has bumped into the camera: its pictures are displaced, to the right and downwards.
    """

    drop: Probability = 0.0
    delay_s: Seconds = 0.0
    silent: bool = False
    frozen: bool = False
    clock_s: Annotated[float, Field(ge=-1e9, le=1e9)] = 0.0
    hidden: frozenset[str] = frozenset()
    swapped: tuple[tuple[str, str], ...] = ()
    shift_px: tuple[float, float] = (0.0, 0.0)


class Placement(StrictModel):
    """A vehicle is lifted and put somewhere, where it stands, switched on anew.

    Attributes:
        number: counts how often it was; a robot that has not seen this number yet obeys.
        pose: x_mm, y_mm, heading_rad in the arena's frame.
    """

    number: int
    pose: tuple[float, float, float]


class Orders(StrictModel):
    """All that holds now.

    Attributes:
        placements: by vehicle; of those that were put somewhere.
        robots: faults by vehicle; the others have none.
        camera: faults of the camera.
    """

    placements: Mapping[str, Placement] = Field(default_factory=dict)
    robots: Mapping[str, RobotFaults] = Field(default_factory=dict)
    camera: CameraFaults = CameraFaults()

    def with_placed(self, poses: Mapping[str, tuple[float, float, float]]) -> "Orders":
        """Return orders that put some vehicles somewhere."""
        placed = {
            vehicle: Placement(number=self.placement_number(vehicle) + 1, pose=pose) for vehicle, pose in poses.items()
        }
        return self.model_copy(update={"placements": {**self.placements, **placed}})

    def with_faults(
        self, robots: Mapping[str, RobotFaults] | None = None, camera: CameraFaults | None = None
    ) -> "Orders":
        """Return orders with other faults; those that are not given stay as they are."""
        given = {"robots": robots, "camera": camera}
        return self.model_copy(update={name: value for name, value in given.items() if value is not None})

    def check(self, vehicles: Sequence[str]) -> None:
        """Refuse orders for vehicles that there are not.

        Raises:
            UserError: naming the first of them.
        """
        pairs = [vehicle for pair in self.camera.swapped for vehicle in pair]
        for vehicle in (*self.placements, *self.robots, *self.camera.hidden, *pairs):
            if vehicle not in vehicles:
                raise UserError(f"no vehicle {vehicle!r} in this fleet: {', '.join(vehicles)}")

    def placement_number(self, vehicle: str) -> int:
        """Return how often a vehicle was put somewhere."""
        return self.placements[vehicle].number if vehicle in self.placements else 0
