"""The tables of the study, for the terminal and for its report.md alike."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich import box
from rich.table import Table

from swarmtwin.studies.hidden_effects.metrics import CLEAR, MIDDLE, RISE_BINS, Proportion, Proportions, Summary


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


def study_tables(summary: Summary) -> Iterator[StudyTable]:
    """Return all tables, the most important first."""
    yield marks_table(summary)
    yield _causes_table(summary)
    yield _clean_table(summary)
    yield _outside_table(summary)
    yield _parameters_table(summary)
    yield _gain_table(summary)
    if len(summary.methods) > 1:
        yield _methods_table(summary)


def marks_table(summary: Summary) -> StudyTable:
    """Return the figures that matter, each beside the mark set for it and its 95 % interval."""
    clear, middle = summary.single[CLEAR], summary.single[MIDDLE]
    shares = [
        ("one effect, error up by ≥ 10 %: found", clear["found"], "≥ 99 %"),
        ("  named first", clear["named_first"], "≥ 95 %"),
        ("  named, or listed as rival", clear["listed"], "≥ 99 %"),
        ("one effect, up by 3 to 10 %: named first", middle["named_first"], "≥ 85 %"),
        ("two effects: exactly these", summary.pair["exact"], "≥ 85 %"),
        ("three effects: exactly these", summary.triple["exact"], "≥ 60 %"),
        ("not in the catalogue: no name given", summary.outside["not_named"], "≥ 95 %"),
        ("  not said to be explained", summary.outside["not_explained"], ""),
        ("nothing wrong: a cause named", summary.clean["accused"], "≤ 1 %"),
        ("  alarmed, with or without a name", summary.clean["alarmed"], ""),
        ("  error raised by 0.5 % or more", summary.clean["harmed"], "0"),
        ("95 % intervals that hold the truth", summary.covered, "92 to 98 %"),
        ("diagnoses that failed", summary.failed, "0"),
    ]
    rows = [[name, str(share), _interval(share), mark] for name, share, mark in shares]
    error, gain = summary.median_parameter_error_percent, summary.gain
    rows.append(["parameters: median error", _percent(error, 1.0), "", "≤ 3 %"])
    rows.append(["gain, of what the effect brought: median", _percent(gain.diagnosis), "", "≥ 95 %"])
    rows.append(["  of all error above the exact mean's", _percent(gain.diagnosis_to_floor), "", ""])
    rows.append(["rivals that a named cause has: mean", _number(summary.rivals_a_cause), "", ""])
    rows.append(["mean confidence of the first cause", _percent(summary.mean_confidence), "", ""])
    rows.append(["  how often it is right", str(summary.first_right), _interval(summary.first_right), ""])
    rows.append(["seconds a diagnosis: median, most", f"{summary.median_seconds:.1f}, {summary.longest_seconds:.1f}"])
    rows[-1] += ["", ""]
    return StudyTable(f"{summary.cases:,} hidden and clean sessions", ("", "measured", "95 % interval", "mark"), rows)


def _causes_table(summary: Summary) -> StudyTable:
    rows = []
    groups = {"all": summary.single, **summary.single_by_robot, **summary.single_by_cause}
    for name, bins in groups.items():
        cells = [_found_and_named(bins[bin_name]) for bin_name in RISE_BINS]
        rows.append([name, *cells, _few(bins[CLEAR]["listed"])])
    headings = ("effect", *(f"{name}: found, named first" for name in RISE_BINS), "listed")
    return StudyTable("One effect, by how much it raises the error", headings, rows)


def _found_and_named(naming: Proportions) -> str:
    total = naming["found"].total
    return f"{naming['found'].count}, {naming['named_first'].count} of {total}" if total else "–"


def _few(share: Proportion) -> str:
    return f"{share.count} of {share.total}" if share.total else "–"


def _clean_table(summary: Summary) -> StudyTable:
    rows = [
        [name, _few(clean["accused"]), f"{clean['accused'].at_most:.1%}", _few(clean["alarmed"]), _few(clean["harmed"])]
        for name, clean in {"all": summary.clean, **summary.clean_by_variety}.items()
    ]
    headings = ("session", "cause named", "at most (95 %)", "alarmed", "error raised")
    return StudyTable("Nothing wrong", headings, rows)


def _outside_table(summary: Summary) -> StudyTable:
    rows = [
        [name, _few(outside["found"]), _few(outside["not_named"]), _few(outside["not_explained"])]
        for name, outside in {"all": summary.outside, **summary.outside_by_effect}.items()
    ]
    return StudyTable("Outside the catalogue", ("effect", "found", "no name given", "not said to be explained"), rows)


def _parameters_table(summary: Summary) -> StudyTable:
    rows = [
        [
            name,
            str(precision.count),
            f"{precision.median_error:.3g} {precision.unit}".strip(),
            _percent(precision.median_error_percent, 1.0),
            _percent(precision.median_error_of_change_percent, 1.0),
            _few(precision.covered),
        ]
        for name, precision in sorted(summary.parameters.items())
    ]
    headings = ("parameter", "cases", "median error", "of its value", "of its change", "in the interval")
    return StudyTable("Parameters of causes named", headings, rows)


def _gain_table(summary: Summary) -> StudyTable:
    rows = [
        [
            name,
            str(gain.count),
            _percent(gain.diagnosis),
            _percent(gain.black_box),
            _percent(gain.diagnosis_to_floor),
            _percent(gain.black_box_to_floor),
        ]
        for name, gain in {"all": summary.gain, **summary.gain_by_cause}.items()
    ]
    headings = ("effect", "cases", "diagnosis", "black box", "to the floor: diagnosis", "black box")
    return StudyTable("Median share of the achievable gain, error up by 10 % or more", headings, rows)


def _methods_table(summary: Summary) -> StudyTable:
    rows = [
        [name, str(method["named_first"]), str(method["exact"]), str(method["accused"]), str(method["outside"])]
        for name, method in summary.methods.items()
    ]
    headings = ("method", "named first", "and no other", "clean accused", "outside: no name")
    return StudyTable("Beside other methods (effects that raise the error by 10 % or more)", headings, rows)


def _interval(share: Proportion) -> str:
    return "" if share.share is None else f"{share.low:.1%} to {share.high:.1%}"


def _percent(value: float | None, factor: float = 100.0) -> str:
    return "–" if value is None else f"{factor * value:.1f} %"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
