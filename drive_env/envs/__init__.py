"""The Gymnasium environments; `import drive_env` registers them, and each is imported only when one is made.

Each has a file with its vector environment, a class of `lanes.Lanes`; the single environment is a view of it.
"""

from __future__ import annotations

from typing import Any

import gymnasium

# Name -> file and class of the vector environment.
ENVIRONMENTS = {
    "ServoDrive/GainTuning-v0": ("gain_tuning", "GainTuning"),
    "ServoDrive/GainScheduling-v0": ("gain_scheduling", "GainScheduling"),
    "ServoDrive/Tracking-v0": ("tracking", "Tracking"),
}


def register() -> None:
    """Register the environments with Gymnasium, once."""
    for name, (module, kind) in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"drive_env.envs:make_{module}",
                vector_entry_point=f"drive_env.envs.{module}:{kind}",
            )


def make_gain_tuning(**options: Any) -> gymnasium.Env[Any, Any]:
    """Return one lane of GainTuning."""
    from drive_env.envs.gain_tuning import GainTuning
    from drive_env.envs.lanes import OneLane

    return OneLane(GainTuning(1, autoreset_mode="Disabled", **options))


def make_gain_scheduling(**options: Any) -> gymnasium.Env[Any, Any]:
    """Return one lane of GainScheduling."""
    from drive_env.envs.gain_scheduling import GainScheduling
    from drive_env.envs.lanes import OneLane

    return OneLane(GainScheduling(1, autoreset_mode="Disabled", **options))


def make_tracking(**options: Any) -> gymnasium.Env[Any, Any]:
    """Return one lane of Tracking."""
    from drive_env.envs.lanes import OneLane
    from drive_env.envs.tracking import Tracking

    return OneLane(Tracking(1, autoreset_mode="Disabled", **options))
