"""What a world computes most, compiled: motion by a table, and what groups measure, each equal to its plain formula.

The plain formulas (`world/observations.py`, `world/group.py`, `simulation/`) say what is meant, and tests compare.
"""
