"""Step 4. How much smaller errors are with an extension than without, on runs that nothing was fitted to."""

import bisect
import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy import stats

from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.open_loop_pieces import WindowErrors, pieces, window_errors
from swarmtwin.diagnosis.result import ENDS, Gain, Gains, WindowGain
from swarmtwin.dynamics.evaluation import one_step_errors
from swarmtwin.recordings.recording import Recording, Track
from swarmtwin.simulation.mechanism import Mechanism
from swarmtwin.simulation.open_loop import OpenLoop, open_loop
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import Transitions


@dataclasses.dataclass(frozen=True)
class Errors:
    """What one simulation gets wrong of the same held-out transitions and runs.

    Attributes:
        one_step: (N, 2) position errors in mm and orientation errors in degrees.
        open_loop: whole runs, predicted from their first pose.
        ten_periods: pieces of them, each predicted from a measured pose over ten periods.
        run: the run of each of these pieces.
        windows: likewise over seconds, of each window.
    """

    one_step: np.ndarray
    open_loop: tuple[OpenLoop, ...]
    ten_periods: tuple[OpenLoop, ...]
    run: tuple[str, ...]
    windows: tuple[WindowErrors, ...]

    @classmethod
    def of(
        cls, simulation: Simulation, transitions: Transitions, tracks: list[Track], windows_s: Sequence[float] = ()
    ) -> "Errors":
        """Predict transitions one by one, whole tracks, and pieces of these, over ten periods and over each window."""
        parts = [(track.run, piece) for track in tracks for piece in pieces(track)]
        return cls(
            one_step_errors(simulation, transitions),
            tuple(open_loop(simulation, tracks)),
            tuple(open_loop(simulation, [piece for _, piece in parts])),
            tuple(run for run, _ in parts),
            window_errors(simulation, tracks, windows_s),
        )


def scored_tracks(measured: Recording, believable: Transitions, scored: Transitions) -> list[Track]:
    """Return the tracks of the scored transitions with the poses that open loop starts from and is compared with.

    Open loop is compared where one-step is: at the poses that scored transitions end at. It starts from the first pose
    of a run that some believable transition has. Poses of no transition, misread or swapped markers, are left out.

    Args:
        measured: the recording.
        believable: all transitions made of it.
        scored: those of them that one-step errors are measured on.
    """
    runs = {scored.runs[index] for index in np.unique(scored.run)}
    tracks = []
    for track in measured.tracks:
        if track.run not in runs:
            continue
        rows = _rows_before(track, scored) + 1
        if len(rows):
            chosen = np.zeros(len(track), dtype=bool)
            chosen[rows] = True
            first = int(_rows_before(track, believable).min())
            chosen[first] = True
            if "velocity" in believable.robot.situation:  # it is known from there on
                chosen[first + 1] = True
            tracks.append(dataclasses.replace(track, pose=np.where(chosen[:, None], track.pose, np.nan)))
    return tracks


def _rows_before(track: Track, transitions: Transitions) -> np.ndarray:
    """Return the rows of a track that its transitions begin at; each ends at the next row."""
    own = (transitions.run == transitions.runs.index(track.run)) & (
        transitions.vehicle == transitions.vehicles.index(track.vehicle)
    )
    return np.searchsorted(track.time_s, transitions.time_s[own])


def gains(before: Errors, after: Errors, run: np.ndarray, draws: int, rng: np.random.Generator) -> Gains:
    """Compare errors without and with an extension, on transitions in runs (N,), with bootstraps over runs."""
    position, orientation = (
        _gain(before.one_step[:, axis], after.one_step[:, axis], run, draws, rng) for axis in (0, 1)
    )
    names = [loop.track.run for loop in before.open_loop]
    return Gains(
        position_mm=position,
        orientation_deg=orientation,
        open_loop_mm=_gain_over_runs(before.open_loop, after.open_loop, names, draws, rng),
        ten_periods_mm=_gain_over_runs(before.ten_periods, after.ten_periods, before.run, draws, rng),
        open_loop_windows=_gains_over_windows(before.windows, after.windows, draws, rng),
    )


def _gain_over_runs(
    before: Sequence[OpenLoop], after: Sequence[OpenLoop], run: Sequence[str], draws: int, rng: np.random.Generator
) -> Gain:
    """Compare predictions of the same tracks, of runs that are named."""
    first, second = (np.array([loop.rmse_mm for loop in loops]) for loops in (before, after))
    known = np.isfinite(first) & np.isfinite(second)
    return _gain(first[known], second[known], np.unique(run, return_inverse=True)[1][known], draws, rng)


def _gains_over_windows(
    before: Sequence[WindowErrors], after: Sequence[WindowErrors], draws: int, rng: np.random.Generator
) -> tuple[WindowGain, ...]:
    """Compare the errors of the same pieces over each window that several runs are long enough for."""
    gained = []
    for first, second in zip(before, after, strict=True):
        known = np.isfinite(first.rmse_mm) & np.isfinite(second.rmse_mm)
        run = np.array(first.run)[known]
        runs = len(np.unique(run))
        if runs < 2:  # one alone says nothing of how runs differ
            continue
        errors_mm = first.rmse_mm[known], second.rmse_mm[known]
        spread = [float(one.std()) for one in errors_mm]
        gained.append(
            WindowGain(
                **_gain(*errors_mm, run, draws, rng).model_dump(),
                window_s=first.window_s,
                before_sd=spread[0],
                after_sd=spread[1],
                pieces=len(run),
                runs=runs,
            )
        )
    return tuple(gained)


def likelihood_gain(
    unfitted: SessionLikelihood, extended: Simulation, draws: int, rng: np.random.Generator, usual: float = 1.0
) -> Gain:
    """Compare how unlikely a held-out transition is without and with mechanisms: negative log-likelihood, nats.

    Sessions of one robot differ in their noise, so that it is taken from the held-out runs themselves; but where the
    extension says how random the motion is, it is held to that, and to the reference's noise without it.

    Args:
        unfitted: of the held-out runs.
        extended: the simulation with the mechanisms.
        draws: bootstraps over runs.
        rng: of these.
        usual: factor that the reference's own motion shows on its noise, where it is measured like a session's.
    """
    mechanisms, factor = extended.mechanisms, extended.noise_factor
    if factor == 1.0:
        before, after = _unlikely(unfitted), _unlikely(unfitted, mechanisms)
    else:
        taken_with = (((), usual), (mechanisms, usual * factor))
        before, after = (-unfitted.log_likelihood_with_motion_noise(*taken) for taken in taken_with)
    return _gain(before, after, unfitted.session.run, draws, rng)


def gain_by_loss(
    fitted: SessionLikelihood,
    unfitted: SessionLikelihood,
    loss: Mechanism,
    parts: int,
    draws: int,
    rng: np.random.Generator,
) -> Gain:
    """Compare likewise how unlikely any transition is without and with lost commands, each by others than itself.

    Where few commands are lost, few runs hold one, and those that are held out may have none. So each part of the other
    runs is held out in turn, with that probability of a grid around the estimated one which makes the other parts the
    likeliest.

    Args:
        fitted: of the runs that the probability was estimated in.
        unfitted: of the held-out runs.
        loss: loses commands, with the probability that was estimated.
        parts: into which the fitted runs are cut.
        draws: bootstraps over runs.
        rng: of these.
    """
    ((name, probability),) = loss.values().items()
    shares = np.clip(probability * np.geomspace(0.25, 4.0, 9), 0.0, 0.9)
    by_share = np.stack([_unlikely(fitted, [type(loss).at({name: float(share)})]) for share in shares])
    part = np.unique(fitted.session.run, return_inverse=True)[1] % parts
    chosen = np.array([by_share[:, part != number].sum(axis=1).argmin() for number in range(parts)])
    after = by_share[chosen[part], np.arange(len(part))]
    return _gain(
        np.concatenate([_unlikely(fitted), _unlikely(unfitted)]),
        np.concatenate([after, _unlikely(unfitted, [loss])]),
        np.concatenate([fitted.session.run, unfitted.session.run + fitted.session.run.max() + 1]),  # other runs
        draws,
        rng,
    )


def _unlikely(model: SessionLikelihood, mechanisms: Sequence[Mechanism] = ()) -> np.ndarray:
    """Return (N,) negative log-likelihoods of a session's transitions."""
    return -model.evaluate(mechanisms).log_likelihood


def not_confirmed(gain: Gains, likelihood: Gain, immaterial: float, moves: bool = True) -> str | None:
    """Say why held-out runs do not confirm an extension; None where they do.

    They do if position or orientation after one period is measurably better, the whole 95 % interval of its gain above
    zero, and neither of them is measurably worse, nor the position after ten periods in open loop: whoever drives in
    the extended simulation drives in open loop. Whole runs are few, and small differences grow in them, so that they
    decide nothing. Where the likeliest motion stays as it was, as with commands that are lost now and then, no error
    can fall: the held-out runs must be measurably more likely instead.

    Args:
        gain: of the extension.
        likelihood: likewise, of the negative log-likelihood.
        immaterial: share of an error by which it may rise.
        moves: whether any cause changes the likeliest motion; what a vehicle has of its own beside it is no cause.
    """
    figures = {
        "position": (gain.position_mm, "mm"),
        "orientation": (gain.orientation_deg, "°"),
        "position after ten periods": (gain.ten_periods_mm, "mm"),
    }
    stays = all(one.before == one.after for one in (gain.position_mm, gain.orientation_deg, gain.open_loop_mm))
    faults = []
    if stays or not moves:
        if likelihood.low <= 0:
            faults.append("they are not measurably more likely with it")
    elif not any(one.low > 0 for one in (gain.position_mm, gain.orientation_deg)):
        told = f"{_gain_text(gain.position_mm, 'mm')}, {_gain_text(gain.orientation_deg, '°')}"
        faults.append(f"neither position nor orientation is measurably better ({told})")
    for name, (one, unit) in figures.items():
        if one and one.high < -immaterial * one.before and one.after > one.before:
            faults.append(f"the {name} is measurably worse ({_gain_text(one, unit)})")
    return " and ".join(faults) or None


def not_shown_in_open_loop(gain: Gains, moves: bool) -> str | None:
    """Say why an extension that held-out runs confirm is not to be registered; None where it is.

    Whoever drives in it drives in open loop: the position after ten periods must be measurably better there, if any
    cause changes the likeliest motion (`moves`).
    """
    if not moves or gain.ten_periods_mm is None or gain.ten_periods_mm.low > 0:
        return None
    if gain.ten_periods_mm.before == 0:
        return "no held-out run is long enough to show what it gains in open loop over ten periods"
    return f"in open loop over ten periods it is not measurably better ({_gain_text(gain.ten_periods_mm, 'mm')})"


def confirmed_from(error: np.ndarray, change: np.ndarray, run: np.ndarray, power: float = 0.9) -> float:
    """Return how many times as large an effect must be for held-out runs to confirm it with a probability of `power`.

    Infinite where an effect a thousand times as large would not be. That the mean over runs varies is what they show of
    it themselves; only one-step errors are looked at.

    Args:
        error: (N, 3) of a simulation that knows all: mm, mm, rad.
        change: (N, 3) of one that does not know the effect.
        run: (N,) of each transition.
        power: probability.
    """
    _, number = np.unique(run, return_inverse=True)
    known, wanted = _sizes(error), _interval_size(max(int(number.max()) + 1, 2)) + float(stats.norm.ppf(power))

    def is_confirmed(factor: float) -> bool:
        rises = [_sizes(error + sign * factor * change) - known for sign in (1, -1)]  # chance alone goes either way
        mean = np.mean(rises, axis=(0, 1))
        by_run = np.zeros((int(number.max()) + 1, 2))
        np.add.at(by_run, number, rises[0] - rises[0].mean(axis=0))
        spread = np.sqrt((by_run**2).sum(axis=0)) / len(run)
        return bool(np.any((mean > wanted * spread) & (mean > 0)))

    factors = np.geomspace(0.01, 1000, 117)  # a tenth apart
    first = bisect.bisect_left(range(len(factors)), True, key=lambda index: is_confirmed(float(factors[index])))
    return float(factors[first]) if first < len(factors) else float("inf")


def _sizes(error: np.ndarray) -> np.ndarray:
    """Return (N, 2) the sizes of errors (N, 3), of position and orientation."""
    return np.column_stack([np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])])


def _gain_text(gain: Gain, unit: str) -> str:
    return f"{gain.before:.2f} → {gain.after:.2f} {unit}, 95 %: {gain.change_words}"


def _gain(before: np.ndarray, after: np.ndarray, run: np.ndarray, draws: int, rng: np.random.Generator) -> Gain:
    if not len(before):
        return Gain(before=0.0, after=0.0, low=0.0, high=0.0)
    _, run = np.unique(run, return_inverse=True)
    sums = np.zeros((int(run.max()) + 1, 2))
    np.add.at(sums, run, np.column_stack([before - after, np.ones(len(before))]))
    weights = rng.multinomial(len(sums), np.full(len(sums), 1 / len(sums)), draws)
    drawn = weights @ sums
    means = float(before.mean()), float(after.mean())
    if len(sums) < 2:  # how runs differ is not known: it may be anything from all that errors are to as much again
        return Gain(before=means[0], after=means[1], low=-abs(means[1]), high=abs(means[0]))
    ends = np.quantile(drawn[:, 0] / np.maximum(drawn[:, 1], 1), ENDS)
    mean = float((before - after).mean())
    error = math.sqrt(((sums[:, 0] - mean * sums[:, 1]) ** 2).sum()) / len(before)
    low, high = mean + (ends - mean) * 2 * error * _interval_size(len(sums)) / max(np.ptp(ends), 1e-12)
    return Gain(before=means[0], after=means[1], low=float(low), high=float(high))


def _interval_size(runs: int) -> float:
    """Return half the width of a 95 % interval of a mean over runs, two or more, in the deviations of its bootstraps.

    These are too narrow by one in `runs` in variance, and know nothing of the error of a variance, as Student's t does
    (Efron and Tibshirani, 1993, chapter 12): bootstraps say how an interval leans, and t how wide it is.
    """
    return float(stats.t.ppf(ENDS[1], runs - 1)) * math.sqrt(runs / (runs - 1))
