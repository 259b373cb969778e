"""Why drives switched themselves off: what their emergencies say."""

from __future__ import annotations

from drive_env.drives.interface import Drives

UNTOLD = "no emergency message with the cause was received"


def stop_causes(drives: Drives) -> list[str]:
    """Return what each axis of the drives has told since its emergencies were read last, most important for a message.

    Returns:
        A text for each axis: "undervoltage (3220h), ..." in the order of the emergencies, or that there was none.
    """
    return [told or UNTOLD for told in told_causes(drives)]


def told_causes(drives: Drives) -> list[str]:
    """Return the same, "" for an axis that has told nothing."""
    told: list[dict[str, None]] = [{} for _ in range(drives.num_axes)]
    for message in drives.emergencies():
        if message.code:
            told[message.axis][f"{message.name.replace('_', ' ')} ({message.code:04X}h)"] = None
    return [", ".join(axis) for axis in told]
