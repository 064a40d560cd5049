"""Where a command writes when nobody says: a numbered folder under `outputs/`."""

from itertools import count
from pathlib import Path


def output_folder(chosen: Path | None, command: str, name: str) -> Path:
    """Return the folder asked for, or the first free `outputs/<command>/<name>-<number>`."""
    if chosen is not None:
        return chosen
    numbered = (Path("outputs") / command / f"{name}-{number:03}" for number in count(1))
    return next(folder for folder in numbered if not folder.exists())
