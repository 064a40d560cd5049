"""The causes that a diagnosis names, as ranges to learn a policy in."""

import pytest
from diagnosis_factories import made_result

from exact_model import simulation_with
from swarmtwin.diagnosis.measured_ranges import measured_ranges
from swarmtwin.diagnosis.result import Cause, Estimate
from swarmtwin.errors import UserError
from swarmtwin.simulation.randomisation import Randomisation
from tiny_policies import robot_named


def cause(name, **intervals):
    """A cause whose parameters lie in the middle of their intervals."""
    parameters = {
        one: Estimate(value=(low + high) / 2, low=low, high=high, unit="") for one, (low, high) in intervals.items()
    }
    return Cause(name=name, parameters=parameters, confidence=0.99, rivals=(), share_of_gap=0.5, evidence="")


def ranges_of(folder, *causes, robot="mgr"):
    result = made_result(causes=causes, robot=robot)
    (folder / "diagnosis.json").write_text(result.model_dump_json())
    return measured_ranges(folder, simulation_with(robot_named("mgr")))


def test_intervals_become_ranges_within_the_bounds_of_their_parameters(tmp_path):
    found = ranges_of(tmp_path, cause("command_delay", delay_s=(0.13, 0.17)), cause("dead_band", width=(-1.0, 12.0)))
    assert found == {"command_delay": {"delay_s": [0.13, 0.17]}, "dead_band": {"width": [0.0, 12.0]}}
    randomisation = Randomisation.read(found, simulation_with(robot_named("mgr")), draws=4)
    assert [one.ranges for one in randomisation.mechanisms] == [{"delay_s": (0.13, 0.17)}, {"width": (0.0, 12.0)}]


def test_what_a_cause_weakens_is_kept(tmp_path):
    weak = cause("gain_change", gain=(0.7, 0.8)).model_copy(update={"form": {"acts_on": "effort"}})
    found = ranges_of(tmp_path, weak)
    [drawn] = Randomisation.read(found, simulation_with(robot_named("mgr")), draws=4).mechanisms
    assert (drawn.ranges, drawn.fixed["acts_on"]) == ({"gain": (0.7, 0.8)}, "effort")


def test_what_is_reported_otherwise_than_by_its_parameters_is_left_out_and_said(tmp_path, caplog):
    drift = cause("steady_drift", speed_mm_s=(3.0, 5.0), direction_rad=(0.1, 0.3))
    assert ranges_of(tmp_path, drift, cause("timing_jitter", spread=(0.05, 0.07))) == {
        "timing_jitter": {"spread": [0.05, 0.07]}
    }
    assert "steady_drift is not reported by its parameters, and is not randomised" in caplog.text
    with pytest.raises(UserError, match="names no cause with ranges"):
        ranges_of(tmp_path, drift)


def test_a_diagnosis_of_nothing_or_of_another_robot_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"names no cause with ranges of its parameters: state ranges yourself"):
        ranges_of(tmp_path)
    with pytest.raises(UserError, match="is a diagnosis of robot 'mur', and the simulation is of 'mgr'"):
        ranges_of(tmp_path, cause("command_delay", delay_s=(0.1, 0.2)), robot="mur")
    with pytest.raises(UserError, match=r"diagnosis\.json is missing: name a folder that swarmtwin diagnose made"):
        measured_ranges(tmp_path / "none", simulation_with(robot_named("mgr")))
