"""Every kind of simulation as a folder: dynamics models that were trained, and those that a diagnosis extended."""

from pathlib import Path
from typing import Any

from torch import Tensor

from swarmtwin.dynamics.model_config import model_config
from swarmtwin.dynamics.model_folder import MODEL_FOLDER, Description, load_dynamics
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.dynamics.predictor import DynamicsModule, NetworkDynamics
from swarmtwin.errors import UserError
from swarmtwin.learning.ensemble import Ensemble
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.ensemble_dynamics import BaseDynamics, CorrectedDynamics, EnsembleDynamics
from swarmtwin.simulation.mechanism import mechanism
from swarmtwin.simulation.residual_model import ResidualModel
from swarmtwin.simulation.simulation import Simulation


class ExtendedConfig(StrictModel):
    """What `model.yaml` says of an extended simulation, which a diagnosis makes and nobody trains.

    Attributes:
        name: `extended`.
        situation: the parts of a situation that it looks at.
        base: the dynamics model that it extends.
        mechanisms: name and parameters of each.
        surroundings: of the session that they were found in.
        learned_residual: what was learned beyond them.
        motion_noise: the random part of motion and camera; null in folders of earlier versions.
    """

    name: str
    situation: tuple[str, ...] | None = None
    base: dict[str, Any]
    mechanisms: tuple[dict[str, Any], ...]
    surroundings: SessionConditions
    learned_residual: dict[str, Any] | None = None
    motion_noise: MotionNoise | None = None
    learning_rate: float | None = None
    steps: int | None = None


def save_extended(folder: Path, simulation: Simulation, provenance: dict[str, Any]) -> None:
    """Write an extended simulation into an existing `folder`. Provenance is plain data, as YAML knows it."""
    assert isinstance(simulation.dynamics, EnsembleDynamics | CorrectedDynamics)
    residual = simulation.residual
    config = ExtendedConfig(
        name="extended",
        situation=simulation.inputs,
        base=simulation.dynamics.description(),
        mechanisms=tuple(one.model_dump(mode="json", exclude_none=True) for one in simulation.mechanisms),
        surroundings=simulation.conditions,
        learned_residual=residual.description() if residual else None,
        motion_noise=simulation.motion_noise,
    )
    description = Description(
        model=config.model_dump(mode="json", exclude_none=True),
        robot=simulation.robot,
        situation=simulation.inputs,
        provenance=provenance,
    )
    named = {f"base.{name}": tensor for name, tensor in simulation.dynamics.state_dict().items()}
    if residual:
        named |= {f"residual.{name}": tensor for name, tensor in residual.state_dict().items()}
    MODEL_FOLDER.save(folder, description, named)


def load_simulation(folder: Path) -> Simulation:
    """Load a simulation, extended or not; nothing in the folder is executed.

    Raises:
        UserError: a file is missing, damaged, or does not belong to the other.
    """
    description = MODEL_FOLDER.read(folder)
    if description.model.get("name") != "extended":
        return Simulation(load_dynamics(folder)).eval()
    where = f"{Path(folder) / MODEL_FOLDER.description_file}: model"
    config = ExtendedConfig.parse(description.model, where)

    def build(weights: dict[str, Tensor]) -> Simulation:
        simulation = _extended(description.robot, config, where)
        base, residual = _parts(weights)
        assert isinstance(simulation.dynamics, DynamicsModule)
        simulation.dynamics.load_state_dict(base)
        if simulation.residual:
            simulation.residual.load_state_dict(residual)
        elif residual:
            raise KeyError("weights of a residual that is not described")
        return simulation.eval()

    return MODEL_FOLDER.load_into(folder, build)


def _parts(weights: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return the weights of the base and of the residual; earlier versions also kept a scaling that nobody reads."""
    base, residual = (
        {name.removeprefix(prefix): tensor for name, tensor in weights.items() if name.startswith(prefix)}
        for prefix in ("base.", "residual.")
    )
    return base, residual


def _extended(robot: Robot, config: ExtendedConfig, where: str) -> Simulation:
    mechanisms = [mechanism(entry, f"{where}: mechanisms") for entry in config.mechanisms]
    base = _base(robot, config.base, where)
    residual = None
    if kept := config.learned_residual:
        ensemble = Ensemble(kept["members"], kept["groups"])
        residual = ResidualModel(robot, config.surroundings, ensemble, float(kept["share"]))
    return Simulation(base, mechanisms, config.surroundings, residual, config.motion_noise)


def _base(robot: Robot, description: dict[str, Any], where: str) -> BaseDynamics:
    if description.get("kind") == "learned":
        conditions = SessionConditions.parse(description["surroundings"], f"{where}: base.surroundings")
        ensemble = Ensemble(description["members"], description["groups"])
        # earlier versions kept no reaches: there was one, 0.4 of the vehicle's length
        reaches_mm = description.get("wall_reaches_mm", [0.4 * max(robot.vehicle_size_mm)])
        return EnsembleDynamics(robot, tuple(description["situation"]), reaches_mm, conditions, ensemble)
    if description.get("kind") != "simulation":
        raise UserError(f"{where}: base.kind {description.get('kind')!r} is not known: {MODEL_FOLDER.remedy}")
    dynamics = NetworkDynamics(robot, model_config(description["model"], f"{where}: base"))
    correction = description.get("correction")
    learned = _base(robot, correction, where) if correction else None
    assert learned is None or isinstance(learned, EnsembleDynamics)
    return CorrectedDynamics(dynamics.eval(), learned)
