"""Which commands arrived is summed over: the compiled sum equals one over every course of a short run."""

from itertools import product

import numpy as np

from swarmtwin.diagnosis.lost_commands import _log_density
from swarmtwin.diagnosis.noise_filter import Chains


def summed_over_courses(emitted, arrives):
    """Log density of one run's (n, 4), over all ways in which its commands, and the two before them, arrived."""
    total = 0.0
    for arrived in product([True, False], repeat=len(emitted) + 2):
        density = np.prod([arrives if one else 1 - arrives for one in arrived])
        for period, densities in enumerate(emitted):
            before, now = arrived[period + 1 : period + 3]
            course = (0 if before else 1) if now else (2 if before else 3)
            density *= np.exp(densities[course])
        total += density
    return np.log(total)


def test_each_run_is_as_likely_as_all_its_courses_together():
    rng = np.random.default_rng(3)
    emitted, rows = rng.normal(-3.0, 2.0, (11, 4)), rng.permutation(11)
    runs = [rows[:5], rows[5:6], rows[6:]]
    density = _log_density(*Chains.of(runs), emitted, 0.7)
    for run in runs:
        assert np.isclose(density[run].sum(), summed_over_courses(emitted[run], 0.7))
