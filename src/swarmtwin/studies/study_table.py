"""A table of a study, for the terminal, for a page and for a text file alike."""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape
from rich import box
from rich.table import Table
from rich.text import Text

WIDE = 40
"""A longer name than of so many characters may be broken in the terminal, to make room for the other columns."""


@dataclass(frozen=True)
class StudyTable:
    r"""R rows of C cells, the first column a name; a cell of several lines holds `\n`.

    Attributes:
        title: what stands above it.
        headings: of the columns.
        rows: of cells.
        caption: what stands below it.
        floors: how many rows, from the first, are no results but the best that can be.
        marked: numbers of the rows that the caption says something of: their names bear a star.
        left: numbers of further columns of words, set on the left.
    """

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    floors: int = 0
    marked: Collection[int] = ()
    left: Collection[int] = ()

    def drawn(self) -> Table:
        """Return it for the terminal."""
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=self.title, title_justify="left")
        for number, heading in enumerate(self.headings):
            words = number == 0 or number in self.left
            unbroken = number == 0 and max((len(row[0]) for row in self._starred), default=0) <= WIDE
            table.add_column(heading, justify="left" if words else "right", no_wrap=unbroken, overflow="fold")
        for number, row in enumerate(self._starred):
            style = "dim" if number < self.floors else "bold" if number in self.marked else None
            table.add_row(*map(Text, row), style=style)
        table.caption = self.caption or None
        return table

    def markdown(self) -> str:
        """Return it for a text file."""
        rulers = ["---" if column == 0 or column in self.left else "---:" for column in range(len(self.headings))]
        lines = [f"| {' | '.join(_unbroken(self.headings))} |", f"| {' | '.join(rulers)} |"]
        lines += [
            f"| {' | '.join(map(str.rstrip, (''.join(_indented(name)), *cells)))} |" for name, *cells in self._starred
        ]
        cells = "\n".join(re.sub(r" *\n", "<br>", line) for line in lines)
        heading = f"## {self.title}\n\n" if self.title else ""
        return heading + cells + "\n" + (f"\n{self._sentence}\n" if self.caption else "")

    def html(self) -> Markup:
        """Return it for a page, without its title; rows that are floors or marked bear that as their class."""
        lines = [_html_row("th", _unbroken(self.headings))]
        for number, row in enumerate(self._starred):
            kind = "floor" if number < self.floors else "marked" if number in self.marked else ""
            lines.append(_html_row("td", row, kind))
        table = Markup("<table>\n{}\n</table>").format(Markup("\n").join(lines))
        return table + Markup("\n<p>{}</p>").format(self._sentence) if self.caption else table

    @property
    def _starred(self) -> list[list[str]]:
        """The rows, with a star behind the first line of each marked one's name."""
        names = (re.sub(r"$", " *", row[0], count=1, flags=re.MULTILINE) for row in self.rows)
        return [
            [name if number in self.marked else row[0], *row[1:]]
            for number, (name, row) in enumerate(zip(names, self.rows, strict=True))
        ]

    @property
    def _sentence(self) -> str:
        return f"{self.caption[0].upper()}{self.caption[1:]}."


def _unbroken(headings: Sequence[str]) -> list[str]:
    """Return headings for where there is room: no word is divided, and no line is empty."""
    return [heading.replace("-\n", "").strip() for heading in headings]


def _indented(name: str) -> tuple[str, str]:
    """Return what sets a row's name as far to the right on a page as its spaces do in the terminal, and the name."""
    shown = name.lstrip(" ")
    return "&emsp;" * ((len(name) - len(shown)) // 2), shown


def _html_row(tag: str, cells: Sequence[str], kind: str = "") -> Markup:
    space, name = _indented(cells[0])
    told = [Markup(space) + escape(name), *map(escape, cells[1:])]
    shown = (Markup("<{0}>{1}</{0}>").format(Markup(tag), cell.replace("\n", Markup("<br>"))) for cell in told)
    return Markup("<tr{}>{}</tr>").format(Markup(' class="{}"').format(kind) if kind else "", Markup("").join(shown))
