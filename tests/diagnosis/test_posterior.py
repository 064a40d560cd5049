"""The posterior over sets of causes: forms of the same causes are summed up, evidence is told without prior odds."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from exact_base import errors_showing

from exact_model import conditions_of
from swarmtwin.diagnosis.cause_report import leading_sets
from swarmtwin.diagnosis.cause_search import CausePosterior, share_beside
from swarmtwin.diagnosis.explanation import Explanation, explanation
from swarmtwin.diagnosis.left_over import LeftOver
from swarmtwin.diagnosis.settings import DiagnosisSettings, SearchSettings
from swarmtwin.simulation.mechanism import mechanism_class

ODDS_AGAINST = 3.0
NOTHING_LEFT = LeftOver(0.0, 0.0)


def posterior_of(**evidence):
    """A posterior over sets with names joined by _and_, each with its evidence over nothing, mean over its forms."""
    rows = [((), 0.0, 1)]
    for key, (nats, forms) in evidence.items():
        rows.append((tuple(key.split("_and_")), nats, forms))
    sets, logs = [], []
    for names, nats, forms in rows:
        for _ in range(forms):  # each form has as much evidence, and its share of the prior
            sets.append(SimpleNamespace(names=names))
            logs.append(nats - len(names) * ODDS_AGAINST - np.log(forms))
    order = np.argsort(logs)[::-1]
    logs = np.array(logs)[order]
    sets = [sets[index] for index in order]
    nothing = next(one for one in sets if not one.names)
    odds = np.array([len(one.names) * ODDS_AGAINST for one in sets])
    return CausePosterior(tuple(sets), logs - np.logaddexp.reduce(logs), nothing, odds)


def test_forms_of_the_same_causes_are_one_set_and_evidence_is_over_nothing():
    posterior = posterior_of(gain_change=(5.0, 2), command_delay=(4.0, 1), gain_change_and_marker_yaw=(6.0, 4))
    sets = leading_sets(posterior, 8)
    weights = {
        ("gain_change",): np.exp(5.0 - 3),
        ("command_delay",): np.exp(4.0 - 3),
        ("gain_change", "marker_yaw"): np.exp(6.0 - 6),
        (): 1.0,
    }
    assert {one.causes for one in sets} == weights.keys()
    assert [one.probability for one in sets] == sorted((one.probability for one in sets), reverse=True)
    for one in sets:
        assert one.probability == pytest.approx(weights[one.causes] / sum(weights.values()), rel=1e-4)
    assert {one.causes: one.log_evidence for one in sets} == pytest.approx(
        {("gain_change",): 5.0, ("command_delay",): 4.0, ("gain_change", "marker_yaw"): 6.0, (): 0.0}, abs=1e-4
    )


def test_at_most_so_many_sets_are_kept_and_nothing_is_always_one_of_them():
    posterior = posterior_of(**{f"cause{number}": (20.0 + number, 1) for number in range(12)})
    sets = leading_sets(posterior, 8)
    assert [one.causes for one in sets] == [(f"cause{number}",) for number in (11, 10, 9, 8, 7, 6, 5)] + [()]


@pytest.mark.parametrize(
    ("robot", "causes", "share"),
    [
        ("mur", ("gain_change",), 0.0),
        ("mur", ("gain_change", "actuator_lag"), 0.02),
        ("mur", ("backlash", "actuator_lag"), 0.08),
        ("mur", ("backlash", "gain_change", "command_delay"), 0.02 + 0.08),
        ("mur", ("timing_jitter", "actuator_lag", "command_delay"), 0.08),
        ("mgr", ("backlash", "actuator_lag"), 0.02),
        ("mgr", ("command_loss", "camera_scale"), 0.0),
        ("mgr", ("command_loss", "camera_scale", "actuator_lag"), 0.02),
        ("mur", ("command_loss", "camera_scale"), 0.02),
    ],
)
def test_of_thrust_causes_that_say_when_it_follows_tell_less_of_each_other(robots, robot, causes, share):
    model = SimpleNamespace(robot=robots[robot], read_off_clock=lambda kind: kind is mechanism_class("timing_jitter"))
    kinds = [mechanism_class(name) for name in causes]
    assert share_beside(SearchSettings(), model, kinds) == pytest.approx(share)


@pytest.mark.parametrize(
    ("cause", "parameter", "value", "error", "named"),
    [
        ("gain_change", "gain", 2.45, 0.01, True),  # far from the end of its range, 2.5, by its own measure
        ("gain_change", "gain", 2.45, 0.04, False),  # it may as well be the end, and more
        ("gain_change", "gain", 1.80, 0.40, True),  # hardly known, but in the middle
        ("gain_change", "gain", 2.50, 0.001, False),
        ("battery_sag", "loss", 0.93, 0.02, True),  # beyond the end there is nothing
    ],
)
def test_a_cause_that_may_lie_at_an_end_is_not_named(robots, cause, parameter, value, error, named):
    explained = explanation_of(robots["mgr"], {cause: (parameter, value, error)}, posterior_of(**{cause: (300.0, 1)}))
    assert explained.names == ((cause,) if named else ())


@pytest.mark.parametrize(("error", "tells"), [(0.02, True), (0.04, False)])  # it may as well be 1
def test_a_cause_that_may_do_nothing_does_not_tell(robots, error, tells):
    causes = {"gain_change": ("gain", 0.95, error)}
    explained = explanation_of(robots["mgr"], causes, posterior_of(gain_change=(300.0, 1)))
    assert explained.telling == (("gain_change",) if tells else ())


USED = "parameters_of", "arrival_probability"


def explanation_of(robot, estimates, posterior=None, gained=300.0, left=NOTHING_LEFT):
    """An explanation by causes, each with a parameter, its value and its error."""

    def parameters(kinds):
        found = []
        for number, kind in enumerate(kinds):
            name, _, _ = estimates[kind.name]
            found.append((number, name, kind.parameters_of(robot, conditions_of(robot))[name]))
        return found

    model = SimpleNamespace(
        settings=DiagnosisSettings(),
        parameters=parameters,
        session=range(4000),
        strange=(),
        read_off_clock=lambda kind: False,
        robot=robot,
    )
    best = SimpleNamespace(
        mechanisms=[
            type(
                cause, (), {"name": cause, own: value, **{name: getattr(mechanism_class(cause), name) for name in USED}}
            )()
            for cause, (own, value, _) in estimates.items()
        ],
        names=tuple(estimates),
        values=np.array([value for _, value, _ in estimates.values()]),
        covariance=np.diag([error**2 for _, _, error in estimates.values()]),
    )
    return Explanation(model, posterior or posterior_of(), best, gained, left, SimpleNamespace(probability=0.0))


SAG, GAIN, GAIN_SURE = ("loss", 0.5, 0.05), ("gain", 1.9, 0.6), ("gain", 1.5, 0.05)


@pytest.mark.parametrize(("nats", "verdict"), [(3.2, "no_gap"), (5.0, "no_gap"), (5.5, "explained")])
def test_a_cause_that_may_as_well_not_be_there_raises_no_alarm(robots, nats, verdict):
    """Nine of ten is asked for that any is there: 0.55, 0.88 and 0.92 here."""
    explained = explanation_of(robots["mgr"], {"battery_sag": SAG}, posterior_of(battery_sag=(nats, 1)), gained=50.0)
    assert explained.posterior.of_any == pytest.approx(1 / (1 + np.exp(ODDS_AGAINST - nats)))
    assert explained.verdict == verdict


def test_an_alarm_is_raised_where_one_of_rivals_is_there_and_neither_leads(robots):
    posterior = posterior_of(battery_sag=(8.0, 1), gain_change=(8.0, 1))
    explained = explanation_of(robots["mgr"], {"battery_sag": SAG}, posterior, gained=50.0)
    assert explained.posterior.probability("battery_sag") < 0.5
    assert (explained.names, explained.verdict) == ((), "unexplained")


@pytest.mark.parametrize(
    ("evidence", "left"),
    [
        ({"battery_sag": (-3.0, 1)}, ()),  # without the gain it is less likely than nothing
        ({"battery_sag": (40.0, 1)}, ("battery_sag",)),
        ({}, ()),  # it was never fitted alone
    ],
)
def test_beside_a_cause_that_may_do_nothing_the_others_are_estimated_anew(robots, monkeypatch, evidence, left):
    posterior = posterior_of(battery_sag_and_gain_change=(60.0, 1), **evidence)
    both = explanation_of(robots["mgr"], {"battery_sag": SAG, "gain_change": GAIN}).best
    monkeypatch.setattr(CausePosterior, "best", both)
    asked = []

    def explained_by(mechanisms, model, posterior, usual):
        names = [one.name for one in mechanisms]
        asked.append(tuple(names))
        known = {"battery_sag": SAG, "gain_change": GAIN}
        return explanation_of(robots["mgr"], {name: known[name] for name in names}, posterior)

    monkeypatch.setattr("swarmtwin.diagnosis.explanation._explained_by", explained_by)
    found = explanation(None, posterior)
    assert asked == [("battery_sag", "gain_change"), left]
    assert found.best.names == left


@pytest.mark.parametrize(
    ("both", "sag_left", "named"),
    [
        (60.8, NOTHING_LEFT, ("battery_sag",)),  # a lag that is not sure ends where lags do: the rest does without it
        (60.8, LeftOver(90.0, 0.0), ()),  # and does not explain the session
        (70.0, NOTHING_LEFT, ()),  # a lag that is sure: beyond the end it, or another cause, may fit better
    ],
)
def test_an_unsure_cause_at_an_end_does_not_keep_the_others_from_being_named(
    robots, monkeypatch, both, sag_left, named
):
    posterior = posterior_of(battery_sag=(57.0, 1), battery_sag_and_actuator_lag=(both, 1))
    lag = ("time_constant_s", robots["mgr"].period_s - 0.001, 0.01)

    def explained_by(mechanisms, model, posterior, usual):
        known = {"battery_sag": SAG, "actuator_lag": lag}
        names = [one.name for one in mechanisms]
        left = NOTHING_LEFT if len(names) == 2 else sag_left
        return explanation_of(robots["mgr"], {name: known[name] for name in names}, posterior, left=left)

    start = explanation_of(robots["mgr"], {"battery_sag": SAG, "actuator_lag": lag}).best
    monkeypatch.setattr(CausePosterior, "best", start)
    monkeypatch.setattr("swarmtwin.diagnosis.explanation._explained_by", explained_by)
    assert explanation(None, posterior).names == named


def test_a_cause_that_does_nothing_without_one_that_is_left_out_is_not_named(robots, monkeypatch):
    sets = {
        "battery_sag": 50.0,
        "battery_sag_and_gain_change": 57.0,
        "battery_sag_and_gain_change_and_actuator_lag": 60.0,
    }
    posterior = posterior_of(**{names: (nats, 1) for names, nats in sets.items()})
    lag = ("time_constant_s", robots["mgr"].period_s - 0.001, 0.01)

    def explained_by(mechanisms, model, posterior, usual):
        names = [one.name for one in mechanisms]
        gain = ("gain", 0.9, 0.01) if "actuator_lag" in names else ("gain", 0.99, 0.01)  # it may as well be 1
        known = {"battery_sag": SAG, "actuator_lag": lag, "gain_change": gain}
        return explanation_of(robots["mgr"], {name: known[name] for name in names}, posterior)

    start = explanation_of(
        robots["mgr"], {"battery_sag": SAG, "gain_change": ("gain", 0.9, 0.01), "actuator_lag": lag}
    ).best
    monkeypatch.setattr(CausePosterior, "best", start)
    monkeypatch.setattr("swarmtwin.diagnosis.explanation._explained_by", explained_by)
    assert explanation(None, posterior).names == ("battery_sag",)


@pytest.mark.parametrize(
    ("gained", "most", "verdict", "may_be_chance"),
    [
        (300.0, 0.0, "explained", False),
        (40.0, 50.0, "no_gap", True),  # an uncertain simulation may gain as much
        (60.0, 50.0, "explained", True),  # more, but not so much more that it would alarm
        (90.0, 50.0, "explained", False),
    ],
)
def test_what_gains_no_more_than_an_uncertain_simulation_is_no_cause(robots, gained, most, verdict, may_be_chance):
    posterior = posterior_of(gain_change=(gained, 1))
    left = LeftOver(0.0, 0.0, most_uncertainty=most, most_by_chance=most)
    gain = {"gain_change": ("gain", 0.9, 0.01)}
    found = explanation_of(robots["mgr"], gain, posterior, gained, left)
    assert found.verdict == verdict
    assert found.may_be_chance == may_be_chance


def test_causes_may_gain_less_by_chance_than_a_regression_does(robots):
    posterior = posterior_of(gain_change=(40.0, 1))
    left = LeftOver(0.0, 0.0, most_uncertainty=50.0, most_by_chance=30.0)
    gain = {"gain_change": ("gain", 0.9, 0.01)}
    assert explanation_of(robots["mgr"], gain, posterior, 40.0, left).names == ("gain_change",)


def residual_with(outliers, count=4000):
    """Errors of unit variance, of which some are ten standard deviations large."""
    residual = np.random.default_rng(1).normal(size=(count, 3))
    residual[:outliers, 0] = 10.0
    return residual


@pytest.mark.parametrize(("outliers", "usual", "is_explained"), [(0, 0.0, True), (60, 0.0, False), (60, 0.012, True)])
@pytest.mark.parametrize("cause", ["command_loss", "noise_change", "gain_change"])
def test_outliers_of_which_the_reference_has_fewer_are_neither_lost_commands_nor_noise(
    robots, outliers, usual, is_explained, cause
):
    estimates = {
        "command_loss": {"command_loss": ("probability", 0.02, 0.002)},
        "gain_change": {"gain_change": GAIN_SURE},
    }
    explained = explanation_of(robots["mgr"], estimates.get(cause, {}), posterior_of(**{cause: (300.0, 1)}))
    fitted = SimpleNamespace(residual=residual_with(outliers), scale=np.ones(3))
    explained = dataclasses.replace(
        explained,
        best=SimpleNamespace(**vars(explained.best), fitted=fitted),
        motion_noise=SimpleNamespace(probability=0.99 if cause == "noise_change" else 0.0),
        reference=errors_showing(outliers=usual),
    )
    expected = is_explained or cause == "gain_change"  # that moves the mean: outliers say nothing of it
    assert explained.verdict == ("explained" if expected else "unexplained")
    assert explained.names_motion_noise is (expected and cause == "noise_change")


@pytest.mark.parametrize(
    ("robot", "lost", "is_explained"), [("mgr", 0.1, True), ("mgr", 0.002, False), ("mur", 0.002, True)]
)
def test_no_more_than_a_tenth_of_what_is_lost_leaves_outliers_where_wheels_lose_it(robots, robot, lost, is_explained):
    """What is taken for a lost command now and then is another mishap, most of which is left over."""
    estimates = {"command_loss": ("probability", lost, lost / 10)}
    explained = explanation_of(robots[robot], estimates, posterior_of(command_loss=(300.0, 1)))
    fitted = SimpleNamespace(residual=residual_with(12), scale=np.ones(3))
    explained = dataclasses.replace(explained, best=SimpleNamespace(**vars(explained.best), fitted=fitted))
    assert explained.verdict == ("explained" if is_explained else "unexplained")


@pytest.mark.parametrize(("beyond", "verdict"), [(5.0, "no_gap"), (50.0, "explained")])
def test_causes_that_the_reference_shows_as_well_are_not_named(robots, beyond, verdict):
    left = LeftOver(0.0, 0.0, beyond_reference=beyond)
    posterior = posterior_of(gain_change=(40.0, 1))
    explained = explanation_of(robots["mgr"], {"gain_change": GAIN_SURE}, posterior, gained=40.0, left=left)
    assert explained.verdict == verdict


@pytest.mark.parametrize(("variation", "verdict"), [(5.0, "explained"), (30.0, "unexplained")])
def test_causes_whose_change_varies_are_not_named(robots, variation, verdict):
    left = LeftOver(0.0, 0.0, by_variation=variation)
    posterior = posterior_of(gain_change=(300.0, 1))
    explained = explanation_of(robots["mgr"], {"gain_change": GAIN_SURE}, posterior, left=left)
    assert explained.verdict == verdict
    assert bool(explained.names) is (verdict == "explained")
