"""The study of hidden effects: planted results give planted figures, and wrong names count as wrong."""

import math
import mmap

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from case_results import result
from exact_model import conditions_of
from swarmtwin.diagnosis.result import DetectionLimit, Estimate
from swarmtwin.diagnosis.settings import VerdictSettings
from swarmtwin.studies.hidden_effects.detection_plots import confusion
from swarmtwin.studies.hidden_effects.held_out_gain import Displacements, HeldOutGain, held_out_gain
from swarmtwin.studies.hidden_effects.metrics import calibration_error_by_chance, expected_calibration_error, summarise
from swarmtwin.studies.hidden_effects.peak_memory import forget_peak, peak_mb
from swarmtwin.studies.hidden_effects.proportions import CLEAR, Proportion
from swarmtwin.studies.hidden_effects.results import (
    Baselines,
    TrueModelAnswer,
    append_result,
    confidences_table,
    filled,
    parameters_table,
    read_results,
    results_table,
)
from swarmtwin.studies.hidden_effects.scoring import score_case, times_limit
from swarmtwin.studies.hidden_effects.study import ScoringJob
from swarmtwin.studies.hidden_effects.tables import study_tables


def formulas(results):
    return summarise(results)["families"]["formulas"]


def column_of(method, summary):
    """What a table shows of one method, by the names of its rows."""
    table = next(table for table in study_tables(summary) if method in table.headings)
    return {row[0].strip(): row[table.headings.index(method)] for row in table.rows}


def named(proportions):
    """Counts of all sessions, whichever vehicle drove."""
    return {
        name: share.count
        for name, share in proportions.items()
        if name not in ("exact_of_known_vehicle", "exact_above_limits")
    }


def test_planted_names_give_planted_rates():
    results = [
        *[result("one", "gain_change", ["gain_change"])] * 7,
        *[result("one", "gain_change", ["battery_sag"])] * 2,
        result("one", "gain_change", ["battery_sag"], rivals=("gain_change",)),
        result("one", "command_delay", ["command_delay", "noise_change"], rise=5.0),
        result("one", "command_delay", verdict="unexplained", rise=1.0),
    ]
    summary = formulas(results)
    counts = named(summary["one"][CLEAR])
    assert counts == {"exact": 7, "found": 10, "named_first": 7, "listed": 8, "falsely_named": 3}
    assert summary["one"][CLEAR]["found"].total == 10
    middle = named(summary["one"]["3 to 10 %"])
    assert middle == {"exact": 0, "found": 1, "named_first": 1, "listed": 1, "falsely_named": 1}
    faint = named(summary["one"]["below 3 %"])
    assert faint == {"exact": 0, "found": 1, "named_first": 0, "listed": 0, "falsely_named": 0}
    assert summary["mechanisms"]["gain_change"]["exact"][CLEAR].share == pytest.approx(0.7)
    assert summary["mechanisms"]["command_delay"]["exact"]["3 to 10 %"].count == 0


def test_families_are_counted_by_themselves():
    results = [
        *[result("one", "gain_change", ["gain_change"])] * 3,
        *[result("one", "gain_change", family="unruly")] * 2,
        result("clean", "plain", ["gain_change"], family="unruly"),
    ]
    families = summarise(results)["families"]
    assert list(families) == ["formulas", "unruly"]
    assert (families["formulas"]["one"][CLEAR]["exact"].count, families["formulas"]["cases"]) == (3, 3)
    assert (families["unruly"]["one"][CLEAR]["exact"].count, families["unruly"]["clean"]["accused"].count) == (0, 1)
    tables = study_tables(summarise(results))
    text = tables[0].markdown()
    assert "| one cause, error up by ≥ 10 %: it and nothing else | 3/3 (43.9–100.0 %) | 0/2 (0.0–65.8 %) |" in text
    assert "three causes" not in text  # none was hidden
    assert "In no catalogue" not in {table.title for table in tables}


def test_sessions_of_the_vehicle_that_was_learned_from_are_counted_apart():
    right, wrong = result("one", "gain_change", ["gain_change"]), result("one", "gain_change")
    results = [*[right] * 3, wrong, *[wrong.model_copy(update={"same_vehicle": False})] * 4]
    clear = formulas(results)["one"][CLEAR]
    assert (clear["exact"].count, clear["exact"].total) == (3, 8)
    assert (clear["exact_of_known_vehicle"].count, clear["exact_of_known_vehicle"].total) == (3, 4)


def test_confidences_that_are_right_as_often_as_they_say_have_no_calibration_error():
    said, right = pd.Series([0.95] * 20 + [0.75] * 4), pd.Series([True] * 19 + [False] + [True] * 3 + [False])
    assert expected_calibration_error(said, right) == pytest.approx(0.0)
    assert expected_calibration_error(pd.Series([1.0] * 10), pd.Series([True] * 8 + [False] * 2)) == pytest.approx(0.2)
    # two bins that miss by 0.15 in opposite ways do not make up for each other
    both = expected_calibration_error(
        pd.Series([0.95] * 10 + [0.35] * 10), pd.Series([1] * 8 + [0] * 2 + [1] * 5 + [0] * 5)
    )
    assert both == pytest.approx(0.15)
    assert expected_calibration_error(pd.Series(dtype=float), pd.Series(dtype=bool)) is None
    results = [
        *[result("one", "gain_change", ["gain_change"], posterior=0.9)] * 6,
        *[result("outside", "whirl", ["lens_distortion"], posterior=0.9)] * 4,
    ]
    gain, lens = (VerdictSettings().confidence(name, 0.9) for name in ("gain_change", "lens_distortion"))
    assert 0.6 < gain < 0.7 < lens < 0.8
    counted = formulas(results)
    assert counted["calibration_error"] == pytest.approx(0.6 * (1 - gain) + 0.4 * lens)
    assert counted["brier"] == pytest.approx(0.6 * (1 - gain) ** 2 + 0.4 * lens**2)
    assert counted["brier_of_posterior"] == pytest.approx(0.6 * 0.1**2 + 0.4 * 0.9**2)


def test_a_calibration_error_is_shown_beside_what_chance_makes_it():
    of_a_hundred, all_certain = pd.Series([0.9] * 100), pd.Series([1.0] * 100)
    # of a hundred that are there with 90 %, 84 to 95 are in 95 % of draws
    assert calibration_error_by_chance(of_a_hundred) == pytest.approx(0.06, abs=0.011)
    assert calibration_error_by_chance(all_certain) == 0.0
    assert calibration_error_by_chance(pd.Series(dtype=float)) is None
    mixed = pd.Series([0.9, 0.3, 0.6] * 30)
    assert calibration_error_by_chance(mixed) == calibration_error_by_chance(mixed[::-1])
    results = [result("one", "marker_offset", ["marker_offset"])] * 100
    (marks, *_) = study_tables(summarise(results))
    (row,) = (one for one in marks.rows if "by chance" in one[0])
    assert float(row[1]) == pytest.approx(2 * np.sqrt(0.961 * 0.039 / 100), abs=0.01)


def test_the_most_memory_of_a_session_forgets_that_of_the_one_before():
    forget_peak()
    before = peak_mb()
    fresh = mmap.mmap(-1, 80 * 1024**2)  # an array may lie in memory that was used before
    np.frombuffer(fresh, np.uint8)[:] = 1
    with_80_mb = peak_mb()
    fresh.close()
    forget_peak()
    assert with_80_mb - before == pytest.approx(80, abs=30)
    assert peak_mb() < before + 30


def test_two_at_once_must_be_exactly_these():
    pair = "dead_band+marker_yaw"
    results = [
        result("two", pair, ["marker_yaw", "dead_band"]),
        result("two", pair, ["dead_band"]),
        result("two", pair, ["dead_band", "marker_yaw", "noise_change"]),
        result("two", pair, ["saturation", "marker_yaw"], rivals=("dead_band",)),
    ]
    counts = named(formulas(results)["two"])
    assert counts == {"exact": 1, "found": 4, "named_first": 3, "listed": 3, "falsely_named": 2}
    assert formulas(results)["three"]["exact"].share is None


def test_what_became_of_sessions_that_are_not_told_as_a_whole():
    pair = "dead_band+marker_yaw"
    results = [
        result("two", pair, ["marker_yaw", "dead_band"]),
        result("two", pair, ["dead_band"]),
        result("two", pair, ["dead_band"], same_vehicle=False),
        result("two", pair, ["marker_yaw"]),
        result("two", pair, ["saturation"], same_vehicle=False),
        result("one", "dead_band", verdict="unexplained"),
        result("one", "dead_band", verdict="no_gap", rise=1.0),
        result("one", "dead_band", verdict="no_gap", rise=5.0),
        result("one", "dead_band").model_copy(update={"verdict": None, "failure": "ValueError: no", "gained": None}),
        result("clean", "", ["dead_band"]),
    ]
    lost = formulas(results)["not_told"]
    assert lost.pop("causes_left_out") == {"marker_yaw": 2, "dead_band": 1}
    assert {name: (share.count, share.total) for name, share in lost.items()} == {
        "not_exact": (7, 8),
        "of_other_vehicle": (2, 2),
        "falsely_named": (1, 7),
        "left_out": (3, 7),
        "nameless": (1, 7),
        "silent": (2, 7),
        "silent_below": (1, 2),
    }
    shown = next(table for table in study_tables(summarise(results)) if "not told" in table.title)
    told = ["7 of 8", "2 of 2", "1 of 7", "3 of 7", "1 of 7", "2 of 7", "1 of 2", "2 marker_yaw, 1 dead_band"]
    assert [row[1] for row in shown.rows] == told


def test_who_would_be_named_if_causes_had_to_explain_more_is_counted():
    def explaining(share, *about, **changes):
        given = result(*about, **changes)
        causes = [one.model_copy(update={"share_of_gap": share / len(given.causes)}) for one in given.causes]
        return given.model_copy(update={"causes": tuple(causes)})

    results = [
        explaining(0.997, "one", "dead_band", ["dead_band"]),
        explaining(0.96, "one", "dead_band", ["dead_band"], rise=5.0),
        explaining(0.97, "one", "dead_band", ["saturation"]),
        explaining(0.0, "one", "noise_change", ["noise_change"]),  # which moves no mean
        result("one", "dead_band", verdict="no_gap"),
        explaining(0.985, "two", "dead_band+marker_yaw", ["marker_yaw", "dead_band"]),
        explaining(0.992, "outside", "bowl", ["dead_band"]),
        result("outside", "bowl", verdict="unexplained"),
        result("clean", "", verdict="no_gap"),
    ]
    counted = {
        least: [own[name].count for name in ("one_of_clear", "one", "two", "three", "outside", "clean")]
        for least, own in summarise(results)["by_least_share"].items()
    }
    assert counted["0"] == counted["95"] == [2, 3, 1, 0, 1, 0]
    assert counted["98"] == [2, 2, 1, 0, 1, 0]
    assert counted["99"] == [2, 2, 0, 0, 1, 0]
    assert counted["99.5"] == [2, 2, 0, 0, 0, 0]
    assert counted["99.9"] == [1, 1, 0, 0, 0, 0]
    shown = next(table for table in study_tables(summarise(results)) if "explain more" in table.title)
    assert shown.rows[0] == ["as it is", "2 of 4", "3 of 5", "1 of 1", "–", "1 of 2", "0 of 1"]


def test_what_is_named_as_certain_is_counted_by_what_its_session_hides():
    results = [
        result("one", "dead_band", ["dead_band", "saturation"], posterior=0.995),
        result("one", "dead_band", ["saturation"], posterior=0.9),
        result("outside", "wobble", ["dead_band"], posterior=1.0),
        result("clean", "", ["dead_band"], posterior=1.0),
    ]
    certain = formulas(results)["certain"]
    counted = {name: (share.count, share.total) for name, share in certain.items()}
    assert counted == {"catalogue": (1, 2), "another_law": (0, 0), "nothing": (0, 2)}


def test_silence_is_right_where_nothing_is_wrong_and_where_there_is_no_name():
    harmed = HeldOutGain(before_mm=4.0, after_mm=4.04, least_mm=3.9, share=None, share_to_floor=None)
    results = [
        *[result("clean", "plain")] * 97,
        result("clean", "gentle", verdict="unexplained"),
        result("clean", "gentle", ["gain_change"], gained=harmed),
        result("clean", "held"),
        result("outside", "whirl", verdict="unexplained", rise=4.0),
        result("outside", "whirl", ["lens_distortion"], verdict="unexplained"),
        result("outside", "bowl", ["lens_distortion"]),
        result("outside", "bowl"),
    ]
    summary = formulas(results)
    assert {name: share.count for name, share in summary["clean"].items()} == {
        **{"accused": 1, "alarmed": 2, "harmed": 1},
        "accused_of_other_vehicle": 0,
    }
    assert summary["clean"]["accused"].total == 100
    assert summarise(results)["clean_by_variety"]["gentle"]["accused"].share == pytest.approx(0.5)
    outside = {name: share.count for name, share in summary["outside"].items()}
    assert outside == {**{"found": 3, "not_named": 2, "not_explained": 3}, "costly_found": 2, "not_named_of_alarmed": 1}
    assert summary["outside"]["costly_found"].total == 3


def test_what_acts_by_another_law_is_to_be_named_all_the_same():
    results = [
        result("misspecified", "worn_rim", ["wall_effect"], likeliest=("wall_effect",)),
        result("misspecified", "worn_rim", ["surface_patch", "wall_effect"]),
        result("misspecified", "worn_rim", verdict="unexplained", rise=5.0, likeliest=("wall_effect",)),
        result("misspecified", "soft_patch", ["surface_patch"], likeliest=("surface_patch",)),
    ]
    summary = summarise(results)
    own = summary["families"]["formulas"]["misspecified"]
    counts = {name: share.count for name, share in own.items() if name != "gain"}
    likely = {"likeliest_true": 3, "falsely_named": 1, "not_explained": 1}
    assert counts == {"found": 4, "exact": 2, "exact_of_clear": 2, **likely}
    assert (own["exact_of_clear"].total, own["gain"]["count"]) == (3, 3)
    assert [share.count for share in summary["misspecified_by_effect"]["worn_rim"].values()] == [3, 1, 2, 1, 1]
    assert summary["families"]["formulas"]["gain"]["count"] == 0
    table = next(table for table in study_tables(summary) if table.title.startswith("Causes that act by another law"))
    assert table.rows[0] == ["worn_rim", "wall_effect", "3 of 3", "1 of 3", "2 of 3", "1 of 3", "1 of 3"]


def test_a_failed_diagnosis_is_no_success_of_any_kind():
    failed = {"verdict": None, "failure": "ValueError: no", "gained": None}
    results = [
        result("one", "gain_change", rise=100.0).model_copy(update=failed),
        result("outside", "whirl").model_copy(update=failed),
        result("two", "dead_band+marker_yaw").model_copy(update=failed),
    ]
    summary = formulas(results)
    assert summary["failed"].count == 3
    assert not summary["one"][CLEAR]["found"].count
    assert not summary["one"][CLEAR]["exact"].count
    assert not summary["outside"]["not_named"].count
    assert not summary["outside"]["not_explained"].count
    assert not summary["two"]["exact"].count


def measured_parameter(name, true, value, half):
    """A result in which a parameter of a gain change is true, and said to be a value, give or take half an interval."""
    planted = result("one", "gain_change", ["gain_change"])
    estimate = Estimate(value=value, low=value - half, high=value + half, unit="")
    (cause,) = planted.causes
    causes = (cause.model_copy(update={"parameters": {name: estimate}}),)
    return planted.model_copy(update={"true_causes": {"gain_change": {name: true}}, "causes": causes})


def test_parameter_errors_and_coverage():
    summary = formulas(
        [
            measured_parameter("gain", 0.8, 0.82, 0.03),
            measured_parameter("gain", 1.2, 1.26, 0.03),
            measured_parameter("gain", 0.5, 0.5, 0.01),
            measured_parameter("direction_rad", 2 * math.pi, 0.2, 0.3),
        ]
    )
    gain = summary["parameters"]["gain_change.gain"]
    assert gain["count"] == 3
    assert gain["median_error"] == pytest.approx(0.02)
    assert gain["median_error_percent"] == pytest.approx(10.0)  # of how far a gain is from 1
    assert (gain["covered"].count, gain["covered"].total) == (2, 3)
    assert summary["parameters"]["gain_change.direction_rad"]["median_error"] == pytest.approx(0.2)
    assert summary["parameters"]["gain_change.direction_rad"]["median_error_percent"] is None
    assert summary["median_parameter_error_percent"] == pytest.approx(10.0)
    assert (summary["covered"].count, summary["covered"].total) == (3, 4)
    assert summary["mechanisms"]["gain_change"]["covered"].count == 3
    assert summary["mechanisms"]["gain_change"]["median_error_percent"] == pytest.approx(10.0)


def test_other_methods_are_counted_on_the_same_cases():
    black_box = HeldOutGain(before_mm=4.0, after_mm=3.5, least_mm=2.5, share=0.4, share_to_floor=0.3)
    right = Baselines(fitted=("gain_change", "saturation"), rule="gain_change", black_box=black_box)
    wrong = Baselines(fitted=("saturation",), rule=None, black_box=black_box)
    both = Baselines(fitted=("saturation", "gain_change"), rule="saturation", black_box=black_box)
    results = [
        result("one", "gain_change", ["gain_change"], baselines=right),
        result("one", "gain_change", ["gain_change"], baselines=wrong),
        result("one", "gain_change", ["gain_change"]),  # not asked of the others
        result("two", "gain_change+saturation", ["gain_change"], baselines=both),
        result("outside", "whirl", baselines=wrong),
        result("clean", "plain", baselines=wrong),
    ]
    summary = summarise(results)
    methods = summary["methods"]["formulas"]
    fitting, rules, diagnosis = (methods[name] for name in ("parameter fitting", "rules on correlations", "diagnosis"))
    assert (fitting["first"].count, fitting["one"][CLEAR].count, fitting["accused"].count) == (1, 0, 1)
    assert (rules["first"].count, rules["one"][CLEAR].count, rules["accused"].count) == (1, 1, 0)
    assert (fitting["two"].count, rules["two"].count, diagnosis["two"].count) == (1, 0, 0)
    assert (fitting["outside"].count, rules["outside"].count, diagnosis["outside"].count) == (0, 1, 1)
    assert (diagnosis["one"][CLEAR].count, diagnosis["one"][CLEAR].total, diagnosis["cases"]) == (2, 2, 5)
    assert (diagnosis["error_cut"], methods["black-box residual"]["error_cut"]) == pytest.approx((0.25, 0.125))
    assert fitting["error_cut"] is None
    assert formulas(results)["gain"]["diagnosis"] == pytest.approx(0.9)
    shown = column_of("parameter fitting", summary)
    told = ("0 of 2", "1 of 2", "1 of 1", "0 of 1", "1 of 1", "–", "–, –")
    assert tuple(list(shown.values())[1:-1]) == told
    black_box = column_of("black-box residual", summary)
    assert (black_box["two: exact"], black_box["error cut, 10 % or more: median"]) == ("–", "12.5 %")


def test_what_the_true_model_says_is_counted_beside_the_diagnosis_on_the_same_cases_alone():
    planted = {"true_causes": {"gain_change": {"gain": 0.8}}}

    def told(gain, **causes):
        return TrueModelAnswer(method="oracle", causes={"gain_change": {"gain": gain}, **causes}, seconds=30.0)

    silent = TrueModelAnswer(method="oracle", seconds=10.0)
    failed = TrueModelAnswer(method="mujoco.sysid", seconds=1.0, failure="ArithmeticError: lost")
    results = [
        result("one", "gain_change", ["gain_change"], true_model=told(0.808), **planted),
        result("one", "gain_change", true_model=told(0.816, saturation={"limit": 90.0}), **planted),
        result("one", "gain_change", ["gain_change"], **planted),  # not asked of the true model
        result("outside", "whirl", ["gain_change"], true_model=silent),
        result("clean", "plain", true_model=told(0.99)),
        result("one", "gain_change", family="rigid_body", true_model=failed),
        result("outside", "bowl", family="rigid_body", true_model=failed),
    ]
    compared = summarise(results)["true_model"]
    oracle, diagnosis = compared["formulas"]["oracle"], compared["formulas"]["diagnosis"]
    assert (oracle["cases"], diagnosis["cases"]) == (4, 4)
    assert (oracle["one"][CLEAR].count, oracle["one"][CLEAR].total) == (1, 2)
    assert (diagnosis["one"][CLEAR].count, diagnosis["one"][CLEAR].total) == (1, 2)
    assert (oracle["outside"].count, diagnosis["outside"].count) == (1, 0)
    assert (oracle["accused"].count, diagnosis["accused"].count) == (1, 0)
    assert oracle["median_parameter_error_percent"] == pytest.approx(6.0)  # 1 and 2 % of 0.8, which is 0.2 from 1
    assert oracle["seconds"] == {"median": 30.0, "most": 30.0}
    sysid = compared["rigid_body"]["mujoco.sysid"]
    assert (sysid["failed"].count, sysid["one"][CLEAR].count, sysid["outside"].count) == (2, 0, 0)
    shown = column_of("oracle", summarise(results))
    told = ("1 of 2", "2 of 2", "1 of 1", "1 of 1", "6.0 %", "–", "30.0, 30.0")
    assert tuple(list(shown.values())[1:-1]) == told
    assert (shown["sessions"], shown["failed"]) == ("4", "0 of 4")
    assert summarise(results[2:3])["true_model"] == {}


def test_a_result_without_what_is_now_asked_for_is_not_taken_again():
    without = result("one", "gain_change")
    answer = TrueModelAnswer(method="oracle", seconds=1.0)
    job = ScoringJob(without.case, with_baselines=False, with_true_model=True)
    assert not job.is_answered_by(without)
    assert job.is_answered_by(without.model_copy(update={"true_model": answer}))
    assert ScoringJob(without.case, with_baselines=False, with_true_model=False).is_answered_by(without)
    assert not ScoringJob(without.case, with_baselines=True, with_true_model=False).is_answered_by(without)


def test_what_a_result_lacks_is_added_and_its_diagnosis_stays(monkeypatch):
    scoring = "swarmtwin.studies.hidden_effects.scoring"
    answer = TrueModelAnswer(method="oracle", seconds=1.0)
    learned = []

    def diagnosis_of(*_):
        learned.append("anew")
        raise MemoryError("too much")

    monkeypatch.setattr(f"{scoring}.record_session", lambda case: (None, None, None))
    monkeypatch.setattr(f"{scoring}.true_model_answer", lambda truth: answer)
    monkeypatch.setattr(f"{scoring}.diagnosis_of", diagnosis_of)
    before = result("one", "gain_change", ["gain_change"])
    with_answer = before.model_copy(update={"true_model": answer})
    assert score_case(before.case, with_baselines=False, with_true_model=True, judged=before) == with_answer
    assert not learned
    assert score_case(before.case, with_baselines=True, with_true_model=True, judged=before) == with_answer
    assert learned  # for the other methods, in vain
    failed = before.model_copy(update={"verdict": None, "failure": "ArithmeticError: lost", "causes": ()})
    assert score_case(before.case, with_baselines=True, with_true_model=False, judged=failed) == failed
    assert len(learned) == 1


def test_what_two_calls_made_of_a_case_is_put_together():
    black_box = HeldOutGain(before_mm=4.0, after_mm=3.5, least_mm=2.5, share=0.4, share_to_floor=0.3)
    others = Baselines(fitted=(), rule=None, black_box=black_box)
    answer = TrueModelAnswer(method="oracle", seconds=1.0)
    first = result("one", "gain_change", ["gain_change"], baselines=others)
    second = result("one", "gain_change", true_model=answer)
    failed = second.model_copy(update={"verdict": None, "failure": "ArithmeticError: lost"})
    whole = first.model_copy(update={"true_model": answer})
    assert filled(first, second) == whole
    assert filled(None, second) == second
    assert filled(first, failed) == filled(failed, first) == whole


def test_the_first_cause_that_a_method_names_is_true_if_it_is_any_of_the_true_ones():
    black_box = HeldOutGain(before_mm=4.0, after_mm=3.5, least_mm=2.5, share=0.4, share_to_floor=0.3)
    both = Baselines(fitted=("saturation", "gain_change"), rule="saturation", black_box=black_box)
    (row,) = results_table([result("two", "gain_change+saturation", baselines=both)]).to_dict("records")
    told = [row[name] for name in ("fitting_first", "fitting_exact", "rule_first", "rule_exact")]
    assert told == [True, True, True, False]


def test_bounds_are_those_of_the_books():
    share = Proportion.of([True] * 8 + [False] * 2)
    interval = stats.binomtest(8, 10).proportion_ci(method="wilson")
    assert (share.low, share.high) == pytest.approx((interval.low, interval.high))
    assert share.low == pytest.approx(0.4901625, abs=1e-6)  # Wilson's interval of 8 in 10, as printed in textbooks
    none = Proportion.of([False] * 300)
    assert none.at_most == pytest.approx(1 - 0.05 ** (1 / 300))  # "rule of three"
    assert none.at_most == pytest.approx(0.01, rel=0.01)
    assert Proportion.of([]).share is None


def test_an_interrupted_study_goes_on_with_whole_lines(tmp_path):
    path = tmp_path / "results.jsonl"
    first, second = result("one", "gain_change", ["gain_change"]), result("clean", "plain", seed=2)
    append_result(path, first)
    with path.open("a") as file:
        file.write(second.model_dump_json()[:40])
    assert list(read_results(path, [first.case, second.case]).values()) == [first]
    append_result(path, second)
    assert list(read_results(path, [first.case, second.case]).values()) == [first, second]
    assert not read_results(path, [second.case.model_copy(update={"seed": 3})])


def test_the_confusion_counts_who_is_taken_for_whom():
    results = [
        result("one", "gain_change", ["gain_change"]),
        result("one", "gain_change", ["battery_sag"]),
        result("one", "gain_change", verdict="unexplained"),
        result("misspecified", "worn_rim", ["wall_effect"]),
        result("outside", "whirl"),
        result("clean", "plain", ["noise_change"]),
    ]
    counts = confusion(results_table(results)).stack()
    assert counts.sum() == len(results)
    assert counts[counts > 0].to_dict() == {
        ("gain_change", "gain_change"): 1,
        ("gain_change", "battery_sag"): 1,
        ("gain_change", "no name"): 1,
        ("worn_rim", "wall_effect"): 1,
        ("whirl", "nothing wrong"): 1,
        ("nothing wrong", "noise_change"): 1,
    }


def test_a_cause_from_outside_the_package_and_a_failed_diagnosis_have_columns_of_their_own():
    results = [
        result("one", "gain_change", ["my_own_cause"]),
        result("one", "gain_change", verdict="no_gap"),
        result("one", "gain_change").model_copy(update={"verdict": None, "failure": "ValueError: no"}),
    ]
    counts = confusion(results_table(results))
    assert list(counts.index) == ["gain_change"]
    assert counts.loc["gain_change"][lambda count: count > 0].to_dict() == {
        "my_own_cause": 1,
        "nothing wrong": 1,
        "failed": 1,
    }


def test_effects_are_counted_by_their_size_beside_the_limit_that_the_diagnosis_states():
    results = [
        *[result("one", "gain_change", ["gain_change"], times_limit=1.4)] * 9,
        result("one", "gain_change", times_limit=1.0),
        result("one", "gain_change", times_limit=0.9),
        result("one", "gain_change", times_limit=0.0),
        result("one", "wall_effect", ["wall_effect"], times_limit=None),
        result("two", "gain_change+wall_effect", times_limit=None),
        result("two", "gain_change+wall_effect", ["gain_change", "wall_effect"], times_limit=1.0),
        result("two", "gain_change+wall_effect", ["gain_change"], times_limit=7.0),
        result("two", "gain_change+wall_effect", ["gain_change"], times_limit=0.9),
    ]
    both = formulas(results)["two"]["exact_above_limits"]
    assert (both.count, both.total) == (1, 2)
    limits = formulas(results)["limits"]
    assert {name: (share.count, share.total) for name, share in limits.items()} == {
        "below half": (0, 1),
        "half to once": (0, 1),
        "once to twice": (9, 10),
        "twice or more": (0, 0),
    }


def displaced(ahead_mm, exact_mean_mm=None):
    """Displacements straight ahead, measured with an alternating error of 1 mm and 0.01 rad, simulated as 10 mm."""
    count = 40
    error = np.where(np.arange(count) % 2, 1.0, -1.0)
    measured = np.stack([ahead_mm + error, np.zeros(count), 0.01 * error], axis=1)
    simulated = np.tile([10.0, 0.0, 0.0], (count, 1))
    exact = None if exact_mean_mm is None else np.tile([exact_mean_mm, 0.0, 0.0], (count, 1))
    return Displacements(measured, simulated, exact)


@pytest.mark.parametrize("is_known", [True, False])
def test_the_share_of_a_gain_is_of_what_the_effect_brought_whether_or_not_exact_means_are_known(is_known):
    """The effect takes 3 of 10 mm; an extension that knows 2 of them takes 1 − 1/9 of the squared error back."""
    known = displaced(7.0, 7.0 if is_known else None)
    twin = displaced(10.0, 10.0 if is_known else None)
    held_out = np.arange(40) < 20
    extended = np.tile([8.0, 0.0, 0.0], (40, 1))
    gain = held_out_gain(known, twin, extended, held_out)
    assert gain.share == pytest.approx(8 / 9)
    assert gain.before_mm == pytest.approx(3.0)
    assert gain.after_mm == pytest.approx(1.0)
    assert (gain.least_mm, gain.share_to_floor) == ((1.0, pytest.approx(8 / 9)) if is_known else (None, None))
    nothing = held_out_gain(twin, twin, twin.simulated, held_out)
    assert nothing.share is None


@pytest.mark.parametrize(
    ("robot", "causes", "parameter", "limit", "times"),
    [
        ("mgr", {"actuator_asymmetry": {"ratio": 0.8}}, "ratio", 0.9, 2.0),
        ("mgr", {"gain_change": {"gain": 0.8}}, "gain", 1.1, 2.0),  # to either side of 1
        ("mgr", {"marker_offset": {"forward_mm": 3.0, "left_mm": -4.0}}, "left_mm", 2.0, 2.5),
        ("mgr", {"command_delay": {"delay_s": 0.01}}, "delay_s", None, 0.0),  # none that could be would be named
        ("mgr", {"steady_drift": {"speed_mm_s": 2.0, "direction_rad": 1.0}}, "x_mm_s", 1.0, 2.0),
        ("mur", {"gain_change": {"gain": 0.8}}, "gain", 1.1, None),  # of thrust, told of speed
        ("mgr", {"gain_change": {"gain": 0.8}, "command_delay": {"delay_s": 0.01}}, "gain", 1.1, None),
    ],
)
def test_an_effect_is_so_many_times_as_large_as_its_limit(robots, robot, causes, parameter, limit, times):
    stated = DetectionLimit(
        cause=next(iter(causes)), parameter=parameter, value=limit, unit="", share_of_range=0.1, rival=None
    )
    found = times_limit(causes, [stated], robots[robot], conditions_of(robots[robot]), "formulas")
    assert found == (None if times is None else pytest.approx(times))


def test_several_effects_are_as_large_as_the_smallest_of_them_beside_its_limit(robots):
    causes = {"gain_change": {"gain": 0.8}, "command_delay": {"delay_s": 0.01}}
    stated = [
        DetectionLimit(cause=cause, parameter=parameter, value=value, unit="", share_of_range=0.1, rival=None)
        for cause, parameter, value in (("gain_change", "gain", 1.1), ("command_delay", "delay_s", 0.008))
    ]
    assert times_limit(causes, stated, robots["mgr"], conditions_of(robots["mgr"]), "formulas") == pytest.approx(1.25)


@pytest.mark.parametrize(
    ("family", "robot", "cause", "form", "said", "is_same"),
    [
        ("formulas", "mgr", "actuator_asymmetry", {}, {"ratio": 0.8}, True),
        ("rigid_body", "mgr", "actuator_asymmetry", {}, {"ratio": 0.8}, False),  # of voltage, told of speed
        ("rigid_body", "mgr", "gain_change", {"acts_on": "speed"}, {"gain": 0.8}, True),
        ("rigid_body", "mgr", "battery_sag", {"acts_on": "speed"}, {"loss": 0.2}, False),
        ("rigid_body", "mgr", "battery_sag", {"acts_on": "effort"}, {"loss": 0.2}, True),
        ("rigid_body", "mur", "battery_sag", {"acts_on": "effort"}, {"shape": 2.0}, True),
        ("formulas", "mur", "gain_change", {"acts_on": "effort"}, {"gain": 0.8}, False),  # of thrust
        ("formulas", "mur", "gain_change", {}, {"gain": 0.8}, False),
        ("formulas", "mur", "noise_change", {}, {"factor": 2.0}, False),  # of eddies, told of all
        ("formulas", "mgr", "noise_change", {}, {"factor": 2.0}, True),
    ],
)
def test_what_is_told_in_another_unit_than_it_is_hidden_in_is_not_compared(family, robot, cause, form, said, is_same):
    planted = result("one", cause, [cause], family=family, robot=robot)
    estimates = {name: Estimate(value=value, low=value, high=value, unit="") for name, value in said.items()}
    causes = (planted.causes[0].model_copy(update={"parameters": estimates, "form": form}),)
    planted = planted.model_copy(update={"true_causes": {cause: said}, "causes": causes})
    assert parameters_table([planted]).same_unit.tolist() == [is_same]


def test_what_another_unit_has_of_itself_counts_neither_for_nor_against_who_names_it():
    about = {"family": "unruly", "same_vehicle": False}
    results = [
        result("clean", "plain", ["marker_offset"], **about),
        result("clean", "plain", ["marker_offset", "dead_band"], **about),
        result("clean", "plain", ["marker_offset"], family="unruly"),
        result("one", "dead_band", ["dead_band", "marker_offset"], **about),
        result("one", "marker_offset", ["marker_offset"], **about),
        result("one", "marker_offset", ["dead_band"], **about),
        result("outside", "whirl", ["marker_offset"], **about),
    ]
    table = results_table(results)
    assert table.named.tolist() == ["", "dead_band", "marker_offset", "dead_band", "marker_offset", "dead_band", ""]
    assert table.found.tolist() == [False, True, True, True, True, True, True]
    assert table.exact.tolist()[3:6] == [True, True, False]
    assert table.falsely_named.tolist()[3:6] == [False, False, True]
    assert confidences_table(results).true.tolist() == [True, True, False, False, True, True, True, False, True]
