"""The next recording: driving what is planned tells rivals apart, or shows effects as small as was said."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from exact_base import ExactBase, as_simulated, known_noise, session_of

from swarmtwin.diagnosis.cause_report import likeliest_causes, reported_causes
from swarmtwin.diagnosis.cause_search import CauseSearch
from swarmtwin.diagnosis.detection_limits import detection_limits
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.explanation import explanation
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.next_recording import lowering_drive, next_recording
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.geometry import compose, exp_map
from swarmtwin.simulation.mechanism import mechanism_class

OFFERED = {name: mechanism_class(name) for name in ("command_delay", "actuator_lag", "gain_change", "battery_sag")}


def explained(base, moved, seed, settings=None, **drive):
    session = session_of(base, np.random.default_rng(seed), moved, **{"runs": 20, "steps": 15, **drive})
    model = SessionLikelihood(base, known_noise(), session, settings=settings)
    return explanation(model, CauseSearch(model, OFFERED).run())


def late(moment, delay_s=0.05):
    share = delay_s / moment.base.robot.period_s
    return compose(exp_map(moment.way_before * share), exp_map(moment.way * (1 - share)))


def as_driven(plan, command):
    """Commands (steps, R, m) of the planned runs: the drive is repeated until all are driven."""
    drives = command.reshape(-1, plan.steps, command.shape[1])
    return drives[np.arange(plan.runs) % len(drives)].transpose(1, 0, 2)


@pytest.fixture(scope="module")
def base(robots):
    return ExactBase(robots["mgr"])


def test_driving_what_is_planned_tells_the_rivals_apart(base):
    """A small delay in a short session could as well be a lag; after the next recording it could not."""
    before = explained(base, late, 4)
    runner_up = before.posterior.probability("actuator_lag")
    assert runner_up > 0.05
    plan, command = next_recording(before, (), 1)
    assert set(plan.separates) == {"command_delay", "actuator_lag"}
    after = explained(base, late, 5, command=as_driven(plan, command))
    assert after.names == ("command_delay",)
    left = after.posterior.probability("actuator_lag")
    assert left < 0.01 < runner_up
    # chance is of some four nats
    assert 0.4 * plan.expected_nats < -np.log(left) < 2.5 * plan.expected_nats


def test_what_the_drive_separates_is_the_cause_that_has_a_rival_and_not_another_one_beside_it(base):
    before = explained(base, late, 4)
    found, rival = (before.posterior.of_names([name]) for name in ("command_delay", "actuator_lag"))
    scaled = estimate(before.model, [OFFERED["gain_change"].at({"gain": 1.02}), *found.mechanisms])
    assert scaled.names[0] == "gain_change"
    assert rival.names == ("actuator_lag",)
    beside = SimpleNamespace(model=before.model, posterior=before.posterior, names=("command_delay",), best=scaled)
    plan, _ = next_recording(beside, (), 1)
    assert plan.separates == ("command_delay", "actuator_lag")


def test_the_evidence_says_by_how_much_the_nearest_rival_is_behind(base):
    found = explained(base, late, 4)
    likeliest = likeliest_causes(found, np.random.default_rng(0))
    assert [one.name for one in likeliest] == ["command_delay"]
    [cause] = reported_causes(found, likeliest)
    assert (cause.parameters, cause.form) == (likeliest[0].parameters, likeliest[0].form)
    forms = zip(found.posterior.sets, found.posterior.log_probability, strict=True)
    sets = dict(reversed([(one.names, log) for one, log in forms]))  # of several forms the likeliest, which comes first
    behind = sets["command_delay",] - sets["actuator_lag",]
    assert behind > 0
    assert f"the most probable set without it, actuator_lag, is less probable by {behind:.1f} nats" in cause.evidence
    assert f"log-likelihood of {len(found.model.session)} transitions rises by" in cause.evidence


def test_shares_of_the_gap_are_told_also_where_the_search_fitted_no_part_of_the_causes(base):
    found = explained(base, lambda moment: 1.15 * late(moment, 0.12), 6)
    assert set(found.names) == {"command_delay", "gain_change"}
    kept = [number for number, one in enumerate(found.posterior.sets) if len(one.names) != 1]
    posterior = replace(
        found.posterior,
        sets=tuple(found.posterior.sets[number] for number in kept),
        log_probability=found.posterior.log_probability[kept],
        log_odds_against=found.posterior.log_odds_against[kept],
    )
    shares = [
        {
            cause.name: cause.share_of_gap
            for cause in reported_causes(one, likeliest_causes(one, np.random.default_rng(0)))
        }
        for one in (found, replace(found, posterior=posterior))
    ]
    assert shares[1] == pytest.approx(shares[0], abs=0.02)


@pytest.mark.parametrize("periods", [402, 410])
def test_a_drive_has_as_many_periods_as_are_asked_for(base, periods):
    settings = DiagnosisSettings.parse({"next_recording": {"periods": periods}}, "here")
    _, command = next_recording(explained(base, late, 4, settings), (), 1)
    assert len(command) == periods


def test_where_nothing_is_wrong_the_drive_lowers_the_limits_as_far_as_it_says(base):
    """Gentle commands show little; the drive that is planned then has limits as much lower as was said."""
    rng, robot = np.random.default_rng(3), base.robot
    gentle = 0.25 * rng.uniform(robot.command_low, robot.command_high, (15, 24, len(robot.command)))
    before = explained(base, as_simulated, 4, command=gentle)
    found = detection_limits(before, kinds=OFFERED)
    plan, command = next_recording(before, found, 1)
    assert plan.separates == ()
    after = explained(base, as_simulated, 5, command=as_driven(plan, command))
    now, then = (
        {one.limit.cause: one.limit.share_of_range for one in limits}
        for limits in (found, detection_limits(after, kinds=OFFERED))
    )
    remaining = {name: then[name] / now[name] for name in now}
    assert plan.lowers["gain_change"] < 0.7
    assert remaining["gain_change"] == pytest.approx(plan.lowers["gain_change"], rel=0.3)


def test_no_other_drive_is_asked_for_where_none_lowers_the_limits(base):
    """Commands drawn over all that the robot can are as good as any candidate."""
    before = explained(base, as_simulated, 4)
    plan, _ = lowering_drive(before.model, detection_limits(before, kinds=OFFERED), 1)
    assert plan is None or np.mean(np.log(list(plan.lowers.values()))) < np.log(0.9)
