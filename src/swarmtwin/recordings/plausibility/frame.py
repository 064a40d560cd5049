"""Axes, headings, signs and rows of a recording: whether vehicles move where they head, and turn as they are told.

Where they do not, mistakes are undone one after the other, and the one without which motion follows is the reason.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from swarmtwin.recordings.observed_motion import Agreement, ObservedMotion
from swarmtwin.recordings.plausibility.doubt import Doubt, Limits


@dataclass(frozen=True)
class Reading:
    """A mistake, undone.

    Attributes:
        mistake: what may have happened, and what to do: "headings count clockwise: multiply heading_rad by −1".
        motion: what the recording would then show.
        possible: whether it may also be how the robot really behaves.
    """

    mistake: str
    motion: ObservedMotion
    possible: bool = False


def frame_doubts(motion: ObservedMotion, in_degrees: ObservedMotion | None, limits: Limits) -> Iterator[Doubt]:
    """Compare the direction of travel with heading and command, and the direction of turning with the command."""
    actuators = motion.robot.actuation
    sign_known = actuators.kind == "wheel"
    found = motion.agreement()
    if _unsigned(found, sign_known).least >= limits.agreement:
        if not sign_known and found.turn is not None and found.turn < 0:
            text = f"vehicles turn right at positive {actuators.steering}"
            yield Doubt("frame", False, f"{text}: is it counted so, or does y point down, as in a camera's picture?")
        best = max(_shifts(motion), key=lambda reading: _together(reading.motion.agreement()))
        if _together(best.motion.agreement()) > _together(found) + limits.shift:
            yield Doubt("frame", False, f"motion agrees better with the commands of other rows: {best.mistake}")
        return
    said = _disagreement(_unsigned(found, sign_known), limits)
    candidates = [
        (reading, _unsigned(reading.motion.agreement(), sign_known).least) for reading in _readings(motion, in_degrees)
    ]
    best, agreement = max(candidates, key=lambda one: round(one[1], 2))
    if agreement >= limits.explained:
        yield Doubt("frame", not best.possible, f"{said}: {best.mistake}")
        return
    known = [abs(value) for value in found if value is not None]
    nothing = len(known) > 1 and max(known) < limits.agreement / 2
    yield Doubt("frame", nothing, f"{said}: are headings, axes and commands those of these rows?")


def _unsigned(agreement: Agreement, sign_known: bool) -> Agreement:
    """Return an agreement in which turning counts either way, where the robot's file does not say which is left."""
    turn = agreement.turn
    return agreement if sign_known or turn is None else agreement._replace(turn=abs(turn))


def _together(agreement: Agreement) -> float:
    return sum(abs(value) for value in agreement if value is not None)


def _disagreement(found: Agreement, limits: Limits) -> str:
    """Say what of the motion is not as heading and command tell."""
    parts = []
    if found.travel is not None and found.travel < limits.agreement:
        reverse = found.travel < -limits.agreement
        parts.append("move away from where they head" if reverse else "do not move where they head")
    if found.turn is not None and found.turn < limits.agreement:
        parts.append("turn the other way than told" if found.turn < -limits.agreement else "do not turn as told")
    figures = ", ".join(f"{name} {value:.2f}" for name, value in found._asdict().items() if value is not None)
    return f"vehicles {' and '.join(parts)} (agreement of {figures}; 1 is full)"


def _readings(motion: ObservedMotion, in_degrees: ObservedMotion | None) -> Iterator[Reading]:
    """Yield mistakes of frame, sign, columns and clock, each undone; the likelier of two that look alike first."""
    for mistake, undo in _frames(motion).items():
        yield Reading(mistake, motion.with_poses(undo))
    if in_degrees is not None:
        degrees = "are headings in degrees? Multiply heading_rad by 0.0174533"
        yield Reading(degrees, in_degrees)
        for mistake, undo in _frames(motion).items():
            yield Reading(f"{degrees}; and {mistake}", in_degrees.with_poses(undo))
    yield Reading("do commands have the other sign? Multiply them by −1", motion.with_commands(np.negative))
    yield from _shifts(motion)


def _shifts(motion: ObservedMotion) -> Iterator[Reading]:
    for count in range(1, 1 + len(motion.commands) // 2):
        rows = "one row" if count == 1 else f"{count} rows"
        late = f"do vehicles answer commands {rows} late, or do poses stand {rows} too far down?"
        yield Reading(late, motion.with_command_of(-count), possible=True)
        early = f"commands stand {rows} below the motion that they bring about: move them up by {rows}"
        yield Reading(early, motion.with_command_of(count))


def _frames(motion: ObservedMotion) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """Return mistakes of axes and headings, and what undoes each of poses (P, 3)."""
    downwards = "does y point down, as in a camera's picture? Replace y_mm by the arena's height − y_mm"
    mirrored = f"{downwards}, and heading_rad by −heading_rad"
    actuators = motion.robot.actuation
    if actuators.kind == "wheel" and len(actuators.effort) > 1:
        mirrored = f"are {' and '.join(actuators.effort)} exchanged? Exchange the columns; or {mirrored}"
    elif actuators.kind == "wheel" and len(motion.robot.command) > 1:
        steering = actuators.steering or motion.robot.command_columns[1]
        mirrored = f"does {steering} count clockwise? Multiply it by −1; or {mirrored}"
    quarter, half = np.array([0, 0, np.pi / 2]), np.array([0, 0, np.pi])
    compass = "do headings count clockwise from the y axis? Replace heading_rad by 1.5708 − heading_rad"
    return {
        mirrored: lambda pose: pose * [1, -1, -1],
        "do headings count clockwise? Multiply heading_rad by −1": lambda pose: pose * [1, 1, -1],
        f"{downwards}; headings are right": lambda pose: pose * [1, -1, 1],
        "does x point left? Replace x_mm by the arena's width − x_mm": lambda pose: pose * [-1, 1, 1],
        "are x_mm and y_mm exchanged? Exchange the columns": lambda pose: pose[:, [1, 0, 2]],
        compass: lambda pose: quarter + pose * [1, 1, -1],
        "are markers turned by 90°? Add 1.5708 to heading_rad": lambda pose: pose + quarter,
        "are markers turned by 90°? Subtract 1.5708 from heading_rad": lambda pose: pose - quarter,
        "are markers mounted backwards? Add 3.14159 to heading_rad": lambda pose: pose + half,
        "are headings in turns? Multiply heading_rad by 6.28319": lambda pose: pose * [1, 1, 2 * np.pi],
    }
