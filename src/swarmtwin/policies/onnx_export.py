"""A policy as ONNX: what runs where there is no torch, on the robots' controller."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime  # type: ignore[import-untyped]
import torch
from onnx import helper, numpy_helper
from torch import Tensor, nn

from swarmtwin.errors import UserError
from swarmtwin.files import whole_file
from swarmtwin.policies.policy import ACTIVATIONS, Policy

ONNX = "policy.onnx"
FLOAT = onnx.TensorProto.FLOAT
OPERATORS = {ACTIVATIONS["relu"]: "Relu", ACTIVATIONS["tanh"]: "Tanh"}


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
    """Compare an ONNX model's commands with those that the policy computes in double precision.

    Large weights make rounding large, so what the policy's own single precision costs is allowed several times over.

    Args:
        content: the model.
        policy: what it was made from.
        largest_difference: between two commands beyond rounding, as a share of the commands' range.
        trials: how many random observations are tried.

    Raises:
        UserError: they differ, or are not finite.
    """
    observation = np.random.default_rng(0).normal(0, 2, (trials, len(policy.observation_names))).astype(np.float32)
    exact = _in_double_precision(policy, observation)
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    (computed,) = session.run(["command"], {"observation": observation})
    span = policy.robot.command_high - policy.robot.command_low
    rounding, difference = (
        float(np.max(np.abs(command - exact) / span)) for command in (policy.act(observation[None])[0], computed)
    )
    if not difference <= largest_difference + 4 * rounding:
        raise UserError(
            f"the policy of {policy.robot.name!r} computes other commands as ONNX, by {difference:.2g} of their range: "
            "report this"
        )


def _in_double_precision(policy: Policy, observation: np.ndarray) -> np.ndarray:
    with torch.inference_mode():
        commands: np.ndarray = copy.deepcopy(policy).double()(torch.as_tensor(observation).double()).numpy()
    return commands


def onnx_model(policy: Policy) -> onnx.ModelProto:
    """Return the policy's forward pass as operators of ONNX; the same policy gives the same bytes.

    A perceptron is few of them: torch's own export would take seconds, and note the paths of the machine that exported.
    """
    nodes: list[onnx.NodeProto] = []
    constants: list[onnx.TensorProto] = []

    def constant(name: str, values: Tensor | np.ndarray) -> str:
        constants.append(numpy_helper.from_array(np.asarray(values, np.float32), name))
        return name

    def apply(operator: str, *inputs: str, **options: Any) -> str:
        output = f"{operator.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(operator, inputs, [output], **options))
        return output

    share = "observation"
    for index, layer in enumerate(policy.network):
        if isinstance(layer, nn.Linear):
            weight, bias = (
                constant(f"{index}.{name}", values.detach().cpu())
                for name, values in (("weight", layer.weight), ("bias", layer.bias))
            )
            share = apply("Gemm", share, weight, bias, transB=1)
        else:
            share = apply(OPERATORS[type(layer)], share)
    if policy.architecture.squashing == "tanh":
        share = apply("Tanh", share)
    else:
        share = apply("Clip", share, constant("least", np.array(-1.0)), constant("most", np.array(1.0)))
    low, high = policy.command_low.cpu(), policy.command_high.cpu()
    half, least = constant("half_range", (high - low) / 2), constant("command_low", low)
    command = apply("Add", least, apply("Mul", half, apply("Add", share, constant("one", np.ones(1)))))
    apply("Min", apply("Max", command, least), constant("command_high", high))
    nodes[-1].output[0] = "command"
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", FLOAT, ["vehicles", len(policy.observation_names)])],
        [helper.make_tensor_value_info("command", FLOAT, ["vehicles", len(low)])],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model, full_check=True)
    return model
