"""A simulation that was learned from too little: it errs, and its members disagree by as much."""

import numpy as np
import torch
from exact_base import ExactBase, as_simulated, known_noise, session_of

from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.dynamics.predictor import DynamicsModule
from swarmtwin.geometry import exp_map

FOLDS = 6


class LearnedBase(DynamicsModule):
    """The exact model with a smooth error of the commands, as of one that was learned from few transitions.

    Its members have seen different runs. They err by the same, and each a little otherwise: so that a jackknife over
    them is as large as the error where `sure` is False, and a tenth of it where it is True.
    """

    inputs = ("command",)
    members = FOLDS

    def __init__(self, robot, sure, size=0.35, waves=12, seed=11):
        super().__init__()
        self.robot, self.exact = robot, ExactBase(robot)
        rng, columns = np.random.default_rng(seed), len(robot.command)
        self.waves = torch.as_tensor(rng.normal(0, 2.0, (FOLDS + 1, columns, waves)))
        self.offsets = torch.as_tensor(rng.uniform(0, 2 * np.pi, (FOLDS + 1, waves)))
        self.shares = torch.as_tensor(rng.normal(0, size * np.sqrt(2 / waves), (FOLDS + 1, waves, 3)))
        self.shares *= torch.tensor([1.0, 1.0, 0.02])
        self.shares[1:] *= np.sqrt(FOLDS) / (FOLDS - 1) * (0.1 if sure else 1.0)

    def _function(self, command, number):
        low, high = torch.as_tensor(self.robot.command_low), torch.as_tensor(self.robot.command_high)
        unit = 2 * (command - low) / (high - low) - 1
        return torch.cos(unit @ self.waves[number] + self.offsets[number]) @ self.shares[number]

    def twist(self, situation, member=None):
        command = situation.command.double()
        members = range(FOLDS) if member is None else [member]
        own = torch.stack([self._function(command, 1 + one) for one in members]).mean(dim=0)
        return self.exact.twist(command) + self._function(command, 0) + own

    def predict(self, situation):
        return exp_map(self.twist(situation))


def likelihood(robot, sure, moved=as_simulated, seed=3, size=0.35, of_error=11):
    """A session of a simulation that errs by a function that a seed of its own draws."""
    session = session_of(ExactBase(robot), np.random.default_rng(seed), moved)
    return SessionLikelihood(LearnedBase(robot, sure, size, seed=of_error), known_noise(), session)
