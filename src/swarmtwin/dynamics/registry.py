"""The dynamics models there are: every file in `models/`, found by its name."""

from swarmtwin.dynamics import models
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.kinds import Kinds

_KINDS: Kinds[ModelConfig] = Kinds(models, "dynamics model", "model")

model_names = _KINDS.names
config_class = _KINDS.config_class
model_config = _KINDS.config
