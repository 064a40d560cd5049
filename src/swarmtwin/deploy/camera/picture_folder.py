"""Pictures in a folder as a camera: in the order of their names, at the times that a table states."""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from swarmtwin.deploy.camera.camera import Frame
from swarmtwin.errors import UserError

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm")


class PictureFolder:
    """Gives every picture in its order.

    Where the folder holds `times.csv` with the columns `file,time_s`, pictures have those times, in s, and come in
    their order; those that it leaves out are left out. Without, they are ordered by name, numbers as numbers, and are
    taken to be `period_s` apart.
    """

    is_live = False

    def __init__(self, path: Path, period_s: float = 1 / 30) -> None:
        """Look what is there.

        Args:
            path: of a folder, or of a single picture.
            period_s: between two pictures whose times are nowhere stated.

        Raises:
            UserError: there is no picture, or the table of times is wrong.
        """
        self.source = f"the pictures in {path}" if path.is_dir() else f"the picture {path}"
        table = path / "times.csv"
        if table.is_file():
            times_s = _read_times(table)
            self._pictures = [(time_s, path / name) for name, time_s in times_s.items()]
        else:
            files = sorted(_pictures_in(path), key=_with_numbers)
            self._pictures = [(number * period_s, file) for number, file in enumerate(files)]
        if not self._pictures:
            raise UserError(f"{path} holds no pictures: put {', '.join(PICTURES[:3])} files there")
        self.size = self._read(0).shape[1::-1]

    def next_frame(self, after: int = -1, timeout_s: float = 1.0) -> Frame | None:
        """Return the picture after number `after`; None: that was the last.

        Raises:
            UserError: it cannot be read, or has another size than the first.
        """
        number = after + 1
        if number >= len(self._pictures):
            return None
        time_s, file = self._pictures[number]
        picture = self._read(number)
        size = picture.shape[1::-1]
        if size != self.size:
            raise UserError(
                f"{file} has {size[0]} x {size[1]} pixels and {self._pictures[0][1].name} has {self.size[0]} x "
                f"{self.size[1]}: a camera's pictures have one size, put others into another folder"
            )
        return Frame(number, time_s, picture)

    def close(self) -> None:
        """There is nothing to let go of."""

    def _read(self, number: int) -> np.ndarray:
        file = self._pictures[number][1]
        picture = cv2.imread(str(file), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if picture is None:
            raise UserError(f"{file} is no picture that can be read: give {', '.join(PICTURES[:3])} files")
        return picture


def is_picture(path: Path) -> bool:
    """Say whether a file is a picture by its name."""
    return path.suffix.lower() in PICTURES


def _pictures_in(path: Path) -> Sequence[Path]:
    return [file for file in path.iterdir() if is_picture(file) and file.is_file()] if path.is_dir() else [path]


def _with_numbers(file: Path) -> list[tuple[int, str]]:
    """Return what sorts picture 9 before picture 10."""
    return [(int(digits or 0), other) for digits, other in re.findall(r"(\d+)|(\D+)", file.name)]


def _read_times(table: Path) -> Mapping[str, float]:
    """Return each file's time in s, in the order of the times.

    Raises:
        UserError: a column is missing, a time is no number, a file is missing or is there twice.
    """
    times_s: dict[str, float] = {}
    with table.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        rows = csv.DictReader(file)
        missing = {"file", "time_s"} - set(rows.fieldnames or ())
        if missing:
            raise UserError(f"{table} has no column {sorted(missing)[0]!r}: it has file,time_s")
        for row in rows:
            name, place = row["file"], f"{table}, line {rows.line_num}"
            try:
                time_s = float(row["time_s"])
                if not math.isfinite(time_s):
                    raise ValueError
            except (TypeError, ValueError):
                raise UserError(f"{place}: {row['time_s']!r} is no time in s: correct it") from None
            if name in times_s:
                raise UserError(f"{place}: {name} is there twice: a picture has one time")
            if not name or not (table.parent / name).is_file():
                raise UserError(f"{place}: there is no picture {name!r} in the folder: correct the name")
            times_s[name] = time_s
    return dict(sorted(times_s.items(), key=lambda entry: entry[1]))
