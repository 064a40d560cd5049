"""`swarmtwin experiment name=table5`: table 5 of the paper, one vehicle and an obstacle, with figures 13 and 14."""

from typing import Any, Literal

from swarmtwin.studies.reality_gap.measured_gaps import measure_gaps
from swarmtwin.studies.reality_gap.options import GapOptions


class Options(GapOptions):
    """Options; their defaults stand in conf/experiment/table5.yaml."""

    name: Literal["table5"]


def run(options: Options) -> dict[str, Any]:
    """Learn policies in simulations, roll them out there and on stand-ins; return gaps and successes.

    Raises:
        UserError: see `measure_gaps`.
    """
    return measure_gaps(options, "table 5")
