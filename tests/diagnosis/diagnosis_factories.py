"""Findings to test with: made-up drives, compared with a simulation that knows all but what is planted."""

from types import SimpleNamespace

import numpy as np
import torch

from drives import header_of
from swarmtwin.diagnosis.report.residual_fields import components
from swarmtwin.diagnosis.report.sentences import (
    QUESTIONS,
)
from swarmtwin.diagnosis.result import (
    Cause,
    Dependence,
    DiagnosedSession,
    DiagnosisResult,
    Estimate,
    Gain,
    Gains,
    NextRecording,
    WindowGain,
)
from swarmtwin.dynamics.predictor import DynamicsModule
from swarmtwin.geometry import compose
from swarmtwin.recordings.recording import Recording, Track
from swarmtwin.robot import Robot
from swarmtwin.simulation.open_loop import open_loop
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import from_recording

NOISE = np.array([1.0, 1.0, 0.03])
NAMES = ("left", "right", "third", "fourth", "fifth", "sixth")
DELAY = Cause(
    name="command_delay",
    parameters={"delay_s": Estimate(value=0.1504, low=0.1311, high=0.1697, unit="s")},
    confidence=0.99,
    rivals=("actuator_lag",),
    share_of_gap=0.93,
    evidence="with it the runs are e^312 times as likely; next best: actuator_lag, behind by 2.1 nats",
)
YAW = Cause(
    name="marker_yaw",
    parameters={"angle_rad": Estimate(value=-0.1, low=-0.12, high=-0.08, unit="rad")},
    confidence=1.0,
    rivals=(),
    share_of_gap=0.05,
    evidence="",
)
NEXT = NextRecording(
    separates=("command_delay", "actuator_lag"),
    drive="next_drive.csv",
    runs=20,
    steps=40,
    expected_nats=7.3,
    command="swarmtwin record robot=mgr drive=next_drive.csv runs=20 output=next",
)


UNCHANGED = Gain(before=1.25, after=1.25, low=0, high=0)


def over(window_s, before, after, low, high):
    """A gain in open loop over so many seconds; spreads are half of the means."""
    spreads = {"before_sd": before / 2, "after_sd": after / 2}
    return WindowGain(window_s=window_s, before=before, after=after, low=low, high=high, pieces=28, runs=7, **spreads)


def made_robot(columns=2, arena=(1000, 800)):
    """A robot with any number of command columns."""
    return Robot.parse(
        {
            "name": "made",
            "title": "Made-up robot",
            "period_s": 0.5,
            "longest_gap_s": 0.6,
            "command": {name: {"low": -100, "high": 100, "unit": "PWM"} for name in NAMES[:columns]},
            "arena_mm": {"x": [0, arena[0]], "y": [0, arena[1]]},
            "largest_displacement": {"forward_mm": 60, "left_mm": 60, "turn_rad": 2.0},
            "situation": ["command"],
            "kinematics": "differential_drive",
            "vehicle_size_mm": [80, 60],
            "actuators": {"kind": "wheel", "effort": []},
        },
        "made",
    )


def simulated(command):
    """Displacements (N, 3) that the simulation expects of commands (N, m)."""
    ahead, turn = 45 * command.mean(axis=-1) / 100, 0.6 * command[..., -1] / 100
    return np.stack([ahead, np.zeros_like(ahead), turn], axis=-1)


class CommandedMotion(DynamicsModule):
    """A dynamics model that expects what `simulated` says."""

    inputs = ("command",)

    def __init__(self, robot):
        super().__init__()
        self.robot = robot

    def predict(self, situation):
        return torch.as_tensor(simulated(situation.command.double().numpy()))


def moved_as_simulated(moment):
    return simulated(moment.command)


def moved_late(moment):
    """Three tenths of the period go on under the command before."""
    return 0.7 * simulated(moment.command) + 0.3 * simulated(moment.previous)


def made_session(result, moved=moved_as_simulated, robot=None, runs=24, steps=40, vehicles=("1",), seed=0):
    """Drive, and compare with the simulation; the extended simulation knows exactly what moved the vehicles."""
    robot, random = robot or made_robot(), np.random.default_rng(seed)
    tracks, expected = [], []
    for run in range(runs):
        for vehicle in vehicles:
            command = random.uniform(-100, 100, (steps + 1, len(robot.command)))
            inner = robot.arena_mm.low_mm + 220, robot.arena_mm.high_mm - 220
            poses = [np.array([*random.uniform(*inner), random.uniform(-3, 3)])]
            time_s = (run * (steps + 10) + np.arange(steps + 1)) * robot.period_s
            for step in range(steps):
                moment = SimpleNamespace(
                    command=command[step], previous=command[max(step - 1, 0)], pose=poses[-1], run=run / runs
                )
                expected.append(moved(moment))
                poses.append(compose(poses[-1], expected[-1] + NOISE * random.normal(size=3)))
            tracks.append(Track(f"run_{run:03d}", vehicle, time_s, command, np.array(poses)))
    recording = Recording(robot, header_of(robot, vehicles), tuple(tracks))
    transitions, counts = from_recording(recording)
    assert counts.kept == len(expected)
    simulation = Simulation(CommandedMotion(robot))
    held_out = transitions.run >= 0.7 * runs
    predicted = open_loop(simulation, [track for track in tracks if int(track.run[4:]) >= 0.7 * runs])
    better = [
        run._replace(predicted=run.track.pose + 1.0, rmse_mm=float(np.sqrt(2))) if result.extension != "none" else run
        for run in predicted
    ]
    extends = result.extension != "none"
    before = (transitions.displacement - simulated(transitions.command)) / NOISE
    return DiagnosedSession(
        result=result,
        simulation=simulation,
        extended=simulation if extends else None,
        transitions=transitions,
        held_out=held_out,
        residual_before=before,
        residual_after=(transitions.displacement - np.array(expected)) / NOISE if extends else before,
        runs_before=tuple(predicted),
        runs_after=tuple(better),
        next_drive=None,
    )


def made_result(verdict="explained", **changes):
    """A diagnosis of a delay, or of nothing."""
    wrong = verdict != "no_gap"
    depends_on = ("previous_command", "command") if wrong else ()
    tests = tuple(
        Dependence(
            part=part,
            statistic=3.25 if part in depends_on else 0.5,
            p_value=0.0005 if part in depends_on else 0.43,
            explained=0.4 / (1 + index) if part in depends_on else 0.001,
            found=part in depends_on,
        )
        for index, part in enumerate(QUESTIONS)
    )
    content = DiagnosisResult(
        verdict=verdict,
        causes=(DELAY,) if wrong else (),
        depends_on=depends_on,
        gain=Gains(
            position_mm=Gain(before=8.61, after=1.82, low=6.52, high=7.11),
            orientation_deg=Gain(before=12.4, after=3.05, low=9.1, high=9.6),
            open_loop_mm=Gain(before=214.0, after=31.0, low=160.0, high=205.0),
            ten_periods_mm=Gain(before=62.0, after=11.0, low=44.0, high=58.0),
            open_loop_windows=(over(2, 31.2, 6.0, 22.1, 28.3), over(10, 118.0, 17.0, 88.0, 112.0)),
        )
        if wrong
        else Gains(
            **dict.fromkeys(("position_mm", "orientation_deg", "open_loop_mm", "ten_periods_mm"), UNCHANGED),
            open_loop_windows=(over(2, 5.5, 5.5, 0, 0),),
        ),
        next_recording=NEXT if wrong else None,
        left_over=(),
        tests=tests,
        robot="made",
        vehicles=("1",),
        runs={"fitted_to": 17, "held_out": 7},
        transitions={"used": 960, "set_aside": 12},
        extension="mechanisms" if wrong else "none",
        seed=5,
    )
    return content.model_copy(update=changes)


def parts_of(session):
    """The components of the simulation's residual."""
    transitions = session.transitions
    return components(transitions, simulated(transitions.command), session.residual_before)
