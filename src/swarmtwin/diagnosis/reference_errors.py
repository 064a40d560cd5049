"""What the reference's own errors show, measured as a session's are: a session's cause shows beyond that."""

from collections.abc import Callable
from functools import cached_property

import numpy as np

from swarmtwin.diagnosis.error_history import nats_by_history
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.likelihood import FittedMechanisms, SessionLikelihood, loses_commands
from swarmtwin.diagnosis.screening import sought_kinds


class ReferenceErrors:
    """The reference's own transitions, predicted by what has not seen them; each question is answered once, when asked.

    Args:
        own: returns how likely they are; None: nothing is known of them, and they show nothing.
        are_gap: whether what the simulation gets wrong of its own reference is a gap of the session as well.
    """

    def __init__(self, own: Callable[[], SessionLikelihood] | None = None, are_gap: bool = False) -> None:
        self._own, self._are_gap = own, are_gap

    @cached_property
    def _model(self) -> SessionLikelihood | None:
        return self._own() if self._own else None

    @property
    def granted(self) -> SessionLikelihood | None:
        """How likely the transitions are; None where their errors are a gap, or nothing is known of them."""
        return None if self._are_gap else self._model

    @property
    def transitions(self) -> int:
        """How many there are; 1 where nothing is known of them."""
        return len(self._model.session) if self._model else 1

    @cached_property
    def motion_noise_log(self) -> float:
        """The log of the factor on the standard deviation of the reference's noise that their own motion shows."""
        return self._model.motion_noise_log()[0] if self._model else 0.0

    @cached_property
    def nats_by_history(self) -> float:
        """Nats a transition that their errors gain by those before them."""
        model = self._model
        return max(nats_by_history(model, model.evaluate([])), 0.0) / len(model.session) if model else 0.0

    @cached_property
    def outliers(self) -> float:
        """The share of them with a large error."""
        return float(outliers(self._model, self._model.evaluate([])).mean()) if self._model else 0.0

    @cached_property
    def loss(self) -> float:
        """The share of commands that seem to be lost; 0 where their errors are a gap."""
        model = self.granted
        lossy = [kind for kind in sought_kinds(model).values() if loses_commands([kind])] if model else []
        if model is None or not lossy:
            return 0.0
        points = lossy[0].initial_points(model.robot, model.session.conditions)
        return float(estimate(model, [lossy[0].at(points[0])]).values[0])


def outliers(model: SessionLikelihood, fitted: FittedMechanisms) -> np.ndarray:
    """Return (N,) in which transitions mechanisms leave a large error, in units of what they leave of all."""
    large: np.ndarray = (np.abs(fitted.residual / fitted.scale) > model.settings.dependence.tail_z).any(axis=1)
    return large
