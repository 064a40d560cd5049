"""The tables of the study, for the terminal and for its report.md alike."""

from collections.abc import Callable, Iterator
from typing import Any

from swarmtwin.studies.hidden_effects.other_laws import OTHER_LAWS
from swarmtwin.studies.hidden_effects.proportions import CLEAR, FAINT, MIDDLE, RISE_BINS, Proportion
from swarmtwin.studies.study_table import StudyTable

Families = dict[str, dict[str, Any]]


def study_tables(summary: dict[str, Any]) -> list[StudyTable]:
    """Return all tables that have rows, the most important first."""
    return [table for table in _all_tables(summary) if table.rows]


def _all_tables(summary: dict[str, Any]) -> Iterator[StudyTable]:
    yield _marks_table(summary)
    yield _not_told_table(summary["families"])
    yield StudyTable(
        "Were causes named only if they explain more of what can be explained",
        (
            "at least",
            "one cause, error up by ≥ 10 %: it and nothing else",
            "one",
            "two",
            "three",
            "in no catalogue: a cause named",
            "nothing wrong: a cause named",
        ),
        [
            [f"{least} %" if float(least) else "as it is", *map(_few, own.values())]
            for least, own in summary["by_least_share"].items()
            if own["outside"].total  # else nothing speaks for naming less
        ],
        caption="all families together",
    )
    for family, own in summary["families"].items():
        yield _mechanisms_table(family, own)
    yield StudyTable(
        "Parameters of causes named",
        ("parameter", "cases", "median error", "of what it changes", "in the interval"),
        [
            [
                f"{family}: {name}",
                str(one["count"]),
                f"{one['median_error']:.3g} {one['unit']}".strip(),
                _percent(one["median_error_percent"], 1.0),
                _few(one["covered"]),
            ]
            for family, own in summary["families"].items()
            for name, one in sorted(own["parameters"].items())
        ],
    )
    yield StudyTable(
        "Causes that act by another law than their mechanisms",
        (
            "effect",
            "is a",
            "alarm",
            "it and nothing else named",
            "alone the likeliest",
            "another named",
            "not said to be explained",
        ),
        [
            [name, OTHER_LAWS[name].cause, *(_few(share) for share in own.values())]
            for name, own in summary["misspecified_by_effect"].items()
        ],
    )
    yield StudyTable(
        "In no catalogue",
        ("effect", "alarm", "alarm where the error is up by 10 % or more", "no name given", "not said to be explained"),
        [
            [name, *(_few(own[column]) for column in ("found", "costly_found", "not_named", "not_explained"))]
            for name, own in summary["outside_by_effect"].items()
        ],
    )
    yield StudyTable(
        "Nothing wrong",
        ("session", "cause named", "at most (95 %)", "alarm", "error raised"),
        [
            [name, _few(own["accused"]), f"{own['accused'].at_most:.1%}", _few(own["alarmed"]), _few(own["harmed"])]
            for name, own in summary["clean_by_variety"].items()
        ],
    )
    for title, families in (
        ("beside other methods", summary["methods"]),
        ("with the true model in hand", summary["true_model"]),
    ):
        for family, methods in families.items():
            yield _comparison_table(f"{family}: {title}", methods)


def _comparison_table(title: str, methods: dict[str, dict[str, Any]]) -> StudyTable:
    """Return what methods make of the same sessions of a family, each in a column."""
    rows: list[tuple[str, Callable[[dict[str, Any]], str]]] = [
        ("sessions", lambda own: str(own["cases"])),
        *((f"one, {name}: exact", lambda own, name=name: _few(own["one"][name])) for name in RISE_BINS),
        (f"one, {CLEAR}: named first", lambda own: _few(own["first"])),
        ("two: exact", lambda own: _few(own["two"])),
        ("three: exact", lambda own: _few(own["three"])),
        ("in no catalogue: no name", lambda own: _few(own["outside"])),
        ("nothing wrong: a cause named", lambda own: _few(own["accused"])),
        ("parameters: median error", lambda own: _percent(own["median_parameter_error_percent"], 1.0)),
        ("error cut, 10 % or more: median", lambda own: _percent(own["error_cut"])),
        ("seconds: median, most", lambda own: _both(own["seconds"], ".1f")),
        ("failed", lambda own: _few(own["failed"])),
    ]
    told = [[name, *map(tell, methods.values())] for name, tell in rows]
    known = [row for row in told if not {"–", "–, –"}.issuperset(row[1:])]
    return StudyTable(title, ("", *methods), known, caption="all on the same sessions")


def _marks_table(summary: dict[str, Any]) -> StudyTable:
    """Return the figures that matter, each family in a column, shares with 95 % intervals, beside the mark set."""
    families: Families = summary["families"]
    of_known = "  of these, the vehicle that was learned from"
    above = "  of these, each at its detection limit or above"
    rows: list[tuple[str, str, Callable[[dict[str, Any]], str]]] = [
        ("sessions", "", lambda own: str(own["cases"])),
        (
            "one cause, error up by ≥ 10 %: it and nothing else",
            "≥ 99 %",
            lambda own: _counted(own["one"][CLEAR]["exact"]),
        ),
        ("  alarm", "", lambda own: _counted(own["one"][CLEAR]["found"])),
        (of_known, "", lambda own: _counted(own["one"][CLEAR]["exact_of_known_vehicle"])),
        ("  a cause named that is not there", "", lambda own: _counted(own["one"][CLEAR]["falsely_named"])),
        ("one cause, 3 to 10 %: it and nothing else", "≥ 90 %", lambda own: _counted(own["one"][MIDDLE]["exact"])),
        (of_known, "", lambda own: _counted(own["one"][MIDDLE]["exact_of_known_vehicle"])),
        ("  a cause named that is not there", "", lambda own: _counted(own["one"][MIDDLE]["falsely_named"])),
        *(
            (label, mark, lambda own, bin_name=bin_name: _counted(own["limits"][bin_name]))
            for label, bin_name, mark in (
                ("one cause, once to twice its detection limit: it and nothing else", "once to twice", "≥ 90 %"),
                ("  twice its limit or more", "twice or more", ""),
                ("  half of its limit to once", "half to once", ""),
                ("  less than half of its limit", "below half", ""),
            )
        ),
        ("two causes: both and nothing else", "≥ 95 %", lambda own: _counted(own["two"]["exact"])),
        (of_known, "", lambda own: _counted(own["two"]["exact_of_known_vehicle"])),
        (above, "", lambda own: _counted(own["two"]["exact_above_limits"])),
        ("  a cause named that is not there", "", lambda own: _counted(own["two"]["falsely_named"])),
        ("three causes: all and nothing else", "≥ 80 %", lambda own: _counted(own["three"]["exact"])),
        (of_known, "", lambda own: _counted(own["three"]["exact_of_known_vehicle"])),
        (above, "", lambda own: _counted(own["three"]["exact_above_limits"])),
        ("  a cause named that is not there", "", lambda own: _counted(own["three"]["falsely_named"])),
        (
            "by another law, error up by ≥ 10 %: it and nothing else",
            "",
            lambda own: _counted(own["misspecified"]["exact_of_clear"]),
        ),
        ("  all of them, also smaller ones", "", lambda own: _counted(own["misspecified"]["exact"])),
        ("  alone the likeliest, named or not", "", lambda own: _counted(own["misspecified"]["likeliest_true"])),
        ("  a cause named that is not there", "", lambda own: _counted(own["misspecified"]["falsely_named"])),
        ("  gain, of what it had brought: median", "", lambda own: _percent(own["misspecified"]["gain"]["diagnosis"])),
        ("  likewise, beside the same runs", "", lambda own: _percent(own["misspecified"]["gain"]["beside_twin"])),
        ("in no catalogue: no cause named", "≥ 98 %", lambda own: _counted(own["outside"]["not_named"])),
        ("  of these, where an alarm was raised", "", lambda own: _counted(own["outside"]["not_named_of_alarmed"])),
        ("  alarm where the error is up by ≥ 10 %", "≥ 95 %", lambda own: _counted(own["outside"]["costly_found"])),
        ("nothing wrong: a cause named", "≤ 0.3 %", lambda own: _counted(own["clean"]["accused"])),
        ("  of these, another vehicle", "", lambda own: _counted(own["clean"]["accused_of_other_vehicle"])),
        ("  alarm", "≤ 0.5 %", lambda own: _counted(own["clean"]["alarmed"])),
        ("  error raised by 0.5 % or more", "0", lambda own: _counted(own["clean"]["harmed"])),
        ("95 % intervals that hold the truth", "93 to 97 %", lambda own: _counted(own["covered"])),
        ("  told in another unit than hidden, not counted", "", lambda own: str(own["in_another_unit"])),
        (
            "parameters: median error, of what they change",
            "≤ 2 %",
            lambda own: _percent(own["median_parameter_error_percent"], 1.0),
        ),
        ("confidence: expected calibration error", "≤ 0.03", lambda own: _number(own["calibration_error"])),
        (
            "  below that in 95 % by chance, if confidences are right",
            "",
            lambda own: _number(own["calibration_error_by_chance"]),
        ),
        (
            "  of posterior probabilities alone",
            "",
            lambda own: _number(own["calibration_error_of_posterior"]),
        ),
        ("  mean confidence", "", lambda own: _percent(own["mean_confidence"])),
        ("  mean squared error (Brier)", "", lambda own: _number(own["brier"])),
        ("  likewise, of posterior probabilities alone", "", lambda own: _number(own["brier_of_posterior"])),
        (
            "all but certain in the catalogue: causes that are there",
            "",
            lambda own: _counted(own["certain"]["catalogue"]),
        ),
        ("  where one acts by another law", "", lambda own: _counted(own["certain"]["another_law"])),
        ("  where nothing of the catalogue is there", "", lambda own: _counted(own["certain"]["nothing"])),
        ("gain, of what the true model gains: median", "≥ 97 %", lambda own: _percent(own["gain"]["diagnosis"])),
        ("  of all down to the exact mean", "", lambda own: _percent(own["gain"]["diagnosis_to_floor"])),
        (
            "  exact means not known: beside the same runs without it",
            "",
            lambda own: _percent(own["gain"]["beside_twin"]),
        ),
        ("seconds a diagnosis: median, most", "≤ 10, –", lambda own: _both(own["seconds"], ".1f")),
        ("  its reference's learning", "", lambda own: _both(own["learning_seconds"], ".1f")),
        ("peak memory, MB: median, most", "–, ≤ 2,000", lambda own: _both(own["memory_mb"], ",.0f")),
        ("diagnoses that failed", "0", lambda own: _counted(own["failed"])),
    ]
    told = [[name, *map(tell, families.values()), mark] for name, mark, tell in rows]
    return StudyTable(
        f"{summary['cases']:,} hidden and clean sessions",
        ("", *families, "mark"),
        [row for row in told if set(row[1:-1]) != {"–"}],
    )


def _not_told_table(families: Families) -> StudyTable:
    """Return what became of the sessions with one, two or three causes that are not told as a whole."""
    rows: list[tuple[str, Callable[[dict[str, Any]], str]]] = [
        ("sessions", lambda lost: _few(lost["not_exact"])),
        ("  of another vehicle", lambda lost: _few(lost["of_other_vehicle"])),
        ("a cause named that is not there", lambda lost: _few(lost["falsely_named"])),
        ("all causes named are there, but others left out", lambda lost: _few(lost["left_out"])),
        ("alarm without a name", lambda lost: _few(lost["nameless"])),
        ("nothing said", lambda lost: _few(lost["silent"])),
        (f"  of these, error up {FAINT}", lambda lost: _few(lost["silent_below"])),
        (
            "causes left out",
            lambda lost: ", ".join(f"{count} {name}" for name, count in lost["causes_left_out"].items()) or "–",
        ),
    ]
    known = {family: own["not_told"] for family, own in families.items() if own["not_told"]["not_exact"].count}
    told = [[name, *map(tell, known.values())] for name, tell in rows if known]
    return StudyTable("One to three causes, not told as a whole", ("", *known), told)


def _mechanisms_table(family: str, own: dict[str, Any]) -> StudyTable:
    return StudyTable(
        f"{family}: one cause, by how much it raises the error",
        ("effect", *(f"{name}: it and nothing else" for name in RISE_BINS), "median error", "in the interval"),
        [
            [
                name,
                *(_few(share) for share in one["exact"].values()),
                _percent(one["median_error_percent"], 1.0),
                _few(one["covered"]),
            ]
            for name, one in sorted(own["mechanisms"].items())
        ],
    )


def _counted(share: Proportion) -> str:
    """Return how many of how many, and Wilson's 95 % interval."""
    if share.share is None:
        return "–"
    return f"{share.count}/{share.total} ({100 * share.low:.1f}–{100 * share.high:.1f} %)"


def _few(share: Proportion) -> str:
    return f"{share.count} of {share.total}" if share.total else "–"


def _percent(value: float | None, factor: float = 100.0) -> str:
    return "–" if value is None else f"{factor * value:.1f} %"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _both(values: dict[str, float | None], form: str) -> str:
    return ", ".join("–" if value is None else f"{value:{form}}" for value in values.values())
