"""Everything random comes from one seed, in one stream a source, so that an effect shifts no other source's numbers."""

import zlib

import numpy as np


class Streams:
    """Named random generators, each continuing where it was last used.

    Args:
        seed: the session's seed.
        purpose: tells apart sessions that share a seed.
    """

    def __init__(self, seed: int, purpose: str = "session") -> None:
        self._seed = seed
        self._purpose = purpose
        self._generators: dict[str, np.random.Generator] = {}

    def of(self, source: str) -> np.random.Generator:
        """Return the stream of one source of randomness."""
        if source not in self._generators:
            key = zlib.crc32(f"{self._purpose}/{source}".encode())
            self._generators[source] = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(key,)))
        return self._generators[source]
