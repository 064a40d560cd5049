"""Policies: learned in the simulated world, shared by all vehicles, rolled out anywhere."""
