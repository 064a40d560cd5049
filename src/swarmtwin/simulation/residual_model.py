"""What the catalogue does not explain, learned: a residual over every part of the situation."""

from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from swarmtwin.learning.encoding import Encoding, Feature
from swarmtwin.learning.ensemble import Ensemble, folds_of, learn
from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Moment


class ResidualModel(nn.Module):
    """An ensemble on command, previous command, place, heading, time, duration and neighbours.

    Attributes:
        robot: whose.
        conditions: of the session.
        share: how much of the ensemble's answer is to be believed, by what it explained of runs it had not seen.
    """

    inputs: tuple[SituationPart, ...] = (
        "command",
        "previous_command",
        "pose",
        "elapsed_s",
        "duration_s",
        "neighbours",
    )

    def __init__(self, robot: Robot, conditions: SessionConditions, ensemble: Ensemble, share: float) -> None:
        super().__init__()
        self.robot, self.conditions, self.ensemble, self.share = robot, conditions, ensemble, share
        self.encoding = residual_encoding(robot, conditions)

    @classmethod
    def learn(
        cls,
        moment: Moment,
        command: Tensor,
        previous_command: Tensor,
        run: np.ndarray,
        residual: Tensor,
        scale: Tensor,
        seed: int,
        folds: int = 5,
    ) -> tuple[Self, np.ndarray]:
        """Learn twists (N, 3) that a simulation leaves unexplained.

        Args:
            moment: where N vehicles were.
            command: (N, m).
            previous_command: (N, m).
            run: (N,) numbers of the runs; whole runs are held out from each member.
            residual: (N, 3) measured minus simulated twists, mm, mm, rad.
            scale: (N, 3) usual size of each.
            seed: of everything random.
            folds: members of the ensemble.

        Returns:
            the model, and (N, 3) what it says of runs that it had not seen.
        """
        encoding = residual_encoding(moment.robot, moment.conditions)
        inputs = encoding(moment.situation(command, previous_command, previous_command)).numpy()
        fold = folds_of(run, folds)
        usual = scale.median(dim=0).values
        weight = (usual / scale) ** 2
        groups = _groups(moment.robot, inputs.shape[1])
        ensemble = learn(groups, inputs, (residual / usual).numpy(), fold, seed, weight.numpy())
        with torch.no_grad():
            answers = ensemble(torch.as_tensor(inputs)).double() * usual
        unseen = answers[fold, np.arange(len(run))]
        share = _believed(unseen / scale, residual / scale)
        with torch.no_grad():
            ensemble.offset.mul_(usual.float())
            ensemble.scale.mul_(usual.float())
        return cls(moment.robot, moment.conditions, ensemble.eval(), share), (share * unseen).numpy()

    def twist(self, moment: Moment, command: Tensor, previous_command: Tensor) -> Tensor:
        """Return what is to be added to the twists (N, 3)."""
        columns = self.encoding(moment.situation(command, previous_command, previous_command))
        with torch.no_grad():
            answer: Tensor = self.ensemble(columns).mean(dim=0).double()
        return self.share * answer

    def description(self) -> dict[str, Any]:
        """Return what makes it up, without its weights."""
        return {"share": self.share, "members": self.ensemble.members, "groups": self.ensemble.groups}


def residual_encoding(robot: Robot, conditions: SessionConditions) -> Encoding:
    """Return the encoding of all that a residual may depend on."""
    features: tuple[Feature, ...] = (
        "command",
        "previous_command",
        "direction",
        "position",
        "elapsed_s",
        "duration_s",
        "neighbours",
    )
    return Encoding(robot, features, "limits", arena_mm=conditions.arena_mm, session_s=conditions.session_s)


def _groups(robot: Robot, width: int) -> list[list[int]]:
    commands = len(robot.command)
    command = list(range(commands))
    place = list(range(2 * commands, width))
    return [list(range(2 * commands)), [*command, *place], list(range(width))]


def _believed(said: Tensor, wanted: Tensor) -> float:
    """Return the share in [0, 1] of what is said that explains most of what was wanted."""
    best = float((said * wanted).sum() / (said**2).sum().clamp(min=1e-12))
    return min(max(best, 0.0), 1.0)
