"""Settings: YAML and Python give the same object, every field has its sentence, and what is set decides."""

import dataclasses
import re

import numpy as np
import pytest
import yaml
from exact_base import ExactBase, known_noise, session_of

from swarmtwin.configuration import config_folder
from swarmtwin.diagnosis.dependence import StandardisedResidual, dependence_tests
from swarmtwin.diagnosis.extension import HeldOutRuns
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.result import Cause
from swarmtwin.diagnosis.screening import sought_kinds
from swarmtwin.diagnosis.settings import DependenceSettings, DiagnosisSettings, VerdictSettings
from swarmtwin.errors import UserError
from swarmtwin.simulation.mechanism import Parameter, mechanism_class

DEFAULT = config_folder() / "diagnosis" / "default.yaml"


def test_yaml_and_python_give_the_same_settings():
    content = yaml.safe_load(DEFAULT.read_text())
    assert DiagnosisSettings.parse(content, str(DEFAULT)) == DiagnosisSettings()
    assert {name: set(part) for name, part in content.items()} == {
        name: set(type(part).model_fields) for name, part in DiagnosisSettings()
    }


def test_every_setting_says_what_it_decides():
    for _, part in DiagnosisSettings():
        said = set(re.findall(r"^ {8}(\w+): ", type(part).__doc__, flags=re.M))
        assert said == set(type(part).model_fields)


def test_an_unknown_setting_is_refused_with_the_near_miss():
    with pytest.raises(UserError, match=r"unknown field 'search.most_cause'.*most_causes"):
        DiagnosisSettings.parse({"search": {"most_cause": 3}}, "here")
    with pytest.raises(UserError, match=r"here: field 'dependence.false_discovery_rate'.*got 1.5"):
        DiagnosisSettings.parse({"dependence": {"false_discovery_rate": 1.5}}, "here")


@pytest.mark.parametrize(("name", "value"), [("prior", 0), ("prior", 1), ("named_from", 1), ("reported_sets", 1)])
def test_a_probability_that_has_no_odds_and_too_few_sets_are_refused(name, value):
    with pytest.raises(UserError, match=rf"here: field 'search.{name}'"):
        DiagnosisSettings.parse({"search": {name: value}}, "here")


def test_settings_by_which_no_run_is_held_out_are_refused(robots):
    settings = DiagnosisSettings.parse({"verdict": {"held_out_every": 50}}, "here")
    session = session_of(ExactBase(robots["mgr"]), np.random.default_rng(1), runs=40, steps=20)
    reference = Reference.learn(session.transitions, 1, settings=settings)
    with pytest.raises(UserError, match="held_out_every=50 holds out no run of the 40 that were measured: lower it"):
        HeldOutRuns(reference, session, None, session.transitions, 1)


def test_runs_of_each_vehicle_are_held_out_where_vehicles_drive_in_turn(robots):
    session = session_of(ExactBase(robots["mgr"]), np.random.default_rng(1), runs=40, steps=20)
    vehicle = session.run % 4
    in_turn = dataclasses.replace(session.transitions, vehicle=vehicle, vehicles=("1", "2", "3", "4"))
    reference = Reference.learn(session.transitions, 1)
    runs = HeldOutRuns(reference, dataclasses.replace(session, transitions=in_turn), None, in_turn, 1)
    assert len(np.unique(session.run[runs.rows])) == 10
    assert set(vehicle[runs.rows]) == {0, 1, 2, 3}
    alone = HeldOutRuns(reference, session, None, session.transitions, 1)
    np.testing.assert_array_equal(alone.rows, session.run % 4 == 3)


def test_lost_commands_by_more_than_a_probability_are_refused(robots, monkeypatch):
    """A mechanism of somebody's own may say so; the diagnosis sums over losses that have one parameter."""
    lost = mechanism_class("command_loss")
    parameters = dict.fromkeys(("probability", "burst"), Parameter(0.0, 1.0, 0.0, "", (0.1,)))
    burst = type("InBursts", (lost,), {"parameters": parameters})
    monkeypatch.setattr("swarmtwin.diagnosis.screening.offered", lambda robot, conditions: {"in_bursts": burst})
    base = ExactBase(robots["mgr"])
    model = SessionLikelihood(base, known_noise(), session_of(base, np.random.default_rng(1), runs=4, steps=5))
    with pytest.raises(UserError, match="mechanism in_bursts has the parameters probability, burst: the diagnosis"):
        sought_kinds(model)


def test_a_reference_too_short_for_the_defaults_is_long_enough_where_less_is_asked_for(robots):
    transitions = session_of(ExactBase(robots["mgr"]), np.random.default_rng(1), runs=7, steps=70).transitions
    with pytest.raises(UserError, match="record at least 8 runs"):
        Reference.learn(transitions, 1)
    settings = DiagnosisSettings.parse({"reference": {"fewest_runs": 7}}, "here")
    assert Reference.learn(transitions, 1, settings=settings).settings == settings


def test_a_dependence_that_is_too_small_for_the_settings_does_not_matter(robots):
    base = ExactBase(robots["mgr"])
    here, there = (session_of(base, np.random.default_rng(seed), runs=80) for seed in (1, 2))
    rng = np.random.default_rng(3)
    measured, reference = (
        StandardisedResidual.of(model, model.evaluate([]))
        for model in (SessionLikelihood(base, known_noise(), session) for session in (here, there))
    )
    measured.residual[:, 0] += 0.4 * np.cos(here.situation.pose[:, 2].numpy() + rng.normal(0, 0.01))
    found = {test.part: test for test in dependence_tests(measured, reference, 4)}
    assert found["heading"].found
    strict = DependenceSettings(least_explained=2 * found["heading"].explained)
    assert not any(test.found for test in dependence_tests(measured, reference, 4, strict) if test.part == "heading")


@pytest.mark.parametrize("name", ["running_means", "ridges"])
def test_candidates_of_which_there_is_none_are_refused(name):
    with pytest.raises(UserError, match=rf"here: field 'flexible.{name}'.*at least 1 item"):
        DiagnosisSettings.parse({"flexible": {name: []}}, "here")


def test_a_cause_is_as_sure_as_names_like_it_were_right():
    verdict = VerdictSettings(named_in_trials={"gain_change": (5, 10), "marker_yaw": (45, 50)}, trials_prior=10)
    of_all = 50 / 60
    assert verdict.confidence("gain_change", 1.0) == pytest.approx((5 + 10 * of_all) / 20)
    assert verdict.confidence("marker_yaw", 0.5) == pytest.approx(0.5 * (45 + 10 * of_all) / 60)
    assert verdict.confidence("of_somebodys_own", 0.8) == pytest.approx(0.8 * of_all)
    assert VerdictSettings(named_in_trials={}).confidence("gain_change", 0.8) == 0.8
    with pytest.raises(UserError, match=r"here: field 'verdict.named_in_trials.gain_change'.*cannot have been there"):
        DiagnosisSettings.parse({"verdict": {"named_in_trials": {"gain_change": [3, 2]}}}, "here")
    with pytest.raises(UserError, match=r"no such mechanism: 'ded_band': did you mean 'dead_band'"):
        DiagnosisSettings.parse({"verdict": {"named_in_trials": {"ded_band": [1, 2]}}}, "here")


def test_a_cause_of_an_earlier_version_has_the_probability_that_was_told():
    told = {"name": "marker_yaw", "parameters": {}, "confidence": 0.9, "rivals": [], "share_of_gap": 1, "evidence": ""}
    assert Cause.model_validate(told).posterior == Cause.model_validate(told).confidence == 0.9
    assert Cause.model_validate(told | {"posterior": 1}).posterior == 1.0
