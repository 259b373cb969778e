"""Synchronisation of a slave: 1C32h of its outputs, 1C33h of its inputs (ETG.1020, 22).

If SYNC0 of the distributed clocks is switched on before Safe-Op, outputs take effect at its pulses, and both objects
show type 2 and its cycle. With a device that uses SYNC1, and if the master switches that on, SYNC1 is used instead, and
the type is 3. Without clocks outputs take effect as they come.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from drive_env.devices import Device
from drive_env.dictionary.aborts import VALUE_RANGE, VALUE_TOO_LOW, WRONG_STATE, ObjectAccessError
from drive_env.dictionary.access import check_limits
from drive_env.dictionary.entries import Entry
from drive_env.ethercat.application import AlStatusCode, ClockSetting
from drive_env.ethercat.ethercat_objects import (
    CYCLE_TIME,
    INPUTS_WITH_OUTPUTS,
    MISSED,
    NANOSECOND,
    SYNC_ERROR,
    TOO_SHORT,
    TYPE,
    WITH_OUTPUTS,
    WITH_SYNC0,
    WITH_SYNC1,
    ethercat_objects,
)
from drive_env.node.axis import ObjectPort
from drive_env.node.process_image import SYNCHRONISATION

MOST = 0xFFFF  # of a counter
# The values that each object can be set to.
TYPES = {SYNCHRONISATION[0]: (WITH_OUTPUTS, WITH_SYNC0), SYNCHRONISATION[1]: (INPUTS_WITH_OUTPUTS, WITH_SYNC0)}


class Synchronisation:
    """The objects of synchronisation, and their effects.

    Args:
        device: The device.
        may_change: Returns whether they may be written now, which is in Pre-Op.

    Attributes:
        has_sync0: Whether outputs take effect with SYNC0.
        has_sync1: Whether they take effect with SYNC1 instead.
    """

    def __init__(self, device: Device, may_change: Callable[[], bool]) -> None:
        assert device.ethercat is not None, "a device without EtherCAT is not synchronised"
        self._may_change = may_change
        self._shortest = device.ethercat.shortest_cycle
        self._uses_sync1 = device.ethercat.uses_sync1
        self._cycles = [round(cycle / NANOSECOND) for cycle in device.ethercat.cycles]
        own = ethercat_objects(device)
        self._factory = {(index, sub): int(one.default) for index in SYNCHRONISATION for sub, one in own[index].items()}
        self.restart()

    def restart(self) -> None:
        """Reset to the state after power-on."""
        self._values = dict(self._factory)
        self._shown: dict[tuple[int, int], int] = {}  # shown instead of the master's settings while SYNC0 is used
        self.has_sync0 = self.has_sync1 = False
        self._came: float | None = None  # when outputs last came [s]
        self._is_new = False

    def owns(self, entry: Entry) -> bool:
        """Return whether an object is one of the synchronisation's."""
        return (entry.index, entry.sub) in self._values

    def port(self, entry: Entry) -> ObjectPort:
        """Return the port of one of the synchronisation's objects."""
        key = (entry.index, entry.sub)

        def read() -> int:
            return self._shown[key] if key in self._shown else self._values[key]

        def write(raw: int) -> None:
            self._values[key] = raw

        return ObjectPort(entry, read, partial(self._check, entry), write)

    def begin(self, clock: ClockSetting) -> AlStatusCode:
        """Check and apply the clocks set before Safe-Op; return the reason of a refusal, or NO_ERROR.

        A cycle of SYNC0 that the device cannot follow, or does not know, is refused; 0, a single pulse, is accepted.
        """
        by_sync1 = self._uses_sync1 and clock.has_sync1
        cycle = round((clock.sync1_cycle if by_sync1 else clock.sync0_cycle) / NANOSECOND)
        known = not self._cycles or cycle in (0, *self._cycles)
        if clock.has_sync0 and (cycle * NANOSECOND < self._shortest - 0.5 * NANOSECOND or not known):
            return AlStatusCode.DC_CYCLE_TIME
        chosen = {self._values[index, TYPE] for index in SYNCHRONISATION}
        if (WITH_SYNC0 in chosen and not clock.has_sync0) or (WITH_SYNC1 in chosen and not by_sync1):
            return AlStatusCode.DC_SYNC_CONFIGURATION
        self.has_sync0, self.has_sync1 = clock.has_sync0, by_sync1
        self._shown = {}
        if clock.has_sync0:
            self._shown = {(index, TYPE): WITH_SYNC1 if by_sync1 else WITH_SYNC0 for index in SYNCHRONISATION}
            self._shown |= {(index, CYCLE_TIME): cycle for index in SYNCHRONISATION}
        for index in SYNCHRONISATION:
            for sub in (MISSED, TOO_SHORT, SYNC_ERROR):
                self._values[index, sub] = 0
        self._came, self._is_new = None, False
        return AlStatusCode.NO_ERROR

    def leave(self) -> None:
        """Return to Pre-Op: the master's settings count again."""
        self._shown = {}

    def outputs_came(self, now: float) -> None:
        """Count outputs that follow the previous ones faster than the device's shortest cycle."""
        if self._came is not None and not self.has_sync0 and now - self._came < self._shortest - NANOSECOND:
            self._count(TOO_SHORT)
        self._came, self._is_new = now, True

    def pulse(self) -> None:
        """Count a pulse in Op without new outputs since the previous pulse."""
        missed = self._came is not None and not self._is_new  # counted from the first outputs on
        if missed:
            self._count(MISSED)
        self._is_new = False
        for index in SYNCHRONISATION:
            self._values[index, SYNC_ERROR] = int(missed)

    # --- inside -----------------------------------------------------------------------------------------------------
    def _count(self, sub: int) -> None:
        for index in SYNCHRONISATION:
            self._values[index, sub] = min(self._values[index, sub] + 1, MOST)

    def _check(self, entry: Entry, raw: int) -> None:
        check_limits(entry, raw)
        if not self._may_change():
            raise ObjectAccessError(WRONG_STATE, f"{entry.label} can only be written in pre-operational")
        types = (*TYPES[entry.index], WITH_SYNC1) if self._uses_sync1 else TYPES[entry.index]
        if entry.sub == TYPE and raw not in types:
            known = " and ".join(map(str, types))
            raise ObjectAccessError(VALUE_RANGE, f"{entry.label} cannot be {raw}; this slave knows {known}")
        if entry.sub == CYCLE_TIME and raw * NANOSECOND < self._shortest - 0.5 * NANOSECOND:
            raise ObjectAccessError(
                VALUE_TOO_LOW, f"{entry.label} = {raw} ns is below {self._shortest / NANOSECOND:.0f} ns"
            )
        if entry.sub == CYCLE_TIME and self._cycles and raw not in self._cycles:
            known = ", ".join(map(str, self._cycles))
            raise ObjectAccessError(VALUE_RANGE, f"{entry.label} cannot be {raw} ns; this slave knows {known}")
