"""Step 2. What a session's residuals depend on beyond what the reference's own do, before and after an extension."""

import numpy as np

from swarmtwin.diagnosis.dependence import StandardisedResidual, dependence_tests
from swarmtwin.diagnosis.likelihood import FittedMechanisms, SessionLikelihood
from swarmtwin.diagnosis.motion_noise_change import usual_noise_spread
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.result import Dependence
from swarmtwin.simulation.simulation import Simulation


class DependenceTests:
    """Tests of a session's residuals, with any causes taken into account, against the reference's own.

    Args:
        reference: the reference.
        model: of the session.
        seed: of the draws, the same for every test.
    """

    def __init__(self, reference: Reference, model: SessionLikelihood, seed: int) -> None:
        self._seed, self._discrepancy = seed, reference.discrepancy is not None
        neighbours = reference.settings.reference.overlap_neighbours
        own = reference.own_likelihood()
        weight = model.session.covariate_overlap(own.session, neighbours)
        self._of_reference = StandardisedResidual.of(own, own.evaluate([]), weight)

    def run(
        self, model: SessionLikelihood, fitted: FittedMechanisms, explained: SessionLikelihood | None = None
    ) -> list[Dependence]:
        """Test what fitted mechanisms leave of a session; its noise is that of the session as it is `explained`."""
        left = StandardisedResidual.of(model, fitted, explained=explained)
        return self._of(left, explained or model)

    def of_extension(self, model: SessionLikelihood, extended: Simulation, residual: np.ndarray) -> list[Dependence]:
        """Test the residuals (N, 3) of an extended simulation, which are standardised by the reference's noise."""
        effects = model.effects_with(extended.mechanisms)
        return self._of(StandardisedResidual.of_residual(model, residual, residual, effects), model)

    def _of(self, left: StandardisedResidual, explained: SessionLikelihood) -> list[Dependence]:
        usual, settings = usual_noise_spread(explained, explained.explained), explained.settings.dependence
        return dependence_tests(left, self._of_reference, self._seed, settings, self._discrepancy, usual)
