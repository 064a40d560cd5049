"""Ways to damage a recording on disk, as hypothesis strategies. Each damage is a function of the recording's folder."""

from hypothesis import strategies as st

POSE_CELLS, TIME_CELL, VEHICLE_CELL = (4, 5, 6), 0, 1
TEXT = ("abc", "1,5", "--", "0x1F", "1.2.3", "None", "1e", "∞", "12 3", "'1'", '"', "TRUE")
NOT_A_NUMBER = ("", "nan", "NaN", "inf", "-inf", "Infinity")
FAR_OUT = ("1e6", "-1e6", "99999.5", "1e300", "-1e300")
STRAY_BYTES = (b"\0", b"\xff", b'"', b"\n", b"\r", b",", b";", b"\xc3")


def run_file(folder, run):
    return sorted((folder / "runs").iterdir())[run]


def read_rows(file):
    return [line.split(",") for line in file.read_text().splitlines()]


def write_rows(file, rows):
    file.write_text("".join(",".join(row) + "\n" for row in rows))


def edited(damage):
    """Make a strategy of whole-table edits: `damage(draw, rows)` changes the rows of one run, header first, in place."""

    @st.composite
    def strategy(draw):
        run = draw(st.integers(0, 1))
        data = draw(st.randoms(use_true_random=False))

        def apply(folder):
            file = run_file(folder, run)
            rows = read_rows(file)
            damage(data, rows)
            write_rows(file, rows)

        apply.__name__ = damage.__name__
        return apply

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


def markers_swapped(random, rows):
    """Exchange the poses of both vehicles from a tick on, for a while or to the end; the first two ticks are right."""
    ticks = (len(rows) - 1) // 2
    first = random.randrange(2, ticks)
    last = random.choice((ticks, random.randrange(first + 1, ticks + 1)))
    for tick in range(first, last):
        one, other = rows[1 + 2 * tick], rows[2 + 2 * tick]
        one[4:], other[4:] = other[4:], one[4:]


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


EDITS = (
    cell_replaced,
    several_cells_replaced,
    header_cell_replaced,
    vehicle_replaced,
    rows_swapped,
    row_repeated,
    rows_deleted,
    column_dropped,
    columns_exchanged,
    field_added_or_removed,
    markers_swapped,
    time_set_back,
    rows_blanked,
)


@st.composite
def cut_off(draw):
    """Cut a file of the recording off after any byte."""
    which, share = draw(st.sampled_from((0, 1, "recording.yaml"))), draw(st.floats(0, 1, exclude_max=True))

    def cut(folder):
        file = folder / which if isinstance(which, str) else run_file(folder, which)
        content = file.read_bytes()
        file.write_bytes(content[: int(share * len(content))])

    return cut


@st.composite
def stray_byte(draw):
    """Put a byte into a run that belongs nowhere."""
    run, share, byte = draw(st.integers(0, 1)), draw(st.floats(0, 1)), draw(st.sampled_from(STRAY_BYTES))

    def insert(folder):
        file = run_file(folder, run)
        content = file.read_bytes()
        position = int(share * len(content))
        file.write_bytes(content[:position] + byte + content[position:])

    return insert


@st.composite
def bytes_overwritten(draw):
    """Overwrite some bytes: for files whose content is checksummed."""
    run, share = draw(st.integers(0, 1)), draw(st.floats(0, 1, exclude_max=True))
    noise = draw(st.binary(min_size=1, max_size=8))

    def overwrite(folder):
        file = run_file(folder, run)
        content = bytearray(file.read_bytes())
        position = int(share * len(content))
        content[position : position + len(noise)] = noise
        file.write_bytes(bytes(content))

    return overwrite


csv_damage = st.one_of(*(edited(damage) for damage in EDITS), cut_off(), stray_byte())
parquet_damage = st.one_of(cut_off(), bytes_overwritten())
