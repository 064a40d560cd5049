"""Speed follows the command gradually: tired motors, a slow controller."""

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

from torch import Tensor

from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.efforts import twist_of_wheels, wheel_travel
from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter
from swarmtwin.simulation.transient import Transient


class Config(Mechanism):
    """Actuators follow to first order: what is left of the old speed decays with an additional `time_constant_s`.

    Wheels: their speed lags, beyond the lag that the reference shows by itself; where gears rub, those that stop or
    turn back stand sooner, by the friction that the reference shows. Or it changes evenly, as where a driver limits the
    acceleration: a change by the robot's largest speed takes twice the time constant, and loses as much way as with
    that; a smaller one less, by its square. Thrust: the setting of fin or propeller lags, so that something between
    both commands holds for a while. A fin that is thrown from one mean angle to another pushes and turns the vehicle as
    it goes, which the reference holds: less the slower it goes, by own / (own + added), and in part in the next period
    only.

    Attributes:
        time_constant_s: the added one.
        own_time_constant_s: of how a sudden change of thrust's setting pushes in the reference, ahead and to the side;
            None: so long that an added lag leaves this as it was.
        own_turn_time_constant_s: likewise of how it turns the vehicle: a hull that recoils from a fin may do so by as
            much, however slowly that is thrown. None: the same.
        goes_on: which share of what that lacks comes in the next period: a quarter at most, as much as is left of what
            dies away with a time constant of three quarters of a period. None: none of it.
        follows: to first order or evenly.
    """

    stage: ClassVar = "actuators"
    words: ClassVar = (
        "actuators follow {follows:with an additional time constant of/by an even acceleration, to full speed within "
        "twice} {time_constant_s}"
    )
    remedy: ClassVar = "check motors and gears for wear, or lower the controller's smoothing"
    parameters: ClassVar = {"time_constant_s": Parameter(0.0, 1.0, 0.0, "s", (0.1,))}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("previous_command", "earlier_command")
    says_when: ClassVar = True

    name: Literal["actuator_lag"] = "actuator_lag"
    time_constant_s: float
    own_time_constant_s: float | None = None
    own_turn_time_constant_s: float | None = None
    goes_on: float | None = None
    follows: Literal["exponentially", "evenly"] = "exponentially"

    @classmethod
    def forms(cls, robot: Robot) -> tuple[type[Mechanism], ...]:
        """Return that of first order, and for wheels that of an even acceleration."""
        return (Config, Config.with_default("follows", "evenly")) if robot.actuation.kind == "wheel" else (Config,)

    @classmethod
    def suits(cls, robot: Robot, conditions: SessionConditions) -> bool:
        """Know what lags: a speed or a setting."""
        return robot.actuation.kind != "unknown"

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Allow a period at most, and two of thrust's own."""
        period_s = robot.period_s
        begin = (0.1 * period_s, 0.35 * period_s)
        added = {"time_constant_s": Parameter(0.0, period_s, 0.0, "s", begin, 0.01 * period_s)}
        if robot.actuation.kind != "thrust":
            return added
        own = Parameter(0.0, 2 * period_s, None, "s", (0.25 * period_s,), 0.01 * period_s, doubted_ends="none")
        goes_on = Parameter(0.0, 0.25, None, "", (0.1,), 0.02, doubted_ends="none")
        return {**added, "own_time_constant_s": own, "own_turn_time_constant_s": own, "goes_on": goes_on}

    def added_lag_s(self) -> float:
        """Return the time constant, if it follows to first order."""
        return self.time_constant_s if self.follows == "exponentially" else 0.0

    def transient(self) -> Transient:
        """Let a change of setting bring about less, and later, the slower it is."""
        way_s, turn_s = self.own_time_constant_s, self.own_turn_time_constant_s
        turn_s = way_s if turn_s is None else turn_s
        way, turn = (
            1.0 if own_s is None or self.time_constant_s <= 0 else own_s / (own_s + self.time_constant_s)
            for own_s in (way_s, turn_s)
        )
        return Transient((way, way, turn), self.goes_on or 0.0)

    def plausible_alternatives(self) -> Sequence[Mechanism]:
        """Return a shorter lag of a fin that loses some of its own way beside its throw.

        What a change of setting brings about in the reference is the throw, which an added lag weakens, and the way
        that the fin takes for it by itself, which stays. How much of it is way is not known: servos are sold with 0.05
        to 0.26 s for 60 degrees, of which most changes are a half.
        """
        way, _, turn = self.transient().shares
        lost_s = (1 - (way + turn) / 2) * 0.05
        if lost_s <= 0:
            return ()
        shorter = max(1 - lost_s / self.time_constant_s, 0.01)
        own = {name: value * shorter for name, value in self.values().items() if name.endswith("time_constant_s")}
        return [self.model_copy(update=own)]

    def initial_memory(self, twist: Tensor, moment: Moment) -> Tensor | None:
        """Return how fast each wheel rolls, mm a period, (N, 2), if it speeds up evenly."""
        if self.follows == "exponentially" or self.time_constant_s <= 0:
            return None
        return wheel_travel(twist, moment.track_mm)

    def actuator_response(self, twist: Tensor, memory: Tensor, share: float, moment: Moment) -> tuple[Tensor, Tensor]:
        """Let wheels come to their speeds evenly."""
        largest, period_s = moment.robot.largest_displacement.forward_mm, moment.robot.period_s
        acceleration = largest / (2 * self.time_constant_s / period_s)  # mm a period, in a period
        aimed = wheel_travel(twist, moment.track_mm)
        takes = ((aimed - memory).abs() / acceleration).clamp(max=share)
        reached = memory + (aimed - memory).sign() * acceleration * takes
        rolled = reached - (reached - memory) / 2 * takes / share
        return twist_of_wheels(rolled, twist, moment.track_mm), reached

    def breakpoints(self, robot: Robot) -> tuple[float, ...]:
        """Look at thrust after each eighth of the change of its setting, at wheels in eighths of a period."""
        if robot.actuation.kind == "wheel":
            return tuple(step / 8 for step in range(1, 8)) if self.follows == "evenly" else ()
        lag = self.time_constant_s / robot.period_s
        return (*(lag * math.log(8 / left) for left in range(7, 0, -1)), 5 * lag)
