"""A laboratory for servo drives: a faithful emulator on MuJoCo mechanics, behind the interface of real drives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drive_env.envs import register

if TYPE_CHECKING:
    from drive_env.dictionary.aborts import ObjectAccessError as ObjectAccessError
    from drive_env.drives import motion as motion
    from drive_env.drives.interface import Drives as Drives
    from drive_env.drives.limits import Limits as Limits
    from drive_env.drives.trace import Trace as Trace
    from drive_env.emulator.emulated_drives import EmulatedDrives as EmulatedDrives
    from drive_env.envs import make_vec_env as make_vec_env
    from drive_env.fieldbus.errors import BusError as BusError
    from drive_env.master.can_drives import CanDrives as CanDrives
    from drive_env.master.ethercat_drives import EtherCatDrives as EtherCatDrives
    from drive_env.master.open_drives import open_drives as open_drives
    from drive_env.safety.envelope import SafetyError as SafetyError

__version__ = "0.2.0"  # the one home of the version: the package and all three programs take it from here

__all__ = [
    "BusError", "CanDrives", "Drives", "EmulatedDrives", "EtherCatDrives", "Limits", "ObjectAccessError", "SafetyError",
    "Trace", "make_vec_env", "motion", "open_drives",
]  # fmt: skip

_HOMES = {
    "BusError": "fieldbus.errors",
    "CanDrives": "master.can_drives",
    "Drives": "drives.interface",
    "EmulatedDrives": "emulator.emulated_drives",
    "EtherCatDrives": "master.ethercat_drives",
    "Limits": "drives.limits",
    "ObjectAccessError": "dictionary.aborts",
    "SafetyError": "safety.envelope",
    "Trace": "drives.trace",
    "make_vec_env": "envs",
    "open_drives": "master.open_drives",
}

register()


def __getattr__(name: str) -> Any:
    # The compiler and MuJoCo take half a second to import; --help should not wait for them.
    import importlib

    if name == "motion":
        return importlib.import_module("drive_env.drives.motion")
    if name in _HOMES:
        return getattr(importlib.import_module(f"drive_env.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'drive_env' has no attribute {name!r}")
