"""Conditional diffusion: a situation is drawn, and a displacement diffused for it; nothing in it is supervised.

Two diffusion models (`Denoiser`: TrigFlow, Lu and Song 2024), one of displacements given the situation, one of
situations. Residual diffusion differs from it in one thing: there an ensemble learned the mean displacement by
supervised regression, and only what remains is diffused. Beside each other they tell what that mean is worth.
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
from swarmtwin.learning.encoding import Scaling
from swarmtwin.learning.recipe import OneCycle
from swarmtwin.robot import Positive


class ConditionalDiffusion(ConditionalGenerator):
    """A diffusion model of situations, and one of displacements, standardised, given the situation."""

    config: "Config"

    def __init__(self, columns: Columns, config: "Config") -> None:
        super().__init__(columns, config, config)
        waves = 2 * config.command_waves * len(self.encoding.columns_of("command"))
        self.noise = Denoiser(3, self.encoding.width + waves, config.noise_width)
        self.situations = Denoiser(columns.situation_width, 0, config.noise_width)
        self.scaling = Scaling(3, "standard")

    def displacements(self, inputs: Tensor, rng: torch.Generator) -> Tensor:
        """Diffuse displacements."""
        return self.scaling.inverse(self.noise.sample(inputs, self.config.sampling_steps, rng))

    def inputs(self, situation: Tensor) -> Tensor:
        """Return what the networks are given of situations: beside their encoding waves of each command.

        Fourier features (Tancik et al. 2020): without them a network finds bends such as a dead band's too slowly.
        """
        encoded = super().inputs(situation)
        command = encoded[:, self.encoding.columns_of("command")]
        phases = [math.pi * number * command for number in range(1, self.config.command_waves + 1)]
        return torch.cat([encoded, *(wave(phase) for phase in phases for wave in (torch.sin, torch.cos))], dim=1)


class ConditionalDiffusionTraining(GeneratorTraining):
    """Both diffusion models learn at every step."""

    generator: ConditionalDiffusion
    inputs: Tensor
    displacement: Tensor
    scores: Tensor
    validation_inputs: Tensor
    validation_displacement: Tensor

    def __init__(self, generator: ConditionalDiffusion, real: RealRows) -> None:
        super().__init__(generator)
        situation, displacement = real.train[:, :-3], real.train[:, -3:]
        generator.marginals.learn(situation)
        generator.scaling.learn(displacement)
        self.register_buffer("inputs", generator.inputs(situation))
        self.register_buffer("displacement", generator.scaling(displacement))
        self.register_buffer("scores", generator.marginals.scores(situation))
        self.register_buffer("validation_inputs", generator.inputs(real.validation[:, :-3]))
        self.register_buffer("validation_displacement", generator.scaling(real.validation[:, -3:]))

    def configure_optimizers(self) -> Any:
        """One optimiser; the learning rate is set at each step."""
        generator, decay = self.generator, self.generator.config.weight_decay
        parameters = [*generator.noise.parameters(), *generator.situations.parameters()]
        return [torch.optim.AdamW(parameters, lr=0, betas=(0.9, 0.99), weight_decay=decay, fused=True)]

    def training_step(self, step: int, batch_index: int) -> dict[str, Tensor]:
        """Take a step of both."""
        config = self.generator.config
        rows = torch.randint(len(self.inputs), (config.batch_size,), device=self.device)
        noise_loss = self.generator.noise.loss(self.displacement[rows], self.inputs[rows])
        situation_loss = self.generator.situations.loss(self.scores[rows], self.inputs[rows, :0])
        learning_rate = config.learning_rate * OneCycle().share(step, config.steps)
        self.descend(noise_loss + situation_loss, 0, learning_rate)
        return {"noise_loss": noise_loss.detach(), "situation_loss": situation_loss.detach()}

    def validation_figures(self) -> dict[str, float]:
        """Return the loss of the displacements' model, at angles and with noise that are the same every time."""
        devices = [self.device] if self.device.type == "cuda" else []
        with torch.inference_mode(), torch.random.fork_rng(devices=devices):
            torch.manual_seed(0)
            loss = self.generator.noise.loss(self.validation_displacement, self.validation_inputs)
        return {"validation_noise_loss": float(loss)}


class Config(GeneratorConfig):
    """`conf/generator/conditional_diffusion.yaml`.

    Attributes:
        command_waves: that the networks are given of each command: of one period over its range up to so many.
        noise_width: of the two diffusion models, of displacements and of situations.
        steps: of both.
        learning_rate: their largest.
        weight_decay: of both.
        batch_size: real rows a step.
        wall_reaches: where motion depends on the pose: how far walls are looked for, in the arena's shorter sides.
        place_weight: of position and heading themselves, beside the walls.
        quantiles: that each column of the situation is kept as.
        sampling_steps: from noise to data.
    """

    name: Literal["conditional_diffusion"] = "conditional_diffusion"
    command_waves: Annotated[int, Field(ge=0)] = 4
    noise_width: Steps = 96
    steps: Steps = 4000
    learning_rate: Positive = 0.005
    weight_decay: Annotated[float, Field(ge=0)] = 0.05
    batch_size: Steps = 512
    wall_reaches: tuple[Positive, ...] = (0.125, 0.03125)
    place_weight: Annotated[float, Field(ge=0)] = 0.2
    quantiles: Count = 129
    sampling_steps: Count = 12

    @property
    def training_steps(self) -> int:
        """Those of both diffusion models, at the same time."""
        return self.steps

    def build(self, columns: Columns) -> ConditionalDiffusion:
        """Build it."""
        return ConditionalDiffusion(columns, self)

    def training(self, generator: Generator, real: RealRows) -> ConditionalDiffusionTraining:
        """Return its training."""
        assert isinstance(generator, ConditionalDiffusion)
        return ConditionalDiffusionTraining(generator, real)
