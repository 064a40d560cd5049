"""The page of findings: every sentence and number on it is made of what the experiments left."""

from collections.abc import Iterator, Mapping, Sequence

from swarmtwin.studies.findings.collected import Collected, FloorGain, PaperDistance
from swarmtwin.studies.study_table import StudyTable
from swarmtwin.studies.training_grid.claims import FINDINGS, PLACES, Finding, JudgedClaim
from swarmtwin.studies.training_grid.comparison import FAILS, HOLDS, OPEN

GROUPS: Mapping[str, tuple[Finding, ...]] = {
    "Owed to weak baselines": ("weak_baselines", "some_baselines"),
    "Owed to counting epochs instead of steps": ("counting_epochs", "some_epochs"),
    "No generator needed": ("needless_generator",),
    "Holds with another generator": ("other_generator",),
}
"""The sections of their own, with the findings that each lists."""


def page_text(
    collected: Sequence[Collected],
    gains: Sequence[FloorGain],
    distances: Sequence[PaperDistance],
    pictures: Mapping[str, str],
) -> str:
    """Return findings.md.

    Args:
        collected: what the experiments left.
        gains: of knowing the commands before.
        distances: from the paper's figures.
        pictures: captions, by the name of their file beside the page.
    """
    parts = ["# What holds of the paper on our data", _opening(collected), claims_table(collected).markdown().strip()]
    parts += _groups(collected)
    parts += ["## How little real data is enough", *_enough(collected)]
    parts += ["## What knowing the previous commands gains", *_gains(gains)]
    parts += ["## How far the stand-ins are from the paper's robots", *_distances(distances)]
    parts += ["## What this rests on", _rests_on(collected).markdown().strip()]
    parts += [f"![{caption}]({name})" for name, caption in pictures.items()]
    return "\n\n".join(parts) + "\n"


def claims_table(collected: Sequence[Collected]) -> StudyTable:
    """Return every claim with its verdict and with what its controls add."""
    rows = [
        [claim.says, claim.where, one.summary.robot, claim.judged.verdict, claim.judged.held, _controlled(claim)]
        for one in collected
        for claim in one.summary.claims
    ]
    headings = ("claim", "where", "robot", "on our data", "comparisons", "and")
    return StudyTable("The claims", headings, rows)


def _controlled(claim: JudgedClaim) -> str:
    return "; ".join(FINDINGS[finding] for finding in claim.findings[1:])


def _opening(collected: Sequence[Collected]) -> str:
    claims = [claim for one in collected for claim in one.summary.claims if not claim.ours]
    counts = {verdict: sum(claim.judged.verdict == verdict for claim in claims) for verdict in (HOLDS, FAILS, OPEN)}
    held = [claim for claim in claims if claim.judged.verdict == HOLDS]
    owed = sum(bool({"weak_baselines", "counting_epochs"} & set(claim.findings)) for claim in held)
    return (
        f"Claims of the paper looked at: {len(claims)}. Of these hold on our data: {counts[HOLDS]}; do not hold: "
        f"{counts[FAILS]}; cannot be told: {counts[OPEN]}. Of those that hold, owed to weak baselines or to counting "
        f"epochs instead of steps: {owed}. A claim holds where the whole 95 % interval of each of its comparisons "
        "speaks for it."
    )


def _groups(collected: Sequence[Collected]) -> Iterator[str]:
    claims = [(one.summary.robot, claim) for one in collected for claim in one.summary.claims]
    for title, findings in GROUPS.items():
        yield f"## {title}"
        lines = [
            f"- {claim.says} ({claim.where}, {robot}): {FINDINGS[finding]}."
            for robot, claim in claims
            for finding in findings
            if finding in claim.findings
        ]
        yield "\n".join(lines) or "None of the claims looked at."


def _enough(collected: Sequence[Collected]) -> Iterator[str]:
    known = {(one.summary.robot, way.sentence): way for one in collected for way in one.summary.enough}
    if not known:
        yield "No experiment with several amounts of real data was found."
        return
    yield "\n".join(f"- {robot}: {sentence}." for robot, sentence in known)
    for robot in dict.fromkeys(robot for robot, _ in known):
        ways = [way for (of, _), way in known.items() if of == robot and way.fewest is not None]
        if ways:
            best = min(ways, key=lambda way: way.fewest or way.real)
            yield f"The fewest on {robot}: {best.sentence}."


def _gains(gains: Sequence[FloorGain]) -> Iterator[str]:
    if not gains:
        yield "No floors were found."
        return
    rows = [
        [
            gain.robot,
            PLACES.get(gain.recording, gain.recording),
            f"{gain.command_mm:.2f} → {gain.history_mm:.2f}",
            f"{gain.share_mm:.0%}",
            f"{gain.command_deg:.2f} → {gain.history_deg:.2f}",
            f"{gain.share_deg:.0%}",
        ]
        for gain in gains
    ]
    headings = ("robot", "measured on", "position floor, mm", "less", "orientation floor, °", "less")
    yield StudyTable("", headings, rows).markdown().strip()
    yield "What a model with the history makes of it stands among the claims."


def _distances(distances: Sequence[PaperDistance]) -> Iterator[str]:
    if not distances:
        yield "The paper states no figures for what was found."
        return
    rows = [
        [
            distance.title,
            distance.robot,
            PLACES.get(distance.recording, distance.recording),
            distance.quantity.rpartition("_")[0].replace("_", " "),
            str(distance.figures),
            f"{distance.median:.2f} ({distance.least:.2f} to {distance.most:.2f})",
            "" if distance.rank_agreement is None else f"{distance.rank_agreement:+.2f}",
        ]
        for distance in distances
    ]
    headings = (
        "of",
        "robot",
        "measured on",
        "error",
        "figures",
        "ours as a share of the paper's: median (range)",
        "rank correlation",
    )
    yield StudyTable("", headings, rows).markdown().strip()


def _rests_on(collected: Sequence[Collected]) -> StudyTable:
    rows = [
        [
            one.summary.title,
            one.summary.robot,
            one.summary.source,
            one.summary.scale,
            one.summary.recipe,
            f"{one.summary.real:,}",
            str(one.summary.seeds),
            str(one.summary.trainings),
            f"{one.summary.training_s / 60:.1f}",
        ]
        for one in collected
    ]
    headings = (
        "experiment",
        "robot",
        "recording",
        "scale",
        "recipe",
        "real transitions",
        "seeds",
        "trainings",
        "minutes",
    )
    return StudyTable("", headings, rows)
