"""The plain rival of every learned model: the robot's kinematic model, fitted in seconds without a trainer."""

import numpy as np
import torch

from swarmtwin.dynamics.model_config import model_config
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.geometry import wrap_angle
from swarmtwin.learning.situation import Situation
from swarmtwin.transitions import Transitions


def fit_kinematics(transitions: Transitions, iterations: int = 100) -> NetworkDynamics:
    """Fit `model=kinematic` to transitions, by the errors that models are judged by: a degree weighs as much as a mm.

    Args:
        transitions: N of one robot.
        iterations: of L-BFGS over all transitions, at most; seven parameters need some thirty.

    Raises:
        UserError: the robot's file names no kinematics.
    """
    dynamics = NetworkDynamics(transitions.robot, model_config({"name": "kinematic", "situation": None}, "model"))
    situation = Situation.from_transitions(transitions, dynamics.inputs)
    displacement = torch.as_tensor(transitions.displacement, dtype=torch.float32)
    optimiser = torch.optim.LBFGS(dynamics.parameters(), max_iter=iterations, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        residual = dynamics(situation) - displacement
        position_mm = torch.linalg.vector_norm(residual[:, :2], dim=1).mean()
        mean = position_mm + wrap_angle(residual[:, 2]).abs().mean() * (180 / np.pi)
        mean.backward()
        return mean

    optimiser.step(loss)
    return dynamics.eval()
