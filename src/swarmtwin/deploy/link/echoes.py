"""What comes back on the topic of commands: our own messages, which measure the way, and those of others."""

import threading
import time
from collections import deque
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class ForeignMessages:
    """Messages on the topic of commands that this link has not sent.

    Attributes:
        count: how many.
        moving: how many of them would have moved a vehicle, or could not be read; the others told all to stand still,
            as a supervisor, a last will or an emergency stop does.
        retained: how many the broker keeps and gives to every vehicle that connects: somebody must delete them.
        last_payload: the newest of those that count as moving, else the newest, cut after 200 bytes.
        last_s: when it came, on the monotonic clock.
    """

    count: int = 0
    moving: int = 0
    retained: int = 0
    last_payload: bytes = b""
    last_s: float = 0.0


class Echoes:
    """Tells own messages from others as they come back through the broker, which keeps the order of one sender.

    A message that comes back is ours if it equals one that is still out; those sent before it are lost then. So each
    message sent answers for one received, and a foreign one is counted even where it says the same as one of ours.
    """

    def __init__(self, longest: int = 256) -> None:
        self._out: deque[tuple[str, bytes, float]] = deque(maxlen=longest)
        self._round_trip_s: deque[float] = deque(maxlen=32)
        self._foreign = ForeignMessages()
        self._lock = threading.Lock()

    @property
    def foreign(self) -> ForeignMessages:
        """What others have sent so far."""
        return self._foreign

    @property
    def round_trip_s(self) -> float:
        """Median time to the broker and back of the last messages; NaN before the first came back."""
        with self._lock:
            return float(np.median(self._round_trip_s)) if self._round_trip_s else float("nan")

    @property
    def unanswered_s(self) -> float:
        """For how long the oldest message that is still out has been so; 0 where none is."""
        with self._lock:
            return time.monotonic() - self._out[0][2] if self._out else 0.0

    def sent(self, topic: str, payload: bytes) -> float:
        """Note that a message goes out now; return when that is, on the monotonic clock."""
        with self._lock:
            now_s = time.monotonic()
            self._out.append((topic, payload, now_s))
        return now_s

    def not_sent(self, topic: str, payload: bytes) -> None:
        """Take back that the newest message went out."""
        with self._lock:
            if self._out and self._out[-1][:2] == (topic, payload):
                self._out.pop()

    def forget(self) -> None:
        """Expect no message back any more: the connection that they went out on is gone."""
        with self._lock:
            self._out.clear()

    def came_back(self, topic: str, payload: bytes) -> bool:
        """Note that a message came in; return whether it is one of ours."""
        with self._lock:
            for index, (one_topic, one_payload, sent_s) in enumerate(self._out):
                if (one_topic, one_payload) == (topic, payload):
                    self._round_trip_s.append(time.monotonic() - sent_s)
                    for _ in range(index + 1):
                        self._out.popleft()
                    return True
        return False

    def is_foreign(self, payload: bytes, moving: bool, retained: bool) -> None:
        """Count a message that is not ours."""
        with self._lock:
            before = self._foreign
            if moving or not before.moving:
                before = replace(before, last_payload=payload[:200], last_s=time.monotonic())
            self._foreign = replace(
                before, count=before.count + 1, moving=before.moving + moving, retained=before.retained + retained
            )
