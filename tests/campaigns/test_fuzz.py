"""The beginning of the campaign in `fuzz.py`; all of it is one command there."""

from fuzz import campaign, failures


def test_damaged_files_are_refused_in_one_line_or_used(tmp_path):
    """Also where the campaign was broken off and goes on."""
    first = campaign(10, 20261122, tmp_path / "state.jsonl")
    cases = campaign(60, 20261122, tmp_path / "state.jsonl")
    assert cases[:10] == first
    assert [case.number for case in cases] == list(range(60))
    assert not failures(cases)
    assert {case.outcome for case in cases} == {"used", "refused"}
