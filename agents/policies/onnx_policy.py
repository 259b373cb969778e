"""Acting with an ONNX model through onnxruntime: ours, or any with `observation` in and `action` out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.policies.agent_file import BundleError
from agents.policies.policy import PolicyError
from mechanics.untrusted import check_size, parse_json

METADATA = "drive_agent"
MOST_BYTES = 100_000_000  # of a file: far more than any policy that makes its millisecond
CARRIED = {"state": "next_state", "cell": "next_cell"}  # of recurrent agents


class OnnxPolicy:
    """A policy of one thread from an ONNX file.

    Args:
        path: The file.

    Raises:
        BundleError: If it is no model, has other inputs, or onnxruntime is missing.
    """

    def __init__(self, path: str | Path) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise BundleError(f"{path} needs onnxruntime: pip install 'drive-env[agents]'") from None
        if not Path(path).is_file():
            raise BundleError(f"there is no file {path}")
        check_size(Path(path), MOST_BYTES)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # threads cost more than such a network
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises what its own library defines
            raise BundleError(f"{path} is not an ONNX model: {str(error).splitlines()[0]}") from None
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
        self._carried: dict[str, NDArray[np.float32]] = {}
        self._lanes = 0

    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
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
        except Exception as error:  # as above
            raise PolicyError(f"the ONNX model does not take this observation: {str(error).splitlines()[0]}") from None
        self._carried = dict(zip(self._carried, after, strict=True))
        if not np.isfinite(action).all():
            raise PolicyError("the policy's output is not a number")
        found: NDArray[np.float32] = action[0] if np.ndim(observation) == 1 else action
        return found

    def reset(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Reset the state, in all environments or where the mask is true."""
        if mask is None:
            self._lanes = 0
        else:
            self._carried = {name: np.where(mask[:, None], np.float32(0.0), x) for name, x in self._carried.items()}
