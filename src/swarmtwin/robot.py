"""What a robot is: its commands, its period and what is believable of its motion, from one file in `conf/robot/`."""

from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
import yaml
from pydantic import AfterValidator, Field, field_validator, model_validator

from swarmtwin import kinematics
from swarmtwin.errors import UserError, near_miss
from swarmtwin.hardware import LinkFormat, Marker
from swarmtwin.kinematics import Actuators, KinematicEquations
from swarmtwin.plain_yaml import read_yaml
from swarmtwin.plugins import PluginRegistry
from swarmtwin.strict_model import Positive, StrictModel

POSE_COLUMNS = ("x_mm", "y_mm", "heading_rad")
DISPLACEMENT_COLUMNS = ("forward_mm", "left_mm", "turn_rad")
VELOCITY_COLUMNS = ("velocity_forward_mm_s", "velocity_left_mm_s", "velocity_turn_rad_s")
RESERVED_COLUMNS = ("time_s", "vehicle", *POSE_COLUMNS)

SituationPart = Literal[
    "command", "previous_command", "earlier_command", "pose", "velocity", "elapsed_s", "duration_s", "neighbours"
]
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]


def _increasing(bounds: tuple[float, float]) -> tuple[float, float]:
    if not bounds[0] < bounds[1]:
        raise ValueError(f"the lower bound must be below the upper one, got [{bounds[0]}, {bounds[1]}]")
    return bounds


Bounds = Annotated[tuple[float, float], AfterValidator(_increasing)]


class Arena(StrictModel):
    """The rectangle that vehicles move in, in mm, in the arena's frame."""

    x: Bounds
    y: Bounds

    @property
    def low_mm(self) -> np.ndarray:
        """The lower corner, (2,)."""
        return np.array([self.x[0], self.y[0]])

    @property
    def high_mm(self) -> np.ndarray:
        """The upper corner, (2,)."""
        return np.array([self.x[1], self.y[1]])

    def __str__(self) -> str:
        """Return its bounds as messages say them."""
        return f"x {self.x[0]:g} to {self.x[1]:g}, y {self.y[0]:g} to {self.y[1]:g} mm"


class CommandColumn(StrictModel):
    """One number of a command: its limits, inclusive, and its unit."""

    low: float
    high: float
    unit: str

    @model_validator(mode="after")
    def _limits_in_order(self) -> Self:
        _increasing((self.low, self.high))
        return self


class LargestDisplacement(StrictModel):
    """The largest believable motion over one period, as absolute values: beyond it a transition is an outlier."""

    forward_mm: Positive
    left_mm: Positive
    turn_rad: Positive


class Robot(StrictModel):
    """A kind of vehicle. Everything that swarmtwin knows of it stands in one file in `conf/robot/`.

    Attributes:
        name: the file's name; also that of the registered models, `<name>-dynamics`.
        title: what people call it, for tables and figures.
        period_s: control period; a row's command is held this long.
        longest_gap_s: two rows of a vehicle further apart than this make no transition.
        command: its columns, in order.
        arena_mm: the usual arena; each recording states its own.
        largest_displacement: the outlier limits of one transition.
        situation: what its dynamics models are given (the paper: command for the MGR, command and pose for the MUR). A
            robot that rolls on when its command changes has momentum: it is given its `velocity` as well.
        kinematics: the file in `kinematics/` that says how a command moves it; fitted, it is a baseline. Null: not
            known, and there is no such baseline.
        vehicle_size_mm: footprint (length, width), for pictures and collisions.
        actuators: what moves it; null: as usual for its kinematics, and unknown where these are.
        unit_spread: by which share the actuators of two units of this robot differ (standard deviation), where a lab
            has measured it; null: a generic one. The units of a reference show a diagnosis more, beside either.
        link: how it is spoken to; null: it cannot be deployed. Like `marker` it is the lab's and not the model's: what
            is learned or stored of a robot does not contain it.
        marker: how the camera sees it; null: it cannot be tracked.
    """

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    title: str
    period_s: Positive
    longest_gap_s: Positive
    command: Annotated[dict[str, CommandColumn], Field(min_length=1)]
    arena_mm: Arena
    largest_displacement: LargestDisplacement
    situation: tuple[SituationPart, ...]
    kinematics: str | None = None
    vehicle_size_mm: tuple[Positive, Positive]
    actuators: Actuators | None = None
    unit_spread: Annotated[float, Field(gt=0, lt=0.5)] | None = None
    link: Annotated[LinkFormat | None, Field(exclude=True)] = None
    marker: Annotated[Marker | None, Field(exclude=True)] = None

    @field_validator("kinematics")
    @classmethod
    def _known_kinematics(cls, name: str | None) -> str | None:
        if name is not None and name not in KINEMATICS.names():
            raise ValueError(f"no such kinematics: {name!r}: {near_miss(name, KINEMATICS.names())}")
        return name

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if taken := [column for column in self.command if column in RESERVED_COLUMNS]:
            raise ValueError(f"command column {taken[0]!r} is a reserved name: {', '.join(RESERVED_COLUMNS)}")
        if "command" not in self.situation:
            raise ValueError("situation must contain 'command'")
        if self.longest_gap_s < self.period_s:
            raise ValueError(f"longest_gap_s {self.longest_gap_s} is shorter than the period {self.period_s}")
        if self.actuators and (unknown := [name for name in self.actuators.columns() if name not in self.command]):
            raise ValueError(f"actuators name {unknown[0]!r}, which is no command column: {', '.join(self.command)}")
        if self.kinematics and len(self.command) != (wanted := self.kinematic_equations().command_size):
            raise ValueError(
                f"kinematics {self.kinematics!r} wants {wanted} command columns, not {len(self.command)} "
                f"({', '.join(self.command)}): correct one of the two"
            )
        if self.link and tuple(self.link.fields) != self.command_columns:
            raise ValueError(f"link.fields must name the command columns in their order: {', '.join(self.command)}")
        return self

    @classmethod
    def load(cls, path: Path) -> "Robot":
        """Read a robot from its YAML file.

        Raises:
            UserError: the file is missing, no YAML, or not a robot.
        """
        try:
            content = read_yaml(path)
        except FileNotFoundError:
            known = [file.stem for file in path.parent.glob("*.yaml")]
            raise UserError(f"no robot file {path}: {near_miss(path.stem, known)}") from None
        except yaml.YAMLError as error:
            raise UserError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None
        return cls.parse(content, str(path))

    def __eq__(self, other: object) -> bool:
        """Whether both are the same to a model: how a lab speaks to a robot and sees it makes it no other robot."""
        if not isinstance(other, Robot):
            return NotImplemented
        return self.model_dump() == other.model_dump()

    def __hash__(self) -> int:
        return hash(self.model_dump_json())

    def kinematic_equations(self) -> KinematicEquations:
        """Return the equations that its kinematics names.

        Raises:
            UserError: it names none.
        """
        if self.kinematics is None:
            raise UserError(
                f"robot {self.name!r} states no kinematics, and this needs some: name one of "
                f"{', '.join(KINEMATICS.names())} in conf/robot/{self.name}.yaml"
            )
        return KINEMATICS.plugin_class(self.kinematics)()

    @cached_property
    def actuation(self) -> Actuators:
        """Its actuators: as stated, and where nothing is, as is usual for its kinematics; unknown without these."""
        if self.kinematics is None:
            return self.actuators or Actuators(kind="unknown")
        usual = self.kinematic_equations().usual_actuators(self)
        if self.actuators is None:
            return usual
        if self.actuators.kind != usual.kind:
            return self.actuators
        return usual.model_copy(update={name: value for name, value in self.actuators if value})

    @property
    def command_columns(self) -> tuple[str, ...]:
        """Names of the command's columns, in order."""
        return tuple(self.command)

    @property
    def command_low(self) -> np.ndarray:
        """Lower command limits, (m,)."""
        return np.array([column.low for column in self.command.values()])

    @property
    def command_high(self) -> np.ndarray:
        """Upper command limits, (m,)."""
        return np.array([column.high for column in self.command.values()])

    @property
    def command_at_rest(self) -> np.ndarray:
        """The command nearest to zero, (m,): what a vehicle is told that is to stand still."""
        return np.clip(0.0, self.command_low, self.command_high)

    def scaled_command(self, command: np.ndarray) -> np.ndarray:
        """Return commands (N, m) between -1 and 1: at the lower and the upper limits."""
        low, high = self.command_low, self.command_high
        scaled: np.ndarray = 2 * (command - low) / (high - low) - 1
        return scaled

    @property
    def displacement_limit(self) -> np.ndarray:
        """Largest believable absolute displacement over one period, (3,): mm, mm, rad."""
        largest = self.largest_displacement
        return np.array([largest.forward_mm, largest.left_mm, largest.turn_rad])


KINEMATICS: PluginRegistry[KinematicEquations] = PluginRegistry(
    kinematics, "kinematics", group="robot", field="kinematics", ends_in="Equations"
)
