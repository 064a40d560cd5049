"""The recording of a deployment whose process was killed, made from its journal."""

import sys
from pathlib import Path

import yaml

from swarmtwin.deploy.control.deployment_recording import ABOUT, SUPERVISOR_LOG, write_about, write_deployment
from swarmtwin.deploy.control.journal import JOURNAL, read_journal
from swarmtwin.errors import UserError
from swarmtwin.files import CHECKPOINTS
from swarmtwin.recordings.recording import Header
from swarmtwin.robot import Robot


def left_by_a_kill(output: Path) -> Path | None:
    """Return the folder of a deployment to `output` that was killed, or None."""
    output = output.absolute()
    partial = output.with_name(f".{output.name}.partial")
    return partial if (partial / CHECKPOINTS / JOURNAL).exists() else None


def check_no_kill(output: Path, command: str) -> None:
    """Refuse to write where a deployment was killed whose recording is not finished.

    Raises:
        UserError: there is one.
    """
    if left_by_a_kill(output):
        raise UserError(
            f"a deployment to {output} was killed, and its recording is not finished: swarmtwin {command} "
            f"recover={output}, or choose another output"
        )


def recover(output: Path) -> None:
    """Finish the recording of a deployment to `output` that was killed.

    Raises:
        UserError: there is none, or the output is there already.
    """
    output = output.absolute()
    partial = left_by_a_kill(output)
    if partial is None:
        raise UserError(f"there is nothing to recover for {output}: no deployment to it was killed")
    if output.exists() and any(output.iterdir()):
        raise UserError(f"{output} already holds something: move it away, then recover again")
    journal = partial / CHECKPOINTS
    about = yaml.safe_load((journal / ABOUT).read_text())
    reasons = [line["reason"] for line in _supervisors_lines(journal) if line.get("event") == "latched"]
    about["outcome"] = {"ending": "stopped", "reason": reasons[-1] if reasons else "the controller was killed"}
    for file in journal.iterdir():
        file.replace(partial / file.name)
    _cut(partial / JOURNAL)
    write_deployment(partial, Robot.parse(about["robot"], ABOUT), Header.parse(about["recording"], ABOUT))
    write_about(partial, about)
    journal.rmdir()
    if output.exists():
        output.rmdir()
    partial.replace(output)
    output.with_name(f".{output.name}.lock.partial").unlink(missing_ok=True)


def _supervisors_lines(folder: Path) -> list[dict[str, object]]:
    log = folder / SUPERVISOR_LOG
    return [dict(line) for line in read_journal(log)] if log.exists() else []


def _cut(journal: Path) -> None:
    """Give back the space that was reserved and not needed."""
    content = journal.read_bytes()
    end = content.find(b"\0")
    if end >= 0:
        journal.write_bytes(content[: content.rfind(b"\n", 0, end) + 1])


if __name__ == "__main__":
    recover(Path(sys.argv[1]))
