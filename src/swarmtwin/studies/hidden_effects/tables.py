"""The tables of the study, for the terminal and for its report.md alike."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.table import Table

from swarmtwin.studies.hidden_effects.metrics import CLEAR, MIDDLE, RISE_BINS, SILENCE, Proportion, Proportions


@dataclass(frozen=True)
class StudyTable:
    """R rows of C cells, the first column a name, for the terminal and for a text file."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]

    def drawn(self) -> Table:
        """Return it for the terminal."""
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=self.title, title_justify="left")
        for number, heading in enumerate(self.headings):
            table.add_column(heading, justify="right" if number else "left", no_wrap=not number)
        for row in self.rows:
            table.add_row(*row)
        return table

    def markdown(self) -> str:
        """Return it for a text file."""
        lines = [self.headings, ["---", *["---:"] * (len(self.headings) - 1)], *self.rows]
        cells = "\n".join("| " + " | ".join(row) + " |" for row in lines)
        return f"## {self.title}\n\n{cells}\n"


def study_tables(summary: dict[str, Any]) -> Iterator[StudyTable]:
    """Return all tables, the most important first."""
    yield _marks_table(summary)
    bins = {"all": summary["single"], **summary["single_by_robot"], **summary["single_by_cause"]}
    yield StudyTable(
        "One effect, by how much it raises the error",
        ("effect", *(f"{name}: found, named first" for name in RISE_BINS), "listed"),
        [[name, *map(_found_and_named, own.values()), _few(own[CLEAR]["listed"])] for name, own in bins.items()],
    )
    yield StudyTable(
        "Nothing wrong",
        ("session", "cause named", "at most (95 %)", "alarmed", "error raised"),
        [
            [name, _few(own["accused"]), f"{own['accused'].at_most:.1%}", _few(own["alarmed"]), _few(own["harmed"])]
            for name, own in {"all": summary["clean"], **summary["clean_by_variety"]}.items()
        ],
    )
    yield StudyTable(
        "Outside the catalogue",
        ("effect", "found", "no name given", "not said to be explained"),
        [
            [name, *(_few(own[column]) for column in SILENCE)]
            for name, own in {"all": summary["outside"], **summary["outside_by_effect"]}.items()
        ],
    )
    yield StudyTable(
        "Parameters of causes named",
        ("parameter", "cases", "median error", "of its value", "of its change", "in the interval"),
        [
            [
                name,
                str(own["count"]),
                f"{own['median_error']:.3g} {own['unit']}".strip(),
                _percent(own["median_error_percent"], 1.0),
                _percent(own["median_error_of_change_percent"], 1.0),
                _few(own["covered"]),
            ]
            for name, own in sorted(summary["parameters"].items())
        ],
    )
    yield StudyTable(
        "Median share of the achievable gain, error up by 10 % or more",
        ("effect", "cases", "diagnosis", "black box", "to the floor: diagnosis", "black box"),
        [
            [name, str(own["count"]), *(_percent(share) for column, share in own.items() if column != "count")]
            for name, own in {"all": summary["gain"], **summary["gain_by_cause"]}.items()
        ],
    )
    if len(summary["methods"]) > 1:
        yield StudyTable(
            "Beside other methods (effects that raise the error by 10 % or more)",
            ("method", "named first", "and no other", "clean accused", "outside: no name"),
            [[name, *map(str, own.values())] for name, own in summary["methods"].items()],
        )


def _marks_table(summary: dict[str, Any]) -> StudyTable:
    """Return the figures that matter, each beside its 95 % interval and the mark set for it."""
    median_s, longest_s = summary["median_seconds"], summary["longest_seconds"]
    clear, middle, clean, gain = summary["single"][CLEAR], summary["single"][MIDDLE], summary["clean"], summary["gain"]
    rows = [
        _marked("one effect, error up by ≥ 10 %: found", clear["found"], "≥ 99 %"),
        _marked("  named first", clear["named_first"], "≥ 95 %"),
        _marked("  named, or listed as rival", clear["listed"], "≥ 99 %"),
        _marked("one effect, up by 3 to 10 %: named first", middle["named_first"], "≥ 85 %"),
        _marked("two effects: exactly these", summary["pair"]["exact"], "≥ 85 %"),
        _marked("three effects: exactly these", summary["triple"]["exact"], "≥ 60 %"),
        _marked("not in the catalogue: no name given", summary["outside"]["not_named"], "≥ 95 %"),
        _marked("  not said to be explained", summary["outside"]["not_explained"], ""),
        _marked("nothing wrong: a cause named", clean["accused"], "≤ 1 %"),
        _marked("  alarmed, with or without a name", clean["alarmed"], ""),
        _marked("  error raised by 0.5 % or more", clean["harmed"], "0"),
        _marked("95 % intervals that hold the truth", summary["covered"], "92 to 98 %"),
        _marked("diagnoses that failed", summary["failed"], "0"),
        ["parameters: median error", _percent(summary["median_parameter_error_percent"], 1.0), "", "≤ 3 %"],
        ["gain, of what the effect brought: median", _percent(gain["diagnosis"]), "", "≥ 95 %"],
        ["  of all error above the exact mean's", _percent(gain["diagnosis_to_floor"]), "", ""],
        ["rivals that a named cause has: mean", _number(summary["rivals_a_cause"]), "", ""],
        ["mean confidence of the first cause", _percent(summary["mean_confidence"]), "", ""],
        _marked("  how often it is right", summary["first_right"], ""),
        ["seconds a diagnosis: median, most", f"{median_s:.1f}, {longest_s:.1f}", "", ""],
    ]
    return StudyTable(
        f"{summary['cases']:,} hidden and clean sessions", ("", "measured", "95 % interval", "mark"), rows
    )


def _marked(name: str, share: Proportion, mark: str) -> list[str]:
    return [name, str(share), "" if share.share is None else f"{share.low:.1%} to {share.high:.1%}", mark]


def _found_and_named(naming: Proportions) -> str:
    total = naming["found"].total
    return f"{naming['found'].count}, {naming['named_first'].count} of {total}" if total else "–"


def _few(share: Proportion) -> str:
    return f"{share.count} of {share.total}" if share.total else "–"


def _percent(value: float | None, factor: float = 100.0) -> str:
    return "–" if value is None else f"{factor * value:.1f} %"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
