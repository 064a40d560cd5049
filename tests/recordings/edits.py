"""Editing a recording on disk by hand, as its tests do."""

import yaml


def lines_of(folder, run=0):
    return (folder / "runs" / f"run_{run:05d}.csv").read_text().splitlines()


def write_lines(folder, lines, run=0):
    file = folder / "runs" / f"run_{run:05d}.csv"
    file.write_text("\n".join(lines) + "\n")
    return file


def replace_cell(folder, row, column, value):
    """Replace one cell of run 0; `row` as an editor shows it."""
    lines = lines_of(folder)
    cells = lines[row - 1].split(",")
    cells[lines[0].split(",").index(column)] = value
    lines[row - 1] = ",".join(cells)
    return write_lines(folder, lines)


def edit_header(folder, **fields):
    file = folder / "recording.yaml"
    content = yaml.safe_load(file.read_text()) | fields
    file.write_text(yaml.safe_dump({name: value for name, value in content.items() if value != "absent"}))
    return file
