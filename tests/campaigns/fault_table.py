"""The drives of a campaign of faults: as lines of a file that it goes on with, and as a table."""

import collections
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from fault_judgement import Fault
from fault_kinds import KINDS, SURVIVABLE


class Drive(NamedTuple):
    """One drive: the faults that were brought into it, and how it ended.

    Attributes:
        number: of the drive.
        firmware: "time-out" or "published".
        faults: in order; all but the last were survived.
        beyond_mm: how far a vehicle's centre was beyond the fence at most; negative: it stayed inside.
        nearest_mm: least distance of two centres.
        status: of the command.
        said: its last line.
        took_s: all of it.
        wrong: what must not be, beside what is wrong with single faults.
    """

    number: int
    firmware: str
    faults: list[Fault]
    beyond_mm: float
    nearest_mm: float
    status: int
    said: str
    took_s: float
    wrong: list[str]

    @property
    def failures(self) -> list[str]:
        """All that must not be."""
        return [*(f"{fault.name}: {fault.wrong}" for fault in self.faults if fault.wrong), *self.wrong]


def read_drives(state: Path) -> list[Drive]:
    """Return the drives of a state file; a last line that was cut off is left out."""
    if not state.exists():
        return []
    lines = (json.loads(line) for line in state.read_text().split("\n")[:-1])
    try:
        return [Drive(**{**line, "faults": [Fault(**one) for one in line["faults"]]}) for line in lines]
    except (KeyError, TypeError):
        raise SystemExit(f"{state} was written by another version of this campaign: move it away") from None


def as_line(drive: Drive) -> str:
    """Return a drive as a line of the state file."""
    return json.dumps(drive._asdict() | {"faults": [one._asdict() for one in drive.faults]}) + "\n"


def table(drives: list[Drive]) -> str:
    """Return in Markdown how often each fault was brought in, what came of it, how soon, and what went wrong."""
    rows: dict[str, list[Fault]] = collections.defaultdict(list)
    for drive in drives:
        for fault in drive.faults:
            firmware = f" ({drive.firmware} firmware)" if KINDS[fault.name].only_by_firmware else ""
            rows[fault.name + firmware].append(fault)
    lines = ["| fault | brought | survived | stopped | told to stand, median | worst | failed |", f"|{' --- |' * 7}"]
    for title in sorted(rows, key=lambda title: (not title.startswith(tuple(SURVIVABLE)), title)):
        lines.append(f"| {' | '.join((title, *_cells(rows[title])))} |")
    faults = sum(len(drive.faults) for drive in drives)
    failed = [drive for drive in drives if drive.failures]
    minutes = sum(drive.took_s for drive in drives) / 60
    lines.append(f"\n{faults} faults in {len(drives)} drives, {minutes:.0f} minutes; {len(failed)} drives failed")
    lines.append(f"beyond the fence at most {max(drive.beyond_mm for drive in drives):.0f} mm (all drives)")
    lines += [f"  {drive.number}: {'; '.join(drive.failures)[:400]}" for drive in failed[:40]]
    return "\n".join(lines)


def _cells(faults: list[Fault]) -> list[str]:
    answers = [fault.answer_s for fault in faults if fault.answer_s is not None]
    times = [f"{np.median(answers):.2f} s", f"{max(answers):.2f} s"] if answers else ["–", "–"]
    counts = collections.Counter(fault.came_of_it for fault in faults)
    failed = sum(bool(fault.wrong) for fault in faults)
    return [str(len(faults)), str(counts["survived"]), str(counts["answered"]), *times, str(failed)]
