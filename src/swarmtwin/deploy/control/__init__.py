"""From poses to safe commands, in time."""
