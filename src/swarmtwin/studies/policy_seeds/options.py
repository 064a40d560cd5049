"""What the study of learning with many seeds is made of."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from swarmtwin.policies.seeds import Count, LearningOptions
from swarmtwin.studies.reality_gap.options import Name, StandIns

SIMULATION = "simulation"

Share = Annotated[float, Field(ge=0, le=1)]


class Options(LearningOptions):
    """Options; their defaults stand in conf/experiment/policy_seeds.yaml."""

    name: Literal["policy_seeds"]
    simulation: str
    randomisation: dict[str, Any] | str | None
    draws: Count
    stand_ins: Annotated[dict[Name, StandIns], Field(min_length=1)]
    rollouts: Count
    asked: Annotated[dict[Name, Share], Field(min_length=1)]
    processes: Count | None
    output: Path
    overwrite: bool

    @model_validator(mode="after")
    def _places_exist(self) -> "Options":
        if SIMULATION in self.stand_ins:
            raise ValueError(f"stand_ins: {SIMULATION!r} is where policies are learned: give the group another name")
        for name in self.asked:
            if name != SIMULATION and name not in self.stand_ins:
                known = ", ".join([SIMULATION, *self.stand_ins])
                raise ValueError(f"asked.{name}: policies are not tried there: name one of {known}, or '~asked.{name}'")
        return self
