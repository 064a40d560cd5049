"""A session in the rigid-body engine: driven by the same operator, over the same link, under the same clock."""

import numpy as np

from swarmtwin.errors import UserError, near_miss
from swarmtwin.geometry import wrap_angle
from swarmtwin.standin.physics import Period
from swarmtwin.standin.rigid_body.car import Car
from swarmtwin.standin.rigid_body.machine import Machine
from swarmtwin.standin.rigid_body.swimmer import Swimmer
from swarmtwin.standin.session import DrivenSession, StandInSession, draw_clock, played_commands
from swarmtwin.standin.streams import Streams


def machine_of(session: StandInSession) -> Machine:
    """Return the session's vehicles, described to the engine.

    Raises:
        UserError: the robot has no rigid body, an effect means nothing to it, or the engine is not installed.
    """
    machines: dict[str, type[Machine]] = {"mgr": Car, "mur": Swimmer}
    name = session.robot.name
    if name not in machines:
        raise UserError(f"robot {name!r} has no rigid body, engine=formulas: {near_miss(name, machines)}")
    return machines[name](session.vehicles, session.conditions, session.robot.period_s)


def drive_rigid_session(session: StandInSession) -> DrivenSession:
    """Drive all runs of a session side by side in the engine; the states are poses and what the engine's joints do.

    Raises:
        UserError: the robot has no rigid body, an effect means nothing to it, or the engine is not installed.
    """
    machine = machine_of(session)
    streams = Streams(session.seed, "rigid body")
    shape = session.shape
    experience = session.physics(session.vehicles)
    plan = session.operator.plan(session.robot, shape, session.command_mode, played_commands(session), streams)
    time_s, duration_s = draw_clock(session, streams)
    chance = streams.of("link").random(shape)
    noise_shape = (*shape[:2], machine.pieces, machine.noises, shape[2])
    noise = streams.of("motion").standard_normal(noise_shape, np.float32)

    state = machine.put(plan.start)
    active = np.empty((len(session.robot.command), *state.shape[1:]))
    active[:] = np.reshape(machine.resting_command, (-1, 1, 1))
    states, actives, sent, lost = [state], [active], [], None
    for step in range(session.steps):
        command = session.operator.steer(session.robot, experience, np.moveaxis(state[:3], 0, -1), plan, step)
        lost = session.conditions.lost(chance[:, step], lost)
        arriving = np.where(lost, active, np.moveaxis(command, -1, 0))
        period = Period(arriving, active, duration_s[:, step, None], session.progress(time_s[:, step, None]))
        state = machine.advance(state, period, noise[:, step].transpose(1, 2, 0, 3))
        active = arriving
        states.append(state)
        actives.append(active)
        sent.append(command)
    true = np.stack(states, axis=2)
    pose = photographed(session, machine, np.moveaxis(true[:3], 0, -1), streams)
    return DrivenSession(session, time_s, np.stack(sent, axis=1), pose, np.stack(actives, axis=2), true)


def photographed(session: StandInSession, machine: Machine, pose: np.ndarray, streams: Streams) -> np.ndarray:
    """Return true poses (..., V, 3) as the camera measures them: most well, some badly, some not at all."""
    noise = streams.of("camera").standard_normal(pose.shape) * np.array(machine.camera_noise)
    worse = streams.of("bad pictures").random(pose.shape[:-1]) < machine.outlier_share
    measured = session.conditions.seen(pose) + np.where(worse[..., None], machine.outlier_factor, 1.0) * noise
    measured[..., 2] = wrap_angle(measured[..., 2])
    missed = streams.of("lost poses").random(pose.shape[:-1]) < session.lost_poses
    measured[missed] = np.nan
    return measured
