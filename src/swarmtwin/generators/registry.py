"""The generators there are: every file in `models/`, found by its name."""

from swarmtwin.generators import models
from swarmtwin.generators.generator_config import GeneratorConfig
from swarmtwin.kinds import Kinds

_KINDS: Kinds[GeneratorConfig] = Kinds(models, "generator", "generator")

generator_names = _KINDS.names
config_class = _KINDS.config_class
generator_config = _KINDS.config
