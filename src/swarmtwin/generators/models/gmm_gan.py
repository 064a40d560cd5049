"""GMM-GAN: noise from a mixture of normal distributions (Ben-Yosef and Weinshall 2018, arXiv:1808.10356, GM-GAN).

The dynamic variant without labels: each component's mean and linear map are learned together with the generator, and a
component is drawn with equal chances. Networks are perceptrons, as the published GAN's but wider, instead of
convolutions for images. Validation runs chose three steps of the discriminator for each of the generator's, no
averaging of gradients, and a learning rate that falls to zero.
"""

from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from swarmtwin.generators.adversarial import normal
from swarmtwin.generators.generator import Steps
from swarmtwin.generators.row_gan import Networks, RowGanConfig, perceptron
from swarmtwin.robot import Positive


class MixtureNoise(nn.Module):
    """Noise z = A_k ε + μ_k of a component k drawn with equal chances, ε normal; A_k and μ_k are learned.

    Args:
        components: how many.
        columns: of the noise.
        range_of_means: the means start evenly distributed between −range and range.
        sd: the maps start as this multiple of the identity.
    """

    def __init__(self, components: int, columns: int, range_of_means: float, sd: float) -> None:
        super().__init__()
        self.means = nn.Parameter(range_of_means * (2 * torch.rand(components, columns) - 1))
        self.maps = nn.Parameter(sd * torch.eye(columns).repeat(components, 1, 1))

    def forward(self, count: int, device: torch.device, rng: torch.Generator | None) -> Tensor:
        """Draw (count, columns)."""
        components, columns = self.means.shape
        drawn_on = "cpu" if rng else device
        component = torch.randint(components, (count,), generator=rng, device=drawn_on).to(device)
        noise = normal(count, columns, device, rng)
        return torch.einsum("nij,nj->ni", self.maps[component], noise) + self.means[component]


class Config(RowGanConfig):
    """`conf/generator/gmm_gan.yaml`.

    Attributes:
        components: of the mixture that noise is drawn from.
        noise_columns: how many random numbers a row is made of.
        range_of_means: between minus and plus this the components' means start.
        component_sd: standard deviation that the components start with.
        generator_layers: widths of the generator's hidden layers.
        discriminator_layers: likewise of the discriminator's.
    """

    name: Literal["gmm_gan"] = "gmm_gan"
    components: Steps = 8
    noise_columns: Steps = 16
    range_of_means: Annotated[float, Field(ge=0)] = 1.0
    component_sd: Positive = 0.5
    generator_layers: tuple[Steps, ...] = (64, 64)
    discriminator_layers: tuple[Steps, ...] = (128, 128)
    learning_rate: Positive = 1e-3
    decay_from: Annotated[float, Field(ge=0, le=1)] = 0.5
    beta1: Annotated[float, Field(ge=0, lt=1)] = 0.0
    batch_size: Annotated[int, Field(ge=4)] = 256
    discriminator_steps: Steps = 3
    steps: Steps = 6000

    def networks(self, width: int) -> Networks:
        """Return a learned mixture and two perceptrons."""
        return Networks(
            MixtureNoise(self.components, self.noise_columns, self.range_of_means, self.component_sd),
            nn.Sequential(*perceptron((self.noise_columns, *self.generator_layers, width), 0.2), nn.Tanh()),
            nn.Sequential(*perceptron((width, *self.discriminator_layers, 1), 0.2), nn.Sigmoid()),
        )
