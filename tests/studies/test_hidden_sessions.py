"""The study's sessions: the same each time, effects as large as asked for, and nothing hidden in clean ones."""

import dataclasses
import functools
import itertools
import math
from dataclasses import replace

import hydra
import numpy as np
import pytest
from omegaconf import OmegaConf

from exact_model import SESSION_S, conditions_of
from swarmtwin.configuration import config_folder
from swarmtwin.errors import UserError
from swarmtwin.geometry import residual_between
from swarmtwin.recordings.blocks import in_blocks
from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.standin.effects import catalogue, parse_effects
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies import stand_in_families
from swarmtwin.studies.hidden_effects import sessions
from swarmtwin.studies.hidden_effects.cases import Case, cases
from swarmtwin.studies.hidden_effects.clean_sessions import VARIETIES, clean_session
from swarmtwin.studies.hidden_effects.effect_sizes import CATALOGUE, PARAMETERS, Draw
from swarmtwin.studies.hidden_effects.error_rise import PlainSimulation, size_that_raises
from swarmtwin.studies.hidden_effects.other_laws import OTHER_LAW_SIZES
from swarmtwin.studies.hidden_effects.outside_effects import OUTSIDE
from swarmtwin.studies.hidden_effects.sessions import (
    is_of_known_vehicle,
    made_effects,
    measured_session,
    record_session,
    reference_session,
    sized_entry,
)
from swarmtwin.studies.hidden_effects.study import Options
from swarmtwin.transitions import from_recording

SMALL = {"runs": 20, "steps": 20, "reference_runs": 30}


@pytest.fixture
def few_trees(monkeypatch):
    """Let the size of what hides be found with few trees: roughly as large as is asked for, in a tenth of the time."""
    monkeypatch.setattr(PlainSimulation, "learn", functools.partial(PlainSimulation.learn, rounds=10))


def same_recording(one, other):
    return all(
        np.array_equal(getattr(own, name), getattr(others, name), equal_nan=True)
        for own, others in zip(one.tracks, other.tracks, strict=True)
        for name in ("time_s", "command", "pose")
    )


def test_the_same_seed_draws_the_same_cases_and_more_of_them_change_none():
    for kind in ("one", "two", "misspecified", "outside", "clean"):
        few, many = cases("formulas", kind, 5, 7), cases("formulas", kind, 9, 7)
        assert many[:5] == few
        assert len({case.key for case in many}) == 9
        assert cases("formulas", kind, 5, 8) != few
        assert cases("unruly", kind, 5, 7) != few


def test_all_effects_and_varieties_take_turns():
    for kind, known in (("one", CATALOGUE), ("outside", OUTSIDE), ("clean", VARIETIES)):
        turns = {(robot, name) for name, fits in known.items() for robot in ("mgr", "mur") if robot in fits}
        drawn = cases("formulas", kind, 2 * len(turns), 3)
        assert {(case.robot, case.about) for case in drawn[: len(turns)]} == turns
        assert {(case.robot, case.about) for case in drawn[len(turns) :]} == turns
    assert set(CATALOGUE) == set(PARAMETERS) == set(catalogue())


def test_rises_are_spread_evenly_over_a_logarithmic_scale():
    rises = np.array([case.rises_percent[0] for case in cases("formulas", "one", 400, 3)])
    share = np.log(rises) / math.log(60.0)
    assert np.histogram(share, 4, (0, 1))[0] == pytest.approx(np.full(4, 100), abs=35)
    several = [rise for case in cases("formulas", "three", 60, 3) for rise in case.rises_percent]
    assert min(several) >= 5.0


def test_effects_that_hide_together_differ_and_a_delay_is_never_beside_a_lag():
    for case in cases("formulas", "three", 60, 3):
        assert len(set(case.names)) == 3
        assert not {"command_delay", "actuator_lag"} <= set(case.names)


@pytest.mark.usefixtures("few_trees")
def test_effects_that_make_the_rigid_body_unstable_together_are_halved_until_they_do_not(monkeypatch):
    film, asked = sessions._film, []

    def unstable(plan, robot, case, most_percent=15.0):
        if plan.session.effects and asked[-1] > most_percent:
            raise ArithmeticError("the rigid-body engine became unstable")
        return film(plan, robot, case)

    def sized(name, rise_percent, *others):
        asked.append(rise_percent)
        assert others[-1] == rise_percent / 40.0  # of the largest
        return {"name": name, "gain": 1.0 + rise_percent / 100.0}

    monkeypatch.setattr(sessions, "_film", unstable)
    monkeypatch.setattr(sessions, "sized_effect", sized)
    case = Case(
        family="formulas", kind="one", robot="mgr", names=["gain_change"], rises_percent=[40.0], seed=3, **SMALL
    )
    assert record_session(case).truth.causes == {"gain_change": {"gain": 1.1}}
    assert asked == [40.0, 20.0, 10.0]
    monkeypatch.setattr(sessions, "_film", functools.partial(unstable, most_percent=0.0))
    with pytest.raises(ArithmeticError):
        record_session(case)


@pytest.mark.usefixtures("few_trees")
@pytest.mark.parametrize("family", ["formulas", "unruly"])
def test_a_case_is_recorded_the_same_each_time(family):
    case = Case(family=family, kind="one", robot="mgr", names=["gain_change"], rises_percent=[20.0], seed=3, **SMALL)
    first, again = record_session(case), record_session(case)
    assert same_recording(first.reference, again.reference)
    assert same_recording(first.measured, again.measured)
    assert first.truth.causes == again.truth.causes
    other = record_session(case.model_copy(update={"seed": 4}))
    assert not same_recording(first.measured, other.measured)
    assert not same_recording(first.reference, other.reference)


def test_the_largest_size_is_taken_where_none_is_large_enough_and_else_the_right_one():
    assert size_that_raises(20.0, (0.001, 1.0), lambda size: 300.0 * size**1.5) == pytest.approx(
        (20 / 300) ** (1 / 1.5)
    )
    assert size_that_raises(20.0, (0.001, 0.1), lambda size: 100.0 * size) == 0.1
    # where larger ones cannot be had, an engine says nothing of them
    found = size_that_raises(20.0, (0.001, 1.0), lambda size: 100.0 * size if size < 0.5 else float("inf"))
    assert found == pytest.approx(0.2, rel=0.05)
    assert 0.0 < size_that_raises(20.0, (0.001, 1.0), lambda size: float("inf")) < 0.002
    # below a threshold nothing happens at all
    found = size_that_raises(20.0, (0.001, 1.0), lambda size: max(0.0, 100.0 * (size - 0.3)))
    assert found == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize(("name", "wanted"), [("gain_change", 40.0), ("command_delay", 15.0), ("random_ground", 30.0)])
def test_an_effect_raises_the_error_by_about_what_is_asked_for(name, wanted):
    kind = "one" if name in CATALOGUE else "outside"
    case = Case(family="formulas", kind=kind, robot="mgr", names=[name], rises_percent=[wanted], seed=5)
    truth = record_session(case).truth
    assert truth.rise_percent == pytest.approx(wanted, rel=0.35)
    assert set(truth.causes) == ({name} if kind == "one" else set())


@pytest.mark.usefixtures("few_trees")
def test_the_twin_differs_by_the_effect_alone():
    case = Case(family="unruly", kind="one", robot="mgr", names=["camera_scale"], rises_percent=[30.0], seed=3, **SMALL)
    truth = record_session(case).truth
    measured, twin = truth.measured.footage, truth.twin.footage
    np.testing.assert_array_equal(measured.state, twin.state)  # the camera changes no motion
    np.testing.assert_array_equal(measured.command, twin.command)
    assert not np.array_equal(measured.pose, twin.pose, equal_nan=True)
    assert truth.twin.footage.session.effects == ()


@pytest.mark.usefixtures("few_trees")
def test_the_spread_of_a_clock_that_is_never_steady_is_told_as_a_recording_shows_it():
    case = Case(family="unruly", kind="one", robot="mgr", names=["timing_jitter"], rises_percent=[20.0], seed=3)
    truth = record_session(case).truth
    shown = truth.measured.footage.duration_s.std() / 0.5
    assert truth.causes["timing_jitter"]["spread"] == pytest.approx(shown, rel=0.05)


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_a_patch_is_told_where_the_camera_shows_it(robots, robot):
    """As a camera sees points on its edge: closer to the middle by a scale, and a lens makes it larger or smaller."""
    robot = robots[robot]
    patch = {"x_mm": 400.0, "y_mm": 300.0, "radius_mm": 150.0}
    centre = (robot.arena_mm.low_mm + robot.arena_mm.high_mm) / 2

    def told(*entries):
        session = StandInSession(robot, ("1",), 1, 10, 0, effects=made_effects(entries, plain))
        return sessions.as_seen(patch, session)

    plain = StandInSession(robot, ("1",), 1, 10, 0)
    marker = {"name": "marker_offset", "forward_mm": 20.0, "left_mm": 0.0}
    assert told() == pytest.approx(patch)
    assert told(marker) == pytest.approx(patch)
    scaled = told(marker, {"name": "camera_scale", "scale": 0.9})
    assert [scaled["x_mm"], scaled["y_mm"]] == pytest.approx(centre + 0.9 * (np.array([400.0, 300.0]) - centre))
    assert scaled["radius_mm"] == pytest.approx(135.0)
    bent = told({"name": "lens_distortion", "coefficient": 0.2})
    assert bent["radius_mm"] > 151
    assert np.linalg.norm([bent["x_mm"] - centre[0], bent["y_mm"] - centre[1]]) > np.linalg.norm(
        np.array([400.0, 300.0]) - centre
    )


@pytest.mark.usefixtures("few_trees")
def test_a_patch_is_told_on_the_floor_by_who_names_what_the_camera_does_to_it():
    about = {"names": ["camera_scale", "surface_patch"], "rises_percent": [30.0, 20.0]}
    truth = record_session(Case(family="formulas", kind="two", robot="mgr", seed=3, **about, **SMALL)).truth
    scale, patch = truth.effects
    x_mm = truth.causes["surface_patch"]["x_mm"]
    assert x_mm == pytest.approx(515 + scale["scale"] * (patch["x_mm"] - 515))
    assert truth.causes_beside(["surface_patch"]) == truth.causes
    told = truth.causes_beside(["surface_patch", "camera_scale"])["surface_patch"]
    assert told == pytest.approx({key: value for key, value in patch.items() if key != "name"})


def z_scores(filmed):
    """How many standard errors, with runs as blocks, residuals against exact means depend on this and that."""
    transitions = filmed.transitions
    residual = residual_between(filmed.least_displacement(transitions), transitions.displacement)
    spread = np.maximum(transitions.command.std(axis=0), 1e-9)
    place = transitions.pose[:, :2] - transitions.pose[:, :2].mean(axis=0)
    columns = [
        np.ones((len(transitions), 1)),
        (transitions.command - transitions.command.mean(axis=0)) / spread,
        place / place.std(axis=0),
        np.stack([np.cos(transitions.pose[:, 2]), np.sin(transitions.pose[:, 2])], axis=1),
        ((transitions.time_s - transitions.time_s.mean()) / transitions.time_s.std())[:, None],
    ]
    products = residual[:, :, None] * np.concatenate(columns, axis=1)[:, None, :]
    _, run = np.unique(transitions.run, return_inverse=True)
    by_run = np.zeros((run.max() + 1, *products.shape[1:]))
    np.add.at(by_run, run, products)
    return by_run.sum(axis=0) / np.sqrt((by_run**2).sum(axis=0))


def test_a_clean_session_moves_as_the_exact_means_say():
    """Residuals, by command, place, heading and time, are within their standard errors: root mean square about 1."""
    scores = []
    for number, (robot, variety) in enumerate(
        [("mgr", "mixed"), ("mgr", "smooth"), ("mgr", "other_arena"), ("mgr", "group"), ("mur", "held")]
    ):
        for family in ("formulas", "unruly"):
            case = Case(family=family, kind="clean", robot=robot, variety=variety, seed=11 + number, runs=60, steps=20)
            truth = record_session(case).truth
            assert truth.causes == {}
            assert truth.rise_percent == 0.0
            scores.append(z_scores(truth.measured).ravel())
    size = np.sqrt(np.mean(np.concatenate(scores) ** 2))
    assert 0.8 < size < 1.2, size


def test_exact_means_of_long_runs_are_those_of_the_blocks_that_a_diagnosis_cuts_them_into():
    case = Case(family="formulas", kind="clean", robot="mgr", variety="long_runs", seed=5, runs=40)
    filmed = record_session(case).truth.measured
    blocks = replace(filmed.recording, tracks=in_blocks(filmed.recording.tracks, fewest=40))
    cut = from_recording(blocks)[0]
    assert len(cut.runs) > len(filmed.transitions.runs)
    whole = filmed.least_displacement(filmed.transitions)
    rows = [np.flatnonzero(np.isclose(filmed.transitions.time_s, time_s))[0] for time_s in cut.time_s]
    np.testing.assert_array_equal(filmed.least_displacement(cut), whole[rows])


def test_the_same_scores_see_an_effect():
    case = Case(family="formulas", kind="one", robot="mgr", names=["steady_drift"], rises_percent=[10.0], seed=2)
    truth = record_session(case).truth
    clean = replace(truth.twin.footage.session)
    blind = dataclasses.replace(truth.measured, footage=replace(truth.measured.footage, session=clean))
    assert np.abs(z_scores(blind)).max() > 7
    assert np.abs(z_scores(truth.measured)).max() < 5


def usual_session(robots, robot="mgr", **more):
    return StandInSession(robots[robot], ("3",), 100, 40, 5, **more)


def test_clean_sessions_differ_as_their_variety_says(robots):
    usual = usual_session(robots)

    def changed(variety):
        return clean_session(variety, usual, np.random.default_rng(4))

    plain = changed("plain").session
    assert all(
        getattr(plain, one.name) == getattr(usual, one.name)
        for one in dataclasses.fields(usual)
        if one.compare and one.init
    )
    assert changed("smooth").session.command_mode == "smooth"
    assert (changed("short_runs").session.runs, changed("short_runs").session.steps) == (400, 10)
    assert (changed("long_runs").session.runs, changed("long_runs").session.steps) == (40, 100)
    assert changed("few_transitions").session.runs * 40 == 600
    assert changed("many_transitions").session.runs * 40 == 10_000
    assert changed("group").session.vehicles[0] == "3"
    assert len(set(changed("group").session.vehicles)) in (2, 3)
    assert changed("other_arena").session.robot.arena_mm != usual.robot.arena_mm
    assert 0.02 <= changed("lost_poses").session.lost_poses <= 0.1
    assert changed("time_of_day").session.starts_s >= 1800
    assert 1.5 <= changed("camera_noise").pose_noise <= 3.0


@pytest.mark.parametrize(
    ("variety", "least", "most"), [("plain", 0.4, 0.75), ("mixed", 0.4, 0.75), ("other_vehicle", 0, 0)]
)
def test_clean_sessions_are_of_other_vehicles_as_often_as_hidden_ones(robots, variety, least, most):
    drawn = [Case(family="formulas", kind="clean", robot="mgr", variety=variety, seed=seed) for seed in range(80)]
    own = [
        measured_session(case, robots["mgr"]).session.vehicles[0] == reference_session(case, robots["mgr"]).vehicles[0]
        for case in drawn
    ]
    assert least <= np.mean(own) <= most


def test_a_reference_of_several_vehicles_holds_as_much_of_each_and_nothing_of_another_that_is_measured(robots):
    for seed in range(6):
        case = Case(family="formulas", kind="clean", robot="mgr", variety="plain", seed=seed, runs=8, steps=6)
        case = case.model_copy(update={"reference_runs": 20, "reference_vehicles": 5})
        reference, measured, truth = record_session(case)
        assert len(reference.vehicles) == len(set(reference.vehicles)) == 5
        assert {vehicle: reference.where(of(vehicle)).runs for vehicle in reference.vehicles} == {
            vehicle: tuple(f"vehicle_{vehicle}_run_000{number}" for number in range(1, 5))
            for vehicle in reference.vehicles
        }
        first = reference_session(case, robots["mgr"]).vehicles[0]
        assert first in reference.vehicles
        assert truth.same_vehicle == is_of_known_vehicle(case) == (measured.vehicles == (first,))
        assert truth.same_vehicle or measured.vehicles[0] not in reference.vehicles
        assert same_recording(record_session(case).reference, reference)


def drawn(*changes):
    """The cases of a study, with changes of its options."""
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        composed = hydra.compose("experiment/hidden_effects", ["families=[formulas]", "output=study", *changes])
    return Options.parse(OmegaConf.to_container(composed, resolve=True), "hidden_effects").drawn_cases()


def test_sessions_of_one_sort_of_vehicle_are_those_of_any_without_the_others():
    counts = ("count.quick.one=12", "count.quick.clean=12", "reference_vehicles=3")
    everything, known, another = (drawn(*counts, f"vehicle={one}") for one in ("any", "known", "another"))
    assert [case for case in everything if case in known] == known
    assert [case for case in everything if case in another] == another
    assert len(known) + len(another) == len(everything)
    assert min(len(known), len(another)) > 5
    assert {case.reference_vehicles for case in everything} == {3}


def of(vehicle):
    return lambda track: track.vehicle == vehicle


def test_a_clean_recording_holds_its_own_arena_its_clock_and_its_noise(robots):
    arena = record_session(Case(family="formulas", kind="clean", robot="mgr", variety="other_arena", seed=3, **SMALL))
    assert arena.measured.header.arena_mm != robots["mgr"].arena_mm
    assert arena.measured.robot == robots["mgr"]
    position_mm = np.concatenate([track.pose[:, :2] for track in arena.measured.tracks])
    assert (np.nanmin(position_mm, axis=0) > arena.measured.header.arena_mm.low_mm - 10).all()
    later = record_session(Case(family="formulas", kind="clean", robot="mgr", variety="time_of_day", seed=3, **SMALL))
    assert later.measured.tracks[0].time_s[0] == later.truth.measured.footage.session.starts_s >= 1800
    case = Case(family="formulas", kind="clean", robot="mgr", variety="camera_noise", seed=3, runs=40, steps=20)
    noisy = record_session(case)
    true = np.moveaxis(noisy.truth.measured.footage.state[:3, :, :, 0], 0, -1)
    away_mm = np.stack([track.pose for track in noisy.measured.tracks])[..., :2] - true[..., :2]
    wanted = clean_session("camera_noise", usual_session(robots), case.rng("none")).pose_noise
    assert 1.5 <= wanted <= 3.0
    assert 1.4 < np.nanstd(away_mm) < 3.1


def test_every_effect_makes_sense_at_its_smallest_and_largest_size(robots):
    for name, sizes in {**CATALOGUE, **OTHER_LAW_SIZES, **OUTSIDE}.items():
        for robot, ends in sizes.items():
            case = Case(family="formulas", kind="outside", robot=robot, names=[name], rises_percent=[1.0], seed=1)
            session = dataclasses.replace(reference_session(case, robots[robot]), vehicles=("1", "2"))
            for size in ends:
                assert len(made_effects((sized_entry(name, size, case, session),), session)) == 1


def test_every_hidden_effect_lies_within_what_its_mechanism_can_be(robots):
    for name, sizes in CATALOGUE.items():
        for robot, ends in sizes.items():
            possible = mechanism_class(name).parameters_of(robots[robot], conditions_of(robots[robot]))
            for size, seed in itertools.product(ends, range(5)):
                drawn = Draw(size, robots[robot], 60.0, SESSION_S, np.random.default_rng(seed))
                for parameter, value in PARAMETERS[name](drawn).items():
                    if parameter in possible:
                        allowed = possible[parameter]
                        assert allowed.low <= value <= allowed.high, (name, robot, parameter, value)


def test_an_engine_that_is_not_there_is_refused_with_the_remedy(monkeypatch):
    monkeypatch.setattr(stand_in_families, "find_spec", lambda name: object() if "rigid" in name else None)
    with pytest.raises(UserError, match=r"family 'rigid_body' needs MuJoCo: pip install"):
        cases("rigid_body", "one", 1, 1)
    assert not stand_in_families.is_available("rigid_body")
    with pytest.raises(UserError, match="no such kind of session: 'pair'"):
        cases("formulas", "pair", 1, 1)


@pytest.mark.usefixtures("few_trees")
def test_hidden_effects_are_those_of_record(robots):
    case = Case(family="formulas", kind="one", robot="mur", names=["backlash"], rises_percent=[20.0], seed=6, **SMALL)
    truth = record_session(case).truth
    assert parse_effects(truth.effects, robots["mur"], 1) == truth.measured.footage.session.effects
