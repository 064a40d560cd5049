"""Who may end a deployment from outside: a signal, a key. The answer is a stop, never a traceback in mid-motion."""

import contextlib
import select
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType


class Interrupts:
    """What has come from outside so far.

    Attributes:
        signalled: by which signal; None: by none.
        key: whether a key was pressed.
    """

    def __init__(self) -> None:
        self.signalled: str | None = None
        self.key = False

    @contextlib.contextmanager
    def heeded(self, keys: bool = True) -> Iterator[None]:
        """Take signals, and the enter key where a terminal is at hand, as a wish to stop, for as long as this lasts."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        former = {number: signal.signal(number, self._on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
        ends = threading.Event()
        if keys and sys.stdin is not None and sys.stdin.isatty():
            threading.Thread(target=self._wait_for_key, args=(ends,), daemon=True).start()
        try:
            yield
        finally:
            ends.set()
            for number, handler in former.items():
                signal.signal(number, handler)

    @property
    def reason(self) -> str | None:
        """Why to stop, in words; None: go on."""
        if self.signalled:
            return f"interrupted by {self.signalled}"
        return "emergency stop by key" if self.key else None

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.signalled = self.signalled or signal.Signals(number).name

    def _wait_for_key(self, ends: threading.Event) -> None:
        while not ends.is_set():
            with contextlib.suppress(OSError, ValueError):
                if select.select([sys.stdin], [], [], 0.2)[0]:
                    sys.stdin.readline()
                    self.key = True
                    return
