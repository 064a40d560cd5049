"""How learning rates change over a training."""

import math

WARM_UP = 0.1


def one_cycle(progress: float) -> float:
    """Return the share of the largest learning rate at `progress` from 0 to 1: it rises, then falls along a cosine."""
    if progress < WARM_UP:
        return (progress + 0.01) / (WARM_UP + 0.01)
    return (1 + math.cos(math.pi * (progress - WARM_UP) / (1 - WARM_UP))) / 2
