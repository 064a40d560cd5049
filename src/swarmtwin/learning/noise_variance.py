"""How much of some outputs no smooth function of some inputs can explain, estimated from data alone."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree


class NoiseVariance(NamedTuple):
    """Variances of d outputs that are no function of the inputs.

    Attributes:
        value: (d,) as estimated.
        covariance: (d, d) of these estimates, over runs.
    """

    value: np.ndarray
    covariance: np.ndarray

    def drawn(self, count: int, seed: int = 0) -> np.ndarray:
        """Return (count, d) variances that it may be, none below 0."""
        rng = np.random.default_rng(seed)
        return np.maximum(rng.multivariate_normal(self.value, self.covariance, count, method="eigh"), 0.0)


def noise_variance(
    inputs: np.ndarray,
    outputs: np.ndarray,
    group: np.ndarray,
    fold: np.ndarray,
    run: np.ndarray,
    neighbours: int = 10,
    most: int = 20_000,
) -> NoiseVariance | None:
    """Estimate noise variances by the Gamma test (Evans and Jones, Proc. R. Soc. A 458, 2002).

    Half the squared difference of two outputs is the noise's variance and what the function differs between both: that
    vanishes with the distance of the inputs. A line through the means over the first, second, … neighbours, continued
    to distance 0, leaves the noise. Neighbours are of the same group and of another fold, so that what lasts in a run
    is not taken for a function. The fewer data and the more inputs, the less is seen to be a function: the estimate is
    too high then, as with any other method, unless the outputs are what a good model leaves.

    Args:
        inputs: (N, c), without NaN.
        outputs: (N, d).
        group: (N,) numbers; whatever differs between groups is no noise.
        fold: (N,) numbers.
        run: (N,) numbers of what is independent of each other.
        neighbours: of each point.
        most: points that are asked for their neighbours, at most; evenly chosen.

    Returns:
        the variances, or None where no point has so many neighbours.
    """
    pairs = _pairs(inputs, group, fold, neighbours, most)
    if not len(pairs.first):
        return None
    halves = (outputs[pairs.second] - outputs[pairs.first, None]) ** 2 / 2
    distance, half = pairs.distance2.mean(axis=0), halves.mean(axis=0)
    centred = distance - distance.mean()
    slope = np.maximum(centred @ half / max(float(centred @ centred), 1e-300), 0.0)
    beyond = halves - slope * pairs.distance2[..., None]
    value = beyond.mean(axis=(0, 1))
    _, number = np.unique(run, return_inverse=True)
    of_first = np.broadcast_to(number[pairs.first][:, None], pairs.second.shape)
    # by how much each neighbour moves the line's beginning
    pull = 1 - neighbours * centred * distance.mean() / max(float(centred @ centred), 1e-300)
    covariance = _covariance((beyond - value) * pull[:, None], of_first, number[pairs.second])
    return NoiseVariance(np.maximum(value, 0.0), covariance)


class _Pairs(NamedTuple):
    """P points and the k nearest of each: indices (P,) and (P, k), squared distances (P, k)."""

    first: np.ndarray
    second: np.ndarray
    distance2: np.ndarray


def _pairs(inputs: np.ndarray, group: np.ndarray, fold: np.ndarray, neighbours: int, most: int) -> _Pairs:
    spread, rng = inputs.std(axis=0), np.random.default_rng(0)
    known = (inputs - inputs.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    known = known + rng.uniform(-1e-6, 1e-6, known.shape)  # of points at one place, each has neighbours of its own
    asked_for = np.zeros(len(known), bool)
    asked_for[:: -(-len(known) // most)] = True
    found = []
    for one in np.unique(group):
        for held_out in np.unique(fold[group == one]):
            others = np.flatnonzero((group == one) & (fold != held_out))
            asked = np.flatnonzero((group == one) & (fold == held_out) & asked_for)
            if len(others) >= neighbours and len(asked):
                distance, nearest = cKDTree(known[others]).query(known[asked], k=np.arange(1, neighbours + 1))
                found.append((asked, others[nearest], distance**2))
    empty = (np.zeros(0, int), np.zeros((0, neighbours), int), np.zeros((0, neighbours)))
    return _Pairs(*(np.concatenate(parts) for parts in zip(*(found or [empty]), strict=True)))


def _covariance(deviation: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the covariance (d, d) of the mean of deviations (P, k, d) of pairs of runs (P, k): pairs share runs.

    The variance of dyadic data, robust to clusters (Aronow, Samii and Assenova, Political Analysis 23, 2015).
    """
    count, runs = one.size, int(max(one.max(), other.max())) + 1
    flat = deviation.reshape(count, -1)
    by_run = np.zeros((runs, flat.shape[1]))
    for own in (one, other):
        np.add.at(by_run, own.ravel(), flat)
    both = np.minimum(one, other).ravel() * runs + np.maximum(one, other).ravel()
    _, number = np.unique(both, return_inverse=True)
    by_pair = np.zeros((number.max() + 1, flat.shape[1]))
    np.add.at(by_pair, number, flat)
    shared = by_run.T @ by_run - by_pair.T @ by_pair
    values, vectors = np.linalg.eigh(shared / count**2)
    least = np.diag(by_pair.T @ by_pair / count**2).min()  # never less than where pairs shared nothing
    covariance: np.ndarray = (vectors * np.maximum(values, least)) @ vectors.T
    return covariance
