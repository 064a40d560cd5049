"""The way of commands to one vehicle, with what goes wrong on it."""

import heapq
import itertools
import math

import numpy as np

from swarmtwin.deploy.fleet.orders import RobotFaults


class FaultyPath:
    """Messages go in at one time and come out at another, or never.

    Attributes:
        faults: what goes wrong now.
        usual: what goes wrong besides, always: a stand-in's own delay and loss.
    """

    def __init__(self, rng: np.random.Generator, usual: RobotFaults | None = None) -> None:
        self.faults = RobotFaults()
        self.usual = usual or RobotFaults()
        self._rng = rng
        self._order = itertools.count()
        self._under_way: list[tuple[float, int, bytes]] = []
        self._held_back: bytes | None = None

    @property
    def next_s(self) -> float:
        """When the next message comes out; infinity where none is under way."""
        return self._under_way[0][0] if self._under_way else math.inf

    def put(self, message: bytes, now_s: float) -> None:
        """Let a message in."""
        faults = self.faults
        if faults.deaf or self._happens(faults.loss) or self._happens(self.usual.loss):
            return
        if self._held_back is None and self._happens(faults.reorder):
            self._held_back = message
            return
        arrives_s = self._send_on(message, now_s)
        if self._held_back is not None:
            self._under_way_at(arrives_s, self._held_back)
            self._held_back = None

    def due(self, now_s: float) -> list[bytes]:
        """Return the messages that have come out by now, in that order."""
        out = []
        while self._under_way and self._under_way[0][0] <= now_s:
            out.append(heapq.heappop(self._under_way)[2])
        return out

    def clear(self) -> None:
        """Forget what is under way: the vehicle was switched off."""
        self._under_way.clear()
        self._held_back = None

    def _send_on(self, message: bytes, now_s: float) -> float:
        """Send a message, or two, on their way; return when the last arrives."""
        arrivals_s = []
        for _ in range(2 if self._happens(self.faults.duplicate) else 1):
            arrivals_s.append(now_s + self.faults.latency_s + self.usual.latency_s)
            if self.faults.jitter_s:
                arrivals_s[-1] += self._rng.uniform(0, self.faults.jitter_s)
            self._under_way_at(arrivals_s[-1], message)
        return max(arrivals_s)

    def _under_way_at(self, arrives_s: float, message: bytes) -> None:
        heapq.heappush(self._under_way, (arrives_s, next(self._order), message))

    def _happens(self, probability: float) -> bool:
        return probability > 0 and self._rng.random() < probability
