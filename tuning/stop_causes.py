"""Why drives switched themselves off: what their emergencies say."""

from __future__ import annotations

from drive_env import cia402
from drive_env.drives.interface import Drives, Observer

UNTOLD = "no emergency message with the cause was received"


class ToldCauses(Observer):
    """Remembers what drives have told, for as long as a tuner works on them: an emergency can be read but once.

    Attributes:
        told: What each axis told last, "" for nothing.
    """

    def __init__(self, num_axes: int) -> None:
        self.told = [""] * num_axes


def stop_causes(drives: Drives) -> list[str]:
    """Return what each axis of the drives has told since its emergencies were read last, most important for a message.

    Of an axis in fault that has told nothing since, what it told before is the cause, where somebody remembers it
    (`tuning.target.timed` does).

    Returns:
        A text for each axis: "undervoltage (3220h), ..." in the order of the emergencies, or that there was none.
    """
    told, remembered = told_causes(drives), _remembered(drives)
    if remembered is not None and any(before and not now for now, before in zip(told, remembered.told, strict=True)):
        fault = cia402.matches(drives.read(cia402.STATUSWORD), cia402.FAULT_BIT)
        told = [now or (before if held else "") for now, before, held in zip(told, remembered.told, fault, strict=True)]
    return [each or UNTOLD for each in told]


def told_causes(drives: Drives) -> list[str]:
    """Return what each axis has told since its emergencies were read last, "" for an axis that has told nothing."""
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
