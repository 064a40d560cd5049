"""What tables 5 and 6 are made of: simulations to learn in, stand-ins to try the policies on, how long, how often."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator

from swarmtwin.policies.seeds import Count, LearningOptions
from swarmtwin.robot import StrictModel
from swarmtwin.transitions.inputs import as_texts
from swarmtwin.world.rollout import Show

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_ .-]*$")]
"""Of a simulation or of a group of stand-ins: a part of file names and of MLflow's metrics."""


class StandIns(StrictModel):
    """Vehicles that play the real ones.

    Attributes:
        vehicles: ids, at least as many as the task has vehicles; the first ones drive.
        effects: what they are told to do, such as `{name: surface_patch, loss: 0.1}`.
    """

    vehicles: Annotated[tuple[str, ...], BeforeValidator(as_texts), Field(min_length=1)]
    effects: tuple[dict[str, Any], ...] = ()


class PublishedRow(StrictModel):
    """What the paper states of policies learned in one simulation.

    Attributes:
        simulator: reward a vehicle and step in simulation, mean and standard deviation.
        real_world: the same on the paper's robots.
        success: share of the roll-outs on them that succeeded; None: not stated.
    """

    simulator: tuple[float, float]
    real_world: tuple[float, float]
    success: float | None = None


class GapOptions(LearningOptions):
    """Options; their defaults stand in conf/experiment/table5.yaml and table6.yaml."""

    simulations: Annotated[dict[Name, str], Field(min_length=1)]
    stand_ins: Annotated[dict[Name, StandIns], Field(min_length=1)]
    rollouts: Count
    open_loop: Path | None
    published: dict[str, dict[Name, PublishedRow]]
    figures: dict[str, dict[Show, Name]]
    pictures: bool
    output: Path
    overwrite: bool

    @model_validator(mode="after")
    def _names_differ(self) -> "GapOptions":
        if both := sorted(self.simulations.keys() & self.stand_ins.keys()):
            raise ValueError(f"{both[0]!r} names a simulation and stand-ins: give them different names")
        return self
