"""The one interface of all dynamics models: a situation goes in, a displacement comes out."""

from collections.abc import Mapping
from typing import Any, Self, cast

import lightning
import torch
from torch import Tensor
from torch.optim.lr_scheduler import ReduceLROnPlateau

from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.recipe import Recipe
from swarmtwin.dynamics.scaling import Encoding, Scaling
from swarmtwin.dynamics.situation import Situation
from swarmtwin.geometry import wrap_angle
from swarmtwin.robot import Robot

Batch = tuple[Situation, Tensor]


class Dynamics(lightning.LightningModule):
    """A forward dynamics model of one robot, equation (1) of the paper: situation → displacement.

    It owns a network and both scalings, so that a saved model needs nothing beside it.

    Attributes:
        robot: the robot whose motion it predicts.
        config: the model's configuration.
        parts: the parts of a situation that it looks at.
        recipe: how it is trained; not needed to predict.
        training_steps: how many steps its whole training takes; likewise.
    """

    recipe: Recipe | None = None
    training_steps: int = 0

    def __init__(self, robot: Robot, config: ModelConfig) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.robot = robot
        self.config = config
        self.parts = config.parts(robot)
        self.encoding = Encoding(robot, self.parts, config.scaling)
        self.network = config.build(robot, self.encoding.width)
        self.output_scaling = Scaling(3, config.scaling)

    @classmethod
    def with_weights(cls, robot: Robot, config: ModelConfig, weights: Mapping[str, Tensor]) -> Self:
        """Build a trained model from its weights and scalings, ready to predict; no random number is drawn."""
        with torch.random.fork_rng(devices=[]):
            dynamics = cls(robot, config)
        dynamics.load_state_dict(weights)
        return dynamics.eval()

    def learn_scaling(self, situation: Situation, displacement: Tensor) -> None:
        """Take both scalings from the training split: N situations and their displacements (N, 3)."""
        self.encoding.learn(situation)
        self.output_scaling.learn(displacement)

    def forward(self, situation: Situation) -> Tensor:
        """Predict displacements (N, 3): forward_mm, left_mm, turn_rad in the vehicles' frames."""
        return self.output_scaling.inverse(self.network(self.encoding(situation)))

    def errors(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the mean position error in mm and the mean orientation error in rad over a batch, with gradients."""
        situation, displacement = batch
        residual = self(situation) - displacement
        position_mm = torch.linalg.vector_norm(residual[:, :2], dim=1).mean()
        return position_mm, wrap_angle(residual[:, 2]).abs().mean()

    def training_step(self, batch: Batch, batch_index: int) -> dict[str, Tensor]:
        """Take one step of the recipe's optimiser and schedule."""
        assert self.recipe is not None
        optimiser = cast(Any, self.optimizers(use_pl_optimizer=False))
        position_mm, orientation_rad = self.errors(batch)
        loss = position_mm + self.recipe.heading_weight * orientation_rad
        optimiser.zero_grad()
        self.manual_backward(loss)
        optimiser.step()
        scheduler = cast(Any, self.lr_schedulers())
        if not isinstance(scheduler, ReduceLROnPlateau):
            scheduler.step()
        return {"loss": loss.detach(), "errors": torch.stack([position_mm, orientation_rad]).detach()}

    def validation_step(self, batch: Batch, batch_index: int) -> dict[str, Tensor]:
        """Return the batch's mean errors, position in mm and orientation in rad."""
        return {"errors": torch.stack(self.errors(batch))}

    def configure_optimizers(self) -> Any:
        """Build what the recipe says."""
        assert self.recipe is not None
        optimiser = self.recipe.optimiser(self.parameters())
        return {"optimizer": optimiser, "lr_scheduler": self.recipe.scheduler(optimiser, self.training_steps)}

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        """Move a batch to where the network is."""
        situation, displacement = batch
        return situation.to(device), displacement.to(device)
