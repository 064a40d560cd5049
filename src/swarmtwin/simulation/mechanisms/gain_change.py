"""All actuators are stronger or weaker: wheel radius, propeller, supply."""

from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.robot import Robot
from swarmtwin.simulation.efforts import by_effort, change_effort
from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter


class Config(Mechanism):
    """The speed of every actuator is multiplied by `gain`; or its effort is, before what the robot makes of it.

    Another wheel changes the speed. A weaker supply or a shorter stroke changes the effort, which dead bands and a
    thrust that levels off turn into another change of speed.

    Attributes:
        gain: the factor.
        acts_on: what it multiplies.
        turning: the factor on how fast a vehicle turns, where it is another one, as a unit's own; not searched for.
    """

    stage: ClassVar = "supply"
    words: ClassVar = "every actuator runs at {gain} times its {acts_on}"
    remedy: ClassVar = "check supply voltage, wheel diameter or propeller; or learn the simulation anew"
    parameters: ClassVar = {"gain": Parameter(0.2, 2.5, 1.0, "", (1.0,))}

    name: Literal["gain_change"] = "gain_change"
    gain: float
    acts_on: Literal["speed", "effort"] = "speed"
    turning: float | None = None

    @classmethod
    def forms(cls, robot: Robot) -> tuple[type[Mechanism], ...]:
        """Return that of the speed and that of the effort."""
        return Config, Config.with_default("acts_on", "effort")

    def transform_command(self, command: Tensor, moment: Moment) -> Tensor:
        """Multiply the efforts, if it acts on them."""
        if self.acts_on == "speed":
            return command
        return change_effort(command, moment, lambda effort: effort * self.gain)

    def supply_gain(self, moment: Moment) -> Tensor | None:
        """Return the gain of all actuators, if it acts on their speed."""
        if self.acts_on == "effort":
            return None
        gain = torch.full((1, 1), self.gain, dtype=torch.float64)
        if self.turning is None:
            return gain
        ahead, aside, _ = by_effort(gain, moment).expand(1, 3).unbind(dim=-1)
        return torch.stack([ahead, aside, torch.full_like(ahead, self.turning)], dim=-1)
