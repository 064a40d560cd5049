"""What the study of policies in extended simulations is made of."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from swarmtwin.policies.seeds import Count, LearningOptions
from swarmtwin.studies.hidden_effects.study import Lengths
from swarmtwin.studies.reality_gap.options import Name
from swarmtwin.transitions.inputs import as_texts

Words = Annotated[tuple[str, ...], BeforeValidator(as_texts), Field(min_length=1)]
Hidden = Annotated[tuple[dict[str, Any], ...], Field(min_length=1)]
"""Effects that are hidden together, as `record` takes them."""


class Options(LearningOptions):
    """Options; their defaults stand in conf/experiment/policy_gain.yaml."""

    name: Literal["policy_gain"]
    families: Words | None
    hidden: Annotated[dict[Name, Hidden], Field(min_length=1)]
    recorded: Annotated[str, BeforeValidator(str)]
    vehicles: Words
    lengths: Lengths
    rollouts: Count
    processes: Count | None
    output: Path
    overwrite: bool
