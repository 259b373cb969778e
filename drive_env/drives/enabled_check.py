"""A warning about set-points for drives of which none is enabled: nothing would move, without any message."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from drive_env import cia402
from drive_env.dictionary.entries import ObjectDictionary
from drive_env.drives.interface import BasicDrives

SET_POINTS = (
    cia402.TARGET_POSITION, cia402.TARGET_VELOCITY, cia402.TARGET_TORQUE, cia402.VL_TARGET_VELOCITY,
    cia402.INTERPOLATION_DATA,
)  # fmt: skip


class EnabledCheck:
    """Checks played objects until an axis has been enabled, or a warning was given."""

    def __init__(self) -> None:
        self._is_done = False

    def __call__(
        self, drives: BasicDrives, known: ObjectDictionary, play: Mapping[Any, Any] | None, cycles: int
    ) -> None:
        """Warn if set-points are played for some cycles, without a controlword, while no axis is enabled."""
        if self._is_done or not play or not cycles:
            return
        indices = {cia402.of_first_axis(known.find(name).index) for name in play}
        played = [index for index in SET_POINTS if index in indices]
        if not played or cia402.CONTROLWORD in indices:
            return
        status = drives.read(cia402.STATUSWORD)
        self._is_done = True
        if not cia402.matches(status, cia402.OPERATION_ENABLED).any():
            warnings.warn(
                f"{played[0]:04X}h is played, but no axis is enabled (6041h = {int(status[0]):04X}h): nothing moves; "
                "call motion.enable(drives, mode=...) first",
                stacklevel=3,
            )
