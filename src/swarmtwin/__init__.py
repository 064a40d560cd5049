"""swarmtwin: learned simulation for groups of identical robots, from one robot's recording to a promoted model."""

__version__ = "0.1.0"
