"""The report: its numbers are those of the diagnosis, and every verdict has its page."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from diagnosis_factories import (
    DELAY,
    NAMES,
    NEXT,
    YAW,
    made_result,
    made_robot,
    made_session,
    moved_as_simulated,
    moved_late,
    parts_of,
)

from swarmtwin.diagnosis.report.page import draw_diagnosis, gain_bars, leading_pictures
from swarmtwin.diagnosis.report.posterior_plot import posterior_figure, shown_sets
from swarmtwin.diagnosis.report.residual_fields import field_choices
from swarmtwin.diagnosis.report.residual_plots import runs_figure
from swarmtwin.diagnosis.report.sentences import (
    SPACE,
    cause_summary,
    cause_words,
    dependence_words,
    estimate_words,
    gain_words,
    next_recording_words,
    odds_words,
    usual_words,
    verdict_words,
)
from swarmtwin.diagnosis.result import (
    CauseSet,
    Dependence,
    DetectionLimit,
    Estimate,
    EstimatedCause,
    Gain,
    UnitDifference,
    UnitFactor,
)
from swarmtwin.diagnosis.saved_diagnosis import SavedDiagnosis, read_result, save_findings
from swarmtwin.errors import UserError
from swarmtwin.kinematics import differential_drive
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import mechanism_class, mechanism_names

POSTERIOR = (
    CauseSet(causes=("command_delay",), probability=0.97, log_evidence=312.0),
    CauseSet(causes=("actuator_lag", "backlash", "steady_drift", "marker_yaw"), probability=0.029, log_evidence=310.0),
    CauseSet(causes=(), probability=1e-13, log_evidence=0.0),
)
LIMITS = (
    DetectionLimit(
        cause="command_delay", parameter="delay_s", value=0.0226, unit="s", share_of_range=0.05, rival="actuator_lag"
    ),
    DetectionLimit(cause="gain_change", parameter="gain", value=1.0564, unit="", share_of_range=0.02),
    DetectionLimit(cause="battery_sag", parameter="loss", value=0.0631, unit="", share_of_range=0.06),
    DetectionLimit(cause="saturation", parameter="limit", value=108.0, unit="PWM", share_of_range=0.11),
    DetectionLimit(cause="lens_distortion", parameter="coefficient", value=None, unit="", share_of_range=1.0),
    DetectionLimit(cause="steady_drift", parameter="x_mm_s", value=0.52, unit="mm/s", share_of_range=0.01),
)


class Page(HTMLParser):
    """What a page loads, what it says, and what it says before anything is unfolded."""

    def __init__(self, text):
        super().__init__()
        self.loaded, self.words, self.open_words, self.depth, self.skipped = [], [], [], 0, 0
        self.feed(text)
        self.text, self.above = " ".join(self.words), " ".join(self.open_words)

    def handle_starttag(self, tag, attrs):
        self.loaded += [value for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        self.depth += tag == "details"
        self.skipped += tag == "style"

    def handle_endtag(self, tag):
        self.depth -= tag == "details"
        self.skipped -= tag == "style"

    def handle_data(self, data):
        if not self.skipped:
            self.words += data.split()
            self.open_words += data.split() if not self.depth else []


def page_of(session, folder):
    """The page of a session, made from its files alone."""
    save_findings(folder, session)
    draw_diagnosis(folder, folder)
    return Page((folder / "report.html").read_text())


def test_the_numbers_on_the_page_are_those_of_the_diagnosis(tmp_path):
    diagnosis = made_result(causes=(DELAY, YAW))
    page = page_of(made_session(diagnosis, moved_late), tmp_path)
    assert (
        "The robot departs from the simulation because the marker is turned by 5.7° to the right on the vehicle – glue "
        "the marker on straight, or enter its angle; and because commands act 0.15 s late (confidence 99 %; less "
        "likely, but not excluded: actuator lag) – check network, broker and camera for latency. Before anything is "
        "repaired, make the recording below, which tells command delay and actuator lag apart."
    ) in page.above
    for said in (
        "Command delay : commands act 0.15 s (0.13 to 0.17) late.",
        "Marker yaw : the marker is turned by 5.7° (4.6 to 6.9) to the right on the vehicle.",
        "Confidence 99 %; it explains 93 % of the squared error that can be explained",
        "Less likely, but not excluded: actuator lag. With the commands driven here, the robot would move nearly the "
        "same; the drive below tells them apart",
        "before 8.61 mm after 1.82 mm −6.8 mm (−7.1 to −6.5), −79",
        "before 12.4° after 3.0° −9.4° (−9.6 to −9.1), −75",
        "before 214 mm after 31 mm −183 mm (−205 to −160), −86",
        "2 s 31.2 ± 15.6 mm 6.0 ± 3.0 mm −25 mm (−28 to −22), −81 % 28 from 7 runs",
        "10 s 118 ± 59 mm 17 ± 8 mm −101 mm (−112 to −88), −86 % 28 from 7 runs",
        "20 runs of 40 steps with the commands in next_drive.csv",
        NEXT.command,
    ):
        assert said in page.above, said
    assert DELAY.evidence in page.text
    assert "previous command yes 0.0005 20.0 % 3.25" in page.text
    assert "17 fitted to, 7 held out" in page.text
    assert "960 used, 12 set aside" in page.text


def test_the_page_begins_with_what_to_do_and_goes_on_in_the_order_that_a_supervisor_asks(tmp_path):
    diagnosis = made_result(posterior=POSTERIOR, detection_limits=LIMITS)
    text = page_of(made_session(diagnosis, moved_late), tmp_path).above
    order = ("check network", "Where it shows", "How sure that is", "Before and after", "What this recording could not")
    places = [text.index(heading) for heading in order]
    assert places == sorted(places)
    assert (tmp_path / "figures" / "posterior.png").exists()


def test_what_is_in_doubt_of_the_recording_is_told_beside_the_verdict(tmp_path):
    doubts = ("the clock begins at 7,200 s", "poses span 1 of 2 mm: are they in metres?")
    text = page_of(made_session(made_result(doubts=doubts), moved_late), tmp_path).above
    assert "In doubt: the clock begins at 7,200 s. In doubt: poses span 1 of 2 mm: are they in metres? Where" in text


def test_limits_are_on_the_page_with_what_a_smaller_effect_is_taken_for(tmp_path):
    page = page_of(made_session(made_result("no_gap", detection_limits=LIMITS), moved_as_simulated), tmp_path)
    assert "command delay delay 0.023 s actuator lag" in page.text
    assert "gain change gain 1.056" in page.text
    assert "steady drift speed 0.52 mm/s" in page.text
    assert "battery sag loss 6.3 %" in page.text
    assert "lens distortion coefficient not at any value" in page.text
    assert "saturation limit 108 PWM or less" in page.text
    assert "it would have been named in nine of ten such recordings" in page.above


def test_the_posterior_is_drawn_with_readable_labels_and_what_it_says():
    figure = posterior_figure(POSTERIOR)
    panel = figure.axes[0]
    assert [label.get_text().replace("\n", " ") for label in panel.get_yticklabels()] == [
        "command delay",
        "actuator lag + backlash + steady drift + marker yaw",
        "nothing is wrong",
    ]
    assert max(len(line) for label in panel.get_yticklabels() for line in label.get_text().split("\n")) <= 34
    np.testing.assert_allclose([bar.get_width() for bar in panel.patches], [97.0, 2.9, 1e-11])
    assert [text.get_text().replace("\N{NO-BREAK SPACE}", " ") for text in panel.texts] == [
        "97 %",
        "2.9 %",
        "under 0.1 %",
    ]
    assert posterior_figure(()) is None


def test_what_is_likeliest_is_told_with_its_values_where_it_is_not_named(tmp_path):
    likeliest = tuple(EstimatedCause(name=one.name, parameters=one.parameters) for one in (DELAY, YAW))
    about = {"causes": (), "extension": "learned_residual", "posterior": POSTERIOR, "likeliest": likeliest}
    unnamed = page_of(made_session(made_result("unexplained", **about), moved_late), tmp_path).above
    said = "commands act 0.15 s (0.13 to 0.17) late; the marker is turned by 5.7° (4.6 to 6.9) to the right on"
    assert f"none is named. If the likeliest set were all that is wrong: {said}" in unnamed


def test_at_most_eight_sets_are_drawn_nothing_wrong_among_them():
    many = [CauseSet(causes=(f"cause_{number}",), probability=0.09, log_evidence=1.0) for number in range(11)]
    nothing = CauseSet(causes=(), probability=1e-9, log_evidence=0.0)
    assert shown_sets([*many, nothing]) == [*many[:7], nothing]
    assert shown_sets([many[0], many[1].model_copy(update={"probability": 1e-5}), nothing])[1].probability == 1e-5
    assert len(shown_sets([many[0], *(one.model_copy(update={"probability": 1e-5}) for one in many[1:]), nothing])) == 3


def test_a_result_of_before_there_was_a_posterior_is_still_read(tmp_path):
    diagnosis = made_result(posterior=POSTERIOR, detection_limits=LIMITS)
    save_findings(tmp_path, made_session(diagnosis, moved_late))
    assert read_result(tmp_path).posterior == POSTERIOR
    content = json.loads((tmp_path / "diagnosis.json").read_text())
    del content["posterior"], content["likeliest"]
    for limit in content["detection_limits"]:
        del limit["rival"]
    del content["next_recording"]["lowers"]
    (tmp_path / "diagnosis.json").write_text(json.dumps(content))
    assert read_result(tmp_path).posterior == ()
    draw_diagnosis(tmp_path, tmp_path)
    assert not (tmp_path / "figures" / "posterior.png").exists()


def test_a_file_in_place_of_its_folder_and_one_that_is_no_text_are_refused(tmp_path):
    save_findings(tmp_path, made_session(made_result(), moved_late))
    file = tmp_path / "diagnosis.json"
    with pytest.raises(UserError, match="is missing: name a folder that swarmtwin diagnose made"):
        read_result(file)
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match=r"is damaged \(.*diagnose again"):
        read_result(tmp_path)


def test_what_to_record_next_where_nothing_is_wrong_is_said():
    plan = NEXT.model_copy(
        update={"separates": (), "lowers": {"command_delay": 0.6, "backlash": 0.71, "dead_band": 0.8}}
    )
    assert next_recording_words(plan).replace("\N{NO-BREAK SPACE}", " ") == (
        "To see smaller effects, record next 20 runs of 40 steps with the commands in next_drive.csv, over and over. "
        "It would lower the limits below, as distances from having no effect: command delay to 60 %, backlash to 71 % "
        "and dead band to 80 % of what they are."
    )


def test_a_report_is_made_of_what_was_diagnosed(tmp_path):
    session = made_session(made_result(), moved_late, vehicles=("1", "2"))
    save_findings(tmp_path, session)
    saved = SavedDiagnosis.read(tmp_path)
    assert saved.result == session.result
    for name in ("held_out", "residual_before", "residual_after"):
        np.testing.assert_array_equal(getattr(saved, name), getattr(session, name))
    np.testing.assert_array_equal(saved.transitions.neighbours, session.transitions.neighbours)
    for own, given in ((saved.runs_before, session.runs_before), (saved.runs_after, session.runs_after)):
        for run, expected in zip(own, given, strict=True):
            assert (run.track.run, run.track.vehicle) == (expected.track.run, expected.track.vehicle)
            assert run.rmse_mm == expected.rmse_mm
            np.testing.assert_array_equal(run.track.pose, expected.track.pose)
            np.testing.assert_array_equal(run.predicted, expected.predicted)


def test_nobody_must_know_statistics_to_read_what_is_not_folded_away(tmp_path):
    above = page_of(made_session(made_result(), moved_late), tmp_path).above.lower()
    for jargon in ("nats", "whitened", "standardised", "likelihood", "p-value", "residual", "bootstrap", "nan"):
        assert not re.search(rf"\b{jargon}\b", above), jargon


OWN_UNIT = UnitDifference(
    vehicle="7",
    way=UnitFactor(value=0.86, low=0.845, high=0.875, unit="", usual=0.05),
    turn=UnitFactor(value=1.01, low=0.995, high=1.025, unit="", usual=0.05),
)


@pytest.mark.parametrize(
    ("verdict", "changes", "sentence"),
    [
        ("no_gap", {}, "No gap was found: within its ordinary noise the robot does what the simulation says"),
        (
            "no_gap",
            {"units": (OWN_UNIT,)},
            "No gap was found beyond how units differ: vehicle 7 goes 0.86 times as far",
        ),
        ("explained", {}, "The robot departs from the simulation because commands act"),
        ("explained", {"units": (OWN_UNIT,)}, "Beside that, vehicle 7 goes 0.86 times as far"),
        ("unexplained", {}, "latency; something else is wrong that has no name – look for what changed, or"),
        (
            "unexplained",
            {"causes": (), "extension": "learned_residual"},
            "no known cause explains it – look for what changed and goes with the command and the previous command, or",
        ),
        ("unexplained", {"causes": (), "extension": "none", "next_recording": None}, "and no known cause explains it"),
        (
            "unexplained",
            {"causes": (), "not_confirmed": "held-out runs do not confirm x"},
            "The extension is discarded: held-out runs do not confirm x.",
        ),
        (
            "unexplained",
            {"not_confirmed": "held-out runs do not confirm x"},
            "held-out runs do not show that this is why – look for what changed",
        ),
    ],
)
def test_every_verdict_has_its_page_and_loads_nothing(tmp_path, verdict, changes, sentence):
    diagnosis = made_result(verdict, **changes)
    page = page_of(made_session(diagnosis, moved_late if verdict != "no_gap" else moved_as_simulated), tmp_path)
    assert sentence in page.above
    assert ("before" in page.above.split()) == (diagnosis.extension != "none")
    kept = diagnosis.extension != "none" and not diagnosis.not_confirmed
    assert ("go on with the extended simulation" in page.above) == kept
    text = (tmp_path / "report.html").read_text()
    assert f'class="verdict {verdict}"' in text
    assert all(source.startswith("data:image/png;base64,iVBOR") for source in page.loaded)
    for loader in ("@import", "url(", "<script", "<link"):
        assert loader not in text
    files = {file.stem for file in (tmp_path / "figures").glob("*.png")}
    assert len(page.loaded) == len(files)
    assert set(leading_pictures(diagnosis)) <= files


@pytest.mark.parametrize("has_two_wheels", [True, False])
def test_a_units_left_wheel_is_told_beside_its_right_one_where_it_has_two(tmp_path, has_two_wheels):
    sides = UnitFactor(value=0.9, low=0.88, high=0.92, unit="", usual=0.03) if has_two_wheels else None
    unit = OWN_UNIT.model_copy(update={"left_to_right": sides})
    page = page_of(made_session(made_result("no_gap", units=(unit,)), moved_as_simulated), tmp_path)
    assert ("its left wheel is 0.90 times as fast beside the right one" in page.above) == has_two_wheels
    assert ("left wheel to right wheel" in page.text) == has_two_wheels


def test_how_far_units_usually_differ_is_told_by_what_they_differ_in():
    assert usual_words(OWN_UNIT) == f"a standard deviation of 5{SPACE}%"
    turns = OWN_UNIT.turn.model_copy(update={"usual": 0.031})
    sides = UnitFactor(value=1.0, low=0.9, high=1.1, unit="", usual=0.0204)
    unit = OWN_UNIT.model_copy(update={"turn": turns, "left_to_right": sides})
    assert usual_words(unit) == (
        f"standard deviations of 5{SPACE}% in how far they go, 3.1{SPACE}% in how far they turn and 2{SPACE}% in how "
        "fast left wheels are beside right ones"
    )
    assert OWN_UNIT.way.is_unusual
    assert not OWN_UNIT.way.model_copy(update={"usual": 0.2}).is_unusual


def test_a_diagnosis_that_was_saved_with_one_spread_for_all_is_read():
    factor = {"value": 0.9, "low": 0.88, "high": 0.92, "unit": ""}
    unit = UnitDifference.model_validate({"vehicle": "7", "way": factor, "turn": factor, "usual": 0.05})
    assert [one.usual for one in unit.factors] == [0.05, 0.05]


def test_a_form_that_the_mechanism_does_not_know_is_passed_over():
    """As of a diagnosis by another version."""
    cause = DELAY.model_copy(update={"form": {"unheard_of": "some"}})
    assert cause_words(cause) == cause_words(DELAY)


def test_vehicles_may_be_called_anything(tmp_path):
    names = ("<script>alert(1)</script>", "$x_{")
    diagnosis = made_result(vehicles=names)
    page = page_of(made_session(diagnosis, moved_late, vehicles=names), tmp_path)
    assert f"vehicles {', '.join(names)}" in page.above
    assert "<script" not in (tmp_path / "report.html").read_text()
    assert (tmp_path / "figures" / "vehicle.png").exists()
    assert (tmp_path / "figures" / "neighbours.png").exists()


@pytest.mark.parametrize("columns", [1, 2, 3, 6])
def test_any_number_of_command_columns_in_any_arena(tmp_path, monkeypatch, columns):
    monkeypatch.setattr(differential_drive.Equations, "command_size", columns)  # as kinematics of one's own may say
    robot = made_robot(columns, arena=(500 + 4000 * (columns == 3), 500 + 9000 * (columns == 6)))
    session = made_session(made_result(), moved_late, robot, runs=6)
    page_of(session, tmp_path)
    choices = field_choices(session.transitions, parts_of(session))
    assert len(choices["command"].axes) == min(2, columns)
    assert all(f"{axis.label}".split(",")[0] in NAMES for axis in choices["command"].axes)


def test_a_page_is_made_of_next_to_nothing(tmp_path):
    session = made_session(made_result("unexplained"), moved_late, runs=2, steps=10)
    nowhere = replace(session, runs_before=(), runs_after=())
    page = page_of(nowhere, tmp_path)
    assert "Errors are counted" not in page.above
    assert [file.name for file in (tmp_path / "figures").iterdir()] == ["spread.png"]


def test_a_typical_run_and_a_bad_one_are_drawn():
    session = made_session(made_result(), moved_late, runs=40)
    figure = runs_figure(session.runs_before, session.runs_after)
    errors = sorted(run.rmse_mm for run in session.runs_before)
    shown = [float(re.search(r": RMSE (\d+) → 1 mm", panel.get_title(loc="left"))[1]) for panel in figure.axes]
    expected = [errors[round(share * (len(errors) - 1))] for share in (0.5, 0.9)]
    assert shown == [float(f"{error:.0f}") for error in expected]
    assert runs_figure((), ()) is None


@pytest.mark.parametrize(
    ("name", "value", "low", "high", "unit", "said"),
    [
        ("delay_s", 0.1504, 0.1311, 0.1697, "s", "0.15 s (0.13 to 0.17)"),
        ("angle_rad", np.pi / 6, np.pi / 6 - 0.002, np.pi / 6 + 0.002, "rad", "30.00° (29.89 to 30.11)"),
        ("loss", 0.302, 0.281, 0.322, "", "30 % (28 to 32)"),
        ("loss", -0.05, -0.09, -0.01, "", "−5 % (−9 to −1)"),
        ("gain", 1.12, 1.10, 1.14, "", "1.12 (1.10 to 1.14)"),
        ("x_mm", 431.0, 402.0, 460.0, "mm", "431 mm (402 to 460)"),
        ("factor", 1.0, 1.0, 1.0, "", "1.00 (1.00 to 1.00)"),
        ("left_mm", -0.001, -0.5, 0.5, "mm", "0.0 mm (−0.5 to 0.5)"),
    ],
)
def test_numbers_are_as_exact_as_their_intervals(name, value, low, high, unit, said):
    assert (
        estimate_words(name, Estimate(value=value, low=low, high=high, unit=unit)).replace("\N{NO-BREAK SPACE}", " ")
        == said
    )


@pytest.mark.parametrize("name", mechanism_names())
def test_every_cause_of_the_catalogue_has_its_sentence(robots, name):
    for robot in robots.values():
        conditions = SessionConditions(arena_mm=robot.arena_mm, session_s=100.0)
        parameters = {
            parameter: Estimate(value=0.5, low=0.4, high=0.6, unit=unit)
            for parameter, unit in mechanism_class(name).units(robot, conditions).items()
        }
        cause = DELAY.model_copy(update={"name": name, "parameters": parameters})
        said = cause_words(cause)
        assert "{" not in said
        assert said.count("(") >= min(1, len(parameters))
        assert cause_summary(cause) in verdict_words(made_result(causes=(cause,)))
        assert "(" not in cause_summary(cause).replace("(coefficient", "").replace("(within", "")


@pytest.mark.parametrize(
    ("form", "of"), [({}, "speed"), ({"acts_on": "speed"}, "speed"), ({"acts_on": "effort"}, "effort")]
)
def test_what_weakens_is_told_of_what_it_acts_on(form, of):
    parameters = {name: Estimate(value=0.2, low=0.15, high=0.25, unit="") for name in ("loss", "shape")}
    sag = DELAY.model_copy(update={"name": "battery_sag", "parameters": parameters, "form": form})
    assert f"of their {of} by the session's end" in cause_words(sag)


@pytest.mark.parametrize(
    ("name", "parameter", "unit", "form", "said"),
    [
        ("dead_band", "width", "PWM", {}, "do nothing, and larger ones all that they should"),
        ("dead_band", "width", "PWM", {"larger": "less"}, "do nothing, and larger ones as much less"),
        ("saturation", "limit", "PWM", {}, "(0.15 to 0.25) are cut"),
        ("saturation", "limit", "PWM", {"sets_in": "gradually"}, "(0.15 to 0.25) should"),
        ("actuator_lag", "time_constant_s", "s", {}, "with an additional time constant of 0.2"),
        ("actuator_lag", "time_constant_s", "s", {"follows": "evenly"}, "to full speed within twice 0.2"),
    ],
)
def test_a_law_is_told_by_its_words(name, parameter, unit, form, said):
    parameters = {parameter: Estimate(value=0.2, low=0.15, high=0.25, unit=unit)}
    cause = DELAY.model_copy(update={"name": name, "parameters": parameters, "form": form})
    assert said in cause_words(cause)


@pytest.mark.parametrize(
    ("side", "said"),
    [
        ("left", "because the left wheel runs at 0.850 times its speed – compare"),
        ("right", "because the right wheel runs at 0.850 times its speed – compare"),
        ("both", "because left and right differ: 0.850 – compare"),
    ],
)
def test_the_side_of_a_weak_wheel_is_told(side, said):
    ratio = Estimate(value=0.85, low=0.845, high=0.855, unit="")
    weak = {"name": "actuator_asymmetry", "rivals": (), "parameters": {"ratio": ratio}, "form": {"side": side}}
    result = made_result(causes=(DELAY.model_copy(update=weak),))
    assert said in verdict_words(result).replace("\N{NO-BREAK SPACE}", " ")


def test_errors_that_scatter_more_are_told_where_no_gap_is_found():
    found = Dependence(part="spread", statistic=7.0, p_value=1e-9, explained=0.2, found=True)
    less = found.model_copy(update={"explained": -0.2})
    said = [verdict_words(made_result("no_gap", tests=(one,))) for one in (found, less)]
    assert ["scatter more" in one for one in said] == [True, False]


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [(0.42, 0.58, "0.42 to 0.58 less"), (-0.04, -0.01, "0.01 to 0.04 more"), (-0.02, 0.03, "0.02 more to 0.03 less")],
)
def test_what_a_change_may_be_is_told_by_its_direction(low, high, said):
    assert Gain(before=1.0, after=1.0, low=low, high=high).change_words == said


def test_gains_may_be_losses_and_errors_nothing():
    worse = gain_words(Gain(before=2.0, after=2.1, low=-0.3, high=0.1), "mm")
    assert worse.replace("\N{NO-BREAK SPACE}", " ") == "+0.1 mm (−0.1 to +0.3), +5 %"
    unknown = Gain(before=0, after=0, low=0, high=0)
    gain = made_result().gain.model_copy(update={"open_loop_mm": unknown})
    bars = gain_bars(made_result(gain=gain))
    assert [bar.after is not None for bar in bars] == [True, True, True, False]
    assert bars[3].before == "not known"
    older = made_result().gain.model_copy(update={"ten_periods_mm": None})
    assert len(gain_bars(made_result(gain=older))) == 3


def test_a_window_of_ten_periods_is_told_once(tmp_path):
    gain = made_result().gain
    ten_s = gain.open_loop_windows[1]
    five_s = ten_s.model_copy(update={"window_s": 5.0, "before": 62.0, "after": 11.0})
    gain = gain.model_copy(update={"open_loop_windows": (five_s, ten_s)})
    page = page_of(made_session(made_result(gain=gain), moved_late), tmp_path)
    assert "Position over ten periods before 62" in page.above
    assert " 5 s 62" not in page.above
    assert " 10 s 118" in page.above


def test_errors_are_told_in_units_of_the_ordinary_noise(tmp_path):
    session = made_session(made_result(), moved_late)
    page = page_of(session, tmp_path)
    before, after = (
        np.sqrt(np.mean(residual[session.held_out] ** 2))
        for residual in (session.residual_before, session.residual_after)
    )
    assert f"errors after one period are {before:.2f} → {after:.2f} (root mean square; noise alone: 1)" in page.above


def test_a_result_without_windows_has_no_table_of_them(tmp_path):
    """Runs were too short for each of them, or it is of an older version."""
    gain = made_result().gain.model_copy(update={"open_loop_windows": ()})
    page = page_of(made_session(made_result(gain=gain), moved_late), tmp_path)
    assert "longer windows" not in page.above
    content = json.loads((tmp_path / "diagnosis.json").read_text())
    del content["gain"]["open_loop_windows"]
    (tmp_path / "diagnosis.json").write_text(json.dumps(content))
    assert read_result(tmp_path).gain == gain


def test_where_nothing_was_extended_one_error_after_each_window_is_told(tmp_path):
    page = page_of(made_session(made_result("no_gap"), moved_as_simulated), tmp_path)
    assert "over error predictions 2 s 5.50 ± 2.75 mm 28 from 7 runs" in page.above


def test_odds_are_round_numbers():
    assert [odds_words(nats) for nats in (5.0, 7.3, 1000.0)] == ["100", "1,000", "1,000,000"]


@pytest.mark.parametrize(
    ("name", "depends_on", "leading"),
    [
        ("battery_sag", ("spread", "command", "time"), ["time", "command"]),
        ("surface_patch", ("command", "wall_distance", "tails"), ["place", "command"]),
        ("gain_change", ("spread", "command"), ["command", "spread"]),
        ("marker_yaw", ("previous_command",), ["previous_command"]),
        ("noise_change", ("spread", "tails"), ["spread"]),
    ],
)
def test_what_the_cause_looks_at_is_shown_first_where_it_shows(name, depends_on, leading):
    cause = DELAY.model_copy(update={"name": name})
    assert leading_pictures(made_result(causes=(cause,), depends_on=depends_on)) == leading


def test_what_is_left_is_said_without_a_direction_that_nobody_measured():
    diagnosis = made_result(depends_on=("time", "spread"), left_over=("position", "spread", "tails"))
    assert dependence_words(diagnosis) == (
        "The error depends on the time since the session began. Errors scatter more than the ordinary noise. "
        "What the extension leaves depends on the place in the arena. With the extension, how errors scatter and how "
        "common large errors are still differs from the ordinary noise."
    )
    tighter = Dependence(part="spread", statistic=1, p_value=0, explained=-0.2, found=True)
    quiet = made_result(depends_on=("spread",), tests=(tighter,))
    assert dependence_words(quiet) == "Errors scatter less than the ordinary noise."


def test_tests_that_find_what_is_no_gap_are_not_denied():
    one, *others = made_result("no_gap").tests
    diagnosis = made_result("no_gap", tests=(one.model_copy(update={"found": True}), *others))
    words = f"1 of {len(diagnosis.tests)} tests show a difference from the reference, but taken together"
    assert dependence_words(diagnosis).startswith(words)


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        (
            "neighbour_interaction",
            {"strength_mm_s": (-98.0, -101.0, -95.0, "mm/s"), "reach_mm": (261.0, 255.0, 267.0, "mm")},
            "vehicles draw each other together at 98 mm/s (95 to 101) where they meet, and at 37 % of that 261 mm (255 "
            "to 267) apart",
        ),
        (
            "marker_offset",
            {"forward_mm": (3.0, 2.8, 3.2, "mm"), "left_mm": (-0.4, -0.9, 0.1, "mm")},
            "the marker sits 3.0 mm (2.8 to 3.2) ahead and 0.4 mm (−0.1 to 0.9) to the right of where it should",
        ),
    ],
)
def test_a_direction_is_told_by_a_word_in_the_place_of_a_sign(name, values, words):
    parameters = {
        parameter: Estimate(value=value, low=low, high=high, unit=unit)
        for parameter, (value, low, high, unit) in values.items()
    }
    cause = DELAY.model_copy(update={"name": name, "parameters": parameters})
    assert cause_words(cause).replace("\N{NO-BREAK SPACE}", " ") == words


def test_in_a_browser_the_report_loads_without_errors_and_fits(tmp_path, browser):
    diagnosis = made_result(causes=(DELAY, YAW), posterior=POSTERIOR, detection_limits=LIMITS)
    page_of(made_session(diagnosis, moved_late), tmp_path)
    for width in (1280, 400):
        page = browser.open(tmp_path / "report.html", width)
        assert "The robot departs from the simulation because the marker is turned by" in page.text()
        assert page.evaluate("document.images.length") > 3
        assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
        assert page.errors == []
        assert page.elsewhere() == []
        assert not page.is_wider_than_the_window()


def test_a_diagnosis_whose_residuals_lack_a_column_is_told_to_be_made_again(tmp_path):
    save_findings(tmp_path, made_session(made_result(), moved_late))
    file = tmp_path / "residuals.parquet"
    table = pa.parquet.read_table(file)
    pa.parquet.write_table(table.drop_columns(["held_out"]), file)
    with pytest.raises(UserError, match=r"residuals.parquet: no transitions can be read .*diagnose again"):
        SavedDiagnosis.read(tmp_path)
