"""The stand-ins: one file a robot, found by the robot's name; each ends in the class `StandIn`, its physics."""

from swarmtwin.plugins import plugin_path

__path__ = plugin_path(__name__, __path__)
