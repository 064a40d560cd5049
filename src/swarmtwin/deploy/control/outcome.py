"""What a drive is watched by, and what comes of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from swarmtwin.deploy.control.expectation import Expectation
from swarmtwin.deploy.control.heartbeat import Heartbeat
from swarmtwin.deploy.control.interrupts import Interrupts
from swarmtwin.errors import RefusedError

Ending = Literal["done", "stopped", "interrupted"]


@dataclass
class Outcome:
    """How a drive ended.

    Attributes:
        ending: as planned, by a safety stop, or because somebody interrupted it.
        reason: in words.
        is_standing: whether all vehicles were seen to stand at the end.
        stopped_s: when the first zeros were sent, on the monotonic clock.
        periods: how many commands were sent to each vehicle.
        lateness_s: of each period's beginning.
        camera_to_command_s: from each period's oldest picture to the moment its command was sent.
        decision_s: that the policy took.
        filter_s: that the safety filter took.
        motion_delay_s: from sending a command to its effect, as estimated in each period.
    """

    ending: Ending = "done"
    reason: str = ""
    is_standing: bool = False
    stopped_s: float = float("nan")
    periods: int = 0
    lateness_s: list[float] = field(default_factory=list)
    camera_to_command_s: list[float] = field(default_factory=list)
    decision_s: list[float] = field(default_factory=list)
    filter_s: list[float] = field(default_factory=list)
    motion_delay_s: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Watchmen:
    """Who else looks after the vehicles; each may be left out.

    Attributes:
        heartbeat: shared with the supervisor and the live view.
        supervisor_lives: whether the supervisor's process is there.
        publish: shows people how it stands; it never waits.
        interrupts: what comes from outside.
        expectation: the watching simulation.
    """

    heartbeat: Heartbeat | None = None
    supervisor_lives: Callable[[], bool] = lambda: True
    publish: Callable[[Mapping[str, Any]], None] = lambda state: None
    interrupts: Interrupts = field(default_factory=Interrupts)
    expectation: Expectation | None = None


def end_by(outcome: Outcome, output: Path) -> None:
    """End a command as its vehicles did.

    Raises:
        RefusedError: by a safety stop, or they could not be seen to stand.
        KeyboardInterrupt: by an interruption.
    """
    seen = "all vehicles stand" if outcome.is_standing else "the vehicles could not be seen to stand: look at them"
    if outcome.ending == "interrupted" and outcome.is_standing:
        raise KeyboardInterrupt(f"{seen}; the recording is in {output}")
    if outcome.ending != "done" or not outcome.is_standing:
        raise RefusedError(f"stopped: {outcome.reason}; {seen}; the recording is in {output}")
