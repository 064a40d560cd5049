"""What is planted is found again: parameters, their uncertainty, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from exact_base import ExactBase, Losing, as_simulated, known_noise, session_of
from scipy import stats

from exact_model import MM_PER_PWM, TRACK_MM, conditions_of
from swarmtwin.diagnosis.cause_search import CauseSearch
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.geometry import compose, displacement_between, exp_map
from swarmtwin.simulation.mechanism import mechanism_class

MIDDLE_MM = 515.0
SESSIONS = 80


def gained(factor):
    return lambda moment: exp_map(moment.way * factor)


def late(share):
    return lambda moment: compose(exp_map(moment.way_before * share), exp_map(moment.way * (1 - share)))


def drifted(x_mm, y_mm):
    def moved(moment):
        end = compose(moment.pose, exp_map(moment.way))
        return displacement_between(moment.pose, end + torch.tensor([x_mm, y_mm, 0.0], dtype=torch.float64))

    return moved


def understood(model, start):
    """Values estimated with the noise of what they leave, as a diagnosis reports them."""
    first = estimate(model, start)
    return estimate(model.explained_by(first.mechanisms), first.mechanisms)


def of_form(share):
    """Settings by which a mechanism's form is wrong by a share of its effect, for its interval as well."""
    return DiagnosisSettings.parse({"likelihood": {"form": share}, "estimation": {"form": share}}, "here")


def stretched(scale):
    return lambda pose: torch.cat([MIDDLE_MM + scale * (pose[:, :2] - MIDDLE_MM), pose[:, 2:]], dim=-1)


def turned(angle_rad):
    return lambda pose: pose + torch.tensor([0.0, 0.0, angle_rad], dtype=torch.float64)


PLANTED = {
    "gain_change": ({"gain": 0.9}, {"gain": 1.2}, {"moved": gained(0.9)}),
    "command_delay": ({"delay_s": 0.12}, {"delay_s": 0.2}, {"moved": late(0.24)}),
    "steady_drift": ({"x_mm_s": 2.0, "y_mm_s": -3.0}, {"x_mm_s": 0.0, "y_mm_s": 0.0}, {"moved": drifted(1.0, -1.5)}),
    "marker_yaw": ({"angle_rad": 0.15}, {"angle_rad": -0.1}, {"seen": turned(0.15)}),
    "camera_scale": ({"scale": 1.08}, {"scale": 1.0}, {"seen": stretched(1.08)}),
    "command_loss": ({"probability": 0.12}, {"probability": 0.4}, {"moved": Losing(0.12, 3)}),
}
LARGEST_ERROR = {
    "gain_change": 0.005,
    "command_delay": 0.005,
    "steady_drift": 0.2,
    "marker_yaw": 0.01,
    "camera_scale": 0.005,
    "command_loss": 0.02,
}


@pytest.mark.parametrize("name", sorted(PLANTED))
def test_a_planted_parameter_is_recovered_within_its_standard_errors(robots, name):
    planted, begun, happening = PLANTED[name]
    base = ExactBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(21), **happening)
    model = SessionLikelihood(base, known_noise(), session, settings=of_form(0.05))
    found = understood(model, [mechanism_class(name).at(begun)])
    error = np.sqrt(np.diag(found.covariance))
    wanted = np.array(list(planted.values()))
    assert (error < LARGEST_ERROR[name]).all(), error
    assert (abs(found.values - wanted) < 3 * error).all(), (found.values, wanted, error)
    assert estimate(model, found.mechanisms).evidence > estimate(model, []).evidence + 100


@pytest.mark.parametrize("probability", [0.01, 0.05, 0.15])
@pytest.mark.parametrize("seed", range(3))
def test_of_how_many_commands_are_lost_no_more_is_known_than_by_counting_them(robots, probability, seed):
    """What the camera errs lasts into the next transition, so that there it matters which course the last one took."""
    base, rng, camera = ExactBase(robots["mgr"]), np.random.default_rng(seed), np.array([4.0, 4.0, 0.03])
    gentle = rng.uniform(base.robot.command_low, base.robot.command_high, (30, 60, 2)) / 4
    session = session_of(base, rng, moved=Losing(probability, seed), camera=camera, command=gentle)
    model = SessionLikelihood(base, replace(known_noise(), camera=camera**2), session)
    found = estimate(model, [mechanism_class("command_loss").at({"probability": 0.05})])
    (share,) = found.values
    counted = len(session) / (share * (1 - share))
    assert 0.25 * counted < found.information[0, 0] < counted
    assert abs(share - probability) < 3.5 / np.sqrt(found.information[0, 0])


class Levelling(ExactBase):
    """Wheels whose speeds level off, as a screw's thrust does: three quarters of the straight line at full effort."""

    def twist(self, command):
        full = torch.as_tensor(self.robot.command_high)
        return super().twist(full * torch.tanh(command / full))


def weakened_by_a_fifth(moment):
    return 0.8


def weakened_with_time(moment):
    robot, run = moment.base.robot, torch.arange(len(moment.command))
    elapsed_s = (run * 40 + moment.step) * robot.period_s  # as `session_of` writes them
    return (1 - 0.5 * conditions_of(robot).progress(elapsed_s))[:, None]


@pytest.mark.parametrize(
    ("name", "share", "value", "begun"),
    [
        ("gain_change", weakened_by_a_fifth, 0.8, {"gain": 1.0}),
        ("battery_sag", weakened_with_time, 0.5, {"loss": 0.2, "shape": 1.5}),
    ],
)
@pytest.mark.parametrize("on_effort", [False, True])
def test_a_session_shows_whether_the_speed_or_the_effort_is_weaker(robots, name, share, value, begun, on_effort):
    base = Levelling(robots["mgr"])

    def moved(moment):
        if on_effort:
            return exp_map(base.twist(moment.command * share(moment)))
        return exp_map(moment.way * share(moment))

    model = SessionLikelihood(base, known_noise(), session_of(base, np.random.default_rng(24), moved))
    on_speed, on_efforts = (estimate(model, [form.at(begun)]) for form in mechanism_class(name).forms(model.robot))
    assert (on_speed.mechanisms[0].acts_on, on_efforts.mechanisms[0].acts_on) == ("speed", "effort")
    right, wrong = (on_efforts, on_speed) if on_effort else (on_speed, on_efforts)
    assert right.evidence > wrong.evidence + 10
    assert abs(right.values[0] - value) < 3 * np.sqrt(right.covariance[0, 0]) < 0.15


def test_a_search_ends_at_the_same_likelihood_wherever_it_begins(robots):
    base = ExactBase(robots["mgr"])
    model = SessionLikelihood(base, known_noise(), session_of(base, np.random.default_rng(22), late(0.24)))
    kind = mechanism_class("command_delay")
    found = [understood(model, [kind.at({"delay_s": begun})]) for begun in (0.05, 0.12, 0.2, 0.3)]
    assert np.ptp([one.values[0] for one in found]) < 0.2 * np.sqrt(found[0].covariance[0, 0])
    assert np.ptp([one.evidence for one in found]) < 0.5


def test_two_planted_causes_are_recovered_together(robots):
    base = ExactBase(robots["mgr"])
    happening = {"moved": late(0.2), "seen": turned(-0.1)}
    model = SessionLikelihood(base, known_noise(), session_of(base, np.random.default_rng(22), **happening))
    kinds = ({"delay_s": 0.02}, "command_delay"), ({"angle_rad": 0.0}, "marker_yaw")
    known = understood(model, [mechanism_class(name).at(begun) for begun, name in kinds])
    assert (abs(known.values - [0.1, -0.1]) < 3 * np.sqrt(np.diag(known.covariance))).all()


def test_without_anything_unknown_the_evidence_is_the_likelihood(robots):
    base = ExactBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(23))
    exact = DiagnosisSettings.parse({"noise": {"set_scale_spread": 1e-6}}, "here")
    model = SessionLikelihood(base, known_noise(), session, settings=exact)
    expected = model.noise.log_likelihood(model.errors([]), model.motion, session)
    assert estimate(model, []).evidence == pytest.approx(expected, abs=0.01)
    assert model.effects.log_determinant == 0.0


def test_a_cause_that_is_not_there_has_less_evidence_than_none(robots):
    """By the price of a parameter that is free within its bounds: half the log of how much better it is known."""
    base = ExactBase(robots["mgr"])
    behind = []
    for seed in range(12):
        model = SessionLikelihood(base, known_noise(), session_of(base, np.random.default_rng(100 + seed), runs=30))
        found = estimate(model, [mechanism_class("gain_change").at({"gain": 1.1})])
        behind.append(estimate(model, []).evidence - found.evidence)
    width = float(np.sqrt(2 * np.pi * found.covariance[0, 0]))
    gain = mechanism_class("gain_change").parameters["gain"]
    assert np.mean(behind) == pytest.approx(np.log(gain.size / width) - 0.5, abs=1.0)
    assert min(behind) > 0


def each_run_its_own(factor, spread, seed):
    """Gains that differ from run to run, as wheels pick up dust: N(factor, spread)."""
    own = {}

    def moved(moment):
        if moment.step == 0:
            own["gain"] = torch.as_tensor(np.random.default_rng(seed).normal(factor, spread, (len(moment.pose), 1)))
        return exp_map(moment.way * own["gain"])

    return moved


def test_what_is_known_to_be_there_is_no_trait_of_a_vehicle_that_nobody_knows(robots):
    """Of a swimmer that steers by a fin, whose trim may be another one: a drift stays a drift."""
    base = ExactBase(robots["mur"])
    session = session_of(base, np.random.default_rng(25), drifted(6.0, -4.0))
    drift = mechanism_class("steady_drift").at({"x_mm_s": 6.0 / 0.8, "y_mm_s": -4.0 / 0.8})
    alone = SessionLikelihood(base, known_noise(), session)
    strange = SessionLikelihood(base, known_noise(), session, known_vehicles=("another",))
    for model in (alone, strange):
        explained = model.explained_by([drift])
        assert explained.evaluate([drift]).total > explained.evaluate([]).total + 1000
    found = understood(strange, [drift])
    assert (abs(found.values - list(drift.values().values())) < 3 * np.sqrt(np.diag(found.covariance))).all()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_sharp_edge_is_found_where_it_is(robots, seed):
    """As a surface through losses around it does not: those rise to both sides by other shares."""
    base, kind, rng = ExactBase(robots["mgr"]), mechanism_class("surface_patch"), np.random.default_rng(seed)
    true = np.array([520.0, 480.0, 160.0])

    def moved(moment):
        inside = (moment.pose[:, :2] - torch.as_tensor(true[:2])).norm(dim=1, keepdim=True) < true[2]
        return exp_map(moment.way * torch.where(inside, 0.7, 1.0))

    model = SessionLikelihood(base, known_noise(), session_of(base, rng, moved))
    begun = [kind.at({"x_mm": 530.0, "y_mm": 470.0, "radius_mm": 170.0, "loss": 0.25})]
    polished, found = (estimate(model, begun, polish=True, final=final) for final in (False, True))
    effects = model.effects_with(polished.mechanisms)
    losses = [effects.loss(model.whitened(one.mechanisms).ravel()) for one in (polished, found)]
    assert losses[1] <= losses[0]
    assert np.abs(found.values[:3] - true).max() < 6.0


@pytest.mark.claims
def test_the_place_of_an_edge_is_known_as_well_as_it_says(robots):
    """A patch whose effect is not quite of the form that is fitted: on it all is slower by a share that swings."""
    base, kind = ExactBase(robots["mgr"]), mechanism_class("surface_patch")
    true = np.array([520.0, 480.0, 160.0])
    away = []
    for seed in range(12):
        rng = np.random.default_rng(2000 + seed)

        def moved(moment, rng=rng):
            inside = (moment.pose[:, :2] - torch.as_tensor(true[:2])).norm(dim=1, keepdim=True) < true[2]
            loss = torch.as_tensor(rng.normal(0.4, 0.2, (len(inside), 1)))
            return exp_map(moment.way * torch.where(inside, 1 - loss, torch.ones_like(loss)))

        model = SessionLikelihood(base, known_noise(), session_of(base, rng, moved))
        begun = kind.at({"x_mm": 530.0, "y_mm": 470.0, "radius_mm": 170.0, "loss": 0.3})
        first = estimate(model, [begun])
        found = estimate(model.explained_by(first.mechanisms), first.mechanisms, polish=True, final=True)
        away.append((found.values[:3] - true) / np.sqrt(np.diag(found.covariance))[:3])
    assert np.sqrt(np.mean(np.square(away))) < 1.6, away


@pytest.mark.claims
@pytest.mark.parametrize("run_spread", [0.0, 0.03])
def test_intervals_cover_as_often_as_they_say_also_where_runs_differ(robots, run_spread):
    """As reported; fewer than the binomial distribution's 1 % point refute 95 %."""
    kind = mechanism_class("gain_change")
    base = ExactBase(robots["mgr"])
    covered = 0
    for seed in range(SESSIONS):
        rng = np.random.default_rng(1000 + seed)
        session = session_of(base, rng, each_run_its_own(0.92, run_spread, 5000 + seed), runs=40, steps=15)
        model = SessionLikelihood(base, known_noise(), session)
        known = estimate(model, [kind.at({"gain": 1.0})])
        low, high = np.quantile(known.draws(400, rng)[:, 0], [0.025, 0.975])
        covered += low <= 0.92 <= high
    assert covered >= stats.binom.ppf(0.01, SESSIONS, 0.95), covered


def test_draws_spread_as_the_covariance_says(robots):
    base = ExactBase(robots["mgr"])
    rng = np.random.default_rng(24)
    model = SessionLikelihood(base, known_noise(), session_of(base, rng, drifted(1.0, 1.0)))
    known = estimate(model, [mechanism_class("steady_drift").at({"x_mm_s": 0.0, "y_mm_s": 0.0})])
    drawn = known.draws(4000, rng)
    np.testing.assert_allclose(np.cov(drawn.T), known.covariance, rtol=0.15, atol=0.1 * known.covariance.max())


def drift_error(robot, runs, form):
    base = ExactBase(robot)
    settings = of_form(form)
    session = session_of(base, np.random.default_rng(25), drifted(1.0, 0.0), runs=runs)
    model = SessionLikelihood(base, known_noise(), session, settings=settings)
    found = estimate(model, [mechanism_class("steady_drift").at({"x_mm_s": 1.0, "y_mm_s": 0.0})])
    return float(found.covariance[0, 0] ** 0.5)


def test_more_runs_make_intervals_narrower_by_the_root_but_not_than_the_form_is_known(robots):
    exact = [drift_error(robots["mgr"], runs, 1e-6) for runs in (40, 160)]
    assert exact[0] / exact[1] == pytest.approx(2, rel=0.15)
    assert drift_error(robots["mgr"], 160, 0.2) > 1.5 * exact[1]


def test_the_error_of_a_gain_is_that_of_least_squares_and_of_the_form_that_nobody_knows(robots):
    base = ExactBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(26), as_simulated, runs=100)
    model = SessionLikelihood(base, known_noise(), session)
    known = estimate(model, [mechanism_class("gain_change").at({"gain": 1.1})])
    left, right = (MM_PER_PWM * session.situation.command).numpy().T
    information = (((left + right) / 2) ** 2).sum() + (((right - left) / TRACK_MM / 0.02) ** 2).sum()
    assert float(known.covariance[0, 0]) == pytest.approx(1 / information, rel=0.35)


@pytest.mark.parametrize("lossy", [False, True])
def test_vehicles_in_contact_say_nothing_of_how_one_goes(robots, lossy):
    """Nearer than half a width, centre to centre; a vehicle next to another does count."""
    base = ExactBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(4), runs=10)
    close = np.arange(len(session)) % 7 == 3
    mechanisms = [mechanism_class("command_loss").at({"probability": 0.02})] if lossy else []

    def change(width_share):
        """Likelihoods where vehicles that are so close go as all do, and where they are pushed ahead."""
        away_mm = np.where(close, width_share * min(base.robot.vehicle_size_mm), 400.0)
        neighbours = np.stack([away_mm, np.zeros(len(session)), np.zeros(len(session))], axis=-1)[:, None]
        plain = replace(session.transitions, neighbours=neighbours)
        pushed = replace(plain, displacement=plain.displacement + 8 * close[:, None] * np.array([1.0, 0.0, 0.0]))
        measured = (MeasuredSession.of(transitions, session.conditions) for transitions in (plain, pushed))
        return [SessionLikelihood(base, known_noise(), one).evaluate(mechanisms) for one in measured]

    contact, apart = change(0.4), change(0.6)
    assert (contact[1].log_likelihood[close] == 0).all()
    lost_nats = [before.total - after.total for before, after in (contact, apart)]
    assert abs(lost_nats[0]) < 0.1 * lost_nats[1]


def test_periods_that_last_too_long_all_along_are_no_gain(robots):
    """The clock says why vehicles go 4 % further, and needs no parameter for it."""
    base = ExactBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(6), moved=gained(1.04))
    slow = replace(session.transitions, duration_s=1.04 * session.transitions.duration_s)
    model = SessionLikelihood(base, known_noise(), MeasuredSession.of(slow, session.conditions))
    clock = mechanism_class("timing_jitter")
    assert model.can_show(clock)
    search = CauseSearch(model, {name: mechanism_class(name) for name in ("timing_jitter", "gain_change")})
    assert search.run().best.names == ("timing_jitter",)
    on_time = SessionLikelihood(base, known_noise(), session)
    assert not on_time.can_show(clock)
