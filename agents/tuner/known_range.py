"""The devices, motors, loads and machines that a tuner's card covers, and a target's parts outside."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agents.policies.agent_file import AgentFile
    from tuning.target import Target

HOLDS = "holds for"  # on a card: a table of "devices", "motors" and "loads", names, and "axes of a machine"


def outside(agent: AgentFile, target: Target, load: str | None) -> tuple[str, ...]:
    """Return a sentence for each part of a target that the tuner was not trained on.

    Args:
        agent: The tuner's file. A card without this table covers the file's configuration.
        target: The target to tune.
        load: Name of the load; None if unknown, as on a bus.
    """
    holds = agent.card.get(HOLDS)
    if not isinstance(holds, Mapping):
        holds = _of_configuration(agent.configuration)
    facts = (
        ("device", target.device.name, holds.get("devices")),
        ("motor", target.motor.name, holds.get("motors")),
        ("load", load, holds.get("loads")),
        ("number of axes of a machine", target.axes_per_machine, [holds.get("axes of a machine")]),
    )
    return tuple(
        f"the agent was not trained on this {what}: {value}, and its card holds for {', '.join(map(str, trained))}; "
        "drive-tune auto designs gains for any"
        for what, value, trained in facts
        if value is not None and isinstance(trained, list) and value not in trained
    )


def _of_configuration(configuration: Mapping[str, Any]) -> dict[str, Any]:
    from drive_env.envs.gain_tuning import GainTuningConfig
    from drive_env.motors import find_motor
    from mechanics.loads import find_load

    own = {name: configuration[name] for name in ("device", "load", "motor") if name in configuration}
    trained = GainTuningConfig(**own)
    load = find_load(trained.load)
    assert trained.motor is not None, "the configuration takes the device's own by default"
    return {
        "devices": [trained.device],
        "motors": [find_motor(trained.motor).name],
        "loads": [load.name],
        "axes of a machine": load.num_axes,
    }
