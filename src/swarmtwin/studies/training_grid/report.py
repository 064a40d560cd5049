"""The page of one experiment: what the paper shows, the table, the pictures, and what is said of each claim."""

from collections.abc import Iterable, Sequence

from swarmtwin.studies.study_table import StudyTable
from swarmtwin.studies.training_grid.claims import CONTROLS, Compared, JudgedClaim
from swarmtwin.studies.training_grid.enough_data import EnoughData
from swarmtwin.studies.training_grid.result_table import CAPTION


def report_text(
    title: str,
    shows: str,
    about: str,
    table: StudyTable,
    claims: Sequence[JudgedClaim],
    enough: Sequence[EnoughData],
    pictures: Iterable[str],
) -> str:
    """Return report.md.

    Args:
        title: of the page.
        shows: what the paper shows here.
        about: what was done, in a sentence.
        table: of all trainings.
        claims: judged.
        enough: what is known of how little real data is enough.
        pictures: names of their files.
    """
    parts = [f"# {title}", f"In the paper: {shows}", about, table.markdown().strip(), CAPTION]
    parts += [f"![{name}]({name})" for name in pictures]
    if claims:
        parts.append("## What is claimed" if all(claim.ours for claim in claims) else "## What the paper claims")
        parts += [claim_text(claim) for claim in claims]
    if enough:
        parts += ["## How little real data is enough", "\n".join(f"- {one.sentence}." for one in enough)]
    return "\n\n".join(parts) + "\n"


def claim_text(claim: JudgedClaim) -> str:
    """Return what is said of a claim: its conclusion, and each comparison that it rests on."""
    lines = [f"### {claim.says} ({claim.where})", f"**{claim.conclusion[0].upper()}{claim.conclusion[1:]}.**"]
    lines += [
        f"As claimed: {claim.judged.verdict}, borne out by {claim.judged.held}:",
        _compared(claim.judged.compared),
    ]
    for kind, control in claim.controls.items():
        lines.append(f"Control, {CONTROLS[kind]}: {control.verdict}, borne out by {control.held}:")
        lines.append(_compared(control.compared))
    return "\n\n".join(lines)


def _compared(compared: Sequence[Compared]) -> str:
    return "\n".join(f"- {one.sentence}." for one in compared)
