"""Conditional diffusion: situations as they were driven, the expected displacement, and the noise around it."""

from typing import Annotated, Any, Literal, cast

import torch
from pydantic import Field
from torch import Tensor

from swarmtwin.generators.base import Generator, RealRows
from swarmtwin.generators.denoiser import Denoiser
from swarmtwin.generators.features import SituationFeatures
from swarmtwin.generators.generator_config import Count, GeneratorConfig, Steps
from swarmtwin.generators.marginals import Marginals
from swarmtwin.generators.schedule import one_cycle
from swarmtwin.generators.trend import Trend, folds
from swarmtwin.geometry import orientation_error_rad, position_error_mm, wrap_angle
from swarmtwin.robot import Positive, Robot

DEGREES = 180 / torch.pi
CHUNK = 16384


class Diffusion(Generator):
    """Draws a situation, and then a displacement for it: the expected one plus a residual.

    In the training's first part an ensemble learns the expected displacement, by the loss that dynamics models are
    trained with. In the second, one diffusion model learns the residuals around it, given the situation, and another
    learns how the situations' columns go together. The columns' own distributions are kept as quantiles.
    """

    config: "Config"

    def __init__(self, robot: Robot, config: "Config") -> None:
        super().__init__(robot, config)
        width = self.columns.situation_width
        self.features = SituationFeatures(self.columns, config.wall_reach_lengths, config.place_weight)
        self.trend = Trend(self.features.width, config.members, config.trend_layers)
        self.noise = Denoiser(3, self.features.width, config.noise_width)
        self.situations = Denoiser(width, 0, config.noise_width)
        self.marginals = Marginals(width, config.quantiles)
        self.register_buffer("residual_scale", torch.ones(3))

    residual_scale: Tensor

    def start(self, real: RealRows) -> None:
        """Take scalings and quantiles, and deal the runs out to the ensemble's members."""
        self.real = real
        situation, displacement = self._parts(real.train)
        self.marginals.learn(situation)
        self.trend.learn_scaling(displacement)
        self._inputs = self.features(situation)
        self._displacement = displacement
        self._fold = folds(real.run, self.trend.members)
        self._taught = [torch.nonzero(self._fold != member)[:, 0] for member in range(self.trend.members)]

    def configure_optimizers(self) -> Any:
        """One optimiser for each part of the training."""
        second = [*self.noise.parameters(), *self.situations.parameters()]
        decay = self.config.weight_decay
        return [
            torch.optim.AdamW(parameters, lr=0, betas=(0.9, 0.99), weight_decay=decay, fused=True)
            for parameters in ([*self.trend.parameters()], second)
        ]

    def training_step(self, step: int, batch_index: int) -> dict[str, Tensor]:
        """Take a step of the first part or of the second."""
        if step < self.config.trend_steps:
            loss = self._trend_loss()
            self._optimise(0, step / self.config.trend_steps, loss)
            return {"trend_loss": loss.detach() / self.trend.members}
        if step == self.config.trend_steps:
            self._take_residuals()
        losses = self._noise_losses()
        self._optimise(1, (step - self.config.trend_steps) / self.config.noise_steps, losses[0] + losses[1])
        return {"noise_loss": losses[0].detach(), "situation_loss": losses[1].detach()}

    def validation_figures(self) -> dict[str, float]:
        """Errors of the expected displacement: what a dynamics model could reach at best on these samples."""
        situation, displacement = self._parts(self.real.validation)
        with torch.inference_mode():
            expected = self._expected(situation)
        return {
            "validation_position_mm": float(position_error_mm(expected, displacement).mean()),
            "validation_orientation_deg": DEGREES * float(orientation_error_rad(expected, displacement).mean()),
        }

    def draw(self, count: int, source: torch.Generator) -> Tensor:
        """Draw situations, then displacements."""
        with torch.inference_mode():
            sizes = [min(CHUNK, count - start) for start in range(0, count, CHUNK)]
            return torch.cat([self._draw(size, source) for size in sizes])

    def _draw(self, count: int, source: torch.Generator) -> Tensor:
        scores = self.situations.sample(torch.empty(count, 0), self.config.sampling_steps, source)
        situation = self.marginals.values(scores)
        features = self.features(situation.float())
        residual = self.noise.sample(features, self.config.sampling_steps, source) * self.residual_scale
        displacement = self.trend(features) + residual
        displacement[:, 2] = wrap_angle(displacement[:, 2])
        return torch.cat([situation, displacement], dim=1)

    def _parts(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        return rows[:, :-3], rows[:, -3:]

    def _expected(self, situation: Tensor) -> Tensor:
        return torch.cat([self.trend(self.features(chunk)) for chunk in situation.split(CHUNK)])

    def _trend_loss(self) -> Tensor:
        """Return the sum over members of mean position error in mm and mean orientation error in degrees."""
        size = self.config.batch_size
        rows = torch.stack([taught[torch.randint(len(taught), (size,))] for taught in self._taught])
        predicted, measured = self.trend.by_member(self._inputs[rows]), self._displacement[rows]
        position_mm = torch.linalg.vector_norm((predicted - measured)[..., :2], dim=-1)
        orientation_deg = DEGREES * wrap_angle(predicted[..., 2] - measured[..., 2]).abs()
        return (position_mm + orientation_deg).mean(dim=1).sum()

    def _take_residuals(self) -> None:
        with torch.no_grad():
            parts = zip(self._inputs.split(CHUNK), self._fold.split(CHUNK), strict=True)
            expected = torch.cat([self.trend.held_out(*part) for part in parts])
            residual = self._displacement - expected
            residual[:, 2] = wrap_angle(residual[:, 2])
            self.residual_scale.copy_(residual.std(dim=0).clamp(min=1e-6))
            self._residual = residual / self.residual_scale
            self._scores = self.marginals.scores(self._parts(self.real.train)[0])

    def _noise_losses(self) -> tuple[Tensor, Tensor]:
        rows = torch.randint(len(self._residual), (self.config.batch_size,))
        noise = self.noise.loss(self._residual[rows], self._inputs[rows])
        return noise, self.situations.loss(self._scores[rows], torch.empty(len(rows), 0))

    def _optimise(self, part: int, progress: float, loss: Tensor) -> None:
        optimiser = cast(Any, self.optimizers(use_pl_optimizer=False))[part]
        peak = (self.config.trend_learning_rate, self.config.noise_learning_rate)[part]
        optimiser.param_groups[0]["lr"] = peak * one_cycle(progress)
        optimiser.zero_grad()
        self.manual_backward(loss)
        optimiser.step()


class Config(GeneratorConfig):
    """`conf/generator/diffusion.yaml`."""

    name: Literal["diffusion"] = "diffusion"
    members: Count = 5
    trend_layers: Annotated[tuple[Steps, ...], Field(min_length=1)] = (96, 96)
    trend_steps: Steps = 1000
    trend_learning_rate: Positive = 0.01
    noise_width: Steps = 96
    noise_steps: Steps = 1500
    noise_learning_rate: Positive = 0.005
    weight_decay: Annotated[float, Field(ge=0)] = 0.5
    batch_size: Steps = 512
    wall_reach_lengths: Positive = 0.3
    place_weight: Annotated[float, Field(ge=0)] = 0.2
    quantiles: Count = 129
    sampling_steps: Count = 12

    @property
    def training_steps(self) -> int:
        """Both parts of the training."""
        return self.trend_steps + self.noise_steps

    def build(self, robot: Robot) -> Diffusion:
        """Build it."""
        return Diffusion(robot, self)
