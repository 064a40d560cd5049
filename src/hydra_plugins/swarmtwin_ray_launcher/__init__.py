"""Hydra finds launchers in packages beside this one, and takes them from nowhere else."""
