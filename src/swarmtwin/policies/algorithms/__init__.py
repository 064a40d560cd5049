"""The learning algorithms: one file each, found by its name; each ends in the class `Config` that types its YAML."""

from swarmtwin.plugins import plugin_path

__path__ = plugin_path(__name__, __path__)
