"""What is compiled moves vehicles as the plain formulas do."""

import numpy as np
import pytest
import torch

from swarmtwin import compilable
from swarmtwin.geometry import compose, displacement_between, exp_map, log_map
from swarmtwin.simulation import arcs
from swarmtwin.simulation.arcs import moved_along, twist_between


@pytest.mark.parametrize("share", [1.0, 0.125, 0.0, -0.5])
def test_compiled_arcs_are_those_of_the_formulas(share):
    rng = np.random.default_rng(1)
    pose = torch.as_tensor(rng.uniform(-1, 1, (500, 3)) * [1000.0, 1000.0, np.pi])
    twist = torch.as_tensor(rng.normal(size=(500, 3)) * [100.0, 20.0, 2.0])
    twist[:20, 2], twist[20:40] = 0.0, 0.0
    torch.testing.assert_close(
        moved_along(pose, twist, share), compose(pose, exp_map(twist * share)), rtol=0, atol=1e-9
    )
    strided = moved_along(pose.T.contiguous().T, twist, share)
    torch.testing.assert_close(strided, moved_along(pose, twist, share), rtol=0, atol=0)


def test_compiled_twists_between_poses_are_those_of_the_formulas():
    rng = np.random.default_rng(2)
    start, end = (torch.as_tensor(rng.uniform(-1, 1, (500, 3)) * [1000.0, 1000.0, np.pi]) for _ in range(2))
    end[:20, 2], end[20:40] = start[:20, 2], start[20:40]
    twist = twist_between(start, end)
    torch.testing.assert_close(twist, log_map(displacement_between(start, end)), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(moved_along(start, twist), end, rtol=0, atol=1e-6)


def test_compiled_maps_between_twists_and_displacements_are_the_formulas_and_wrap_no_turn():
    rng = np.random.default_rng(3)
    twist = torch.as_tensor(rng.normal(size=(500, 3)) * [100.0, 20.0, 2.0])
    twist[:20, 2], twist[20:40], twist[40] = 0.0, 0.0, torch.tensor([10.0, 1.0, 5.0])
    moved = arcs.exp_map(twist)
    torch.testing.assert_close(moved, exp_map(twist), rtol=0, atol=1e-9)
    torch.testing.assert_close(arcs.log_map(moved), log_map(moved), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(arcs.log_map(moved), twist, rtol=1e-6, atol=1e-6)


def test_headings_come_wrapped():
    pose = torch.tensor([[0.0, 0.0, np.pi], [0.0, 0.0, 3.0], [0.0, 0.0, -3.0]], dtype=torch.float64)
    turned = moved_along(pose, torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64))
    torch.testing.assert_close(
        turned[:, 2], torch.tensor([np.pi, 4.0 - 2 * np.pi, 2 * np.pi - 4.0], dtype=torch.float64)
    )


def test_gradients_and_single_precision_go_by_the_formulas():
    pose, twist = torch.zeros(3, 3), torch.ones(3, 3, requires_grad=True)
    moved = moved_along(pose, twist)
    assert moved.dtype == torch.float32
    moved.sum().backward()
    assert torch.isfinite(twist.grad).all()


def test_without_numba_the_formulas_are_used(monkeypatch):
    monkeypatch.setattr(compilable, "can_compile", lambda: False)
    pose, twist = torch.ones(4, 3, dtype=torch.float64), torch.full((4, 3), 0.3, dtype=torch.float64)
    torch.testing.assert_close(moved_along(pose, twist), compose(pose, exp_map(twist)), rtol=0, atol=0)
    torch.testing.assert_close(twist_between(pose, twist), log_map(displacement_between(pose, twist)), rtol=0, atol=0)
    torch.testing.assert_close(arcs.exp_map(twist), exp_map(twist), rtol=0, atol=0)
    torch.testing.assert_close(arcs.log_map(twist), log_map(twist), rtol=0, atol=0)
