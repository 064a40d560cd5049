"""Exact means are read as they were written, of this version and of older ones, and damage is one clear error."""

import numpy as np
import pandas as pd
import pytest

from swarmtwin.errors import UserError
from swarmtwin.recordings.exact_means import exact_means_table, mean_columns, read_exact_means, write_exact_means

KNOWN = ("situation", "previous_command", "earlier_command")


@pytest.fixture
def table():
    """Two runs of three rows of two vehicles; each number tells where it stands."""
    numbers = np.arange(2 * 3 * 2 * 3, dtype=np.float32).reshape(2, 3, 2, 3)
    means = {known: 1000 * level + numbers for level, known in enumerate(KNOWN)}
    time_s = np.array([[0.0, 0.5, 1.0], [10.0, 10.5, 11.0]])
    return exact_means_table(["a", "b"], ["2", "1"], time_s, means)


def test_each_number_is_found_where_it_belongs(table, tmp_path):
    write_exact_means(tmp_path, table)
    read = read_exact_means(tmp_path)
    assert read.equals(table)
    row = read[(read.run == "b") & (read.vehicle == "1") & (read.time_s == 10.5)]
    place = 3 * (2 * (3 * 1 + 1) + 1)
    assert row[mean_columns("situation")].to_numpy().tolist() == [[place, place + 1, place + 2]]
    assert row[mean_columns("earlier_command")].to_numpy().tolist() == [[place + 2000, place + 2001, place + 2002]]


def test_an_old_file_has_the_mean_given_everything_instead(table, tmp_path):
    kept = table.drop(columns=mean_columns("earlier_command"))
    names = dict(zip(mean_columns("previous_command"), mean_columns("everything"), strict=True))
    write_exact_means(tmp_path, kept.rename(columns=names))
    columns = [*mean_columns("situation"), *mean_columns("everything")]
    assert list(read_exact_means(tmp_path)) == ["run", "vehicle", "time_s", *columns]


def test_a_recording_without_exact_means_says_so(tmp_path):
    with pytest.raises(UserError, match="only recordings of stand-ins made by `swarmtwin record` have exact means"):
        read_exact_means(tmp_path)


def truncated(file):
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])


def without(column):
    return lambda file: pd.read_parquet(file).drop(columns=column).to_parquet(file)


DAMAGES = {
    "empty": lambda file: file.write_bytes(b""),
    "truncated": truncated,
    "text": lambda file: file.write_text("run,vehicle,time_s"),
    "a column short": without("earlier_command_left_mm"),
    "a mean short": without(mean_columns("previous_command")),
    "a folder": lambda file: (file.unlink(), file.mkdir()),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damage_is_one_clear_error(table, tmp_path, damage):
    write_exact_means(tmp_path, table)
    file = tmp_path / "truth.parquet"
    damage(file)
    with pytest.raises(UserError) as refused:
        read_exact_means(tmp_path)
    message = str(refused.value)
    assert message.startswith(f"{file} is damaged (")
    assert message.endswith("): copy it again, or record again with the same options and seed")
    assert "\n" not in message
