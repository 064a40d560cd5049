"""What a mechanism is: one stage of the signal chain, with few named, bounded, physical parameters.

A mechanism overrides the hooks of its stage and leaves the others alone; `signal_chain.py` asks all mechanisms of a
simulation in the order of the signal: link, controller, supply, actuators, ground, body, marker, camera, clock. N
vehicles at a time; tensors are float64.
"""

from abc import ABC
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, ClassVar, Literal, NamedTuple, Self, cast, get_args

import numpy as np
import torch
from pydantic import create_model
from torch import Tensor

from swarmtwin.geometry import compose, displacement_between
from swarmtwin.learning.situation import Situation
from swarmtwin.plugins import PluginRegistry
from swarmtwin.robot import Robot, SituationPart, StrictModel
from swarmtwin.simulation import mechanisms
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.traction_score import LocalTractionScore
from swarmtwin.simulation.transient import Transient

Stage = Literal["link", "controller", "supply", "actuators", "ground", "body", "marker", "camera", "clock"]
STAGES: tuple[Stage, ...] = get_args(Stage)
Slowed = Literal["vehicle", "wheels", "thrust"]


class Parameter(NamedTuple):
    """A parameter of a mechanism.

    Attributes:
        low: its lower bound.
        high: its upper bound.
        null_value: where the mechanism does nothing; None where another parameter says so.
        unit: what it is measured in; empty for a ratio.
        initial_values: values that a search begins from.
        step: change for which the motion's response is measured; None: a thousandth of the bounds' distance.
        doubted_ends: bounds at which a cause that runs there is doubted, since beyond them it may fit better: not where
            nothing can be beyond, nor of what only says in which form a mechanism acts.
    """

    low: float
    high: float
    null_value: float | None
    unit: str
    initial_values: tuple[float, ...]
    step: float | None = None
    doubted_ends: Literal["both", "low", "high", "none"] = "both"

    @property
    def doubted(self) -> frozenset[float]:
        """The bounds at which a cause is doubted that does something there."""
        low, high = {self.low}, {self.high}
        ends = {"both": low | high, "low": low, "high": high, "none": set[float]()}[self.doubted_ends]
        return frozenset(ends - {self.null_value})

    @property
    def size(self) -> float:
        """Distance of the bounds."""
        return self.high - self.low

    @property
    def response_step(self) -> float:
        """Change for which the motion's response is measured."""
        return self.step or 1e-3 * self.size

    def stepped_from(self, value: float, steps: float = 1.0) -> float:
        """Return a value so many response steps above another one, or below it where there is no room above."""
        step = steps * self.response_step
        return value + step if value + step <= self.high else value - step


@dataclass(frozen=True)
class Moment:
    """N vehicles at the start of a control period, as mechanisms see them.

    Attributes:
        robot: whose vehicles they are.
        conditions: of the session.
        pose: (N, 3) true poses: x_mm, y_mm, heading_rad in the arena's frame.
        elapsed_s: (N,) since the session began.
        duration_s: (N,) of the period.
        neighbours: (N, M, 3) others in the vehicle's own frame: forward_mm, left_mm, turn_rad; NaN where there is none.
        neighbours_after: (N, M, 3) where they are at its end, in the same frame; None: not known, they stay.
        given: (N, m) the commands that the actuators are given in this period: None until the controller has passed
            them on, in the hooks of link and controller.
        velocity: (N, 3) forward_mm_s, left_mm_s, turn_rad_s, from which a dynamics model with momentum goes on: the
            mean of the period before, without what mechanisms made of it; None: not known.
    """

    robot: Robot
    conditions: SessionConditions
    pose: Tensor
    elapsed_s: Tensor
    duration_s: Tensor
    neighbours: Tensor
    neighbours_after: Tensor | None = None
    given: Tensor | None = None
    velocity: Tensor | None = None

    def of_rows(self, rows: np.ndarray) -> "Moment":
        """Return the vehicles at indices (n,)."""
        chosen: dict[str, Any] = {name: part[rows] for name, part in vars(self).items() if isinstance(part, Tensor)}
        return replace(self, **chosen)

    def situation(self, command: Tensor, previous_command: Tensor, earlier_command: Tensor) -> Situation:
        """Return it with the commands (N, m) of this period and of the two before: what a dynamics model looks at."""
        return Situation(
            command=command,
            previous_command=previous_command,
            earlier_command=earlier_command,
            pose=self.pose,
            velocity=self.velocity,
            elapsed_s=self.elapsed_s,
            duration_s=self.duration_s,
            neighbours=self.neighbours,
        )

    def at_true_poses(self, mechanisms: Iterable["Mechanism"]) -> "Moment":
        """Return what was measured as it truly is, by what mechanisms make of the camera: poses, and neighbours."""
        seen = partial(true_poses, tuple(mechanisms), conditions=self.conditions)
        pose = seen(self.pose)
        if pose is self.pose:
            return self
        neighbours, after = self.neighbours, self.neighbours_after
        return replace(
            self,
            pose=pose,
            neighbours=true_neighbours(self.pose, neighbours, seen),
            neighbours_after=None if after is None else true_neighbours(self.pose, after, seen),
        )

    @property
    def progress(self) -> Tensor:
        """Share of the session that has passed, (N,) in [0, 1]."""
        return self.conditions.progress(self.elapsed_s)

    @property
    def track_mm(self) -> float:
        """Distance between the wheels; 1 where the robot has none, so that nothing is divided by zero."""
        return self.conditions.track_mm or 1.0


def true_poses(mechanisms: Sequence["Mechanism"], pose: Tensor, conditions: SessionConditions) -> Tensor:
    """Return which true poses (N, 3) are measured like these, by mechanisms in the order of the signal."""
    for mechanism in reversed(mechanisms):
        pose = mechanism.from_measured(pose, conditions)
    return pose


def true_neighbours(pose: Tensor, neighbours: Tensor, seen: Callable[[Tensor], Tensor]) -> Tensor:
    """Return where others truly are, (N, M, 3) in vehicles' own frames; NaN where there is none.

    Args:
        pose: (N, 3) of the vehicles, as measured.
        neighbours: (N, M, 3) of the others in their frames, as measured.
        seen: says which true poses (n, 3) are measured like some.
    """
    there = neighbours.isfinite().all(dim=-1)
    if not there.any():
        return neighbours
    own = pose[:, None].expand_as(neighbours)[there]
    moved = neighbours.clone()
    moved[there] = displacement_between(seen(own), seen(compose(own, neighbours[there])))
    return moved


class Mechanism(StrictModel, ABC):
    """A cause of the catalogue with values for its parameters, which are its fields.

    Attributes:
        name: of the cause, that of its file.
        stage: of the signal chain.
        words: what it is, for a person; parameters in braces, `{x_mm} {x_mm:ahead/behind}` without their sign; of a
            form, `{slows:way/drive}`, the first word for the usual one.
        remedy: what to repair or check.
        parameters: its parameters by field name.
        inputs: parts of the measured situation that a simulation with it must be shown beside the command; those of
            commands before, where it has memory or a delay.
        says_when: whether it says how late, or how gradually, actuators follow a command.
        is_smooth: whether the motion changes gradually with the parameters.
        is_arrival_alone: whether it decides that commands arrive and nothing else: known what arrived, it does nothing.
        place_in_stage: of several in a stage, those of smaller numbers act first, those of the same one by name.
    """

    stage: ClassVar[Stage]
    words: ClassVar[str]
    remedy: ClassVar[str]
    parameters: ClassVar[Mapping[str, Parameter]]
    inputs: ClassVar[tuple[SituationPart, ...]] = ()
    says_when: ClassVar[bool] = False
    is_smooth: ClassVar[bool] = True
    is_arrival_alone: ClassVar[bool] = False
    place_in_stage: ClassVar[int] = 0

    name: str

    @classmethod
    def suits(cls, robot: Robot, conditions: SessionConditions) -> bool:
        """Say whether it makes sense for a robot."""
        return True

    @classmethod
    def forms(cls, robot: Robot) -> tuple[type["Mechanism"], ...]:
        """Return the physical forms that this cause may take on a robot, all of its name: a session shows which."""
        return (cls,)

    @classmethod
    @cache
    def with_default(cls, field: str, value: Any) -> type["Mechanism"]:
        """Return the same mechanism with another default of a field: another form of it."""
        fields: dict[str, Any] = {field: (cls.model_fields[field].annotation, value)}
        return create_model(cls.__name__, __base__=cls, **fields)

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Return its parameters for a robot in a session, by name."""
        return cls.parameters

    @classmethod
    def bounds_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Return all its parameters by name, also those that are read off the clock instead of fitted."""
        return cls.parameters_of(robot, conditions)

    @classmethod
    def at(cls, values: Mapping[str, float]) -> Self:
        """Return it with values that are not checked against the bounds: for searches."""
        content: dict[str, Any] = {"name": cls.model_fields["name"].default, **values}
        return cast(Self, cls.model_construct(**content))

    @classmethod
    def initial_points(
        cls, robot: Robot, conditions: SessionConditions, traction: LocalTractionScore | None = None
    ) -> list[dict[str, float]]:
        """Return where a search for its parameters begins: all combinations of their initial values.

        `traction` says where in the arena vehicles get further or less far than they should.
        """
        combined: list[dict[str, float]] = [{}]
        for name, parameter in cls.parameters_of(robot, conditions).items():
            combined = [{**point, name: value} for point in combined for value in parameter.initial_values]
        return combined

    @classmethod
    def read_from_clock(cls, duration_s: np.ndarray, robot: Robot) -> dict[str, float] | None:
        """Return fields that are read off the periods' lengths (N,) instead of fitted; None where they show nothing.

        Periods longer than the robot's longest gap are no transitions, and are not among them.
        """
        return {}

    @classmethod
    def units(cls, robot: Robot, conditions: SessionConditions) -> dict[str, str]:
        """Return the units of what `reported` gives."""
        return {name: parameter.unit for name, parameter in cls.parameters_of(robot, conditions).items()}

    def values(self) -> dict[str, float]:
        """Return its parameters' values by name."""
        return {name: value for name, value in self if isinstance(value, float | int)}

    def form(self) -> dict[str, str]:
        """Return which of its forms it takes: the fields that are words and no numbers."""
        return {name: value for name, value in self if isinstance(value, str) and name != "name"}

    @classmethod
    def usual_form(cls) -> dict[str, str]:
        """Return likewise the form that it takes where nothing else is said."""
        defaults = {name: field.default for name, field in cls.model_fields.items() if name != "name"}
        return {name: value for name, value in defaults.items() if isinstance(value, str)}

    def reported(self) -> dict[str, float]:
        """Return its parameters as a diagnosis reports them; the same as `values` unless said otherwise."""
        return self.values()

    def plausible_alternatives(self) -> Sequence["Mechanism"]:
        """Return what it may be instead, each a standard deviation away: its values may not mean just what they say."""
        return ()

    # link

    def arrival_probability(self) -> float:
        """Return the probability that a command arrives; otherwise the one in force before goes on."""
        return 1.0

    def latency_s(self) -> float:
        """Return how long after it was sent a command acts, at most a period."""
        return 0.0

    # controller

    def transform_command(self, command: Tensor, moment: Moment) -> Tensor:
        """Return the commands (N, m) that the actuators are given."""
        return command

    # supply and actuators

    def mean_command(self, command: Tensor, previous: Tensor, moment: Moment) -> Tensor:
        """Return the commands (N, m) that are in force on average in a period, `previous` (N, m) in the one before."""
        return command

    def supply_gain(self, moment: Moment) -> Tensor | None:
        """Return the factor on the actuators' efforts, (N or 1, 1), or speeds, as `efforts.slowed` has it; None: 1."""
        return None

    def added_lag_s(self) -> float:
        """Return with which additional time constant the actuators follow, to first order."""
        return 0.0

    def transient(self) -> Transient:
        """Return what is left of what a sudden change of a setting brings about beyond steady motion."""
        return Transient()

    def initial_memory(self, twist: Tensor, moment: Moment) -> Tensor | None:
        """Return what it remembers (N, ...) of actuators that have long moved by `twist` (N, 3); None: nothing."""
        return None

    def actuator_response(self, twist: Tensor, memory: Tensor, share: float, moment: Moment) -> tuple[Tensor, Tensor]:
        """Return what becomes of actuators' twists (N, 3), per nominal period, and its memory (N, ...) after that.

        Asked only of those with an `initial_memory`, once for each piece that the period is integrated in, in order:
        `share` is the piece's part of the period, and the breakpoints of all mechanisms decide how many there are.
        """
        return twist, memory

    # ground

    def traction(self, position: Tensor, moment: Moment) -> Tensor | None:
        """Return the factor (N,) on how far the actuators bring vehicles at positions (N, 2); None: 1."""
        return None

    def what_traction_slows(self) -> Slowed:
        """Say what a factor on traction slows: all of a vehicle's motion, each wheel where that is, or thrust.

        Weaker thrust slows each part of the motion by the power with which that grows with effort.
        """
        return "vehicle"

    # body

    def drift_velocity(self, displacement: Tensor, moment: Moment) -> Tensor | None:
        """Return a velocity (N or 1, 2) in mm/s along the arena's x and y, added to the vehicle's own; None: none.

        `displacement` (N, 3) is that of the vehicle itself at the middle of the period, in its frame at the start.
        """
        return None

    def noise_factor(self) -> float:
        """Return the factor on the standard deviation of the motion's random part."""
        return 1.0

    # marker and camera

    def to_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Return what the camera measures of true poses (N, 3)."""
        return pose

    def from_measured(self, pose: Tensor, conditions: SessionConditions) -> Tensor:
        """Return which true poses (N, 3) are measured like this: the inverse of `to_measured`."""
        return pose

    # clock

    def follows_clock(self) -> bool:
        """Say whether the motion lasts as long as the period really does, instead of its nominal length."""
        return False

    def draw_duration_s(self, count: int, period_s: float, rng: torch.Generator) -> Tensor | None:
        """Draw the lengths (N,) of periods; None: nominal."""
        return None

    # integration

    def breakpoints(self, robot: Robot) -> tuple[float, ...]:
        """Return the shares of a period at which what it does to the motion must be looked at anew, each in (0, 1)."""
        return ()


MECHANISMS: PluginRegistry[Mechanism] = PluginRegistry(mechanisms, "mechanism", group=None)
mechanism_names = MECHANISMS.names
mechanism_class = MECHANISMS.plugin_class
mechanism = MECHANISMS.config


def offered(robot: Robot, conditions: SessionConditions) -> dict[str, type[Mechanism]]:
    """Return by name the mechanisms that make sense for a robot."""
    classes = {name: mechanism_class(name) for name in mechanism_names()}
    return {name: cls for name, cls in classes.items() if cls.suits(robot, conditions)}


def in_signal_order(chosen: Iterable[Mechanism]) -> tuple[Mechanism, ...]:
    """Return mechanisms in the order of the signal chain."""
    return tuple(sorted(chosen, key=lambda one: (STAGES.index(one.stage), one.place_in_stage, one.name)))
