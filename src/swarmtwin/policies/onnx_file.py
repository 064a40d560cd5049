"""A policy as ONNX: what runs where there is no torch, on the robots' controller."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime  # type: ignore[import-untyped]
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from swarmtwin.errors import UserError
from swarmtwin.files import whole_file
from swarmtwin.policies.policy import Policy

ONNX = "policy.onnx"
OPSET = 18
LARGEST_DIFFERENCE = 1e-5
TRIALS = 512


def write_onnx(path: Path, policy: Policy) -> None:
    """Write a policy: input `observation` (N, o), output `command` (N, m) in the robot's units.

    Raises:
        UserError: ONNX computes other commands than torch, or any that are not finite.
    """
    content = onnx_model(policy).SerializeToString()
    check_equal(content, policy)
    with whole_file(path) as aside:
        aside.write_bytes(content)


def check_equal(content: bytes, policy: Policy) -> None:
    """Compare an ONNX model's commands with the policy's, for many observations; relative to the commands' range.

    Raises:
        UserError: they differ, or are not finite.
    """
    observation = np.random.default_rng(0).normal(0, 2, (TRIALS, len(policy.observation_names))).astype(np.float32)
    expected = policy.act(observation[None])[0]
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    (computed,) = session.run(["command"], {"observation": observation})
    span = policy.robot.command_high - policy.robot.command_low
    difference = float(np.max(np.abs(computed - expected) / span))
    if not difference <= LARGEST_DIFFERENCE:
        raise UserError(
            f"the policy of {policy.robot.name!r} computes other commands as ONNX, by {difference:.2g} of their range: "
            "report this"
        )


def onnx_model(policy: Policy) -> onnx.ModelProto:
    """Return the policy's forward pass as an ONNX model; the same policy gives the same bytes."""
    low, high, one = policy.command_low, policy.command_high, torch.ones(1)
    constants = {"low": low, "high": high, "span": high - low, "one": one, "half": 0.5 * one}
    if policy.architecture.squashing == "clip":
        constants["minus_one"] = -one
    nodes, last = [], "observation"
    for index, layer in enumerate(policy.network):
        name = f"layer_{index}"
        if isinstance(layer, nn.Linear):
            constants |= {f"{name}_weight": layer.weight, f"{name}_bias": layer.bias}
            inputs = [last, f"{name}_weight", f"{name}_bias"]
            nodes.append(helper.make_node("Gemm", inputs, [name], transB=1))
        else:
            nodes.append(helper.make_node("Relu" if isinstance(layer, nn.ReLU) else "Tanh", [last], [name]))
        last = name
    nodes += _commands(policy, last)
    columns, size = len(policy.robot.command), len(policy.observation_names)
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["vehicles", size])],
        [helper.make_tensor_value_info("command", TensorProto.FLOAT, ["vehicles", columns])],
        [numpy_helper.from_array(tensor.detach().numpy(), name) for name, tensor in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="swarmtwin")
    model.ir_version = 10
    onnx.checker.check_model(model)
    return model


def _commands(policy: Policy, output: str) -> list[onnx.NodeProto]:
    """Return the nodes that turn the network's output into commands within their limits."""
    squash = [helper.make_node("Tanh", [output], ["share"])]
    if policy.architecture.squashing == "clip":
        at_least = helper.make_node("Max", [output, "minus_one"], ["at_least"])
        squash = [at_least, helper.make_node("Min", ["at_least", "one"], ["share"])]
    return [
        *squash,
        helper.make_node("Add", ["share", "one"], ["raised"]),
        helper.make_node("Mul", ["raised", "half"], ["fraction"]),
        helper.make_node("Mul", ["fraction", "span"], ["above_low"]),
        helper.make_node("Add", ["above_low", "low"], ["unbounded"]),
        helper.make_node("Max", ["unbounded", "low"], ["not_below"]),
        helper.make_node("Min", ["not_below", "high"], ["command"]),
    ]
