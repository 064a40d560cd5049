"""The beginning of the campaign in `fuzz.py`; all of it is one command there."""

from fuzz import campaign, failures


def test_damaged_files_are_refused_in_one_line_or_used(tmp_path):
    cases = campaign(60, 20261122, tmp_path / "state.jsonl")
    assert not failures(cases)
    assert {case.outcome for case in cases} == {"used", "refused"}


def test_a_campaign_goes_on_where_it_was_broken_off(tmp_path):
    whole = campaign(12, 7, tmp_path / "whole.jsonl")
    campaign(5, 7, tmp_path / "state.jsonl")
    assert campaign(12, 7, tmp_path / "state.jsonl") == whole
