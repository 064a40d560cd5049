"""Cosine, sine and exponential in float32, of sums and products alone, so that the compiler computes several at a time.

Those of the C library are called one by one, which took a third of a step. The polynomials are those of Cephes
(Moshier 1989, `sinf.c` and `expf.c`).
"""

import math

import numpy as np

from swarmtwin.compiled import compiled


@compiled
def cos_and_sin(angle_rad):  # type: ignore[no-untyped-def]
    """Return cosine and sine of an angle, float64, as float32: to 2e-7 for angles up to a million."""
    quarters = math.floor(angle_rad * (2 / math.pi) + 0.5)
    rest = np.float32(angle_rad - quarters * (math.pi / 2))
    square = rest * rest
    series = np.float32(8.3321608736e-3) + square * np.float32(-1.9515295891e-4)
    sin = rest + rest * square * (np.float32(-1.6666654611e-1) + square * series)
    series = np.float32(-1.388731625493765e-3) + square * np.float32(2.443315711809948e-5)
    series = np.float32(4.166664568298827e-2) + square * series
    cos = np.float32(1.0) - np.float32(0.5) * square + square * square * series
    quarter = np.int64(quarters)
    along, across = (sin, cos) if quarter & 1 else (cos, sin)
    return -along if (quarter + 1) & 2 else along, -across if quarter & 2 else across


@compiled
def exponential(power):  # type: ignore[no-untyped-def]
    """Return e to a power, float32: to 4e-7 of it; powers below −87 and above 88 are taken for these."""
    power = min(max(power, np.float32(-87.0)), np.float32(88.0))
    doublings = np.float32(math.floor(power * np.float32(1.44269504088896341) + np.float32(0.5)))
    rest = power - doublings * np.float32(0.693359375) - doublings * np.float32(-2.12194440e-4)
    series = np.float32(1.3981999507e-3) + rest * np.float32(1.9875691500e-4)
    series = np.float32(8.3334519073e-3) + rest * series
    series = np.float32(4.1665795894e-2) + rest * series
    series = np.float32(1.6666665459e-1) + rest * series
    series = np.float32(5.0000001201e-1) + rest * series
    of_rest = np.float32(1.0) + rest + rest * rest * series
    exponent = np.int32(doublings) + np.int32(127)
    return of_rest * np.int32(exponent << np.int32(23)).view(np.float32)  # two to the doublings, by its bits
