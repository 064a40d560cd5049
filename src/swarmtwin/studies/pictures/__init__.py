"""`swarmtwin experiment name=pictures`."""
