"""Step 1, its tool: what answers as a trained model does, in a fraction of its time: a table, or an imitation."""

import numpy as np

from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.dynamics.predictor import DynamicsModule
from swarmtwin.errors import UserError
from swarmtwin.geometry import log_map
from swarmtwin.learning.ensemble import learn
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.displacement_table import DisplacementTable, TableSettings
from swarmtwin.simulation.ensemble_dynamics import (
    KNOWN_INPUTS,
    EnsembleDynamics,
    ensemble_encoding,
    wall_reaches_over,
)


def table_of(dynamics: DynamicsModule, points: int = 193, beyond: float = 0.25) -> DisplacementTable | None:
    """Return a table of a model that looks at commands alone; None where there is none that is accurate.

    It is far less off than motion is noisy, and goes on beyond the limits, where stronger actuators are looked for.
    """
    try:
        return DisplacementTable(dynamics, TableSettings(points=points), beyond=beyond)
    except UserError:
        return None


def imitation_of(dynamics: DynamicsModule, session: MeasuredSession, seed: int, shuffled: int = 3) -> EnsembleDynamics:
    """Learn a small network to answer as a trained model does: nearly, and quicker.

    It learns from what the model answers to a session's situations, and to some in which commands, those before them
    and poses are those of different ones, so many times as many: without noise, so that few suffice.
    """
    robot, rng, count = dynamics.robot, np.random.default_rng(seed), len(session)
    inputs = tuple(part for part in KNOWN_INPUTS if part in dynamics.inputs)
    given, parts = session.situation.only(inputs), [np.arange(count)]
    rows = {part: np.concatenate([*parts, *(rng.permutation(count) for _ in range(shuffled))]) for part in inputs}
    asked = Situation(**{part: getattr(given, part)[rows[part]] for part in inputs})
    reaches_mm = wall_reaches_over(session.conditions)
    encoding, groups = ensemble_encoding(robot, inputs, reaches_mm, session.conditions)
    answer = log_map(dynamics.predict(asked).double())
    everything = np.full(len(asked), -1)
    ensemble = learn(groups, encoding(asked).numpy(), answer.numpy(), everything, seed, members=1)
    return EnsembleDynamics(robot, inputs, reaches_mm, session.conditions, ensemble)
