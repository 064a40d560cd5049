"""Ways to damage a recording on disk, as hypothesis strategies of `Damage`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hypothesis import strategies as st

RUNS = st.integers(0, 1)
POSE_CELLS, TIME_CELL, VEHICLE_CELL = (4, 5, 6), 0, 1
TEXT = ("abc", "1,5", "--", "0x1F", "1.2.3", "None", "1e", "∞", "12 3", "'1'", '"', "TRUE")
NOT_A_NUMBER = ("", "nan", "NaN", "inf", "-inf", "Infinity")
FAR_OUT = ("1e6", "-1e6", "99999.5", "1e300", "-1e300")
STRAY_BYTES = (b"\0", b"\xff", b'"', b"\n", b"\r", b",", b";", b"\xc3")


@dataclass(frozen=True)
class Damage:
    """What is done, to which of the two runs (None: to recording.yaml), by a function of the file."""

    name: str
    run: int | None
    act: Callable[[Path], None]

    def __call__(self, folder):
        runs = sorted((folder / "runs").iterdir())
        self.act(folder / "recording.yaml" if self.run is None else runs[self.run])

    def __repr__(self):
        return f"{self.name} of run {self.run}"


def read_rows(file):
    return [line.split(",") for line in file.read_text().splitlines()]


def write_rows(file, rows):
    file.write_text("".join(",".join(row) + "\n" for row in rows))


def edited(damage):
    """Make a strategy of `damage(random, rows)`, which edits the rows of one run, header first, in place."""

    @st.composite
    def strategy(draw):
        random = draw(st.randoms(use_true_random=False))

        def edit(file):
            rows = read_rows(file)
            damage(random, rows)
            write_rows(file, rows)

        return Damage(damage.__name__, draw(RUNS), edit)

    return strategy()


def cell_replaced(random, rows):
    rows[random.randrange(1, len(rows))][random.randrange(7)] = random.choice(TEXT + NOT_A_NUMBER + FAR_OUT)


def several_cells_replaced(random, rows):
    for _ in range(random.randrange(2, 6)):
        column = random.choice([TIME_CELL, 2, 3, *POSE_CELLS])
        rows[random.randrange(1, len(rows))][column] = random.choice(NOT_A_NUMBER + FAR_OUT)


def header_cell_replaced(random, rows):
    rows[0][random.randrange(7)] = random.choice(("", "lefft", "Left", "x", "time", "vehicle", "left", "amplitude_deg"))


def vehicle_replaced(random, rows):
    rows[random.randrange(1, len(rows))][VEHICLE_CELL] = random.choice(("1", "2", "3", "02", " 1", "", "two"))


def rows_swapped(random, rows):
    first, second = random.randrange(1, len(rows)), random.randrange(1, len(rows))
    rows[first], rows[second] = rows[second], rows[first]


def row_repeated(random, rows):
    row = random.randrange(1, len(rows))
    rows.insert(random.choice((row + 1, random.randrange(1, len(rows)))), list(rows[row]))


def rows_deleted(random, rows):
    first = random.randrange(1, len(rows))
    del rows[first : first + random.randrange(1, 6)]


def column_dropped(random, rows):
    column = random.randrange(7)
    for row in rows:
        del row[column]


def columns_exchanged(random, rows):
    first, second = random.randrange(7), random.randrange(7)
    for row in rows:
        row[first], row[second] = row[second], row[first]


def field_added_or_removed(random, rows):
    row = rows[random.randrange(1, len(rows))]
    if random.random() < 0.5:
        row.append("1")
    else:
        del row[random.randrange(7)]


def markers_swapped(random, rows, earliest=2):
    """Exchange the poses of both vehicles from a tick on, for a while or to the end; the first two ticks are right."""
    ticks = (len(rows) - 1) // 2
    first = random.randrange(earliest, ticks)
    last = random.choice((ticks, random.randrange(first + 1, ticks + 1)))
    for tick in range(first, last):
        one, other = rows[1 + 2 * tick], rows[2 + 2 * tick]
        one[4:], other[4:] = other[4:], one[4:]


def markers_swapped_late(random, rows):
    """Leave so many right poses first that another damage cannot take them all: nothing else tells who is who."""
    markers_swapped(random, rows, earliest=8)


def time_set_back(random, rows):
    """Let the clock jump back by at least a period, from a row on."""
    back_s = random.choice((0.5, 1.0, 3.25, 1000.0))
    for row in rows[random.randrange(3, len(rows)) :]:
        row[TIME_CELL] = str(float(row[TIME_CELL]) - back_s)


def rows_blanked(random, rows):
    """Lose poses, commands or both for some rows of both vehicles."""
    cells = random.choice((POSE_CELLS, (2, 3), (2, 3, *POSE_CELLS)))
    first = random.randrange(1, len(rows))
    for row in rows[first : first + random.randrange(1, 8)]:
        for cell in cells:
            row[cell] = ""


# Any two of these can be told for what they are. Two of the others can undo each other's traces: rows lost and then the
# clock set back leave a recording that nothing is wrong with.
MINGLING = (cell_replaced, several_cells_replaced, row_repeated, markers_swapped_late, rows_blanked)
ALONE = (
    markers_swapped,
    header_cell_replaced,
    vehicle_replaced,
    rows_swapped,
    rows_deleted,
    column_dropped,
    columns_exchanged,
    field_added_or_removed,
    time_set_back,
)


@st.composite
def cut_off(draw):
    """Cut a file of the recording off after any byte."""
    share = draw(st.floats(0, 1, exclude_max=True))

    def cut(file):
        content = file.read_bytes()
        file.write_bytes(content[: int(share * len(content))])

    return Damage(f"cut off after {share:.3f}", draw(st.sampled_from((0, 1, None))), cut)


@st.composite
def stray_byte(draw):
    """Put a byte into a run that belongs nowhere."""
    share, byte = draw(st.floats(0, 1)), draw(st.sampled_from(STRAY_BYTES))

    def insert(file):
        content = file.read_bytes()
        position = int(share * len(content))
        file.write_bytes(content[:position] + byte + content[position:])

    return Damage(f"{byte!r} at {share:.3f}", draw(RUNS), insert)


@st.composite
def bytes_overwritten(draw):
    """Overwrite some bytes: for files whose content is checksummed."""
    share, noise = draw(st.floats(0, 1, exclude_max=True)), draw(st.binary(min_size=1, max_size=8))

    def overwrite(file):
        content = bytearray(file.read_bytes())
        position = int(share * len(content))
        content[position : position + len(noise)] = noise
        file.write_bytes(bytes(content))

    return Damage(f"{noise!r} at {share:.3f}", draw(RUNS), overwrite)


csv_damage = st.one_of(*(edited(damage) for damage in MINGLING + ALONE), cut_off(), stray_byte())
mingled_csv_damage = st.lists(st.one_of(*(edited(damage) for damage in MINGLING)), min_size=2, max_size=2)
parquet_damage = st.one_of(cut_off(), bytes_overwritten())
