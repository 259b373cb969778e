"""The scales of each axis' units, of emulated drives and of those of a bus alike."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from drive_env.drives.interface import Drives
from drive_env.master.quantities import Scale, scales_of

if TYPE_CHECKING:
    from drive_env.master.description import Description


class _Described:
    """Emulated drives with the parts that `scales_of` needs of those of a bus."""

    def __init__(self, drives: Drives, description: Description) -> None:
        self.description = description
        self.num_axes = drives.num_axes
        self.read = drives.read


def axis_scales(drives: Drives, description: Description) -> list[Scale]:
    """Read the scales of every axis from the drives, as far as they have them."""
    return scales_of(cast(Any, _Described(drives, description)))
