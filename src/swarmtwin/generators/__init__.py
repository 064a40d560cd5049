"""Generators: from real transitions of one vehicle to as many synthetic ones as a simulation wants."""
