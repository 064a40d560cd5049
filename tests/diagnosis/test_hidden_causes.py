"""Effects hidden in stand-ins: the diagnosis sees the recording alone, and must name them often enough.

What is hidden is drawn from all that could be, by one seed that was chosen before any result was seen. How many must be
right is the lower 1 % point of the binomial distribution of what is claimed: fewer refute the claim. Many more sessions
are drawn by `swarmtwin experiment name=hidden_effects`.
"""

from dataclasses import replace

import numpy as np
import pytest
from hidden_sessions import SEED, hidden, learned, nothing_hidden, usual, with_effects
from scipy import stats

from swarmtwin.diagnosis.diagnose import diagnose
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.clean_sessions import VARIETIES
from swarmtwin.studies.hidden_effects.effect_sizes import CATALOGUE
from swarmtwin.studies.hidden_effects.outside_effects import OUTSIDE

pytestmark = pytest.mark.claims
CLEAR = 30.0  # percent by which the effect raises the one-step error
ROBOTS = ("mgr", "mur")


def fewest(sessions, claimed):
    """The fewest right answers of so many sessions that do not refute a claimed share at the 1 % level."""
    return int(stats.binom.ppf(0.01, sessions, claimed))


def drawn(names, count, number):
    """So many of the names, drawn by the documented seed."""
    return [str(name) for name in np.random.default_rng([SEED, number]).permutation(sorted(names))[:count]]


def known_to(effects, robot):
    return [name for name, sizes in effects.items() if robot in sizes]


@pytest.fixture(scope="module")
def references(robots):
    return {name: learned(robots[name]) for name in ROBOTS}


def diagnosed(references, session):
    return diagnose(references[session.case.robot], session.recording, SEED).result


def not_worse(result):
    return result.gain.position_mm.after <= 1.005 * result.gain.position_mm.before


def test_clear_effects_are_named_first(robots, references):
    """Of clear effects, drawn from the whole catalogue, 85 % are claimed to be named first."""
    right, said = 0, []
    for number, robot in enumerate(ROBOTS):
        for name in drawn(known_to(CATALOGUE, robot), 4, number):
            session = hidden(robots[robot], name, CLEAR)
            result = diagnosed(references, session)
            named = [cause.name for cause in result.causes]
            right += named[:1] == list(session.case.true_names)
            said.append((session.about, result.verdict, named))
            assert not_worse(result), session.about
    assert right >= fewest(len(said), 0.85), said


def test_the_example_of_the_readme_is_answered_with_what_is_hidden(robots, references):
    """A delay looks like a lag, and both are half of what is wrong: the other half is the battery."""
    effects = ({"name": "battery_sag", "loss": 0.2}, {"name": "command_delay", "delay_s": 0.05})
    case = Case(family="formulas", kind="two", robot="mgr", names=[one["name"] for one in effects], seed=12)
    session = with_effects(case, usual(robots["mgr"], 100, 12), effects)
    result = diagnose(references["mgr"], session.recording, SEED).result
    causes = {cause.name: {name: one.value for name, one in cause.parameters.items()} for cause in result.causes}
    assert set(causes) == {"battery_sag", "command_delay"}
    assert causes["command_delay"]["delay_s"] == pytest.approx(0.05, abs=0.004)
    assert causes["battery_sag"]["loss"] == pytest.approx(0.2, abs=0.015)


def test_nothing_is_named_where_nothing_is_wrong(robots, references):
    """No session is accused, other units included: at the claimed level of 1 % one of six would be with 6 %."""
    for number, robot in enumerate(ROBOTS):
        too_short = "few_transitions"  # of these sessions, which are short themselves
        others = {variety for variety, fits in VARIETIES.items() if robot in fits} - {"other_vehicle", too_short}
        for variety in ("other_vehicle", *drawn(others, 2, 2 + number)):
            session = nothing_hidden(robots[robot], variety)
            result = diagnosed(references, session)
            assert not result.causes, (session.about, result.causes)
            assert not_worse(result), session.about


def test_what_the_catalogue_does_not_know_is_not_named(robots, references):
    """Of clear effects outside the catalogue, 90 % are claimed to be noticed and to get no name."""
    right, said = 0, []
    for number, robot in enumerate(ROBOTS):
        for name in drawn(known_to(OUTSIDE, robot), 2, 4 + number):
            session = hidden(robots[robot], name, CLEAR)
            result = diagnosed(references, session)
            right += result.verdict == "unexplained" and not result.causes
            said.append((session.about, result.verdict, [cause.name for cause in result.causes]))
    assert right >= fewest(len(said), 0.9), said


@pytest.mark.parametrize(
    ("name", "parameter", "value"), [("noise_change", "factor", 1.6), ("command_loss", "probability", 0.4)]
)
def test_what_moves_no_mean_is_named_alone_and_held_by_its_interval(robots, references, name, parameter, value):
    """No error falls by it: held-out runs confirm it since they are likelier.

    Of two in five commands that are lost one in sixteen follows two others, or more: what goes on is older still.
    """
    effects = ({"name": name, parameter: value},)
    case = Case(family="formulas", kind="one", robot="mgr", names=[name], seed=13)
    session = with_effects(case, usual(robots["mgr"], 45, 13), effects)
    result = diagnose(references["mgr"], session.recording, SEED).result
    assert [cause.name for cause in result.causes] == [name], result.not_confirmed
    found = result.causes[0].parameters[parameter]
    assert found.low < value < found.high


def test_eight_long_drives_tell_as_much_as_many_short_ones(robots, references):
    effects = ({"name": "battery_sag", "loss": 0.3, "shape": 1.0},)
    case = Case(family="formulas", kind="one", robot="mgr", names=["battery_sag"], seed=17)
    session = with_effects(case, replace(usual(robots["mgr"], 8, 17), steps=250), effects)
    assert len(session.recording.runs) == 8
    result = diagnose(references["mgr"], session.recording, SEED).result
    assert [cause.name for cause in result.causes] == ["battery_sag"], result.not_confirmed
    assert result.runs["held_out"] >= 8  # blocks: of two drives there would be no interval
    loss = result.causes[0].parameters["loss"]
    assert loss.low < 0.3 < loss.high
