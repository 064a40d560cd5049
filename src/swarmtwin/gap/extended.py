"""Base and mechanisms are a dynamics model again: the world, the policies and the robots take it without knowing."""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.model_config import ModelConfig, Steps
from swarmtwin.dynamics.scaling import Encoding, ScalingMethod
from swarmtwin.dynamics.situation import ALL_PARTS, Situation
from swarmtwin.dynamics.twist import displacement_of, twist_of
from swarmtwin.errors import UserError
from swarmtwin.gap.base import AnyBase
from swarmtwin.gap.learned import LearnedResidual
from swarmtwin.gap.mechanism import Drive, Mechanism
from swarmtwin.gap.motion import likeliest_displacement
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import Positive, Robot, SituationPart


class ExtendedConfig(ModelConfig):
    """What `model.yaml` says of an extended simulation; it is made by `diagnose`, not trained."""

    scaling: ClassVar[ScalingMethod] = "standard"

    name: Literal["extended"] = "extended"
    learning_rate: Positive = 1.0
    steps: Steps = 1
    base: dict[str, Any]
    mechanisms: tuple[dict[str, Any], ...]
    surroundings: Surroundings
    learned_residual: dict[str, Any] | None = None

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Refuse: there is no network to train.

        Raises:
            UserError: always.
        """
        raise UserError("model 'extended' is made by swarmtwin diagnose; it cannot be trained")


class ExtendedDynamics(Dynamics):
    """A base simulation changed by mechanisms, and by a learned residual where no mechanism explains what is left.

    Attributes:
        base: the simulation that it extends.
        mechanisms: in the order of the signal's way.
        surroundings: of the session that they were found in.
        residual: what was learned beyond them, or None.
    """

    def __init__(
        self,
        base: AnyBase,
        mechanisms: Sequence[Mechanism],
        surroundings: Surroundings,
        residual: LearnedResidual | None = None,
    ) -> None:
        super(Dynamics, self).__init__()
        self.automatic_optimization = False
        self.robot = base.robot
        self.base = base
        self.mechanisms = tuple(mechanisms)
        self.surroundings = surroundings
        self.residual = residual
        needed = {*base.parts, *(part for mechanism in mechanisms for part in mechanism.needs)}
        if any(mechanism.uses_history for mechanism in mechanisms):
            needed.add("previous_command")
        if residual:
            needed |= set(residual.parts)
        self.parts: tuple[SituationPart, ...] = tuple(part for part in ALL_PARTS if part in needed)
        self.config = ExtendedConfig(
            situation=self.parts,
            base=base.description(),
            mechanisms=tuple(mechanism.model_dump(mode="json", exclude_none=True) for mechanism in mechanisms),
            surroundings=surroundings,
            learned_residual=residual.description() if residual else None,
        )
        looked_at = [part for part in self.parts if part in ("command", "previous_command", "pose")]
        with torch.random.fork_rng(devices=[]):
            self.encoding = Encoding(base.robot, looked_at, "standard")
        low, high = (torch.as_tensor(limits) for limits in (base.robot.command_low, base.robot.command_high))
        self.rest = torch.zeros(len(low), dtype=torch.float64).clamp(low, high)

    def forward(self, situation: Situation) -> Tensor:
        """Predict displacements (N, 3): forward_mm, left_mm, turn_rad, as the camera will measure them."""
        drive = self._drive(situation)
        displacement = likeliest_displacement(self.base, self.mechanisms, drive)
        if self.residual:
            displacement = displacement_of(twist_of(displacement) + self.residual.way(drive))
        return displacement.float()

    def _drive(self, situation: Situation) -> Drive:
        """Fill in what nobody asks for; before the first command of a run the vehicle was at rest."""
        command = situation.command.double()
        count = len(command)
        previous = self._known(situation.previous_command, self.rest.expand_as(command))
        pose = situation.pose if situation.pose is not None else torch.zeros(count, 3)
        elapsed_s = situation.elapsed_s if situation.elapsed_s is not None else torch.zeros(count)
        period_s = self.robot.period_s
        duration_s = situation.duration_s if situation.duration_s is not None else torch.full((count,), period_s)
        neighbours = situation.neighbours if situation.neighbours is not None else torch.zeros(count, 0, 3)
        return Drive(
            robot=self.robot,
            surroundings=self.surroundings,
            command=command,
            previous_command=previous,
            earlier_command=self._known(situation.earlier_command, previous),
            pose=pose.double(),
            elapsed_s=elapsed_s.double(),
            duration_s=duration_s.double(),
            neighbours=neighbours.double(),
        )

    @staticmethod
    def _known(command: Tensor | None, otherwise: Tensor) -> Tensor:
        if command is None:
            return otherwise
        return torch.where(command.isnan(), otherwise, command.double())
