"""What the catalogue does not explain, learned: a residual over every part of the situation."""

from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from swarmtwin.gap.ensemble import Ensemble, folds_of, learn
from swarmtwin.gap.mechanism import Drive
from swarmtwin.gap.session import Session
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import Robot, SituationPart

FOLDS = 5
SHRINKAGE_STEPS = 21
PARTS: tuple[SituationPart, ...] = ("command", "previous_command", "pose", "elapsed_s", "duration_s", "neighbours")


class LearnedResidual(nn.Module):
    """An ensemble on command, previous command, place, heading, time, duration and neighbours.

    Attributes:
        robot: whose.
        surroundings: of the session.
        share: how much of the ensemble's answer is to be believed, by what it explained of runs it had not seen.
    """

    parts = PARTS

    def __init__(self, robot: Robot, surroundings: Surroundings, ensemble: Ensemble, share: float) -> None:
        super().__init__()
        self.robot, self.surroundings, self.ensemble, self.share = robot, surroundings, ensemble, share

    @classmethod
    def learn(cls, session: Session, residual: Tensor, spread: Tensor, seed: int) -> tuple[Self, np.ndarray]:
        """Learn what is left, residuals (N, 3) in mm, mm, rad, each of usual size `spread` (N, 3).

        Returns:
            the residual, and (N, 3) what it says of runs that it had not seen.
        """
        drive = session.drive
        inputs = columns(drive).numpy()
        fold = folds_of(session.run, FOLDS)
        usual = spread.median(dim=0).values
        weight = (usual / spread) ** 2
        ensemble = learn(
            _groups(drive.robot, inputs.shape[1]), inputs, (residual / usual).numpy(), fold, seed, weight.numpy()
        )
        with torch.no_grad():
            answers = ensemble(torch.as_tensor(inputs)).double() * usual
        unseen = answers[fold, np.arange(len(session))]
        share = _believed(unseen / spread, residual / spread)
        with torch.no_grad():
            ensemble.offset.mul_(usual.float())
            ensemble.scale.mul_(usual.float())
        return cls(drive.robot, drive.surroundings, ensemble.eval(), share), (share * unseen).numpy()

    def way(self, drive: Drive) -> Tensor:
        """Return what is to be added to the ways (N, 3)."""
        with torch.no_grad():
            answer: Tensor = self.ensemble(columns(drive)).mean(dim=0).double()
        return self.share * answer

    def description(self) -> dict[str, Any]:
        """Return what makes it up, without its weights."""
        return {"share": self.share, "members": self.ensemble.members, "groups": self.ensemble.groups}


def columns(drive: Drive) -> Tensor:
    """Return (N, columns), float32, of all that a residual may depend on."""
    robot, surroundings = drive.robot, drive.surroundings
    middle = torch.as_tensor((robot.command_low + robot.command_high) / 2)
    half = torch.as_tensor((robot.command_high - robot.command_low) / 2)
    size = torch.as_tensor(surroundings.arena_mm.high_mm - surroundings.arena_mm.low_mm) / 2
    heading = drive.pose[:, 2:]
    away = drive.neighbours[..., :2]
    near = torch.exp(-away.norm(dim=-1, keepdim=True) / (2 * max(robot.vehicle_size_mm)))
    push = (near * away / away.norm(dim=-1, keepdim=True).clamp(min=1.0)).nan_to_num(0.0).sum(dim=1)
    found = [
        (drive.command - middle) / half,
        (drive.previous_command - middle) / half,
        heading.cos(),
        heading.sin(),
        (drive.pose[:, :2] - surroundings.centre_mm) / size,
        2 * drive.progress[:, None] - 1,
        10 * (drive.duration_s[:, None] / robot.period_s - 1),
        push,
    ]
    return torch.cat(found, dim=-1).float()


def _groups(robot: Robot, width: int) -> list[list[int]]:
    commands = len(robot.command)
    command = list(range(commands))
    place = list(range(2 * commands, width))
    return [list(range(2 * commands)), [*command, *place], list(range(width))]


def _believed(said: Tensor, wanted: Tensor) -> float:
    """Return the share in [0, 1] of what is said that explains most of what was wanted."""
    best = float((said * wanted).sum() / (said**2).sum().clamp(min=1e-12))
    return min(max(best, 0.0), 1.0)
