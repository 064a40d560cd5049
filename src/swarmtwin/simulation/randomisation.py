"""Mechanisms whose parameters are drawn from ranges: a policy that has met them all is ready for whichever is true.

Latency, lost commands, irregular periods, noise and vehicles that are not built alike are so learned on purpose, as in
dynamics randomisation (Peng et al. 2018); the ranges may be those that a diagnosis measured on the robots.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field

from swarmtwin.errors import UserError, near_miss
from swarmtwin.robot import StrictModel
from swarmtwin.simulation.actuation import with_actuation
from swarmtwin.simulation.mechanism import Mechanism, Parameter, Stage, mechanism, mechanism_class, mechanism_names
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.unlike_vehicles import UnlikeVehicles

Owner = Literal["world", "vehicle"]
"""Whose a drawn parameter is: that of all vehicles of a world, or each vehicle's own."""

SHARED_STAGES: tuple[Stage, ...] = ("ground", "camera", "clock")
"""Stages that all vehicles of a world have in common."""


class RandomMechanism(StrictModel):
    """A mechanism whose parameters are drawn.

    Attributes:
        name: of the mechanism.
        of: whose parameters they are.
        ranges: low and high of each parameter, which is uniform between them.
        fixed: its other fields.
    """

    name: str
    of: Owner
    ranges: dict[str, tuple[float, float]]
    fixed: dict[str, Any] = Field(default_factory=dict)

    @classmethod
    def read(cls, name: str, content: Any, simulation: Simulation, where: str) -> "RandomMechanism":
        """Validate ranges for a mechanism that extends a simulation, or stands in the place of its own one.

        Raises:
            UserError: there is no such mechanism or parameter, it makes no sense there, or a range is none.
        """
        kind = _mechanism_for(name, simulation, where)
        if not isinstance(content, Mapping):
            raise UserError(f"{where}: give ranges of its parameters, {_example(kind, simulation)}, got {content!r}")
        bounds = kind.bounds_of(simulation.robot, simulation.conditions)
        forms = {name: value for name, value in content.items() if name in kind.model_fields and isinstance(value, str)}
        ranges = {}
        for parameter in [name for name in content if name != "of" and name not in forms]:
            if parameter not in bounds:
                raise UserError(f"{where}: no such parameter: {parameter!r}: {near_miss(str(parameter), bounds)}")
            ranges[parameter] = _range(content[parameter], bounds[parameter], f"{where}.{parameter}")
        if not ranges:
            raise UserError(f"{where}: no range at all: give one, {_example(kind, simulation)}, or leave it out")
        known = _fields_in(simulation, name) | forms
        fixed = {field: value for field, value in known.items() if field not in ranges}
        if missing := [one for one in bounds if kind.model_fields[one].is_required() and one not in {*ranges, *fixed}]:
            raise UserError(f"{where}: no range for {', '.join(missing)}: add one, {_example(kind, simulation)}")
        mechanism({"name": name, **fixed, **{one: low for one, (low, _) in ranges.items()}}, where)
        return cls(name=name, of=_owner(content.get("of", "world"), kind, where), ranges=ranges, fixed=fixed)


class Randomisation(StrictModel):
    """What is drawn anew for each roll-out.

    Attributes:
        mechanisms: by whose parameters roll-outs differ.
        draws: how many groups that differ there are at most at a time; further worlds share theirs.
    """

    mechanisms: Annotated[tuple[RandomMechanism, ...], Field(min_length=1)]
    draws: Annotated[int, Field(ge=1)] = 16

    @classmethod
    def read(cls, content: Any, simulation: Simulation, draws: int, where: str = "randomisation") -> "Randomisation":
        """Validate a mapping of mechanisms to ranges of their parameters, for a simulation.

        Raises:
            UserError: it is none, or a mechanism or a range is refused.
        """
        if not isinstance(content, Mapping) or not content:
            raise UserError(f"{where}: give mechanisms with ranges, {{command_delay: {{delay_s: [0.0, 0.2]}}}}")
        extensible = with_known_actuation(simulation)
        return cls(
            mechanisms=tuple(
                RandomMechanism.read(str(name), ranges, extensible, f"{where}.{name}")
                for name, ranges in content.items()
            ),
            draws=draws,
        )

    @property
    def is_fixed(self) -> bool:
        """Whether all ranges have no width, so that nothing differs."""
        return all(low == high for one in self.mechanisms for low, high in one.ranges.values())

    @property
    def vehicles_differ(self) -> bool:
        """Whether vehicles of one world differ."""
        return any(one.of == "vehicle" for one in self.mechanisms)

    def draw(self, rng: np.random.Generator, vehicles: int) -> np.ndarray:
        """Draw the P parameters of each of K vehicles, (K, P), in the order of mechanisms and their ranges."""
        columns = [
            np.broadcast_to(rng.uniform(low, high, vehicles if one.of == "vehicle" else 1), vehicles)
            for one in self.mechanisms
            for low, high in one.ranges.values()
        ]
        return np.stack(columns, axis=-1)

    def group(self, simulation: Simulation, values: np.ndarray) -> Simulation | UnlikeVehicles:
        """Return what moves K vehicles with parameters (K, P), as `draw` gives them: a simulation extended by them."""
        if not self.vehicles_differ:
            return self._extended(simulation, values[0])
        return UnlikeVehicles([self._extended(simulation, own) for own in values])

    def _extended(self, simulation: Simulation, values: np.ndarray) -> Simulation:
        left, chosen = iter(values.tolist()), []
        for one in self.mechanisms:
            drawn = {parameter: next(left) for parameter in one.ranges}
            chosen.append(mechanism_class(one.name).at({**one.fixed, **drawn}))
        replaced = {one.name for one in chosen}
        kept = [one for one in simulation.mechanisms if one.name not in replaced]
        extended = Simulation(
            simulation.dynamics,
            [*kept, *chosen],
            simulation.conditions,
            simulation.residual,
            simulation.motion_noise,
        )
        return extended.eval()


def with_known_actuation(simulation: Simulation) -> Simulation:
    """Return a simulation that mechanisms can extend: with what a bare dynamics model shows of its actuators."""
    if simulation.is_extended:
        return simulation
    conditions = with_actuation(simulation.conditions, simulation.dynamics, seed=0)
    return Simulation(simulation.dynamics, (), conditions, None, simulation.motion_noise).eval()


def _mechanism_for(name: str, simulation: Simulation, where: str) -> type[Mechanism]:
    """Return a mechanism by name, if it makes sense in a simulation."""
    if name not in mechanism_names():
        raise UserError(f"{where}: no such mechanism: {name!r}: {near_miss(name, mechanism_names())}")
    kind = mechanism_class(name)
    if not kind.suits(simulation.robot, simulation.conditions):
        raise UserError(f"{where}: it makes no sense for robot {simulation.robot.name!r}: leave it out")
    if "elapsed_s" in kind.inputs and not simulation.is_extended:
        raise UserError(
            f"{where}: a bare dynamics model does not say how long a session lasts: randomise gain_change instead, or "
            "learn in the simulation that a diagnosis has extended"
        )
    if kind.noise_factor is not Mechanism.noise_factor and simulation.motion_noise is None:
        raise UserError(
            f"{where}: this simulation of {simulation.robot.name!r} does not know how much its motion varies: train "
            "its dynamics model anew, or leave it out"
        )
    return kind


def _fields_in(simulation: Simulation, name: str) -> dict[str, Any]:
    """Return the fields of a mechanism that a simulation has; nothing where it has none of that name."""
    own = [one for one in simulation.mechanisms if one.name == name]
    return own[0].model_dump(exclude={"name"}, exclude_none=True) if own else {}


def _owner(owner: Any, kind: type[Mechanism], where: str) -> Owner:
    if owner not in get_args(Owner):
        raise UserError(f"{where}.of: {owner!r}: {near_miss(str(owner), get_args(Owner))}")
    if owner == "vehicle" and kind.stage in SHARED_STAGES:
        raise UserError(f"{where}.of: all vehicles of a world have the same {kind.stage}: take of: world")
    checked: Owner = owner
    return checked


def _range(value: Any, bounds: Parameter, where: str) -> tuple[float, float]:
    """Return a range within a parameter's bounds."""
    pair = list(value) if isinstance(value, list | tuple) else []
    if len(pair) != 2 or not all(isinstance(end, int | float) and not isinstance(end, bool) for end in pair):
        raise UserError(f"{where}: give a range of two numbers, [low, high], got {value!r}")
    low, high = (float(end) for end in pair)
    if low > high:
        raise UserError(f"{where}: [{low:g}, {high:g}] begins above its end: did you mean [{high:g}, {low:g}]?")
    if not bounds.low <= low <= high <= bounds.high:
        unit = f" {bounds.unit}" if bounds.unit else ""
        raise UserError(
            f"{where}: [{low:g}, {high:g}] is not within {bounds.low:g} to {bounds.high:g}{unit}: narrow it"
        )
    return low, high


def _example(kind: type[Mechanism], simulation: Simulation) -> str:
    """Return ranges as they may be given, for an error."""
    bounds = kind.bounds_of(simulation.robot, simulation.conditions)
    return "such as {" + ", ".join(f"{name}: [{one.low:g}, {one.high:g}]" for name, one in bounds.items()) + "}"
