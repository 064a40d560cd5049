"""Each mechanism, hidden in sessions that it drives itself, is estimated with intervals that hold as often as they say.

Where forms and noise are known, nothing but the inference is tested (Cook, Gelman and Rubin, 2006); what an inexact
form costs, the study of hidden effects counts.
"""

import numpy as np
import pytest
from exact_base import ExactBase
from scipy import stats
from simulated_session import simulated_noise, simulated_session

from exact_model import conditions_of
from swarmtwin.configuration import config_folder
from swarmtwin.diagnosis.cause_report import reported_parameters
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.robot import Robot
from swarmtwin.simulation.mechanism import mechanism_class, offered

SESSIONS = 40

ESTIMATED = (
    *("command_loss", "command_delay", "dead_band", "saturation", "gain_change", "battery_sag"),
    *("actuator_asymmetry", "actuator_lag", "backlash", "surface_patch", "wall_effect", "steady_drift"),
    *("neighbour_interaction", "marker_offset", "marker_yaw", "camera_scale", "lens_distortion", "timing_jitter"),
)

WIDER_THAN_NEEDED = ("dead_band", "surface_patch")
"""Where edges in the likelihood tell more exactly than intervals say: truths lie too near what is said of them."""

CERTAIN = DiagnosisSettings.parse(
    {"likelihood": {"form": 1e-6, "rough_form": 1e-6}, "estimation": {"form": 1e-6}}, "here"
)


def drawn_values(kind, robot, rng):
    """Values between those that a search begins with, not nearly doing nothing."""
    side_mm = float(np.min(robot.arena_mm.high_mm - robot.arena_mm.low_mm))
    direction_rad = rng.uniform(-np.pi, np.pi)
    ways = np.array([np.cos(direction_rad), np.sin(direction_rad)])
    match kind.model_fields["name"].default:
        case "surface_patch":
            middle = robot.arena_mm.low_mm + (robot.arena_mm.high_mm - robot.arena_mm.low_mm) * rng.uniform(0.3, 0.7, 2)
            place = dict(zip(("x_mm", "y_mm"), middle.tolist(), strict=True))
            return {**place, "radius_mm": side_mm * rng.uniform(0.18, 0.32), "loss": rng.uniform(0.15, 0.6)}
        case "steady_drift":
            return dict(zip(("x_mm_s", "y_mm_s"), rng.uniform(1, 6) * ways, strict=True))
        case "timing_jitter":
            return {"spread": rng.uniform(0.02, 0.06)}
        case "command_loss":
            return {"probability": rng.uniform(0.02, 0.4)}
    values, points = {}, kind.initial_points(robot, conditions_of(robot))
    for name, parameter in kind.parameters_of(robot, conditions_of(robot)).items():
        low, high = (end(point[name] for point in points) for end in (min, max))
        value, null = rng.uniform(low, high) if low < high else low, parameter.null_value
        if null is not None and abs(value - null) < 0.1 * (high - low):
            value = null + np.copysign(0.2 * (high - low), value - null)
        values[name] = value
    return values


def every_form():
    """Robot, mechanism and number of each form that it may take on this robot."""
    for name in ESTIMATED:
        for robot in ("mgr", "mur"):
            body = Robot.load(config_folder() / "robot" / f"{robot}.yaml")
            yield from ((robot, name, form) for form in range(len(mechanism_class(name).forms(body))))


def standing(kind, robot, seed):
    """Of each parameter of a mechanism of drawn values, where the truth lies in its interval: −1 to 1 is within."""
    rng = np.random.default_rng([seed, 20261127])
    true = kind(**drawn_values(kind, robot, rng))
    pair = 2 if "neighbours" in kind.inputs else 1
    session = simulated_session(robot, [true], 100 + seed, vehicles=pair)
    model = SessionLikelihood(ExactBase(robot), simulated_noise(), session, settings=CERTAIN)
    found = estimate(model, [true], polish=True, final=True)
    places = {}
    for name, told in reported_parameters(model, found, rng)[true.name].items():
        away = true.reported()[name] - told.value
        if told.unit == "rad":
            away = np.angle(np.exp(1j * away))
        places[name] = away / (told.high - told.value if away > 0 else told.value - told.low)
    return places


@pytest.mark.claims
@pytest.mark.parametrize(("robot", "name", "form"), list(every_form()))
def test_intervals_hold_the_truth_as_often_as_they_say(robots, robot, name, form):
    """Fewer than the binomial distribution's point of 1 in 1,000 refute 95 %.

    Nor is any parameter estimated too high or too low by more than 0.3 standard errors, as far as these sessions show,
    and the truths' ranks in what is said of them are spread evenly, which Kolmogorov and Smirnov's test refutes below
    0.001 (simulation-based calibration: Talts et al., 2018); those of `WIDER_THAN_NEEDED` may lie too near the middle,
    and no farther from it. What these sessions say nothing of stays where a search begins, but for rounding, where the
    truth is as well, and has no ranks.
    """
    kind = mechanism_class(name).forms(robots[robot])[form]
    by_session = [standing(kind, robots[robot], seed) for seed in range(SESSIONS)]
    for parameter in by_session[0]:
        places = np.array([one[parameter] for one in by_session])
        held = int((abs(places) <= 1).sum())
        bias = 1.96 * float(places.mean())
        ranks = stats.norm.cdf(1.96 * places)
        if name in WIDER_THAN_NEEDED:
            even = stats.kstest(abs(2 * ranks - 1), "uniform", alternative="less").pvalue
        else:
            even = stats.kstest(ranks, "uniform").pvalue
        told = f"{held} of {SESSIONS}, bias {bias:+.2f} standard errors, ranks even with p = {even:.3f}"
        print(f"{robot} {name} {form} {parameter}: {told}")
        assert held >= stats.binom.ppf(0.001, SESSIONS, 0.95), (parameter, held, places.round(2))
        assert even > 0.001 or np.allclose(places, 0, atol=1e-9), (parameter, even, places.round(2))
        assert abs(bias) <= 0.3 + stats.norm.ppf(0.9995) / SESSIONS**0.5, (parameter, bias)


@pytest.mark.claims
@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_so_do_those_of_how_random_the_motion_is(robots, robot):
    held = 0
    for seed in range(SESSIONS):
        factor = np.exp(np.random.default_rng([seed, 3]).uniform(-0.5, 0.7))
        noisier = mechanism_class("noise_change").at({"factor": factor})
        session = simulated_session(robots[robot], [noisier], 500 + seed)
        log, error = SessionLikelihood(ExactBase(robots[robot]), simulated_noise(), session).motion_noise_log()
        held += abs(log - np.log(factor)) <= 1.96 * error
    assert held >= stats.binom.ppf(0.001, SESSIONS, 0.95), held


def test_no_mechanism_is_left_out(robots):
    for robot in ("mgr", "mur"):
        assert set(offered(robots[robot], conditions_of(robots[robot]))) == {*ESTIMATED, "noise_change"}
