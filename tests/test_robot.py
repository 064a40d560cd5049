from pathlib import Path

import numpy as np
import pytest
import yaml

from swarmtwin.errors import UserError
from swarmtwin.kinematics import Actuators
from swarmtwin.robot import Robot

MGR = Path(__file__).resolve().parents[1] / "conf" / "robot" / "mgr.yaml"


def changed(tmp_path, **changes):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(MGR.read_text()), **changes}))
    return path


def test_the_shipped_robots_are_those_of_the_design(robots):
    limits = {name: list(zip(r.command_low, r.command_high, strict=True)) for name, r in robots.items()}
    assert limits == {
        "mgr": [(-120, 120), (-120, 120)],
        "mur": [(-79, 79), (0, 60), (3, 9)],
        "create": [(0, 100), (-0.6, 0.6)],
        "car": [(-1, 1), (-25, 25)],
    }
    periods_s = {"mgr": 0.5, "mur": 0.8, "create": 0.5, "car": 0.1}
    assert {name: robot.period_s for name, robot in robots.items()} == periods_s
    assert robots["mur"].command_columns == ("mean_angle_deg", "amplitude_deg", "frequency_rad_s")


def test_yaml_and_python_give_the_same_robot(robots):
    again = Robot.parse(robots["mgr"].model_dump(mode="json"), "memory")
    assert again == robots["mgr"]
    assert again.link is None  # the lab's, and no part of what is stored of a robot
    np.testing.assert_array_equal(again.displacement_limit, [50, 25, 1.4])


def test_a_robot_of_ones_own_is_one_file(tmp_path):
    command = {name: {"low": 0, "high": 1, "unit": "1"} for name in ("port", "starboard")}
    fields = {name: {"key": name} for name in command}
    link = {"command_topic": "boats/{vehicle}", "fields": fields}
    robot = Robot.load(changed(tmp_path, name="mine", command=command, link=link))
    assert robot.command_columns == ("port", "starboard")


def test_a_robot_without_kinematics_works_and_says_what_is_missing_where_they_are_needed(tmp_path):
    for stated in ({"kinematics": None}, {}):
        content = yaml.safe_load(MGR.read_text())
        del content["kinematics"]
        path = tmp_path / "mine.yaml"
        path.write_text(yaml.safe_dump({**content, **stated, "actuators": None}))
        robot = Robot.load(path)
        assert robot.kinematics is None
        assert robot.actuation == Actuators(kind="unknown")
        with pytest.raises(UserError) as error:
            robot.kinematic_equations()
        assert str(error.value) == (
            "robot 'mgr' states no kinematics, and this needs some: name one of bicycle, differential_drive, tail_fin, "
            "unicycle in conf/robot/mgr.yaml"
        )
    stated = Robot.load(changed(tmp_path, kinematics=None, actuators={"kind": "wheel", "effort": ["left", "right"]}))
    assert stated.actuation.effort == ("left", "right")


def test_a_car_is_driven_by_its_first_column_and_steered_by_its_second(robots):
    unstated = robots["car"].model_copy(update={"actuators": None})
    assert unstated.actuation == Actuators(kind="wheel", effort=("throttle",), steering="steering_deg")
    assert robots["car"].actuation == unstated.actuation
    assert robots["car"].situation == ("command", "velocity")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"peroid_s": 1}, "unknown field 'peroid_s': did you mean 'period_s'?"),
        ({"period_s": "soon"}, "field 'period_s': Input should be a valid number"),
        ({"period_s": -1}, "field 'period_s': Input should be greater than 0, got -1"),
        ({"longest_gap_s": 0.1}, "longest_gap_s 0.1 is shorter than the period 0.5"),
        ({"arena_mm": {"x": [5, 0], "y": [0, 1]}}, "the lower bound must be below the upper one, got [5.0, 0.0]"),
        ({"command": {"x_mm": {"low": 0, "high": 1, "unit": "mm"}}}, "command column 'x_mm' is a reserved name"),
        ({"situation": ["pose"]}, "situation must contain 'command'"),
        (
            {"kinematics": "unicicle"},
            "field 'kinematics': Value error, no such kinematics: 'unicicle': did you mean 'unicycle'?",
        ),
        ({"command": {}}, "field 'command': Dictionary should have at least 1 item"),
        (
            {"kinematics": "tail_fin"},
            "kinematics 'tail_fin' wants 3 command columns, not 2 (left, right): correct one of the two",
        ),
        (
            {"link": {"command_topic": "t", "fields": {"left": {"key": "L"}}}},
            "link.fields must name the command columns",
        ),
        (
            {"command": {"thrust": {"low": 0, "high": 1, "unit": "1"}}},
            "kinematics 'differential_drive' wants 2 command columns, not 1 (thrust)",
        ),
    ],
)
def test_a_wrong_robot_file_is_one_clear_error(tmp_path, changes, message):
    path = changed(tmp_path, **changes)
    with pytest.raises(UserError) as error:
        Robot.load(path)
    assert str(path) in str(error.value)
    assert message in str(error.value)


def test_a_missing_robot_names_those_there_are():
    known = "known: car, create, mgr, mur"
    with pytest.raises(UserError, match=rf"no robot file .*mgrr.yaml: did you mean 'mgr'\? {known}"):
        Robot.load(MGR.with_name("mgrr.yaml"))


def test_a_field_that_was_removed_is_told_and_left_alone(tmp_path, caplog):
    """Robots' files and stored models of earlier versions may state it."""
    usual = Robot.load(changed(tmp_path, actuators={"kind": "thrust"}))
    assert not caplog.records
    stated = {"kind": "thrust", "strength_exponents": [1.2, 2.0, 1.7]}
    assert Robot.load(changed(tmp_path, actuators=stated)) == usual
    (told,) = caplog.messages
    assert "strength_exponents has no effect any more" in told
    assert "take the line out" in told


def test_the_shipped_robots_state_nothing_that_only_a_maker_of_stand_ins_could_know():
    for file in MGR.parent.glob("*.yaml"):
        content = yaml.safe_load(file.read_text())
        assert "unit_spread" not in content
        assert "strength_exponents" not in (content["actuators"] or {})
