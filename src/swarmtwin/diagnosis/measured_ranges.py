"""What a diagnosis measured on robots as ranges: what was found as a gap, policies learn and are judged in."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from swarmtwin.diagnosis.result import Cause
from swarmtwin.diagnosis.saved_diagnosis import read_result
from swarmtwin.errors import UserError
from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.simulation.randomisation import Randomisation
from swarmtwin.simulation.simulation import Simulation

log = logging.getLogger(__name__)


def chosen_randomisation(
    given: Mapping[str, Any] | str | None, simulation: Simulation, draws: int
) -> Randomisation | None:
    """Return what is to differ from roll-out to roll-out in a simulation, as an option of a command says it.

    Args:
        given: mechanisms with ranges of their parameters; or the folder of a diagnosis, whose causes' intervals are
            taken; or None: nothing differs.
        simulation: in which it is to differ.
        draws: how many roll-outs differ at a time, at most.

    Raises:
        UserError: it cannot differ so in this simulation, or the folder holds no such diagnosis.
    """
    if given is None:
        return None
    if isinstance(given, str):
        return Randomisation.read(measured_ranges(Path(given), simulation), simulation, draws, given)
    return Randomisation.read(given, simulation, draws)


def measured_ranges(folder: Path, simulation: Simulation) -> dict[str, dict[str, list[float] | str]]:
    """Return the causes that a diagnosis names: intervals of their parameters, within the bounds of these, and form.

    Args:
        folder: as `diagnose` left it.
        simulation: that the ranges are for.

    Raises:
        UserError: the folder holds no diagnosis, one of another robot, or one that names no cause with ranges.
    """
    result = read_result(folder)
    if result.robot != simulation.robot.name:
        raise UserError(
            f"{folder} is a diagnosis of robot {result.robot!r}, and the simulation is of {simulation.robot.name!r}: "
            "name another"
        )
    ranges = {cause.name: _ranges_of(cause, simulation) for cause in result.causes}
    for name in [name for name, found in ranges.items() if not found]:
        log.warning("%s: %s is not reported by its parameters, and is not randomised", folder, name)
        del ranges[name]
    if not ranges:
        raise UserError(
            f"{folder}: the diagnosis ({result.verdict}) names no cause with ranges of its parameters: state ranges "
            "yourself, randomisation={command_delay: {delay_s: [0.0, 0.2]}}"
        )
    return ranges


def _ranges_of(cause: Cause, simulation: Simulation) -> dict[str, list[float] | str]:
    """Return a cause's form and its parameters' intervals; nothing where it is reported otherwise than by these."""
    kind = mechanism_class(cause.name)
    bounds = kind.bounds_of(simulation.robot, simulation.conditions)
    needed = {name for name in bounds if kind.model_fields[name].is_required()}
    if not needed <= set(cause.parameters) <= set(bounds):
        return {}
    ranges = {
        name: [float(np.clip(end, bounds[name].low, bounds[name].high)) for end in (found.low, found.high)]
        for name, found in cause.parameters.items()
    }
    return {**cause.form, **ranges}
