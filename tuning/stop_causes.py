"""Why drives switched themselves off: the texts of their emergencies."""

from __future__ import annotations

from drive_env import cia402
from drive_env.drives.interface import Drives, Observer

UNTOLD = "no emergency message with the cause was received"


class ToldCauses(Observer):
    """Remembers the drives' emergencies while a tuner works on them: each emergency can be read only once.

    Attributes:
        told: Last emergencies of each axis as text, "" without any.
    """

    def __init__(self, num_axes: int) -> None:
        self.told = [""] * num_axes


def stop_causes(drives: Drives) -> list[str]:
    """Return the emergencies of each axis since they were last read, the most important causes for a message.

    An axis in fault without new emergencies gets its remembered ones, if the drives have `ToldCauses`
    (`tuning.target.timed` adds it).

    Returns:
        One text for each axis: "undervoltage (3220h), ..." in the order of arrival, or that none was received.
    """
    told, remembered = told_causes(drives), _remembered(drives)
    if remembered is not None and any(before and not now for now, before in zip(told, remembered.told, strict=True)):
        fault = cia402.matches(drives.read(cia402.STATUSWORD), cia402.FAULT_BIT)
        told = [now or (before if held else "") for now, before, held in zip(told, remembered.told, fault, strict=True)]
    return [each or UNTOLD for each in told]


def told_causes(drives: Drives) -> list[str]:
    """Return the emergencies of each axis since they were last read, "" for an axis without one."""
    told: list[dict[str, None]] = [{} for _ in range(drives.num_axes)]
    for message in drives.emergencies():
        if message.code:
            told[message.axis][f"{message.name.replace('_', ' ')} ({message.code:04X}h)"] = None
    causes = [", ".join(axis) for axis in told]
    if (remembered := _remembered(drives)) is not None:
        remembered.told = [now or before for now, before in zip(causes, remembered.told, strict=True)]
    return causes


def _remembered(drives: Drives) -> ToldCauses | None:
    return next((each for each in drives.observers if isinstance(each, ToldCauses)), None)
