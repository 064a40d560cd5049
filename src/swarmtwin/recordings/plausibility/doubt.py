"""What makes a recording implausible, and from where on."""

from dataclasses import dataclass
from typing import NamedTuple

from swarmtwin.recordings.recording import Check


@dataclass(frozen=True)
class Limits:
    """From where on a recording is doubted. Shares are of 1.

    Attributes:
        fewest_pairs: with fewer pairs of rows nothing is said.
        usual_periods: refused where fewer pairs of rows are about a period apart; warned of below twice as many.
        period_error: warned of where the median time between rows differs by more than this share of the period.
        beyond_limits: refused where more rows command what the robot cannot; warned of above a tenth of this.
        command_range: warned of where a column never exceeds this share of its limits.
        gain: refused where vehicles move more than the second or, in a corner of the arena, less than the first number
            times as far for their commands as they can.
        least_gain: refused where they move less than this number of times as far, wherever they drive.
        corner: share of the arena's length and width below which a recording covers a corner only.
        outside: refused where more poses are outside the arena; warned of above a tenth of this.
        covered: warned of where poses begin at the arena's origin and end before this share of its length and width.
        still: refused where more pairs of rows repeat a pose although the command drives; warned of above a fifth.
        least_motion: frozen where 95 % of displacements are below this share of the largest believable one.
        agreement: contradicted where less of the motion follows heading and command.
        explained: agreement from which on a mistake is said to be the reason.
        log_disagreement: refused where rows' commands differ from the log's means in their periods by more than this
            share of the commands' variance. Of commands drawn anew each period a clock is off by half a period there.
        logged: warned of where the log of commands says what was in force in a smaller share of the rows.
        shift: warned of where commands of another row agree by so much more, travel and turning together.
    """

    fewest_pairs: int = 100
    usual_periods: float = 0.3
    period_error: float = 0.1
    beyond_limits: float = 0.25
    command_range: float = 0.03
    gain: tuple[float, float] = (0.15, 5.0)
    least_gain: float = 0.02
    corner: float = 0.2
    outside: float = 0.3
    covered: float = 0.8
    still: float = 0.5
    least_motion: float = 0.002
    agreement: float = 0.35
    explained: float = 0.55
    log_disagreement: float = 0.5
    logged: float = 0.8
    shift: float = 0.1


class Doubt(NamedTuple):
    """What is implausible of a recording, and the mistake or circumstance that would explain it.

    Attributes:
        check: in which check it was found.
        refused: whether it contradicts the robot's file or the arena; else it may be meant.
        text: what, and what to do.
    """

    check: Check
    refused: bool
    text: str
