"""What an extended simulation gains of what a hidden effect had brought, on runs that nothing was fitted to."""

from dataclasses import dataclass

import numpy as np

from swarmtwin.geometry import orientation_error_rad, position_error_mm
from swarmtwin.robot import StrictModel

ONLY_RANDOM = frozenset({"command_loss", "noise_change"})
"""Effects whose squared error no model takes back, but for a part of it that only exact means tell."""


class HeldOutGain(StrictModel):
    """What an extended simulation gained on runs that nothing was fitted to.

    Attributes:
        before_mm: mean position error of the simulation as it was.
        after_mm: of the extended one.
        least_mm: of the stand-in's exact mean displacement; null where only an engine knows it.
        share: of the squared error that the effect had brought, the part that is gone again; null where it had brought
            next to nothing. Squared, which an exact mean makes least: where commands are lost a prediction of the
            likeliest motion earns none of it. Where only an engine knows exact means, the effect had brought what the
            simulation errs more than on the same runs without it; null where what it brings is random.
        share_to_floor: likewise, of all squared error above that of the exact mean, also what the simulation erred
            before the effect; null where only an engine knows that.
    """

    before_mm: float
    after_mm: float
    least_mm: float | None
    share: float | None
    share_to_floor: float | None


@dataclass(frozen=True)
class Displacements:
    """N displacements of a stand-in's session in three versions, each (N, 3).

    Attributes:
        measured: as the camera saw them.
        simulated: as the simulation predicts them.
        exact_mean: as the stand-in would do them on average, given its true state; None where only an engine knows.
    """

    measured: np.ndarray
    simulated: np.ndarray
    exact_mean: np.ndarray | None

    def squared(self, predicted: np.ndarray, chosen: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return the mean squared errors (2,) of predicted displacements (N, 3): of position and of turn."""
        measured = self.measured[chosen]
        errors = (error(predicted[chosen], measured) for error in (position_error_mm, orientation_error_rad))
        return np.array([(error**2).mean() for error in errors])

    def excess(self, predicted: np.ndarray, least: np.ndarray, chosen: np.ndarray | slice = slice(None)) -> float:
        """Return by how much squared errors of (N, 3) exceed the least ones (2,), as a share of these.

        Position and turn count alike. Squared, since that is what an exact mean makes least.
        """
        return float((self.squared(predicted, chosen) / least).mean() - 1.0)


def held_out_gain(
    known: Displacements, twin: Displacements | None, extended: np.ndarray, held_out: np.ndarray, least: float = 0.04
) -> HeldOutGain:
    """Compare displacements (N, 3) of an extended simulation with those of the simulation, on held-out runs.

    Where the effect brought less squared error than a share `least` of the least there is, no share of it is stated: it
    would be one of noise. Nor is one where nothing is hidden.

    Args:
        known: of the session.
        twin: of the session without the effect, where there is one that tells what the effect brought; where only an
            engine knows exact means, of the held-out runs alone.
        extended: by the extended simulation.
        held_out: (N,) which transitions nothing was fitted to.
        least: see above.
    """

    def error_mm(predicted: np.ndarray) -> float:
        return float(position_error_mm(predicted[held_out], known.measured[held_out]).mean())

    def shares(before: float, after: float, brought: float) -> tuple[float | None, float | None]:
        return (
            (before - after) / brought if brought > least else None,
            (before - after) / before if before > least else None,
        )

    least_mm, share, share_to_floor = None, None, None
    if known.exact_mean is not None:
        least_mm = error_mm(known.exact_mean)
        if twin and twin.exact_mean is not None:
            floor = known.squared(known.exact_mean, held_out)
            before, after = (known.excess(one, floor, held_out) for one in (known.simulated, extended))
            usual = twin.excess(twin.simulated, twin.squared(twin.exact_mean))
            share, share_to_floor = shares(before, after, before - usual)
    elif twin:
        usual_errors = twin.squared(twin.simulated)
        before, after = (known.excess(one, usual_errors, held_out) for one in (known.simulated, extended))
        share, _ = shares(before, after, before)
    return HeldOutGain(
        before_mm=error_mm(known.simulated),
        after_mm=error_mm(extended),
        least_mm=least_mm,
        share=share,
        share_to_floor=share_to_floor,
    )
