"""What supply gives actuators: how much faster or slower all that they do is by it."""

from collections.abc import Sequence
from typing import Self

from torch import Tensor

from swarmtwin.simulation.efforts import by_effort, slowed
from swarmtwin.simulation.mechanism import Mechanism, Moment


class Supply:
    """What becomes of twists (N, 3) of actuators with their supply as it is in a moment.

    Args:
        factors: each as `efforts.slowed` takes it.
        track_mm: of the robot.
    """

    def __init__(self, factors: Sequence[Tensor], track_mm: float) -> None:
        self._factors, self._track_mm = factors, track_mm

    @classmethod
    def of(cls, mechanisms: Sequence[Mechanism], moment: Moment) -> Self:
        """Ask mechanisms for their gains; a gain of one column acts on the actuators' efforts."""
        gains = [gain for one in mechanisms if (gain := one.supply_gain(moment)) is not None]
        return cls([by_effort(gain, moment) if gain.shape[-1] == 1 else gain for gain in gains], moment.track_mm)

    def __call__(self, twist: Tensor) -> Tensor:
        """Return the twists (N, 3) of actuators that would do these with their usual supply."""
        for factor in self._factors:
            twist = slowed(twist, factor, self._track_mm)
        return twist
