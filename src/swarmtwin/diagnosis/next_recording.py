"""Step 4. Which drive says more: under which rivals predict most differently, or smaller effects would be named."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from scipy.linalg import block_diag

from swarmtwin.diagnosis.detection_limits import FoundLimit
from swarmtwin.diagnosis.estimated_set import EstimatedSet
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.explanation import Explanation
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.noise import Noise
from swarmtwin.diagnosis.random_effects import other_forms, smooth_functions
from swarmtwin.diagnosis.result import NextRecording
from swarmtwin.diagnosis.session_prediction import SessionPredictor
from swarmtwin.diagnosis.settings import LikelihoodSettings, NextRecordingSettings
from swarmtwin.dynamics.predictor import DynamicsModel
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import Robot
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, mechanism_class
from swarmtwin.simulation.simulation import Simulation

DRIVE_FILE = "next_drive.csv"


def next_recording(
    explained: Explanation, limits: Sequence[FoundLimit], seed: int
) -> tuple[NextRecording | None, np.ndarray | None]:
    """Plan the drive that says most, and its commands (P, m).

    Where a named cause has rivals, it is the one that separates the first of these causes from its nearest rival; where
    nothing is wrong, the one that lowers the limits from which on causes would be named. Else None.
    """
    posterior, search = explained.posterior, explained.model.settings.search
    for name in explained.names:
        rivals = posterior.rivals(name, search.rival_from)
        if rivals:
            rival = next(one for one in posterior.sets if rivals[0] in one.names and name not in one.names)
            forms = _in_all_forms(explained.model, rival)
            return separating_drive(explained.model, (name, rivals[0]), explained.best, forms, seed)
    return lowering_drive(explained.model, limits, seed) if explained.verdict == "no_gap" else (None, None)


def _in_all_forms(model: SessionLikelihood, found: EstimatedSet) -> list[EstimatedSet]:
    """Return a set of causes in each form that one of them may take: a drive may tell apart from some of them alone."""
    forms = [found]
    for mechanism in found.mechanisms:
        others = [other for other in found.mechanisms if other is not mechanism]
        for form in mechanism_class(mechanism.name).forms(model.robot):
            if form.usual_form() != mechanism.form():
                parameters = form.parameters_of(model.robot, model.session.conditions)
                known = {name: value for name, value in mechanism.values().items() if name in parameters}
                begun = {name: one.initial_values[0] for name, one in parameters.items()} | known
                forms.append(estimate(model, [*others, form.at(begun)], polish=True))
    return forms


def separating_drive(
    model: SessionLikelihood,
    names: tuple[str, str],
    found: EstimatedSet,
    rivals: Sequence[EstimatedSet],
    seed: int,
) -> tuple[NextRecording, np.ndarray]:
    """Return the drive, of several candidates, under which two explanations differ most, and its commands (P, m).

    Expected nats are half the squared difference of what both predict, in units of the reference's noise; whichever is
    wrong may take other values, and be of another form as far as mechanisms may: the drive is to say it by itself.

    Args:
        model: of the session in hand.
        names: of the cause that is to be told apart, and of the other one.
        found: one explanation.
        rivals: the other one, in all the forms that it may take: that is meant which differs least.
        seed: of the candidates.
    """
    settings = model.settings.next_recording
    drives = _drives(model, seed)
    pairs = [pair for rival in rivals for pair in ((found, rival), (rival, found))]
    forms = model.settings.likelihood
    nats = [min(drive.nats(*pair, forms) for pair in pairs) / len(drive.command) for drive in drives]
    best = int(np.argmax(nats))
    nats_a_run = nats[best] * settings.steps
    wanted = np.ceil(settings.enough_nats / max(nats_a_run, 1e-3))
    runs = int(np.clip(wanted, settings.fewest_runs, settings.most_runs))
    plan = NextRecording(
        separates=names,
        drive=DRIVE_FILE,
        runs=runs,
        steps=settings.steps,
        expected_nats=nats_a_run * runs,
        command=_record_command(model.robot, runs, settings.steps),
    )
    return plan, drives[best].command


def lowering_drive(
    model: SessionLikelihood, limits: Sequence[FoundLimit], seed: int
) -> tuple[NextRecording | None, np.ndarray | None]:
    """Return the drive that lowers the limits most, on average over their logarithms, and its commands (P, m).

    A recording of the same length is planned. An effect shows the more, the further it moves vehicles away from where
    the simulation has them, or the cause that it would be taken for, in units of the noise. None where no candidate
    lowers the limits by as much as the settings ask for.
    """
    settings, kept = model.settings.next_recording, model.settings.verdict.held_out_every
    moving = [one for one in limits if one.mechanism and one.limit.value and "neighbours" not in one.mechanism.inputs]
    if not moving:
        return None, None
    spread = model.reference_noise.spread(model.simulated.numpy())
    here = _Drive(model.predictor, spread, model.session.transitions.command)
    now = np.array([here.rate(one) for one in moving])
    shown = now * len(model.session) > 0.1  # nats: what cannot be told from another cause has no limit to lower
    moving, now = [one for one, is_shown in zip(moving, shown, strict=True) if is_shown], now[shown]
    if not moving:
        return None, None
    drives = _drives(model, seed)
    remaining = [np.sqrt(now / np.array([max(drive.rate(one), 1e-12) for one in moving])) for drive in drives]
    best = int(np.argmin([np.log(shares).mean() for shares in remaining]))
    if np.exp(np.log(remaining[best]).mean()) > settings.enough_lower:
        return None, None
    shares = {one.limit.cause: float(share) for one, share in zip(moving, remaining[best], strict=True)}
    runs = int(np.clip(np.ceil(len(model.session) * kept / (kept - 1) / settings.steps), 1, settings.most_runs))
    plan = NextRecording(
        separates=(),
        lowers={cause: share for cause, share in sorted(shares.items(), key=lambda one: one[1]) if share < 1},
        drive=DRIVE_FILE,
        runs=runs,
        steps=settings.steps,
        expected_nats=0.0,
        command=_record_command(model.robot, runs, settings.steps),
    )
    return plan, drives[best].command


@dataclass(frozen=True)
class _Drive:
    """A drive of P periods, and what is expected of it.

    Attributes:
        predictor: of it.
        spread: (P, 3) the noise's.
        command: (P, m).
    """

    predictor: SessionPredictor
    spread: np.ndarray
    command: np.ndarray

    @classmethod
    def of(
        cls, base: DynamicsModel, noise: Noise, conditions: SessionConditions, situation: Situation, steps: int
    ) -> Self:
        """Take situations (P) of the simulation alone, in runs of so many steps."""
        before = np.arange(len(situation.command)) - 1
        before[::steps] = -1
        predictor = SessionPredictor(base, conditions, situation, before)
        return cls(predictor, noise.spread(predictor.twist(()).numpy()), situation.command.numpy())

    def ways(self, mechanisms: Sequence[Mechanism]) -> np.ndarray:
        """Return (3 P,) where mechanisms lead, in units of the noise."""
        ways: np.ndarray = (self.predictor.most_likely_twist(mechanisms).numpy() / self.spread).ravel()
        return ways

    def slopes(self, mechanisms: Sequence[Mechanism]) -> np.ndarray:
        """Return (3 P, Q) how that changes with the parameters of mechanisms."""
        here, columns = self.ways(mechanisms), []
        for index, one in enumerate(mechanisms):
            parameters = type(one).parameters_of(self.predictor.base.robot, self.predictor.conditions)
            for name, parameter in parameters.items():
                value = getattr(one, name)
                moved = type(one).at({**one.values(), name: parameter.stepped_from(value)})
                change = self.ways([*mechanisms[:index], moved, *mechanisms[index + 1 :]]) - here
                columns.append(change / (parameter.stepped_from(value) - value))
        return np.stack(columns, axis=-1) if columns else np.zeros((len(here), 0))

    def nats(self, true: EstimatedSet, wrong: EstimatedSet, settings: LikelihoodSettings) -> float:
        """Return the nats by which the true of two sets is expected to win; the other adjusts its values and forms."""
        apart, slopes = self.ways(true.mechanisms) - self.ways(wrong.mechanisms), self.slopes(wrong.mechanisms)
        forms = self._forms(wrong.mechanisms, settings)
        known = block_diag(1e-6 * np.diag((slopes**2).sum(axis=0)), np.eye(forms.shape[1]))
        return _left_apart(apart, np.column_stack([slopes, forms]), known)

    def _forms(self, mechanisms: Sequence[Mechanism], settings: LikelihoodSettings) -> np.ndarray:
        """Return (3 P, q) by what other forms of mechanisms lead elsewhere, in units of the noise."""
        robot, columns = self.predictor.base.robot, []
        functions = smooth_functions(robot, self.predictor.situation)
        for one in mechanisms:
            others = [other for other in mechanisms if other is not one]
            change = (self.ways(mechanisms) - self.ways(others)).reshape(-1, 3)
            columns += [form.ravel() for form in other_forms(one, change, functions, robot, settings)]
        return np.stack(columns, axis=-1) if columns else np.zeros((3 * len(self.command), 0))

    def rate(self, one: FoundLimit) -> float:
        """Return the nats a transition that a cause at its limit brings over what it would be taken for."""
        assert one.mechanism
        rivals = [one.rival] if one.rival else []
        apart, slopes = self.ways([one.mechanism]) - self.ways(rivals), self.slopes(rivals)
        return _left_apart(apart, slopes, 1e-6 * np.diag((slopes**2).sum(axis=0))) / len(self.command)


def _left_apart(apart: np.ndarray, slopes: np.ndarray, known: np.ndarray) -> float:
    """Return half the square of a difference (K,), less what steps along slopes (K, Q) take away.

    `known` is the information (Q, Q) that holds the steps back.
    """
    whole = float(apart @ apart)
    if slopes.shape[1]:
        side = slopes.T @ apart
        whole -= float(side @ np.linalg.lstsq(slopes.T @ slopes + known, side, rcond=None)[0])
    return max(whole, 0.0) / 2


def _drives(model: SessionLikelihood, seed: int) -> list[_Drive]:
    settings, base, conditions = model.settings.next_recording, model.predictor.base, model.session.conditions
    commands = _commands(model.robot, settings, np.random.default_rng(seed))
    situations = _driven(base, conditions, commands, settings.steps)
    return [_Drive.of(base, model.reference_noise, conditions, one, settings.steps) for one in situations]


def _record_command(robot: Robot, runs: int, steps: int) -> str:
    return f"swarmtwin collect robot={robot.name} drive={DRIVE_FILE} runs={runs} steps={steps} output=DIR"


def _commands(robot: Robot, settings: NextRecordingSettings, rng: np.random.Generator) -> list[np.ndarray]:
    """Return commands (P, m): at random, held, to and fro between the limits, likewise held for long, small ones.

    And runs at random in turn with runs to and fro.
    """
    low, high, periods = robot.command_low, robot.command_high, settings.periods
    uniform = rng.uniform(low, high, (periods, len(low)))
    held = np.repeat(rng.uniform(low, high, (-(-periods // 4), len(low))), 4, axis=0)[:periods]
    extremes = np.where(rng.random((periods, len(low))) < 0.5, low, high)
    seldom = np.where(rng.random((-(-periods // 10), len(low))) < 0.5, low, high)
    long_held = np.repeat(seldom, 10, axis=0)[:periods]
    middle = np.clip(0.0, low, high)
    small = middle + settings.small_share * (uniform - middle)
    mixed = np.where(np.arange(periods)[:, None] // settings.steps % 2, uniform, extremes)
    return [np.round(command, 3) for command in (uniform, held, extremes, long_held, small, mixed)]


def _driven(
    base: DynamicsModel, conditions: SessionConditions, commands: Sequence[np.ndarray], steps: int
) -> list[Situation]:
    """Drive the simulation open loop by commands (P, m), each run of so many steps from the middle of the arena.

    All runs of all drives side by side; returns P situations for each drive.
    """
    simulation, sent = Simulation(base, (), conditions), torch.as_tensor(np.stack(commands))
    drives, count, columns = sent.shape
    previous = torch.cat([sent[:, :1], sent[:, :-1]], dim=1)
    runs = -(-count // steps)
    padded, before = (
        torch.cat([one, one[:, -1:].expand(-1, runs * steps - count, -1)], dim=1).reshape(-1, steps, 1, columns)
        for one in (sent, previous)
    )
    middle = torch.cat([conditions.centre_mm, conditions.centre_mm.new_zeros(1)])
    state = replace(simulation.start(middle.expand(drives * runs, 1, 3)), previous_command=before[:, 0])
    states = []
    for step in range(steps):
        states.append(state)
        state = simulation.step(state, padded[:, step])
    pose, velocity = (
        torch.stack(parts, dim=1).reshape(drives, runs * steps, -1)[:, :count]
        for parts in ([one.pose for one in states], [one.velocity for one in states])
    )
    return [
        Situation(
            command=sent[drive],
            previous_command=previous[drive],
            earlier_command=torch.cat([previous[drive, :1], previous[drive, :-1]]),
            pose=pose[drive],
            velocity=velocity[drive],
            elapsed_s=torch.arange(count).double() / count * conditions.session_s,
            duration_s=torch.full((count,), simulation.robot.period_s, dtype=torch.float64),
            neighbours=torch.zeros(count, 0, 3, dtype=torch.float64),
        )
        for drive in range(drives)
    ]
