"""Sessions that the extended simulation drives itself, with everything random in it: their causes are exactly so."""

from dataclasses import replace

import numpy as np
import torch
from exact_base import SPREAD, known_noise

from exact_model import ExactDynamics, conditions_of
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.geometry import displacement_between
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import Transitions

CAMERA = np.array([1.0, 1.0, 0.01])
NOISE = MotionNoise(
    at_rest=tuple(np.array(SPREAD) ** 2), with_motion=(0, 0, 0), usual_mm=20, usual_rad=0.5, camera=tuple(CAMERA**2)
)


def simulated_noise():
    """The noise of these sessions, as a diagnosis knows it."""
    return replace(known_noise(), camera=CAMERA**2)


def simulated_session(robot, mechanisms, seed, runs=60, steps=24, vehicles=1):
    """Drive vehicles, one or a pair, by random commands as mechanisms extend the exact model; a camera watches them."""
    rng, drawn = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    simulation = Simulation(ExactDynamics(robot, NOISE), mechanisms, conditions_of(robot))
    command = rng.uniform(robot.command_low, robot.command_high, (steps, runs, vehicles, len(robot.command)))
    low, span = robot.arena_mm.low_mm, robot.arena_mm.high_mm - robot.arena_mm.low_mm
    places = low + span * rng.uniform(0.15, 0.85, (runs, vehicles, 2))
    start = np.concatenate([places, rng.uniform(-3.1, 3.1, (runs, vehicles, 1))], axis=-1)
    began_s = torch.arange(runs, dtype=torch.float64)[:, None] * (steps + 10) * robot.period_s
    state = simulation.start(torch.as_tensor(start), began_s.expand(runs, vehicles))
    seen, elapsed_s = [simulation.observe(state, drawn)], [state.elapsed_s]
    for sent in command:
        duration_s = simulation.drawn_duration_s((runs, vehicles), drawn)
        state = simulation.step(state, torch.as_tensor(sent), duration_s, drawn)
        seen.append(simulation.observe(state, drawn))
        elapsed_s.append(state.elapsed_s)
    poses, at_s = torch.stack(seen).numpy(), torch.stack(elapsed_s).numpy()
    before, earlier = np.full((2, *command.shape), np.nan)
    before[1:], earlier[2:] = command[:-1], command[:-2]
    others = poses[:-1][:, :, ::-1, None] if vehicles == 2 else np.empty((steps, runs, vehicles, 0, 3))

    def by_track(values):
        """Rows (T, R, K, …) run by run, vehicle by vehicle, (N, …)."""
        return np.moveaxis(values, 0, 2).reshape(steps * runs * vehicles, *values.shape[3:])

    displacement = displacement_between(poses[:-1], poses[1:])
    taken = map(by_track, (command, before, earlier, poses[:-1], displacement))
    transitions = Transitions(
        robot,
        robot.arena_mm,
        *taken,
        neighbours=by_track(displacement_between(poses[:-1][:, :, :, None], others)),
        time_s=by_track(at_s[:-1]),
        duration_s=by_track(np.diff(at_s, axis=0)),
        run=np.repeat(np.arange(runs), vehicles * steps),
        vehicle=np.tile(np.repeat(np.arange(vehicles), steps), runs),
        split=np.zeros(command[..., 0].size, dtype=int),
        runs=tuple(f"run_{run:03d}" for run in range(runs)),
        vehicles=tuple(str(1 + vehicle) for vehicle in range(vehicles)),
    )
    return MeasuredSession.of(transitions, conditions_of(robot))
