"""When a picture was taken, from its own stamp of another clock and from when it arrived here."""


class StampClock:
    """Maps the stamps of a camera's clock to this machine's monotonic clock.

    Arrival − stamp is the difference of the clocks plus the picture's delay. Its smallest value so far stands for a
    picture without delay, so a picture that was delayed looks as old as it is. That value is let grow by `drift` with
    time, since clocks run unlike: what persists as a delay is believed to be one for long, and a real drift follows.
    What all pictures need at the least to get here cannot be seen, and is not in their age.

    A clock that was set back shows by stamps that do not increase, one that was set forward by a smaller difference:
    either is learned with that picture. No picture is ever younger than its arrival. A clock that was set back while no
    picture came shows only by pictures that seem older than `oldest_s`; until then they look too old, never too young.
    """

    def __init__(self, drift: float = 5e-4, oldest_s: float = 30.0) -> None:
        """Know nothing yet.

        Args:
            drift: how much faster one clock may run than the other: 5e-4 is the fastest that NTP corrects one.
            oldest_s: no picture is believed to have been under way for longer.
        """
        self._drift, self._oldest_s = drift, oldest_s
        self._last_stamp_s: float | None = None
        self._difference_s = 0.0
        self._learned_s = 0.0

    def captured_s(self, stamp_s: float, arrived_s: float) -> float:
        """Return when a picture was taken, on the monotonic clock.

        Args:
            stamp_s: of the camera's clock.
            arrived_s: on the monotonic clock; not before that of the picture before.
        """
        now_s = arrived_s - stamp_s
        allowed_s = self._difference_s + self._drift * (arrived_s - self._learned_s)
        was_set_back = self._last_stamp_s is None or stamp_s <= self._last_stamp_s
        self._last_stamp_s = stamp_s
        if was_set_back or now_s <= allowed_s or now_s > allowed_s + self._oldest_s:
            self._difference_s, self._learned_s = now_s, arrived_s
            return arrived_s
        return min(stamp_s + allowed_s, arrived_s)
