"""Acting with an ONNX model through onnxruntime: ours, or any with `observation` in and `action` out."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from agents.policies.agent_file import BundleError
from agents.policies.policy import PolicyError
from mechanics.arrays import Mask, Singles
from mechanics.reading.limited_child import call_limited
from mechanics.reading.untrusted import parse_json, read_bytes

METADATA = "drive_agent"
MOST_BYTES = 100_000_000  # of a file: far more than a policy that computes within a millisecond
ACTION_TIME, ACTION_MEMORY = 20.0, 2_000_000_000  # processor time [s] and bytes for loading it and one action
CARRIED = {"state": "next_state", "cell": "next_cell"}  # of recurrent agents


class OnnxPolicy:
    """A policy of one thread from an ONNX file.

    A file of a few bytes may demand 10^11 numbers or 10^15 rounds of a loop: another process first acts once.

    Args:
        path: The file.

    Raises:
        BundleError: If it is not a model, has other inputs, one action exceeds a limit, or onnxruntime is missing.
    """

    def __init__(self, path: str | Path) -> None:
        try:
            import onnxruntime  # noqa: F401
        except ImportError:
            raise BundleError(f"{path} needs onnxruntime: pip install 'drive-env[agents]'") from None
        if not Path(path).is_file():
            raise BundleError(f"there is no file {path}")
        _check_limits(Path(path))
        self._session = _session(path)
        inputs = {one.name: one.shape for one in self._session.get_inputs()}
        outputs = [one.name for one in self._session.get_outputs()]
        if "observation" not in inputs or "action" not in outputs:
            raise BundleError(
                f"{path} takes {', '.join(inputs)} and gives {', '.join(outputs)}; a policy takes `observation`, "
                "shape (environments, entries), and gives `action`"
            )
        try:
            about = parse_json(self._session.get_modelmeta().custom_metadata_map.get(METADATA, "{}"))
            self.environment: str | None = about.get("environment")
            self.configuration: dict[str, Any] = dict(about.get("configuration", {}))
            self.card: dict[str, Any] = dict(about.get("card", {}))
        except (ValueError, TypeError, AttributeError) as error:
            raise BundleError(f"{path}: its metadata {METADATA!r} is not ours: {error}; export it again") from None
        if not isinstance(self.environment, str | None):
            raise BundleError(f"{path}: its metadata names {self.environment!r} as environment; export the agent again")
        for name in CARRIED:
            if name in inputs and not (len(inputs[name]) == 2 and isinstance(inputs[name][1], int)):
                raise BundleError(f"{path}: {name} has shape {inputs[name]}; a policy's is (environments, cells)")
        self._outputs = ["action", *(CARRIED[name] for name in CARRIED if name in inputs)]
        self._cells = {name: int(inputs[name][1]) for name in CARRIED if name in inputs}
        self._carried: dict[str, Singles] = {}
        self._lanes = 0

    def act(self, observation: ArrayLike) -> Singles:
        """Return the action for one observation, or one for each environment.

        Raises:
            PolicyError: If observation or action is not a number, or the observation has another shape.
        """
        rows = np.atleast_2d(np.asarray(observation, np.float32))
        if not np.isfinite(rows).all():
            raise PolicyError("the observation is not a number: the policy was not called")
        if len(rows) != self._lanes:
            self._lanes = len(rows)
            self._carried = {name: np.zeros((self._lanes, cells), np.float32) for name, cells in self._cells.items()}
        try:
            action, *after = self._session.run(self._outputs, {"observation": rows, **self._carried})
        except Exception as error:  # onnxruntime raises exceptions of its own library
            raise PolicyError(f"the ONNX model does not take this observation: {str(error).splitlines()[0]}") from None
        self._carried = dict(zip(self._carried, after, strict=True))
        if not np.isfinite(action).all():
            raise PolicyError("the policy's output is not a number")
        found: Singles = action[0] if np.ndim(observation) == 1 else action
        return found

    def reset(self, mask: Mask | None = None) -> None:
        """Reset the state, in all environments or where the mask is true."""
        if mask is None:
            self._lanes = 0
        else:
            self._carried = {name: np.where(mask[:, None], np.float32(0.0), x) for name, x in self._carried.items()}


_harmless: set[bytes] = set()  # hashes of files that have acted once within the limits


def _check_limits(path: Path) -> None:
    """Raise BundleError unless a model can be loaded and act within the limits."""
    try:
        content = hashlib.sha256(read_bytes(path, MOST_BYTES)).digest()
        if content not in _harmless:
            call_limited(f"the policy {path}", _act_once, path, memory=ACTION_MEMORY, time=ACTION_TIME)
            _harmless.add(content)
    except ValueError as error:
        raise BundleError(str(error)) from None


def _act_once(path: Path) -> bytes:
    session = _session(path)
    rows = {one.name: np.zeros([n if isinstance(n, int) else 1 for n in one.shape], np.float32)
            for one in session.get_inputs()}  # fmt: skip
    try:
        session.run(None, rows)
    except Exception as error:  # unsupported content is reported when it is used
        if "alloc" in str(error):
            raise MemoryError from None
    return b""


def _session(path: str | Path) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # threads cost more than such a network
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises exceptions of its own library
        raise BundleError(f"{path} is not an ONNX model: {str(error).splitlines()[0]}") from None
