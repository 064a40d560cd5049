"""Residual diffusion: an ensemble's mean displacement for a sampled situation, plus a diffused residual.

Most of it is supervised regression: the ensemble is a dynamics model in its own right (`model=ensemble` trains such a
one directly), and what is diffused are the situations and the residuals around its mean.
"""

import math
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from swarmtwin.generators.columns import Columns
from swarmtwin.generators.conditional import ConditionalGenerator
from swarmtwin.generators.denoiser import Denoiser
from swarmtwin.generators.generator import Count, Generator, GeneratorConfig, GeneratorTraining, RealRows, Steps
from swarmtwin.geometry import orientation_error_rad, position_error_mm, wrap_angle
from swarmtwin.learning.ensemble import Ensemble, folds_of
from swarmtwin.learning.recipe import OneCycle
from swarmtwin.robot import Positive


class ResidualDiffusion(ConditionalGenerator):
    """Draws a situation, then a displacement for it: the mean of an ensemble of perceptrons plus a residual.

    One diffusion model draws residuals, given the situation; another draws how the situation's columns go together.
    """

    config: "Config"
    residual_scale: Tensor

    def __init__(self, columns: Columns, config: "Config") -> None:
        super().__init__(columns, config, config)
        columns_seen = [range(self.encoding.width)]
        self.mean_model = Ensemble(config.members, columns_seen, layers=config.mean_model_layers, alike=False)
        self.noise = Denoiser(3, self.encoding.width, config.noise_width)
        self.situations = Denoiser(columns.situation_width, 0, config.noise_width)
        self.register_buffer("residual_scale", torch.ones(3))

    def displacements(self, inputs: Tensor, rng: torch.Generator) -> Tensor:
        """Add a residual to each mean."""
        residual = self.noise.sample(inputs, self.config.sampling_steps, rng) * self.residual_scale
        mean: Tensor = self.mean_model.mean(inputs)
        return mean + residual


class ResidualDiffusionTraining(GeneratorTraining):
    """First the ensemble learns the displacement, by the loss that dynamics models are trained with.

    Then the two diffusion models learn the residuals around it, each by the member that has not seen its run, and the
    situations.
    """

    generator: ResidualDiffusion
    inputs: Tensor
    displacement: Tensor
    fold: Tensor
    residual: Tensor
    scores: Tensor
    seen: list[Tensor]
    validation_inputs: Tensor
    validation_displacement: Tensor

    def __init__(self, generator: ResidualDiffusion, real: RealRows) -> None:
        super().__init__(generator)
        situation, displacement = real.train[:, :-3], real.train[:, -3:]
        generator.marginals.learn(situation)
        generator.mean_model.learn_scaling(displacement)
        self.register_buffer("inputs", generator.inputs(situation))
        self.register_buffer("displacement", displacement)
        fold = folds_of(real.run.numpy(), generator.config.members, split_runs=True)
        self.register_buffer("fold", torch.as_tensor(fold))
        self.register_buffer("residual", torch.zeros_like(displacement))
        self.register_buffer("scores", generator.marginals.scores(situation))
        self.register_buffer("validation_inputs", generator.inputs(real.validation[:, :-3]))
        self.register_buffer("validation_displacement", real.validation[:, -3:])

    def on_fit_start(self) -> None:
        """Deal the runs out: each member may see the rows that are not in its fold."""
        self.seen = [torch.nonzero(self.fold != member)[:, 0] for member in range(self.generator.config.members)]

    def configure_optimizers(self) -> Any:
        """One optimiser for the ensemble, one for both diffusion models; the learning rate is set at each step."""
        generator = self.generator
        return [
            torch.optim.AdamW(
                parameters, lr=0, betas=(0.9, 0.99), weight_decay=generator.config.weight_decay, fused=True
            )
            for parameters in (
                [*generator.mean_model.parameters()],
                [*generator.noise.parameters(), *generator.situations.parameters()],
            )
        ]

    def training_step(self, step: int, batch_index: int) -> dict[str, Tensor]:
        """Take a step of the ensemble's training, or of the diffusion models'."""
        config = self.generator.config
        if step < config.mean_model_steps:
            loss = self._mean_model_loss()
            learning_rate = config.mean_model_learning_rate * OneCycle().share(step, config.mean_model_steps)
            self.descend(loss, 0, learning_rate)
            return {"mean_model_loss": loss.detach() / config.members}
        step -= config.mean_model_steps
        if step == 0:
            self._take_residuals()
        rows = self._random_rows(len(self.inputs))
        noise_loss = self.generator.noise.loss(self.residual[rows], self.inputs[rows])
        situation_loss = self.generator.situations.loss(self.scores[rows], self.inputs[rows, :0])
        learning_rate = config.noise_learning_rate * OneCycle().share(step, config.noise_steps)
        self.descend(noise_loss + situation_loss, 1, learning_rate)
        return {"noise_loss": noise_loss.detach(), "situation_loss": situation_loss.detach()}

    def validation_figures(self) -> dict[str, float]:
        """Errors of the ensemble's mean: what a dynamics model could reach at best on samples."""
        with torch.inference_mode():
            expected = self.generator.mean_model.mean(self.validation_inputs)
        measured = self.validation_displacement
        return {
            "validation_position_mm": float(position_error_mm(expected, measured).mean()),
            "validation_orientation_deg": math.degrees(float(orientation_error_rad(expected, measured).mean())),
        }

    def _mean_model_loss(self) -> Tensor:
        """Return the sum over members of mean position error in mm and mean orientation error in degrees.

        Each member is given rows of its own choice, none of its fold.
        """
        rows = torch.stack([seen[self._random_rows(len(seen))] for seen in self.seen])
        residual = self.generator.mean_model(self.inputs[rows]) - self.displacement[rows]
        position_mm = torch.linalg.vector_norm(residual[..., :2], dim=-1)
        return (position_mm + torch.rad2deg(wrap_angle(residual[..., 2]).abs())).mean(dim=1).sum()

    def _take_residuals(self) -> None:
        generator = self.generator
        with torch.no_grad():
            parts = zip(self.inputs.split(16384), self.fold.split(16384), strict=True)
            residual = self.displacement - torch.cat([generator.mean_model.held_out(*part) for part in parts])
            residual[:, 2] = wrap_angle(residual[:, 2])
            generator.residual_scale.copy_(residual.std(dim=0).clamp(min=1e-6))
            self.residual.copy_(residual / generator.residual_scale)

    def _random_rows(self, of: int) -> Tensor:
        return torch.randint(of, (self.generator.config.batch_size,), device=self.device)


class Config(GeneratorConfig):
    """`conf/generator/residual_diffusion.yaml`.

    Attributes:
        members: perceptrons in the ensemble; each leaves out a part of the runs, one in `members`.
        mean_model_layers: widths of their hidden layers.
        mean_model_steps: optimiser steps of the ensemble.
        mean_model_learning_rate: its largest learning rate.
        noise_width: width of the two diffusion models' hidden layers.
        noise_steps: optimiser steps of both.
        noise_learning_rate: their largest learning rate.
        weight_decay: of all.
        batch_size: real rows a step, for each member and each diffusion model.
        wall_reaches: where motion depends on the pose, the distances over which walls are looked for, as shares of the
            arena's shorter side: a ladder over all that could be, since nobody knows how far walls are felt.
        place_weight: of position and heading themselves, beside the walls: what depends on the place alone is rare.
        quantiles: that each column of the situation is kept as.
        sampling_steps: from noise to data.
    """

    name: Literal["residual_diffusion"] = "residual_diffusion"
    members: Count = 5
    mean_model_layers: Annotated[tuple[Steps, ...], Field(min_length=1)] = (96, 96)
    mean_model_steps: Steps = 1000
    mean_model_learning_rate: Positive = 0.01
    noise_width: Steps = 96
    noise_steps: Steps = 1500
    noise_learning_rate: Positive = 0.005
    weight_decay: Annotated[float, Field(ge=0)] = 0.5
    batch_size: Steps = 512
    wall_reaches: tuple[Positive, ...] = (0.125, 0.03125)
    place_weight: Annotated[float, Field(ge=0)] = 0.2
    quantiles: Count = 129
    sampling_steps: Count = 12

    @property
    def training_steps(self) -> int:
        """Those of the ensemble, then those of the diffusion models."""
        return self.mean_model_steps + self.noise_steps

    def build(self, columns: Columns) -> ResidualDiffusion:
        """Build it."""
        return ResidualDiffusion(columns, self)

    def training(self, generator: Generator, real: RealRows) -> ResidualDiffusionTraining:
        """Return its training."""
        assert isinstance(generator, ResidualDiffusion)
        return ResidualDiffusionTraining(generator, real)
