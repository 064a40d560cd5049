"""The published GAN with half as many units."""

from typing import Literal

from swarmtwin.generators.models import gan


class Config(gan.Config):
    """`conf/generator/small_gan.yaml`."""

    name: Literal["small_gan"] = "small_gan"
    generator_layers: tuple[int, ...] = (16, 8)
    discriminator_layers: tuple[int, ...] = (16, 8)
