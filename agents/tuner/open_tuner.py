"""A trained tuner by its name or file, for a device; and its trials as printed lines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from agents.policies.policy import load_policy
from agents.shipped import find_agent
from agents.tuner.tune_target import gains_for
from drive_env.devices import find_device
from drive_env.devices.gains import check_linear_model
from drive_env.loops.dynamics import find_dynamics

if TYPE_CHECKING:
    from agents.tuner.tune_target import TrialShown
    from drive_env.devices.gain_set import GainSet

MOST_TRIALS = 10_000
ENVIRONMENT = "ServoDrive/GainTuning-v0"


def open_tuner(agent: str, device: str, trials: int | None, dynamics: str | None = None) -> Any:
    """Return the agent's policy, with another number of trials or other dynamics if given.

    Raises:
        ValueError: If it cannot tune the device; raised before anything moves.
    """
    if trials is not None and not 1 <= trials <= MOST_TRIALS:
        raise ValueError(f"--trials {trials} must be 1 or more, and {MOST_TRIALS} at most: each turns the motor")
    policy = load_policy(find_agent(agent))
    if policy.bundle.environment != ENVIRONMENT:
        raise ValueError(
            f"agent {agent} acts in {policy.bundle.environment}; a tuner acts in {ENVIRONMENT}; give one of those"
        )
    known = find_device(device)
    gains_for(policy.bundle.configuration, known)
    check_linear_model(known)
    if dynamics is not None:
        policy.bundle.configuration["dynamics"] = find_dynamics(dynamics).name
    if trials is not None:
        policy.bundle.configuration["trials"] = trials
    return policy


def titles_of_trials(known: GainSet) -> list[str]:
    """Return the titles of the gains in a trial's line."""
    return [known.titles[k] for k in known.columns_of("velocity", "position")]


def remark(trial: TrialShown) -> str:
    """Return the remark on a trial of one machine, "" for none."""
    mark = "better" if trial.better[0] else ""
    if trial.lowered[0]:
        mark = f"{mark}; " * bool(mark) + "lowered: the agent's proposal breaks the dynamics"
    if trial.number == 0:
        broken = "" if trial.kept[0] else "; they break the dynamics"
        mark = f"the baseline rule's gains, where the agent starts{broken}"
    if trial.aborted[0]:
        told = ", ".join(name.replace("_", " ") for name in trial.faults[0])
        rule = f"; {mark}" if trial.number == 0 else ""
        mark = f"stopped: it oscillated or went into fault{told and f'; the drive reported {told}'}{rule}"
    return mark
