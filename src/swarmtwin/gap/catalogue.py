"""Which mechanisms there are: one file each in `mechanisms/` (DESIGN section 8)."""

from swarmtwin.gap import mechanisms
from swarmtwin.gap.mechanism import Mechanism
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.kinds import Kinds
from swarmtwin.robot import Robot

_kinds: Kinds[Mechanism] = Kinds(mechanisms, "mechanism", "mechanism")
mechanism_names = _kinds.names
mechanism_class = _kinds.config_class
mechanism = _kinds.config


def offered(robot: Robot, surroundings: Surroundings) -> dict[str, type[Mechanism]]:
    """Return by name the mechanisms that make sense for a robot."""
    classes = {name: mechanism_class(name) for name in mechanism_names()}
    return {name: cls for name, cls in classes.items() if cls.suits(robot, surroundings)}
