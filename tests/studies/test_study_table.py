"""A study's table says the same in the terminal, in a text file and on a page."""

import io

import pytest
from rich.console import Console

from swarmtwin.errors import UserError
from swarmtwin.studies.study_table import StudyTable
from swarmtwin.studies.tables.study import Options, run


@pytest.fixture
def table():
    return StudyTable(
        "Errors",
        ("model\nparameters", "colli-\nsions", "where"),
        [["floor", "", "[brackets] & <signs>"], ["crnet\n95,511", "1 %\n2 %", "here"]],
        "with *: the first of them",
        floors=1,
        marked=(1,),
        left=(2,),
    )


def test_a_text_file_has_its_lines_in_cells_and_words_on_the_left(table):
    assert table.markdown().splitlines() == [
        "## Errors",
        "",
        "| model<br>parameters | collisions | where |",
        "| --- | ---: | --- |",
        "| floor |  | [brackets] & <signs> |",
        "| crnet *<br>95,511 | 1 %<br>2 % | here |",
        "",
        "With *: the first of them.",
    ]


def test_a_table_without_title_and_caption_is_its_cells_alone():
    assert StudyTable("", ("one", "two"), [["a", "b"]]).markdown() == "| one | two |\n| --- | ---: |\n| a | b |\n"


def test_a_page_escapes_what_is_no_markup_and_tells_rows_apart(table):
    html = table.html()
    assert '<tr class="floor"><td>floor</td><td></td><td>[brackets] &amp; &lt;signs&gt;</td></tr>' in html
    assert '<tr class="marked"><td>crnet *<br>95,511</td><td>1 %<br>2 %</td><td>here</td></tr>' in html
    assert html.endswith("<p>With *: the first of them.</p>")


def test_the_terminal_takes_no_cell_for_markup(table):
    console = Console(file=io.StringIO(), width=80)
    console.print(table.drawn())
    shown = console.file.getvalue()
    assert "[brackets] & <signs>" in shown
    assert "colli-" in shown
    assert "crnet *" in shown


def test_what_is_part_of_the_row_above_stands_farther_to_the_right():
    shown = StudyTable("", ("", "sessions"), [["all", "9"], ["  of these, < 3 %", "4"]])
    assert shown.markdown().splitlines()[2:] == ["| all | 9 |", "| &emsp;of these, < 3 % | 4 |"]
    assert "<tr><td>&emsp;of these, &lt; 3 %</td><td>4</td></tr>" in shown.html()


def test_long_names_leave_room_for_the_other_columns_in_a_narrow_terminal():
    name = "two causes that hide together: both named, and nothing else beside them"
    shown = StudyTable("", ("", "one family", "another one"), [[name, "19/24 (59.5–90.8 %)", "17/24 (50.8–85.1 %)"]])
    console = Console(file=io.StringIO(), width=80)
    console.print(shown.drawn())
    assert "…" not in console.file.getvalue()
    assert "19/24 (59.5–90.8 %)  17/24 (50.8–85.1 %)" in console.file.getvalue()


def test_what_a_pipeline_left_damaged_or_not_at_all_is_refused(robots, tmp_path):
    asked = {"name": "tables", "robot": robots["mgr"], "artifacts": tmp_path, "output": tmp_path / "out"}
    options = Options(**asked, overwrite=False)
    with pytest.raises(UserError, match=r"table\.csv is missing: run `dvc repro` first"):
        run(options)
    (tmp_path / "comparison" / "mgr").mkdir(parents=True)
    (tmp_path / "comparison" / "mgr" / "table.csv").write_text("")
    with pytest.raises(UserError, match="robot 'mgr' is damaged"):
        run(options)
    assert not (tmp_path / "out").exists()
