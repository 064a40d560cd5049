"""What a dynamics model answered to the same commands is not asked again, and is what it would have answered."""

import numpy as np
import pytest
import torch

from exact_model import ExactDynamics, conditions_of
from swarmtwin.simulation.base_twists import BaseTwists
from swarmtwin.simulation.ensemble_dynamics import CorrectedDynamics
from swarmtwin.simulation.following_actuators import ActuatorTwists, Following, SettingChange
from swarmtwin.simulation.mechanism import Moment

COUNT = 30
PAIRS = [(0, 1), (0, 0), (1, 1), (2, 2), (1, 2)]


class AskedDynamics(ExactDynamics):
    """Lags behind the command before, and counts the situations that it is asked for."""

    inputs = ("command", "previous_command")
    asked = 0

    def predict(self, situation):
        self.asked += len(situation)
        before = situation.command if situation.previous_command is None else situation.previous_command
        return super().predict(situation.__class__(command=0.8 * situation.command + 0.2 * before))


@pytest.fixture
def dynamics(robots):
    return AskedDynamics(robots["mgr"])


@pytest.fixture
def driven(dynamics):
    """Two runs of so many periods, commands held for some of them: the moment, the last three commands, `follows`."""
    rng = np.random.default_rng(4)
    command = torch.as_tensor(rng.uniform(-100, 100, (COUNT, 2)))
    follows = np.arange(COUNT) - 1
    follows[[0, COUNT // 2]] = -1
    previous = torch.where(torch.as_tensor(follows >= 0)[:, None], command[follows], 10.0)
    earlier = torch.where(torch.as_tensor(follows >= 0)[:, None], previous[follows], 20.0)
    nothing = torch.zeros(COUNT, dtype=torch.float64)
    moment = Moment(
        robot=dynamics.robot,
        conditions=conditions_of(dynamics.robot).model_copy(update={"own_lags": (0.2, 0.2, 0.2)}),
        pose=torch.zeros(COUNT, 3, dtype=torch.float64),
        elapsed_s=nothing,
        duration_s=nothing + dynamics.robot.period_s,
        neighbours=torch.zeros(COUNT, 0, 3, dtype=torch.float64),
    )
    return moment, (command, previous, earlier), follows


def answers(twists):
    """Of all pairs of commands, (5, N, 3)."""
    return torch.stack([twists._answer(*pair) for pair in PAIRS])


def test_the_period_before_was_answered_already(dynamics, driven):
    moment, commands, follows = driven
    alone = answers(BaseTwists(dynamics, moment, commands))
    dynamics.asked = 0
    again = answers(BaseTwists(dynamics, moment, commands, follows=follows))
    torch.testing.assert_close(again, alone, rtol=0, atol=1e-12)
    assert dynamics.asked == 2 * COUNT + 2 * 3  # what is held and what changes; of the first of each run, those before


def test_commands_that_stay_as_they_were_sent_were_answered_already(dynamics, driven):
    moment, commands, follows = driven
    cut = [command.clamp(-95.0, 95.0) for command in commands]
    sent = BaseTwists(dynamics, moment, commands, follows=follows)
    alone, _ = answers(BaseTwists(dynamics, moment, cut)), answers(sent)
    dynamics.asked = 0
    again = answers(BaseTwists(dynamics, moment, cut, follows=follows, undisturbed=sent))
    torch.testing.assert_close(again, alone, rtol=0, atol=1e-12)
    changed = (cut[0] != commands[0]).any(dim=-1)
    either = changed | (cut[1] != commands[1]).any(dim=-1)
    assert 0 < dynamics.asked == int(changed.sum() + either.sum())


def test_a_model_that_looks_at_poses_is_asked_at_each(dynamics, driven):
    moment, commands, follows = driven
    dynamics.inputs = ("command", "previous_command", "pose")
    answers(BaseTwists(dynamics, moment, commands, follows=follows))
    assert dynamics.asked == len(PAIRS) * COUNT


def test_a_correction_that_looks_at_more_does_not_ask_the_model_again(robots, driven):
    """A model of the command alone is asked for each command once, its correction for each pair of them."""
    moment, commands, follows = driven
    model, correction = AskedDynamics(robots["mgr"]), AskedDynamics(robots["mgr"])
    model.inputs = ("command",)
    corrected = CorrectedDynamics(model, correction)
    answered = answers(BaseTwists(corrected, moment, commands, follows=follows))
    apart = [answers(BaseTwists(one, moment, commands)) for one in (model, correction)]
    torch.testing.assert_close(answered, apart[0] + apart[1], rtol=0, atol=1e-12)
    model.asked = 0
    answers(BaseTwists(corrected, moment, commands, follows=follows))
    assert model.asked == COUNT + 2 * 2


def test_wheels_end_where_their_pieces_lead(dynamics, driven):
    """Late and gradual, in pieces: what is carried to the next period is the same without the pieces' twists."""
    moment, commands, follows = driven
    twists = BaseTwists(dynamics, moment, commands, follows=follows)
    following = Following(place=0, ends=(0.25, 0.3, 1.0), latency=0.3, added_lag=0.15)
    rng = np.random.default_rng(8)
    moving = ActuatorTwists(*(torch.as_tensor(rng.normal(size=(COUNT, 3))) for _ in range(2)))
    _, _, expected = following.wheels(twists, lambda twist: 0.9 * twist, moving)
    for one, other in zip(following.wheels_at_end(twists, lambda twist: 0.9 * twist, moving), expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)


class BendingDynamics(AskedDynamics):
    """A fin, or a propeller: what it does is no straight line in its setting."""

    inputs = ("command",)

    def predict(self, situation):
        return super().predict(situation.__class__(command=100 * torch.sin(situation.command / 40)))


@pytest.mark.parametrize(("left_behind", "asked"), [(0.0, 0), (0.005, 1), (0.2, 4)])
def test_settings_on_their_way_are_asked_once_for_all_lags_that_leave_little_behind(robots, driven, left_behind, asked):
    moment, commands, _ = driven
    dynamics = BendingDynamics(robots["mgr"])
    twists = BaseTwists(dynamics, moment, commands)
    start = commands[1] + left_behind * (commands[2] - commands[1])
    following = Following(place=0, ends=(0.2, 0.5, 1.0), latency=0.0, added_lag=0.1)
    change = SettingChange(following, 0, start, [0.9, 0.3, 0.02], start)
    largest = max(float(piece.abs().max()) for piece in change.twists(twists))
    dynamics.asked = 0
    change._replace(following=following._replace(added_lag=0.11)).twists(twists)
    assert dynamics.asked == asked * COUNT
    on_the_way = change._on_the_way(twists, [0.5, 1.0])
    for one, left in zip(on_the_way, (0.5, 1.0), strict=True):
        setting = commands[0] + left * (start - commands[0])
        assert (one - twists._ask(setting, setting, setting)).abs().max() < 0.01 * largest
