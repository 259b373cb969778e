"""The watchdogs of some drives: set, proved to be in force, and given up where the axes are proved off."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.master.errors import BusError
from drive_env.safety.axes import Axes
from drive_env.safety.bounds import POSITION_HIGH
from drive_env.safety.error_control import Beats, ErrorControl, Heartbeats, NoWatchdogError
from drive_env.safety.errors import SafetyError, logged
from drive_env.safety.lending import Lending
from drive_env.safety.limits import NO_LIMIT
from drive_env.safety.limits_in_force import LimitsInForce
from drive_env.safety.objects import CONTROLWORD, STATUSWORD

if TYPE_CHECKING:
    from drive_env.master.can_drives import CanDrives

logger = logging.getLogger(__name__)

LEAST_SILENCE = 0.06  # s; what heartbeats of a computer that does other things besides can keep
OF_TRAVEL = 0.25  # of the travel, that a dead master may use up
LOCKSTEP_LOOK = 0.012  # s for which a drive in lockstep must stand still


class Watchdogs:
    """What the drives do by themselves when this process dies.

    Args:
        drives: The drives.
        axes: What is known of them.
        limits: Those that hold.
        lending: What the drives have for a while, and get back before their watchdogs are given up.
    """

    def __init__(self, drives: CanDrives, axes: Axes, limits: LimitsInForce, lending: Lending) -> None:
        self._drives = drives
        self._known = drives.description.dictionary
        self._axes = axes
        self._limits = limits
        self._lending = lending
        self._heartbeats = Heartbeats(drives.port, drives.nodes)
        self._controls = [
            ErrorControl(node, drives.sdo(k), drives.description, self._heartbeats)
            for k, node in enumerate(drives.nodes)
        ]
        self._beats: Beats | None = None
        self._is_lockstep_proved = False

    def check(self) -> None:
        """Have the axes armed anew unless every drive, asked, still watches over its master: one may have restarted.

        Raises:
            BusError: If a node does not answer.
        """
        if self._beats is None:
            return
        for control in self._controls:
            if not control.is_in_force():
                self._axes.is_armed = False

    def keep(self) -> None:
        """Send the heartbeats that are due."""
        if self._beats is not None:
            self._beats.keep()

    def cease(self) -> None:
        """Send no heartbeats any more, so that the drives stop by themselves."""
        if self._beats is not None:
            self._beats.cease()

    def end(self) -> None:
        """Send no heartbeats any more, since the watchdogs are given up."""
        self._beats = None

    def forget(self, node: int) -> None:
        """Take note that a node, by position, was reset: its error control is its own again."""
        self._controls[node].forget()

    def take_shared_id(self) -> int | None:
        """Return, once, the node-ID as which another program sends heartbeats, too; None if none does."""
        if not self._heartbeats.is_shared or self._beats is None:
            return None
        node, self._heartbeats.node_id = self._heartbeats.node_id, 0
        return node

    def set(self) -> None:
        """Have every drive watch over its master, and begin to send heartbeats; in lockstep, prove that time waits.

        Raises:
            SafetyError: If a drive cannot watch, or time does not wait.
        """
        if self._drives.time_waits:
            self._prove_lockstep()
            return
        if self._limits.user.silence is None:
            logger.warning("Limits(silence=None): no drive stops by itself when this process dies")
            self._beats = None
            return
        self._heartbeats.choose()
        silence = self._silence()
        try:
            for control in self._controls:
                control.configure(silence)
        except NoWatchdogError as error:
            raise SafetyError(f"{error}") from None
        self._beats = Beats(self._heartbeats, self._controls, silence)
        self._beats.begin()

    def _silence(self) -> float:
        """Return after which silence the drives act [s]: a dead master must not leave the travel.

        A drive that holds software limits itself keeps its travel; of another the speed allowed is lowered where even
        the shortest silence would be too long.
        """
        silence = self._limits.user.silence
        assert silence is not None
        bounds = self._limits.bounds()
        ends = (bounds.low > -NO_LIMIT) & (bounds.high < NO_LIMIT) & bounds.given
        if not ends.any() or self._drives.description.has(POSITION_HIGH):
            return silence
        room = np.where(ends, OF_TRAVEL * (bounds.high - bounds.low), np.inf)
        speed = np.minimum(bounds.velocity if self._axes.is_counted else bounds.speed, 2.0**40).astype(float)
        braking = np.where(bounds.braking > 0.0, bounds.braking, np.inf)
        time_left = (room - speed**2 / (2.0 * braking)) / speed
        chosen = float(np.clip(time_left.min(), min(LEAST_SILENCE, silence), silence))
        # v * silence + v^2 / 2a = room
        finite = np.where(np.isfinite(braking), braking, 1.0)
        root = np.where(
            np.isfinite(braking),
            finite * (np.sqrt(chosen**2 + 2.0 * np.where(np.isfinite(room), room, 0.0) / finite) - chosen),
            np.where(np.isfinite(room), room, 0.0) / chosen,
        )
        slower = ends & (root < speed)
        if slower.any():
            if self._axes.is_counted:
                bounds.velocity = np.where(slower, np.floor(root), bounds.velocity).astype(np.int64)
            else:
                bounds.speed = np.where(slower, root, bounds.speed)
            logger.warning(
                "these drives hold no software limits (607Dh): no more than %d increments a second are allowed, so "
                "that a dead master cannot take them out of their travel", int(root[slower].min()),
            )  # fmt: skip
        return chosen

    def _prove_lockstep(self) -> None:
        """Raise SafetyError if time passes on a bus on which it should wait for SYNC.

        A drive that sends heartbeats by itself tells it: none is due while no SYNC is sent.
        """
        producer = (0x1017, 0)
        if self._is_lockstep_proved or not self._drives.description.has(producer):
            return
        entry = self._known.find(producer)
        beats: list[bytes] = []
        try:
            before = int(self._drives.read_raw(entry, 0))
            self._drives.hear_errors(beats.append)
            self._drives.write_raw(entry, 0, 1)
            self._drives.port.drain()
            beats.clear()
            time.sleep(LOCKSTEP_LOOK)
            self._drives.read_raw(entry, 0)  # whoever is late answers after what was due before
            self._drives.write_raw(entry, 0, before)
        except ObjectAccessError:
            return  # a drive without: nothing to tell it by
        finally:
            self._drives.hear_errors(None)
        if len(beats) > 1:
            raise SafetyError(
                "pace='lockstep' is for an emulator that is served with --lockstep, and time passes by itself on this "
                "bus: nothing would monitor the drives between two calls; open them with pace='real-time'"
            )
        self._is_lockstep_proved = True

    def give_up(self) -> None:
        """Give drives back what they had and their watchdogs; what is not proved off keeps them and hears no more."""
        per_node = self._drives.description.num_axes
        for k, (node, control) in enumerate(zip(self._drives.nodes, self._controls, strict=True)):
            axes = range(k * per_node, (k + 1) * per_node)
            is_untouched = control.kind == "none" and not self._lending.has_lent(set(axes))
            if is_untouched and not self._axes.may_turn[axes.start : axes.stop].any():
                continue
            if all(self._is_proved_off(axis) for axis in axes):
                with logged():
                    self._lending.give_back(set(axes))
                with logged():
                    control.restore()
                self._axes.take_for_off(self._axes.of_nodes([k]))
                continue
            self._axes.lost.update(axes)
            self.cease()
            logger.error(
                "node %d could not be proved to be off: %s. Look at the machine, and keep the emergency stop at hand",
                node,
                "its watchdog stays on and gets no more heartbeats, so that the drive stops by itself"
                if control.kind != "none"
                else "it has no watchdog",
            )

    def _is_proved_off(self, axis: int) -> bool:
        """Return whether the statusword, read twice in a row, shows an axis off: one answer may be an old one.

        Off is what no single frame enables; an axis that is closer to operation is taken there first.
        """
        entry = self._known.find(STATUSWORD)
        off, is_woken = 0, False
        for _ in range(5):
            try:
                status = int(self._drives.read_raw(entry, axis))
                if cia402.is_live(status):
                    return False
                if not cia402.is_disabled(status):
                    self._drives.write_raw(self._known.find(CONTROLWORD), axis, cia402.DISABLE_VOLTAGE)
                off = off + 1 if cia402.is_disabled(status) else 0
            except (BusError, ObjectAccessError):
                if is_woken:
                    return False
                # A node that has missed its master is stopped and answers nothing. Operational, not pre-operational,
                # where some drives no longer watch their master.
                is_woken = True
                with logged():
                    self._drives.must_start()
                    self._drives.start()
            if off == 2:
                return True
        return False
