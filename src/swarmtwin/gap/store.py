"""Every kind of simulation as a folder: those that were trained, and those that a diagnosis extended."""

from pathlib import Path
from typing import Any

import torch

from swarmtwin import weights
from swarmtwin.dynamics import store
from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.registry import model_config
from swarmtwin.errors import UserError
from swarmtwin.gap.base import AnyBase, LearnedBase, SimulationBase
from swarmtwin.gap.catalogue import mechanism
from swarmtwin.gap.ensemble import Ensemble
from swarmtwin.gap.extended import ExtendedConfig, ExtendedDynamics
from swarmtwin.gap.learned import LearnedResidual
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import Robot

EXTENDED = "extended"


def load_dynamics(folder: Path) -> Dynamics:
    """Load a simulation to predict with, extended or not; nothing in the folder is executed.

    Raises:
        UserError: a file is missing, damaged, or does not belong to the other.
    """
    folder = Path(folder)
    description = store.read_description(folder)
    if description.model.get("name") != EXTENDED:
        return store.load_dynamics(folder)
    where = f"{folder / store.DESCRIPTION}: model"
    config = ExtendedConfig.parse(description.model, where)
    trained = weights.load_weights(folder, store.REMEDY)
    try:
        with torch.random.fork_rng(devices=[]):
            extended = _extended(description.robot, config, where)
        extended.load_state_dict(trained)
    except (RuntimeError, KeyError, TypeError, ValueError):
        raise weights.not_belonging(folder, store.DESCRIPTION, store.REMEDY) from None
    return extended.eval()


def _extended(robot: Robot, config: ExtendedConfig, where: str) -> ExtendedDynamics:
    mechanisms = [mechanism(entry, f"{where}: mechanisms") for entry in config.mechanisms]
    base = _base(robot, config.base, where)
    residual = None
    if config.learned_residual:
        kept = config.learned_residual
        residual = LearnedResidual(
            robot, config.surroundings, Ensemble(kept["members"], kept["groups"]), float(kept["share"])
        )
    return ExtendedDynamics(base, mechanisms, config.surroundings, residual)


def _base(robot: Robot, description: dict[str, Any], where: str) -> AnyBase:
    if description.get("kind") == "learned":
        surroundings = Surroundings.parse(description["surroundings"], f"{where}: base.surroundings")
        ensemble = Ensemble(description["members"], description["groups"])
        return LearnedBase(robot, tuple(description["situation"]), surroundings, ensemble)
    if description.get("kind") != "simulation":
        raise UserError(f"{where}: base.kind {description.get('kind')!r} is not known: {store.REMEDY}")
    dynamics = Dynamics(robot, model_config(description["model"], f"{where}: base"))
    correction = description.get("correction")
    learned = _base(robot, correction, where) if correction else None
    assert learned is None or isinstance(learned, LearnedBase)
    return SimulationBase(dynamics.eval(), learned)
