"""A probabilistic ensemble, the paper's future work (section 5): uncertainty, and how vehicles differ, encoded."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field
from torch import nn

from swarmtwin.dynamics.mean_variance import MeanVarianceEnsemble
from swarmtwin.dynamics.model_config import ModelConfig, Steps, Widths
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot


class Config(ModelConfig):
    """`conf/model/probabilistic_ensemble.yaml`.

    Each member learns from a bootstrap of whole runs, of one vehicle where several were recorded. In a sampled
    simulation a vehicle draws a member when it is put down and keeps it, so that vehicles differ, and each period's
    noise from that member's variance. The variances are calibrated on the validation runs (`dynamics/spread.py`).

    Attributes:
        members: how many perceptrons.
        layers: widths of their hidden layers.
        variance_weight: β of the loss; 0 is likelihood alone, 1 lets the means be learned as by least squares.
    """

    scaling: ClassVar[ScalingMethod] = "standard"

    name: Literal["probabilistic_ensemble"] = "probabilistic_ensemble"
    learning_rate: Positive = 0.005
    steps: Steps = 1000
    wall_reaches: tuple[Positive, ...] = (0.125, 0.03125)
    members: Annotated[int, Field(ge=2)] = 5
    layers: Widths = (96, 96)
    variance_weight: Annotated[float, Field(ge=0, le=1)] = 0.5

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the perceptrons."""
        return MeanVarianceEnsemble(inputs, self.members, self.layers, self.variance_weight)
