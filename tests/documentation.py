"""The README and the pages in docs/: their code blocks, the commands in these, and the plug-ins that they show."""

import re
import shlex
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
README = REPOSITORY / "README.md"
PAGES = sorted([README, *DOCS.rglob("*.md")])


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks of a page in a language, without their fences."""
    return re.findall(rf"```{language}[^\n]*\n(.*?)```", page.read_text(), re.DOTALL)


def commands(page: Path) -> list[list[str]]:
    """The calls of swarmtwin in a page's shell blocks: the arguments of each, comments and `...` left out."""
    lines = [line.strip() for block in blocks(page, "sh") for line in block.replace("\\\n", " ").splitlines()]
    calls = [shlex.split(line, comments=True) for line in lines if line.startswith("swarmtwin ")]
    return [[argument for argument in call[1:] if argument != "..."] for call in calls]
