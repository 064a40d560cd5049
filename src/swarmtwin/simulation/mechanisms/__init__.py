"""The causes of the catalogue, one file each, found by its name."""

from swarmtwin.plugins import plugin_path

__path__ = plugin_path(__name__, __path__)
