"""A policy as ONNX: what runs where there is no torch, on the robots' controller."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime  # type: ignore[import-untyped]
import torch

from swarmtwin.errors import UserError
from swarmtwin.files import whole_file
from swarmtwin.learning.progress_bars import quieter
from swarmtwin.policies.policy import Policy

ONNX = "policy.onnx"


def write_onnx(path: Path, policy: Policy) -> None:
    """Write a policy: input `observation` (N, o), output `command` (N, m) in the robot's units.

    Raises:
        UserError: ONNX computes other commands than torch, or any that are not finite.
    """
    content = onnx_model(policy).SerializeToString()
    check_equal(content, policy)
    with whole_file(path) as aside:
        aside.write_bytes(content)


def check_equal(content: bytes, policy: Policy, largest_difference: float = 1e-5, trials: int = 512) -> None:
    """Compare an ONNX model's commands with the policy's.

    Args:
        content: the model.
        policy: what it was made from.
        largest_difference: between two commands, as a share of the commands' range.
        trials: how many random observations are tried.

    Raises:
        UserError: they differ, or are not finite.
    """
    observation = np.random.default_rng(0).normal(0, 2, (trials, len(policy.observation_names))).astype(np.float32)
    expected = policy.act(observation[None])[0]
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    (computed,) = session.run(["command"], {"observation": observation})
    span = policy.robot.command_high - policy.robot.command_low
    difference = float(np.max(np.abs(computed - expected) / span))
    if not difference <= largest_difference:
        raise UserError(
            f"the policy of {policy.robot.name!r} computes other commands as ONNX, by {difference:.2g} of their range: "
            "report this"
        )


def onnx_model(policy: Policy) -> onnx.ModelProto:
    """Return the policy's forward pass as torch exports it; the same policy gives the same bytes."""
    example = torch.zeros(2, len(policy.observation_names))
    # what the export says of libraries that are not installed, and of its own future, is nothing for a user
    with quieter("torch.onnx"), warnings.catch_warnings(action="ignore"):
        program = torch.onnx.export(
            policy.eval(),
            (example,),
            input_names=["observation"],
            output_names=["command"],
            dynamic_shapes=({0: torch.export.Dim("vehicles")},),
            opset_version=18,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model: onnx.ModelProto = program.model_proto
    _forget_source(model)
    onnx.checker.check_model(model)
    return model


def _forget_source(model: onnx.ModelProto) -> None:
    """Take out what the export notes of the source code: its paths are those of the machine that exported it."""
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        annotated: Any = part
        annotated.ClearField("metadata_props")
