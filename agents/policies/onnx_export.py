"""A bundle as ONNX: the normaliser and the action's bounds inside, the agent's card in its metadata.

Inputs: `observation` (environments, entries), float32; of a recurrent agent also `state` and `cell` (environments,
cells), zeros at an episode's begin. Outputs: `action` (environments, actions); of a recurrent agent also `next_state`
and `next_cell`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from agents.policies.agent_file import AgentFile, BundleError
from drive_env.whole_file import write_whole
from mechanics.arrays import Singles

OPSET, IR_VERSION = 17, 8  # old enough for the runtimes of recent years
TOLERANCE = 1e-5  # of an action's range: float32 is summed in another order there
METADATA = "drive_agent"

# Activation -> its ONNX operator; None if it takes several.
_OPERATORS = {"tanh": "Tanh", "relu": "Relu", "elu": "Elu", "leaky_relu": "LeakyRelu", "silu": None}


class Graph:
    """An ONNX graph that grows by calls; names are given in order."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: Any, kind: Any = np.float32) -> str:
        """Return the name of a constant."""
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, kind), name))
        return name

    def add(self, operator: str, *inputs: str, outputs: int = 1, named: str | None = None, **options: Any) -> Any:
        """Return the name of a node's output, or the names of several."""
        from onnx import helper

        names = [named] if named else [f"{operator.lower()}_{len(self.nodes)}_{k}" for k in range(outputs)]
        self.nodes.append(helper.make_node(operator, list(inputs), names, **options))
        return names[0] if outputs == 1 else names


def to_onnx(bundle: AgentFile) -> Any:
    """Return the ONNX model of a bundle.

    Raises:
        BundleError: For a kind that cannot be exported.
    """
    from onnx import checker, helper

    if bundle.kind not in _BODIES:
        raise BundleError(
            f"an agent of kind {bundle.kind!r} cannot be written as ONNX, only {', '.join(_BODIES)}; use its file "
            "with NumPy alone: agents.policies.policy.load_policy"
        )
    graph = Graph()
    x = _enter(graph, bundle)
    x, inputs, outputs = _BODIES[bundle.kind](graph, bundle, x)
    _leave(graph, bundle, x)
    entries, actions = len(bundle.arrays["observation_mean"]), len(bundle.arrays["action_low"])
    made = helper.make_graph(
        graph.nodes,
        "policy",
        [_matrix("observation", entries), *inputs],
        [_matrix("action", actions), *outputs],
        graph.constants,
    )
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="drive-agent")
    model.ir_version = IR_VERSION
    about = {"environment": bundle.environment, "configuration": dict(bundle.configuration)}
    about |= {"card": dict(bundle.card), "hash": bundle.hash}
    helper.set_model_props(model, {METADATA: json.dumps(about)})
    checker.check_model(model)
    return model


def export(bundle: AgentFile, path: str | Path) -> float:
    """Write a bundle as ONNX and return the largest difference of an action from NumPy's, as a share of its range.

    Raises:
        BundleError: If it is larger than TOLERANCE; no file is left then.
    """
    path = Path(path)
    write_whole(path, to_onnx(bundle).SerializeToString())
    worst = compare(bundle, path)
    if worst > TOLERANCE:
        path.unlink()
        raise BundleError(f"the ONNX model differs by {worst:.1e} of an action's range; {TOLERANCE:g} is allowed")
    return worst


def compare(bundle: AgentFile, path: str | Path, act: Callable[[Any], Any] | None = None) -> float:
    """Return the largest difference of an ONNX model's actions from another policy's, as a share of their range.

    Args:
        bundle: The agent.
        path: The ONNX model.
        act: The function to compare with; the bundle's own NumPy runtime by default.
    """
    from agents.policies.onnx_policy import OnnxPolicy
    from agents.policies.policy import policy_of

    one, two = OnnxPolicy(path), act or policy_of(bundle).act
    span = np.asarray(bundle.arrays["action_high"]) - np.asarray(bundle.arrays["action_low"])
    worst = 0.0
    for rows in trial_observations(bundle):
        worst = max(worst, float(np.max(np.abs(one.act(rows) - two(rows)) / span)))
    return worst


def trial_observations(bundle: AgentFile, steps: int = 200) -> Singles:
    """Return observations in the range of a training and far beyond, shape (steps, 16 environments, entries)."""
    mean, scale = bundle.arrays["observation_mean"], bundle.arrays["observation_scale"]
    rng = np.random.default_rng(0)
    spread = np.exp(rng.uniform(np.log(0.1), np.log(20.0), (steps, 16, 1)))
    noise = rng.standard_normal((steps, 16, len(mean))) * spread / np.maximum(np.abs(scale), 1e-6)
    return np.asarray(mean + noise, np.float32)


def _enter(graph: Graph, bundle: AgentFile) -> str:
    clip = bundle.settings.get("observation_clip")
    if clip is None:
        return "observation"
    # In doubles, as NumPy does: otherwise a mean far from 0 would cost digits.
    x = graph.add("Cast", "observation", to=11)
    x = graph.add("Sub", x, graph.constant(bundle.arrays["observation_mean"], np.float64))
    x = graph.add("Mul", x, graph.constant(bundle.arrays["observation_scale"], np.float64))
    x = graph.add("Clip", x, graph.constant(-clip, np.float64), graph.constant(clip, np.float64))
    return str(graph.add("Cast", x, to=1))


def _leave(graph: Graph, bundle: AgentFile, x: str) -> None:
    low, high = (np.asarray(bundle.arrays[f"action_{end}"], np.float32) for end in ("low", "high"))
    if bundle.settings["output"] == "clip":
        x = graph.add("Max", x, graph.constant(low))
        graph.add("Min", x, graph.constant(high), named="action")
        return
    x = graph.add("Tanh", x)
    x = graph.add("Mul", x, graph.constant(0.5 * (high - low)))
    graph.add("Add", x, graph.constant(low + np.float32(0.5) * (high - low)), named="action")


def _layers(graph: Graph, bundle: AgentFile, x: str) -> str:
    count = sum(name.startswith("weight_") for name in bundle.arrays)
    for k in range(count):
        weight, bias = (graph.constant(bundle.arrays[f"{name}_{k}"]) for name in ("weight", "bias"))
        x = graph.add("Gemm", x, weight, bias)
        if k < count - 1:
            operator = _OPERATORS[bundle.settings["activation"]]
            x = graph.add(operator, x) if operator else graph.add("Mul", x, graph.add("Sigmoid", x))
    return x


def _mlp(graph: Graph, bundle: AgentFile, x: str) -> tuple[str, list[Any], list[Any]]:
    return _layers(graph, bundle, x), [], []


def _lstm(graph: Graph, bundle: AgentFile, x: str) -> tuple[str, list[Any], list[Any]]:
    cells = len(bundle.arrays["lstm_state"])
    gates = graph.add(
        "Gemm", x, graph.constant(bundle.arrays["lstm_input"]), graph.constant(bundle.arrays["lstm_bias"])
    )
    gates = graph.add("Add", gates, graph.add("MatMul", "state", graph.constant(bundle.arrays["lstm_state"])))
    parts = graph.constant([cells] * 4, np.int64)
    enter, forget, cell, leave = graph.add("Split", gates, parts, outputs=4, axis=1)
    kept = graph.add("Mul", graph.add("Sigmoid", forget), "cell")
    new = graph.add("Mul", graph.add("Sigmoid", enter), graph.add("Tanh", cell))
    graph.add("Add", kept, new, named="next_cell")
    graph.add("Mul", graph.add("Sigmoid", leave), graph.add("Tanh", "next_cell"), named="next_state")
    x = _layers(graph, bundle, "next_state")
    return (
        x,
        [_matrix(name, cells) for name in ("state", "cell")],
        [_matrix(name, cells) for name in ("next_state", "next_cell")],
    )


# Kind of a bundle -> builder of its network; inputs and outputs besides observation and action.
_BODIES: dict[str, Callable[[Graph, AgentFile, str], tuple[str, list[Any], list[Any]]]] = {"mlp": _mlp, "lstm": _lstm}


def _matrix(name: str, columns: int) -> Any:
    from onnx import TensorProto, helper

    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["lanes", columns])
