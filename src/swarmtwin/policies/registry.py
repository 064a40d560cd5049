"""The learning algorithms there are: every file in `algorithms/`, found by its name."""

from swarmtwin.kinds import Kinds
from swarmtwin.policies import algorithms
from swarmtwin.policies.algorithm import AlgorithmConfig

_KINDS: Kinds[AlgorithmConfig] = Kinds(algorithms, "algorithm", "algorithm")

algorithm_names = _KINDS.names
config_class = _KINDS.config_class
algorithm_config = _KINDS.config
