"""Emergencies of drives, from an emulator or a bus."""

from __future__ import annotations

from typing import NamedTuple


class EmergencyMessage(NamedTuple):
    """An emergency of an axis: code, error register and the five additional bytes, as on the bus."""

    axis: int
    code: int
    error_register: int
    extra: tuple[int, ...]
    name: str
