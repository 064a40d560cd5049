"""The gap: what a simulation gets wrong on measured data; its cause by name, the extended simulation and the gain."""
