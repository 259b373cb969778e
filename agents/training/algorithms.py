"""The algorithms of Stable-Baselines3 and sb3-contrib for training agents."""

from __future__ import annotations

import importlib
from typing import Any

# Algorithm -> its class.
ALGORITHMS = {
    "ppo": "stable_baselines3:PPO",
    "sac": "stable_baselines3:SAC",
    "recurrent_ppo": "sb3_contrib:RecurrentPPO",
    "tqc": "sb3_contrib:TQC",
    "crossq": "sb3_contrib:CrossQ",
}
# Algorithm -> the algorithm whose hyper-parameters it shares: TQC is SAC with critics of quantiles (arXiv:2005.04269),
# CrossQ is SAC with normalised layers instead of target networks (arXiv:1902.05605).
SAME_HYPERPARAMETERS = {"tqc": "sac", "crossq": "sac"}
# Algorithm -> shared hyper-parameters that it does not have.
NOT_TAKEN = {"crossq": ("tau",)}


class MissingPackageError(ImportError):
    """A package that training needs is not installed; the message says which extra has it."""


def need(package: str) -> None:
    """Raise MissingPackageError for a package that is not installed."""
    try:
        importlib.import_module(package)
    except ImportError:
        raise MissingPackageError(
            f"training needs {package}, which is not installed: pip install 'drive-env[agents]'"
        ) from None


def algorithm_class(name: str) -> Any:
    """Return the class of an algorithm."""
    module, _, kind = ALGORITHMS[name].partition(":")
    need(module)
    return getattr(importlib.import_module(module), kind)
