"""`mujoco.sysid` on the true rigid-body model: planted changes are found, and its absence is said."""

import sys

import numpy as np
import pytest

from swarmtwin.errors import UserError
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.rigid_body.driving import drive_rigid_session
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.hidden_effects.baselines.engine_identification import (
    EngineIdentification,
    is_identification_available,
    load_identification,
)
from swarmtwin.studies.stand_in_recording import record

needs_toolbox = pytest.mark.skipif(not is_identification_available(), reason="mujoco[sysid] is not installed")


def identification(robot, *entries, runs=8, steps=8, **options):
    session = StandInSession(robot, ("3",), runs, steps, 5, parse_effects(entries, robot, 1), **options)
    return EngineIdentification.of(*record(session, drive=drive_rigid_session))


@needs_toolbox
@pytest.mark.claims
@pytest.mark.parametrize(
    ("entry", "tolerance"),
    [
        ({"name": "gain_change", "gain": 0.8}, 0.03),
        ({"name": "marker_offset", "forward_mm": 20.0, "left_mm": 0.0}, 2.0),
    ],
)
def test_a_planted_change_is_named_and_its_size_found(robots, entry, tolerance):
    found = identification(robots["mgr"], entry).identify()
    assert set(found.causes) == {entry["name"]}
    for key, value in found.causes[entry["name"]].items():
        assert value == pytest.approx(entry[key], abs=tolerance)


@needs_toolbox
@pytest.mark.claims
def test_nothing_is_named_where_nothing_hides(robots):
    assert identification(robots["mgr"]).identify().causes == {}


@pytest.mark.parametrize("name", ["mgr", "mur"])
def test_the_nominal_model_predicts_what_the_camera_shows(robots, name):
    """Without chance, predictions from measured poses are as good as the camera; with a wrong gain they are not."""
    calm = {"name": "noise_change", "factor": 1e-4}
    model = identification(robots[name], calm)
    runs = np.arange(8)
    values = {key: freedom.nominal for key, freedom in model.freedoms.items()}
    wrong = values | ({"left_radius": 0.7, "right_radius": 0.7} if name == "mgr" else {"stroke": 0.7})
    measured = model.measured[:, 1:] - model.measured[:, :-1]
    moved_mm = np.linalg.norm(measured[..., :2], axis=-1)

    def error_mm(of):
        length_mm = np.linalg.norm(model.predicted(np.array(list(of.values())), runs)[..., :2], axis=-1)
        return np.abs(length_mm - moved_mm).mean()

    assert error_mm(values) < 2.0
    assert error_mm(wrong) > 1.5 * error_mm(values)


def test_without_the_toolbox_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco.sysid", None)
    with pytest.raises(UserError, match=r"not installed: pip install 'mujoco\[sysid\]>=4\.0\.0,<5'"):
        load_identification()
    assert not is_identification_available()
