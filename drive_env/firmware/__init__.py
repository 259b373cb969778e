"""The firmware of drives: the record, the parts that all drives share, and a list of stages for each kind of drive."""

from __future__ import annotations

import importlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from mechanics.reading.near_names import did_you_mean

if TYPE_CHECKING:
    from drive_env.firmware.cycle import Firmware

_FOLDER = Path(__file__).parent


def firmware_names() -> list[str]:
    """Return the names of the lists of stages."""
    return sorted(path.parent.name for path in _FOLDER.glob("*/stages.py"))


@cache
def checked_firmware(name: str) -> str:
    """Return a name of a list of stages; ValueError for an unknown one, listing the known ones."""
    if name not in firmware_names():
        near = did_you_mean(str(name), firmware_names())
        raise ValueError(f"no firmware is named {name!r}; there are {', '.join(firmware_names())}{near}")
    return name


def motor_kinds(name: str) -> tuple[str, ...]:
    """Return the kinds of motor that a firmware supports, without composing it."""
    kinds: tuple[str, ...] = importlib.import_module(f"drive_env.firmware.{checked_firmware(name)}").MOTOR_KINDS
    return kinds


def default_motor(name: str) -> str:
    """Return the default motor of a firmware's drives, from the catalogue."""
    motor: str = importlib.import_module(f"drive_env.firmware.{checked_firmware(name)}").DEFAULT_MOTOR
    return motor


@cache
def find_firmware(name: str) -> Firmware:
    """Return the firmware of a list of stages; it is composed at the first call, compiled at its first use."""
    firmware: Firmware = importlib.import_module(f"drive_env.firmware.{checked_firmware(name)}.stages").FIRMWARE
    return firmware
