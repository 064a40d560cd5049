import dataclasses
import multiprocessing

import numpy as np
import pytest

from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.training import train
from swarmtwin.errors import UserError
from toy import recipe, toy_transitions

ENDLESS = config_class("mlp")(steps=10_000_000)


@pytest.fixture(scope="module")
def transitions(robots):
    return toy_transitions(robots["mgr"], 600)


def test_what_a_worker_raises_is_raised_here(transitions):
    without_validation = dataclasses.replace(transitions, split=np.zeros(len(transitions), int))
    with pytest.raises(UserError, match=r"^the validation split has 0 transitions: "):
        train(without_validation, ENDLESS, recipe(), [0, 1], processes=2)
    assert not multiprocessing.active_children()
