"""Less real data, and real data mixed with synthetic ones: whole runs, kept sizes, kept lineage."""

import dataclasses

import numpy as np
import pytest

from drives import drive, header_of
from swarmtwin.errors import UserError
from swarmtwin.recordings.recording import Recording
from swarmtwin.transitions import (
    SPLITS,
    Fractions,
    GeneratorOrigin,
    first_runs,
    from_recording,
    held_out,
    mix,
    split_by_run,
)
from swarmtwin.transitions.preparation import counts_by_split, describe, load_preparation, save_preparation

FRACTIONS = Fractions(train=0.8, validation=0.1, test=0.1)


@pytest.fixture(scope="module")
def real(robots):
    """Forty runs and how they were prepared."""
    mgr = robots["mgr"]
    recording = Recording(mgr, header_of(mgr), tuple(drive(mgr, runs=40, steps=12)), {}, "0123abcd")
    transitions, counts = from_recording(recording)
    transitions = split_by_run(transitions, FRACTIONS, seed=1)
    return transitions, describe(recording, "monday", transitions, counts, FRACTIONS, seed=1)


@pytest.fixture(scope="module")
def synthetic(real):
    """As many transitions as if they had been generated, without pose, time, commands before and neighbours."""
    transitions, preparation = real
    nothing = {
        name: np.full_like(getattr(transitions, name), np.nan)
        for name in ("pose", "previous_command", "earlier_command", "velocity", "time_s")
    }
    nothing["neighbours"] = np.empty((len(transitions), 0, 3))
    runs = tuple(f"synthetic-{index}" for index in range(len(transitions.runs)))
    made = dataclasses.replace(
        transitions, **nothing, runs=runs, vehicles=("synthetic",), vehicle=np.zeros_like(transitions.vehicle)
    )
    origin = GeneratorOrigin(name="residual_diffusion", digest="d1", seed=1, real_transitions=400)
    return made, preparation.model_copy(update={"origin": "synthetic", "generator": origin, "learned": ("other",)})


def test_the_first_runs_make_about_the_count_and_keep_the_shares(real):
    transitions, _ = real
    part = first_runs(transitions, 180)
    assert abs(len(part) - 180) <= 24
    assert len(part.part("test")) == 0
    for split in ("train", "validation"):
        kept, all_runs = np.unique(part.part(split).run), np.unique(transitions.part(split).run)
        np.testing.assert_array_equal(kept, all_runs[: len(kept)])
        assert (part.part(split).run == kept[0]).sum() == (transitions.run == kept[0]).sum()
    assert len(part.part("train")) > 5 * len(part.part("validation")) > 0


def test_more_than_there_is_cannot_be_had(real):
    available = len(real[0].part("train")) + len(real[0].part("validation"))
    with pytest.raises(UserError, match=rf"^there are {available} real transitions for training and validation: ask"):
        first_runs(real[0], available + 1)
    assert len(first_runs(real[0], available)) == available


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_a_mixture_is_as_large_as_the_real_data_and_has_their_share(real, synthetic, share):
    transitions, preparation = mix(real, synthetic, share)
    for split in ("train", "validation"):
        assert len(transitions.part(split)) == len(real[0].part(split))
    from_real = np.array(transitions.vehicles)[transitions.vehicle] != "synthetic"
    assert from_real.mean() == pytest.approx(share, abs=0.06)
    assert (preparation.origin, preparation.generator.digest) == ("mixed", "d1")
    assert set(preparation.learned) == {*real[1].learned, "other"}
    assert preparation.transitions == counts_by_split(transitions)


def test_a_mixture_holds_only_what_both_hold_and_every_row_is_one_of_theirs(real, synthetic):
    transitions, _ = mix(real, synthetic, 0.5)
    for name in ("pose", "previous_command", "earlier_command", "velocity", "time_s", "neighbours"):
        assert np.isnan(getattr(transitions, name)).all()
    assert np.isfinite(real[0].neighbours).all()
    known = {row.tobytes() for row in real[0].displacement}
    assert all(row.tobytes() in known for row in transitions.displacement)
    for run in np.unique(transitions.run):
        assert len(set(transitions.split[transitions.run == run])) == 1


def test_the_first_whole_runs_are_held_out_until_there_are_enough(real):
    """Every run of the two vehicles makes 24 transitions."""
    transitions, _ = real
    unseen = transitions.where(transitions.split != SPLITS.index("train"))
    in_order = np.unique(unseen.run)
    for most, runs in ((10**6, len(in_order)), (72, 3), (71, 2), (24, 1), (5, 1)):
        part = held_out(transitions, ("validation", "test"), most)
        np.testing.assert_array_equal(np.unique(part.run), in_order[:runs])
        assert len(part) == 24 * runs
    assert set(held_out(transitions, ("test",), 10**6).split) == {SPLITS.index("test")}
    assert len(held_out(transitions, (), 10**6)) == 0


def test_what_does_not_fit_is_refused(real, synthetic):
    few = (synthetic[0].where(np.arange(50)), synthetic[1])
    with pytest.raises(UserError, match=r"^the mixture needs \d+ synthetic transitions for train, and there are \d+: "):
        mix(real, few, 0.25)
    with pytest.raises(UserError, match=r"^synthetic=\.\.\. names real transitions: name a folder that generate made$"):
        mix(real, real, 0.5)
    with pytest.raises(UserError, match=r"to be mixed with synthetic ones are synthetic, and should be real$"):
        mix(synthetic, synthetic, 0.5)


def test_lineage_is_kept_and_an_older_preparation_is_real(synthetic, tmp_path):
    save_preparation(tmp_path, *synthetic)
    assert load_preparation(tmp_path) == synthetic[1]
    older = synthetic[1].model_dump(mode="json", exclude={"origin", "generator"})
    assert type(synthetic[1]).parse(older, "here").origin == "real"
