"""`swarmtwin experiment name=table6`: table 6 of the paper, groups of vehicles, with figures 15 to 17."""

from typing import Any, Literal

from swarmtwin.studies.reality_gap.measured_gaps import measure_gaps
from swarmtwin.studies.reality_gap.options import GapOptions


class Options(GapOptions):
    """Options; their defaults stand in conf/experiment/table6.yaml."""

    name: Literal["table6"]


def run(options: Options) -> dict[str, Any]:
    """Learn policies in simulations, roll them out there and on stand-ins; return gaps and successes.

    Raises:
        UserError: see `measure_gaps`.
    """
    return measure_gaps(options, "table 6")
