"""The study of hidden effects: planted results give planted figures, and wrong names count as wrong."""

import math

import numpy as np
import pytest
from scipy import stats

from case_results import result
from swarmtwin.diagnosis.result import Estimate
from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.errors import UserError
from swarmtwin.standin.effect import Placement
from swarmtwin.standin.effects import catalogue
from swarmtwin.studies.hidden_effects.cases import (
    KINDS,
    VARIETIES,
    CaseCounts,
    Plan,
    clean,
    draw_cases,
    one_effect,
    several_effects,
)
from swarmtwin.studies.hidden_effects.detection_plots import confusion
from swarmtwin.studies.hidden_effects.effect_sizes import CATALOGUE, OUTSIDE, PARAMETERS
from swarmtwin.studies.hidden_effects.metrics import CLEAR, Proportion, summarise
from swarmtwin.studies.hidden_effects.outside_effects import EFFECTS, SwappedWheels, WarmUp
from swarmtwin.studies.hidden_effects.results import (
    Baselines,
    HeldOutGain,
    append_result,
    read_results,
    results_table,
)
from swarmtwin.studies.hidden_effects.scoring import rise_percent
from swarmtwin.studies.hidden_effects.sessions import clean_twin, effects_of, measure
from swarmtwin.studies.hidden_effects.tables import study_tables

PLAN = Plan(seed=5, runs=12, steps=20, references=2)
COUNTS = CaseCounts(single=2, pair=3, triple=2, outside=1, clean=1)


@pytest.fixture
def two(robots):
    return [robots["mgr"], robots["mur"]]


def test_planted_names_give_planted_rates():
    results = [
        *[result("single", "gain_change", ["gain_change"])] * 7,
        *[result("single", "gain_change", ["battery_sag"])] * 2,
        result("single", "gain_change", ["battery_sag"], rivals=("gain_change",)),
        result("single", "command_delay", ["command_delay", "noise_change"], rise=5.0),
        result("single", "command_delay", verdict="unexplained", rise=1.0),
    ]
    summary = summarise(results)
    clear = summary["single"][CLEAR]
    assert (clear["found"].count, clear["named_first"].count, clear["listed"].count, clear["exact"].count) == (
        10,
        7,
        8,
        7,
    )
    assert clear["found"].total == 10
    middle = summary["single"]["3 to 10 %"]
    assert (middle["named_first"].count, middle["exact"].count, middle["found"].total) == (1, 0, 1)
    faint = summary["single"]["below 3 %"]
    assert (faint["found"].count, faint["named_first"].count, faint["listed"].count) == (1, 0, 0)
    assert summary["single_by_cause"]["gain_change"][CLEAR]["named_first"].share == pytest.approx(0.7)
    assert (summary["first_right"].count, summary["first_right"].total) == (8, 11)
    assert summary["rivals_a_cause"] == pytest.approx(1 / 12)


def test_two_at_once_must_be_exactly_these():
    pair = "dead_band+marker_yaw"
    results = [
        result("pair", pair, ["marker_yaw", "dead_band"]),
        result("pair", pair, ["dead_band"]),
        result("pair", pair, ["dead_band", "marker_yaw", "noise_change"]),
        result("pair", pair, ["saturation", "marker_yaw"], rivals=("dead_band",)),
    ]
    summary = summarise(results)
    assert summary["pair"]["exact"].count == 1
    assert summary["pair"]["listed"].count == 3
    assert summary["pair"]["named_first"].count == 3
    assert summary["triple"]["exact"].share is None


def test_silence_is_right_where_nothing_is_wrong_and_where_there_is_no_name():
    harmed = HeldOutGain(before_mm=4.0, after_mm=4.04, least_mm=3.9, share=None, share_to_floor=None)
    results = [
        *[result("clean", "plain")] * 97,
        result("clean", "gentle", verdict="unexplained"),
        result("clean", "gentle", ["gain_change"], gained=harmed),
        result("clean", "held"),
        result("outside", "whirl", verdict="unexplained"),
        result("outside", "whirl", ["lens_distortion"], verdict="unexplained"),
        result("outside", "bowl", ["lens_distortion"]),
        result("outside", "bowl"),
    ]
    summary = summarise(results)
    assert (summary["clean"]["accused"].count, summary["clean"]["alarmed"].count, summary["clean"]["harmed"].count) == (
        1,
        2,
        1,
    )
    assert summary["clean"]["accused"].total == 100
    assert summary["clean_by_variety"]["gentle"]["accused"].share == pytest.approx(0.5)
    assert summary["worst_harm_percent"] == pytest.approx(1.0)
    assert summary["outside"]["not_named"].count == 2
    assert summary["outside"]["not_explained"].count == 3
    assert summary["outside"]["found"].count == 3


def test_a_failed_diagnosis_is_no_success_of_any_kind():
    failed = {"verdict": None, "failure": "ValueError: no", "gained": None}
    results = [
        result("single", "gain_change", rise=100.0).model_copy(update=failed),
        result("outside", "whirl").model_copy(update=failed),
        result("pair", "dead_band+marker_yaw").model_copy(update=failed),
    ]
    summary = summarise(results)
    assert summary["failed"].count == 3
    assert not summary["single"][CLEAR]["found"].count
    assert not summary["single"][CLEAR]["exact"].count
    assert not summary["outside"]["not_named"].count
    assert not summary["outside"]["not_explained"].count
    assert not summary["pair"]["exact"].count


def measured_parameter(name, true, value, half):
    """A result in which a parameter of a gain change is true, and said to be a value, give or take half an interval."""
    planted = result("single", "gain_change", ["gain_change"])
    estimate = Estimate(value=value, low=value - half, high=value + half, unit="")
    (cause,) = planted.causes
    causes = (cause.model_copy(update={"parameters": {name: estimate}}),)
    case = planted.case.model_copy(update={"effects": ({"name": "gain_change", name: true},)})
    return planted.model_copy(update={"case": case, "causes": causes})


def test_parameter_errors_and_coverage():
    summary = summarise(
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
    assert gain["median_error_percent"] == pytest.approx(2.5)
    assert gain["median_error_of_change_percent"] == pytest.approx(10.0)
    assert (gain["covered"].count, gain["covered"].total) == (2, 3)
    assert summary["parameters"]["gain_change.direction_rad"]["median_error"] == pytest.approx(0.2)
    assert summary["parameters"]["gain_change.direction_rad"]["median_error_percent"] is None
    assert summary["median_parameter_error_percent"] == pytest.approx(2.5)
    assert (summary["covered"].count, summary["covered"].total) == (3, 4)


def test_other_methods_are_counted_on_the_same_cases():
    black_box = HeldOutGain(before_mm=4.0, after_mm=3.5, least_mm=2.5, share=0.4, share_to_floor=0.3)
    right = Baselines(fitted=("gain_change", "saturation"), rule="gain_change", black_box=black_box)
    wrong = Baselines(fitted=("saturation",), rule=None, black_box=black_box)
    results = [
        result("single", "gain_change", ["gain_change"], baselines=right),
        result("single", "gain_change", ["gain_change"], baselines=wrong),
        result("clean", "plain", baselines=wrong),
    ]
    summary = summarise(results)
    fitting, rules = summary["methods"]["parameter fitting"], summary["methods"]["correlation rules"]
    assert (fitting["named_first"].count, fitting["exact"].count, fitting["accused"].count) == (1, 0, 1)
    assert (rules["named_first"].count, rules["exact"].count, rules["accused"].count) == (1, 1, 0)
    assert summary["methods"]["diagnosis"]["exact"].count == 2
    assert summary["gain"]["black_box"] == pytest.approx(0.4)
    assert summary["gain"]["diagnosis"] == pytest.approx(0.9)
    text = "\n".join(table.markdown() for table in study_tables(summary))
    assert "| parameter fitting | 50.0% (1/2) | 0.0% (0/2) | 100.0% (1/1) | – |" in text


def test_bounds_are_those_of_the_books():
    share = Proportion.of([True] * 8 + [False] * 2)
    interval = stats.binomtest(8, 10).proportion_ci(method="wilson")
    assert (share.low, share.high) == pytest.approx((interval.low, interval.high))
    assert share.low == pytest.approx(0.4901625, abs=1e-6)  # Wilson's interval of 8 in 10, as printed in textbooks
    none = Proportion.of([False] * 300)
    assert none.at_most == pytest.approx(1 - 0.05 ** (1 / 300))  # "rule of three"
    assert none.at_most == pytest.approx(0.01, rel=0.01)
    assert Proportion.of([]).share is None


def test_every_effect_of_the_catalogue_is_drawn_and_makes_sense(two):
    assert set(CATALOGUE) == set(catalogue())
    assert set(OUTSIDE) == set(EFFECTS)
    assert set(PARAMETERS) == {*CATALOGUE, *OUTSIDE}
    assert len(OUTSIDE) >= 8
    cases = draw_cases(two, PLAN, COUNTS, "all")
    robots = {robot.name: robot for robot in two}
    for case in cases:
        effects_of(case, robots[case.robot])
    single = [case for case in cases if case.kind == "single"]
    assert {(case.variety, case.robot) for case in single} == {(name, robot) for name in CATALOGUE for robot in robots}
    assert {case.variety for case in cases if case.kind == "clean"} == set(VARIETIES)
    assert len({case.key for case in cases}) == len(cases)
    assert not set(OUTSIDE) & set(catalogue())


def test_the_same_seed_draws_the_same_cases_and_more_of_them_change_none(two):
    pairs = [case for case in draw_cases(two, PLAN, COUNTS, ["pair"]) if case.robot == "mgr"]
    more = draw_cases(two, PLAN, COUNTS.model_copy(update={"pair": 5}), "all")
    assert [case for case in more if case.kind == "pair" and case.robot == "mgr"][:3] == pairs
    other = Plan(**(PLAN.model_dump() | {"seed": 6}))
    assert draw_cases(two, other, COUNTS, ["pair"])[:3] != pairs
    assert {case.kind for case in draw_cases(two, PLAN, COUNTS, "quick")} == set(KINDS)


def test_an_unknown_kind_of_case_names_the_near_miss(two):
    with pytest.raises(UserError, match=r"^cases: no such kind: 'pairs': did you mean 'pair'\?"):
        draw_cases(two, PLAN, COUNTS, ["pairs"])


def test_effects_that_hide_together_differ(two):
    for index in range(40):
        names = several_effects(two[0], PLAN, "triple", index).true_names
        assert len(set(names)) == 3
        assert not {"command_delay", "actuator_lag"} <= set(names)


def test_a_clear_effect_raises_the_error_and_its_twin_has_none(two):
    robot = two[0]
    case = one_effect(robot, PLAN, "gain_change", 1.0, 0)
    hidden, twin = measure(case, robot), clean_twin(case, robot)
    assert np.array_equal(hidden.footage.time_s, twin.footage.time_s)
    least = [session.least_displacement(session.transitions) for session in (hidden, twin)]
    now, usual = (
        ErrorFigure.between(own, session.transitions.displacement)
        for own, session in zip(least, (hidden, twin), strict=True)
    )
    assert now.position_mm == pytest.approx(usual.position_mm, rel=0.25)
    wrong = least[0] / case.effects[0]["gain"]
    assert rise_percent(ErrorFigure.between(wrong, hidden.transitions.displacement), usual) > 20


def test_more_pose_noise_is_as_much_as_asked(two):
    robot = two[0]
    case = clean(robot, Plan(seed=3, runs=40, steps=20, references=1), "pose_noise", 0)
    session = measure(case, robot)
    true = np.moveaxis(session.footage.state[:3], 0, -1)
    seen = np.stack([track.pose for track in session.recording.tracks])
    away = (seen - true[:, :, 0])[..., :2]
    assert np.nanstd(away) == pytest.approx(case.pose_noise * 1.0, rel=0.05)


def test_some_effects_outside_the_catalogue_do_what_they_say(robots):
    now = np.zeros((2, 1))
    start = Placement(now, now, now, now, now[None], now[None])
    warm = WarmUp(loss=0.4, warm_after_s=5.0, run_s=25.0, session_s=250.0)
    at_start = warm.strength(start)
    later = warm.strength(Placement(now + 0.099, now, now, now, now[None], now[None]))  # 24.75 s into the first run
    next_run = warm.strength(Placement(now + 0.1, now, now, now, now[None], now[None]))
    assert at_start == pytest.approx(0.6, abs=1e-3)
    assert later == pytest.approx(1.0, abs=5e-3)
    assert next_run == pytest.approx(0.6, abs=1e-3)
    command = np.random.default_rng(1).uniform(-120, 120, (2, 20_000)).round(1)
    swapped = SwappedWheels(probability=0.05).transform_command(command, robots["mgr"])
    changed = (swapped != command).any(axis=0)
    assert changed.mean() == pytest.approx(0.05, abs=0.01)
    assert np.array_equal(swapped[:, changed], command[::-1, changed])


def test_an_interrupted_study_goes_on_with_whole_lines(tmp_path):
    path = tmp_path / "results.jsonl"
    first, second = result("single", "gain_change", ["gain_change"]), result("clean", "plain", seed=2)
    append_result(path, first)
    with path.open("a") as file:
        file.write(second.model_dump_json()[:40])
    assert list(read_results(path, [first.case, second.case]).values()) == [first]
    append_result(path, second)
    assert list(read_results(path, [first.case, second.case]).values()) == [first, second]
    assert not read_results(path, [second.case.model_copy(update={"seed": 3})])


def test_the_confusion_counts_who_is_taken_for_whom():
    results = [
        result("single", "gain_change", ["gain_change"]),
        result("single", "gain_change", ["battery_sag"]),
        result("single", "gain_change", verdict="unexplained"),
        result("outside", "whirl"),
        result("clean", "plain", ["noise_change"]),
    ]
    counts = confusion(results_table(results)).stack()
    assert counts.sum() == len(results)
    assert counts[counts > 0].to_dict() == {
        ("gain_change", "gain_change"): 1,
        ("gain_change", "battery_sag"): 1,
        ("gain_change", "no name"): 1,
        ("whirl", "nothing wrong"): 1,
        ("nothing wrong", "noise_change"): 1,
    }


def test_a_cause_from_outside_the_package_and_a_failed_diagnosis_have_columns_of_their_own():
    results = [
        result("single", "gain_change", ["my_own_cause"]),
        result("single", "gain_change", verdict="no_gap"),
        result("single", "gain_change").model_copy(update={"verdict": None, "failure": "ValueError: no"}),
    ]
    counts = confusion(results_table(results))
    assert list(counts.index) == ["gain_change"]
    assert counts.loc["gain_change"][lambda count: count > 0].to_dict() == {
        "my_own_cause": 1,
        "nothing wrong": 1,
        "failed": 1,
    }
