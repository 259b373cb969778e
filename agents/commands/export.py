"""`drive-agent export`: an agent as ONNX, checked, with the latency of each runtime."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from agents.commands.options import Json, Trust, errors_as_exit_codes, print_json


def export(
    agent: Annotated[str, typer.Argument(help="agent.npz, checkpoint.zip, or an agent that ships, by name.")],
    out: Annotated[Path | None, typer.Option("--out", help="The .onnx file.", show_default="beside the agent")] = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Write an agent as ONNX, with its normaliser, and check it against the original to 1e-5 of an action's range.

    Prints the latency of the NumPy runtime (which needs no torch: agents/policies/policy.py) and of onnxruntime. A
    checkpoint is compared with Stable-Baselines3's own network, too, and its .npz is written beside the .onnx.
    """
    with errors_as_exit_codes():
        from agents.evaluation.open_policy import open_policy
        from agents.policies.onnx_export import TOLERANCE, compare, trial_observations
        from agents.policies.onnx_export import export as write_onnx
        from agents.policies.onnx_policy import OnnxPolicy
        from agents.policies.policy import measure_latency, policy_of
        from agents.shipped import shipped_names

        if agent not in shipped_names() and not agent.lower().endswith((".npz", ".zip")):
            raise ValueError(f"{agent} must be an agent (.npz), a checkpoint (.zip), or one that ships: "
                             f"{', '.join(shipped_names())}")  # fmt: skip
        path = Path(agent).with_suffix(".onnx") if out is None else out
        if path.suffix.lower() != ".onnx":
            raise ValueError(f"--out {path} must end in .onnx")
        original = open_policy(agent, trust=trust)
        found: dict[str, object] = {"file": str(path)}
        if agent.lower().endswith(".zip"):
            from agents.training.train import bundle_of_checkpoint

            bundle = bundle_of_checkpoint(agent, trust=trust)
            bundle.save(path.with_suffix(".npz"))
        else:
            bundle = original.policy.bundle
        found["NumPy"] = write_onnx(bundle, path)
        if agent.lower().endswith(".zip"):
            worst = compare(bundle, path, original.policy.act)
            if worst > TOLERANCE:
                path.unlink()
                raise ValueError(f"the ONNX model differs from the network by {worst:.1e} of an action's range")
            found["Stable-Baselines3"] = worst
        entries = trial_observations(bundle, 1).shape[2]
        latencies = {
            "NumPy": measure_latency(policy_of(bundle).act, entries),
            "onnxruntime": measure_latency(OnnxPolicy(path).act, entries),
        }
        if json:
            print_json({**found, "latency": {name: one._asdict() for name, one in latencies.items()}})
            return
        for name in ("NumPy", "Stable-Baselines3"):
            if name in found:
                print(f"largest difference from {name}: {found[name]:.1e} of an action's range")
        for name, one in latencies.items():
            print(f"{name}: {one} per action")
        print(f"written to {path}, {path.stat().st_size / 1000:.0f} kB")
