"""How a robot is spoken to and how it is seen: the part of its file that only a deployment needs."""

from collections.abc import Mapping
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from swarmtwin.strict_model import Positive, StrictModel


class MessageField(StrictModel):
    """How one column of a command is written into a message: key: round(factor · value + offset, decimals).

    Attributes:
        key: the name that the firmware reads.
        factor: of the number sent over the command's own unit.
        offset: added after that.
        decimals: of the number sent; 0 sends a whole number.
    """

    key: str
    factor: float = 1.0
    offset: float = 0.0
    decimals: Annotated[int, Field(ge=0, le=9)] = 0

    @model_validator(mode="after")
    def _can_be_undone(self) -> Self:
        if self.factor == 0:
            raise ValueError("factor must not be 0: every command would be the same")
        return self


class LinkFormat(StrictModel):
    """How commands travel over MQTT, as JSON.

    Attributes:
        command_topic: where commands are published. With `{vehicle}` in it each vehicle has a topic of its own, and a
            message is the vehicle's object; without, one message holds the objects of the whole group by vehicle id.
        fields: for each column of a command, in order, its place in the vehicle's object.
        announce_topic: where a vehicle says its id when it is switched on; null: it does not.
        firmware_timeout_s: a vehicle stops by itself when no command has come for so long; null: it drives on.
    """

    command_topic: Annotated[str, Field(min_length=1, pattern=r"^[^#+\x00]+$")]
    fields: dict[str, MessageField]
    announce_topic: Annotated[str, Field(min_length=1, pattern=r"^[^#+\x00]+$")] | None = None
    firmware_timeout_s: Positive | None = None

    @model_validator(mode="after")
    def _keys_differ(self) -> Self:
        keys = [field.key for field in self.fields.values()]
        if len(set(keys)) < len(keys):
            raise ValueError("two fields have the same key: a command's columns would overwrite each other")
        return self


MarkerDictionary = Literal[
    "DICT_4X4_50", "DICT_4X4_100", "DICT_4X4_250", "DICT_5X5_50", "DICT_5X5_100", "DICT_6X6_50", "DICT_ARUCO_ORIGINAL"
]


class Marker(StrictModel):
    """The ArUco marker on a vehicle.

    The marker's own frame: x from its left to its right edge, y from its lower to its upper one, as printed upright.
    Its heading is that of x, counter-clockwise from the arena's x.

    Attributes:
        dictionary: of OpenCV.
        size_mm: length of its black square's side.
        height_mm: of the marker above the floor; the camera sees it displaced by that.
        forward_mm: of its centre in the vehicle's frame.
        left_mm: likewise.
        turn_deg: of the marker on the vehicle, counter-clockwise; −90: printed upright, it points forward (the marker's
            upper edge is at the vehicle's front).
        ids: the marker's id for each vehicle whose id is not that number.
    """

    dictionary: MarkerDictionary = "DICT_4X4_50"
    size_mm: Positive
    height_mm: Annotated[float, Field(ge=0)] = 0.0
    forward_mm: float = 0.0
    left_mm: float = 0.0
    turn_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    ids: Mapping[str, Annotated[int, Field(ge=0)]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_vehicle_each(self) -> Self:
        if len(set(self.ids.values())) < len(self.ids):
            raise ValueError("two vehicles have the same marker id: give each its own")
        return self
