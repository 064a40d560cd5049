"""The importers: one file a source of foreign data, found by its name; each ends in the class `Config`."""

from swarmtwin.plugins import plugin_path

__path__ = plugin_path(__name__, __path__)
