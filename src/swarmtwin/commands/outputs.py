"""Where a command writes when nobody says: a numbered folder under `outputs/`."""

from itertools import count
from pathlib import Path


def output_folder(chosen: Path | None, command: str, name: str) -> Path:
    """Return the folder asked for, or claim the first free `outputs/<command>/<name>-<number>` by making it, empty."""
    if chosen is not None:
        return chosen
    for number in count(1):
        folder = Path("outputs") / command / f"{name}-{number:03}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise AssertionError
