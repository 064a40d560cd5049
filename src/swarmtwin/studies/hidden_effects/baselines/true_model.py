"""What is made of a case with the true model in hand: the oracle, or on the rigid body its engine's own toolbox."""

import time

from swarmtwin.studies.hidden_effects.baselines.engine_identification import EngineIdentification
from swarmtwin.studies.hidden_effects.baselines.oracle import oracle_causes
from swarmtwin.studies.hidden_effects.results import TrueModelAnswer
from swarmtwin.studies.hidden_effects.sessions import Truth


def true_model_answer(truth: Truth) -> TrueModelAnswer:
    """Return what the method that has the true model names; formulas have a likelihood, an engine has none."""
    start = time.perf_counter()
    causes, failure = {}, None
    try:
        causes = _identified(truth) if truth.case.family == "rigid_body" else oracle_causes(truth)
    except (ArithmeticError, ValueError) as error:  # a study goes on, and counts it as a failure
        failure = f"{type(error).__name__}: {error}"
    method = "mujoco.sysid" if truth.case.family == "rigid_body" else "oracle"
    return TrueModelAnswer(method=method, causes=causes, seconds=time.perf_counter() - start, failure=failure)


def _identified(truth: Truth) -> dict[str, dict[str, float]]:
    return EngineIdentification.of(truth.measured.footage, truth.measured.recording).identify().causes
