"""How much later than supposed commands act, measured on the motion that they bring about."""

import numpy as np

from swarmtwin.deploy.control.effect_time import EffectTimePredictor
from swarmtwin.geometry import displacement_between, log_map, residual_between


class MotionDelay:
    """A running estimate of what link, firmware and motors add between a command's sending and its effect.

    What vehicles did between two pictures is compared with what the simulation says they did a little earlier or later:
    the shift that fits best, over the last periods, corrects the estimate by a part. Where commands do not change there
    is nothing to learn, and nothing is.

    Attributes:
        delay_s: as far as known, beyond what the link itself measures; 0 at first.
    """

    def __init__(
        self,
        period_s: float,
        usual: np.ndarray,
        shifts_s: tuple[float, ...] = (-0.06, -0.04, -0.02, 0.0, 0.02, 0.04, 0.06, 0.08),
        kept: float = 0.85,
        least_gain: float = 0.03,
        rate: float = 0.3,
    ) -> None:
        """Begin without a delay.

        Args:
            period_s: of control; a delay is taken to be half of it at most.
            usual: (3,) size of a displacement, mm, mm, rad, by which errors are weighed.
            shifts_s: that are compared; 0 is among them.
            kept: share of the older evidence that is kept from period to period.
            least_gain: share of the error that the best shift must save to be believed.
            rate: part of the best shift by which the estimate is corrected.
        """
        self.delay_s = 0.0
        self._most_s = period_s / 2
        self._usual = usual
        self._shifts_s = np.array(shifts_s)
        self._kept, self._least_gain, self._rate = kept, least_gain, rate
        self._errors = np.zeros(len(shifts_s))
        self._periods = 0

    def update(
        self, predictor: EffectTimePredictor, start: tuple[np.ndarray, np.ndarray], end: tuple[np.ndarray, np.ndarray]
    ) -> None:
        """Take in what vehicles did from one picture to another: true poses (V, 3) and times (V,) of both."""
        done = log_map(displacement_between(start[0], end[0]))
        errors = []
        for shift_s in self._shifts_s:
            expected = log_map(predictor.motion_between(start[1] - shift_s, end[1] - shift_s))
            errors.append(float(((residual_between(expected, done) / self._usual) ** 2).sum()))
        self._errors = self._kept * self._errors + errors
        self._periods += 1
        now = self._errors[np.argmin(np.abs(self._shifts_s))]
        best = int(np.argmin(self._errors))
        if self._periods >= 5 and now - self._errors[best] > self._least_gain * now:
            changed_s = self.delay_s + self._rate * float(self._shifts_s[best])
            self.delay_s = min(max(changed_s, 0.0), self._most_s)
