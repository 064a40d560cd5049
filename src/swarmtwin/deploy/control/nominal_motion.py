"""A robot's motion by its kinematics alone, for a robot that nobody has recorded yet: rough, and rather too fast."""

from swarmtwin.dynamics.model_config import model_config
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.robot import Robot
from swarmtwin.simulation.simulation import Simulation


def nominal_simulation(robot: Robot) -> Simulation:
    """Return a simulation by the equations that the robot's file names, with nothing fitted.

    At the command's limits it moves by the largest believable displacement, so that looking ahead in it errs on the
    safe side; a robot with momentum goes on for a while when it is told to stop. It knows nothing of how random motion
    is: `SafetySettings.unknown_spread` stands in.

    Raises:
        UserError: the robot's file names no kinematics.
    """
    config = model_config({"name": "kinematic", "situation": None}, "kinematic")
    return Simulation(NetworkDynamics(robot, config).eval()).eval()
