"""The shared machine: a base motion and mechanisms, run in the order of the signal's way."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from swarmtwin.dynamics.twist import displacement_of, twist_of
from swarmtwin.gap.mechanism import Drive, Mechanism, Responses, way_of_wheels, wheel_ways
from swarmtwin.geometry import compose, displacement_between, rotate
from swarmtwin.robot import Robot, SituationPart

PATH_POINTS = (0.1, 0.3, 0.5, 0.7, 0.9)


class Base(Protocol):
    """The simulation that mechanisms extend; it answers in ways along an arc, float64 (N, 3)."""

    robot: Robot
    parts: tuple[SituationPart, ...]

    def way(self, command: Tensor, previous_command: Tensor, pose: Tensor) -> Tensor:
        """Return how far vehicles go in one nominal period."""


class Alternative(NamedTuple):
    """One way in which a period can go: its probability and the measured displacement (N, 3)."""

    probability: float
    displacement: Tensor


class Remembered:
    """A base that answers once for the same tensors: most mechanisms leave commands and poses as they are."""

    def __init__(self, base: Base) -> None:
        self.robot, self.parts = base.robot, base.parts
        self._base = base
        self._answers: dict[tuple[int, int, int], tuple[tuple[Tensor, ...], Tensor]] = {}
        self._kept: set[int] = set()

    def keep(self, *tensors: Tensor) -> None:
        """Remember answers for these tensors, and only for these."""
        self._kept |= {id(tensor) for tensor in tensors}

    def way(self, command: Tensor, previous_command: Tensor, pose: Tensor) -> Tensor:
        """Answer as the base does."""
        if "previous_command" not in self.parts:
            previous_command = command
        asked = (command, previous_command, pose)
        key = (id(command), id(previous_command), id(pose) if "pose" in self.parts else 0)
        if key in self._answers:
            return self._answers[key][1]
        way = self._base.way(*asked)
        if set(key) - {0} <= self._kept:
            self._answers[key] = (asked, way)
        return way


def alternatives(base: Base, mechanisms: Sequence[Mechanism], drive: Drive) -> list[Alternative]:
    """Predict the measured displacements of N situations, whose `drive.pose` is as measured.

    Several alternatives result where a command may or may not arrive.
    """
    measured = drive.pose
    true = measured
    for mechanism in reversed(mechanisms):
        true = mechanism.true(true, drive.surroundings)
    if true is not measured:
        drive = Drive(**{**vars(drive), "pose": true})
    ways = _ways(base, mechanisms, drive)
    return [Alternative(probability, _measured(way, measured, mechanisms, drive)) for probability, way in ways]


def likeliest_displacement(base: Base, mechanisms: Sequence[Mechanism], drive: Drive) -> Tensor:
    """Return the likeliest measured displacements (N, 3) of N situations.

    Where a command may be lost that is the motion with the command that arrives, if most do: the mean of both ways lies
    where no vehicle ever goes, and has the larger mean error.
    """
    found = alternatives(base, mechanisms, drive)
    return max(found, key=lambda one: one.probability).displacement


def _ways(base: Base, mechanisms: Sequence[Mechanism], drive: Drive) -> list[tuple[float, Tensor]]:
    command, previous, earlier = drive.command, drive.previous_command, drive.earlier_command
    for mechanism in mechanisms:
        command = mechanism.received(command, drive)
        previous = mechanism.received(previous, drive)
        earlier = mechanism.received(earlier, drive)
    now = base.way(command, previous, drive.pose)
    if any(mechanism.uses_history for mechanism in mechanisms):
        settled = base.way(command, command, drive.pose)
        before = base.way(previous, previous, drive.pose)
        longest = any("earlier_command" in mechanism.needs for mechanism in mechanisms)
        past = base.way(earlier, earlier, drive.pose) if longest else before
    else:
        settled = before = past = now
    for mechanism in mechanisms:
        for share, part in mechanism.gradual(drive):
            between = command + part * (previous - command)
            now = now + share * (base.way(between, between, drive.pose) - settled)
    possible = [(1.0, Responses(now, settled, before, past))]
    for mechanism in mechanisms:
        if mechanism.overrides("arriving"):
            possible = [
                (earlier * later, arrived)
                for earlier, responses in possible
                for later, arrived in mechanism.arriving(responses, drive)
            ]
    return [(probability, _driven(responses, mechanisms, drive)) for probability, responses in possible]


def _driven(responses: Responses, mechanisms: Sequence[Mechanism], drive: Drive) -> Tensor:
    for mechanism in mechanisms:
        responses = mechanism.delivered(responses, drive)
    way = responses.now
    for mechanism in mechanisms:
        if mechanism.overrides("strength"):
            way = strengthened(way, mechanism.strength(drive), drive)
    gripping = [mechanism for mechanism in mechanisms if mechanism.overrides("grip")]
    if gripping:
        path = _path(way, drive.pose)
        for mechanism in gripping:
            way = strengthened(way, mechanism.grip(path, drive).mean(dim=-1, keepdim=True), drive)
    periods = None
    for mechanism in mechanisms:
        if mechanism.overrides("duration"):
            periods = mechanism.duration(drive)
    if periods is not None:
        longer = displacement_of(responses.settled * (periods - 1)[:, None])
        way = twist_of(_joined(displacement_of(way), longer))
    return way


def strengthened(way: Tensor, factor: Tensor, drive: Drive) -> Tensor:
    """Return the ways (N, 3) of actuators that are `factor` (N, 1), or (N, 2) left and right, as fast."""
    if factor.shape[-1] == 2:
        track_mm = drive.surroundings.track_mm or 1.0
        return way_of_wheels(wheel_ways(way, track_mm) * factor, way, track_mm)
    exponents = torch.tensor(drive.robot.actuation.strength_exponents, dtype=torch.float64)
    if bool((exponents == 1).all()):
        return way * factor
    return way * factor.clamp(min=1e-6) ** exponents


def _path(way: Tensor, pose: Tensor) -> Tensor:
    """Return positions (N, P, 2) along the ways (N, 3) from poses (N, 3)."""
    return torch.stack([compose(pose, displacement_of(way * share))[:, :2] for share in PATH_POINTS], dim=1)


def _measured(way: Tensor, measured: Tensor, mechanisms: Sequence[Mechanism], drive: Drive) -> Tensor:
    """Return what the camera sees (N, 3) of vehicles that go `way` (N, 3) from where it sees them, `measured`."""
    displacement = displacement_of(way)
    for mechanism in mechanisms:
        if mechanism.overrides("carried_mm_s"):
            carried_mm = mechanism.carried_mm_s(way, drive) * drive.duration_s[:, None]
            along = rotate(carried_mm, -drive.pose[:, 2])
            displacement = torch.cat([displacement[:, :2] + along, displacement[:, 2:]], dim=-1)
    looking = [mechanism for mechanism in mechanisms if mechanism.overrides("seen")]
    if not looking:
        return displacement
    end = compose(drive.pose, displacement)
    for mechanism in looking:
        end = mechanism.seen(end, drive.surroundings)
    return displacement_between(measured, end)


def _joined(first: Tensor, second: Tensor) -> Tensor:
    """Return the displacements (N, 3) of one after the other."""
    return compose(first, second)
