"""What code does, as text: equal where only comments, docstrings and layout differ, and different everywhere else."""

import re
from pathlib import Path

import pytest

from swarmtwin.tracking.bare_code import bare, digest

SOURCE = Path(__file__).resolve().parents[2] / "src" / "swarmtwin"
CODE = '''"""A module."""

LIMIT = 3.0
"""What it is."""


class Empty:
    """Nothing but this."""


def half(value):  # a comment
    """Return half of it."""
    return value / 2
'''


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("A module.", "The module, explained."),
        ("  # a comment", ""),
        ('"""What it is."""\n', ""),
        ("Return half of it.", "Return it,\n    halved."),
        ("return value / 2", "return (\n        value / 2\n    )"),
        ('    """Nothing but this."""', "    pass"),
    ],
)
def test_how_it_is_written_does_not_matter(old, new):
    assert CODE.replace(old, new) != CODE
    assert bare(CODE.replace(old, new)) == bare(CODE)


@pytest.mark.parametrize(
    ("old", "new"),
    [("/ 2", "/ 3"), ("3.0", "3"), ("half(value)", "half(value=1)"), ("return value", "value"), ("Empty", "Void")],
)
def test_what_it_does_does(old, new):
    assert bare(CODE.replace(old, new)) != bare(CODE)


def test_a_text_that_is_used_stays():
    assert bare("print('# no comment')") != bare("print('')")
    assert bare("def f():\n    return 'a text'") != bare("def f():\n    'a text'")


def test_a_digest_is_of_what_code_does_and_of_all_else_as_it_is(tmp_path):
    code, page = tmp_path / "code.py", tmp_path / "page.html"
    digests = []
    for text in (CODE, f"{CODE}# another comment\n", f"{CODE}ANOTHER = 1\n"):
        code.write_text(text)
        page.write_text(text)
        digests.append((digest(code), digest(page)))
    (first, _), (commented, _), (changed, _) = digests
    assert first == commented != changed
    assert len({of_page for _, of_page in digests}) == 3


def test_nothing_in_the_package_asks_for_docstrings():
    for file in SOURCE.rglob("*.py"):
        text = bare(file.read_text())
        assert bare(text) == text
        assert not re.search(r"\b(__doc__|getdoc|getsource|cleandoc)\b", text), file
