"""The watchdogs of some drives: set, verified, and given up once the axes are proved off."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.drives.limits import NO_LIMIT
from drive_env.fieldbus.errors import BusError
from drive_env.fieldbus.link import NoWatchdogError
from drive_env.safety.axes import Axes
from drive_env.safety.bounds import POSITION_HIGH
from drive_env.safety.errors import SafetyError, logged
from drive_env.safety.lending import Lending
from drive_env.safety.limits_in_force import LimitsInForce
from drive_env.safety.objects import CONTROLWORD, STATUSWORD

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import WatchedDrives

logger = logging.getLogger(__name__)

LEAST_SILENCE = 0.06  # s; the shortest silence that a computer with other work can keep
OF_TRAVEL = 0.25  # of the travel, which an axis may use up after the master has died
ROUNDING = 0.001  # s by which a drive may react late: watchdogs count milliseconds


class Watchdogs:
    """The drives' own reaction when this process dies.

    Args:
        drives: The drives.
        axes: Their present state.
        limits: The limits in force.
        lending: The lent values, which the drives give back before their watchdogs are given up.
    """

    def __init__(self, drives: WatchedDrives, axes: Axes, limits: LimitsInForce, lending: Lending) -> None:
        self._drives = drives
        self._known = drives.description.dictionary
        self._axes = axes
        self._limits = limits
        self._lending = lending
        self._watch = drives.link.watch
        self._is_set = False
        self._is_lockstep_proved = False

    def check(self) -> None:
        """Ask the drives; require arming anew if one no longer watches its master, for example after a restart.

        Raises:
            BusError: If a node does not answer.
        """
        if not self._is_set:
            return
        for k in range(len(self._drives.nodes)):
            if not self._watch.is_in_force(k):
                self._axes.is_armed = False

    def check_not_held(self, entry: Entry) -> None:
        """Raise SafetyError for an object that a watchdog depends on: it must not change while the watchdog is set."""
        if self._watch.holds((entry.index, entry.sub)):
            raise SafetyError(
                f"{entry.label} belongs to the watchdog by which the drive notices that this process is dead; nothing "
                "was sent. Write it before the first command, or without this program"
            )

    def own(self, entry: Entry, axis: int, found: int) -> int:
        """Return the value that an object had before a watchdog was set; `found`, the value read, otherwise."""
        node, part = divmod(axis, self._drives.description.num_axes)
        before = self._watch.before(node, self._drives.description.key(entry, part))
        return found if before is None else before

    def keep(self) -> None:
        """Send a sign of life to the drives, when it is due."""
        self._watch.keep()

    def cease(self) -> None:
        """Send the drives a last sign of life, so that they stop by themselves."""
        with logged():
            self._watch.cease()

    def end(self) -> None:
        """Send the drives no more signs of life, since the watchdogs are given up."""
        self._watch.end()
        self._is_set = False

    def forget(self, node: int) -> None:
        """Note that a node, by position, was reset: its watchdog has its own settings again."""
        self._watch.forget(node)

    def take_rival(self) -> str:
        """Return, once, the program that keeps the drives from noticing this one's death; "" if no program does."""
        return self._watch.take_rival()

    def set(self) -> None:
        """Set every drive's watchdog and begin to send signs of life; in lockstep, prove that time waits.

        Raises:
            SafetyError: If a drive has no watchdog, or one that is too slow, or time does not wait.
        """
        if self._drives.time_waits:
            self._prove_lockstep()
            return
        if self._limits.user.silence is None:
            logger.warning("Limits(silence=None): no drive stops by itself when this process dies")
            self.end()
            return
        silence = self._silence()
        try:
            self._watch.begin(silence)
        except NoWatchdogError as error:
            raise SafetyError(f"{error}") from None
        self._is_set = True
        if self._watch.detection_time > silence + ROUNDING:
            raise SafetyError(
                f"the drives notice that this process is dead after {self._watch.detection_time:g} s, and {silence:g} "
                "s are allowed; give Limits(silence=...) as long, or a position limit that leaves the room"
            )

    def _silence(self) -> float:
        """Return the silence after which the drives act [s]: after the master's death an axis must stay in its travel.

        A drive with software limits stays in its travel by itself; for another the allowed speed is lowered if even the
        shortest silence would be too long.
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
        """Raise SafetyError if time passes on a bus on which it should wait for SYNC."""
        if self._is_lockstep_proved:
            return
        passes = self._drives.link.time_passes()
        if passes:
            raise SafetyError(
                "pace='lockstep' is for an emulator that is served with --lockstep, and time passes by itself on this "
                "bus: nothing would monitor the drives between two calls; open them with pace='real-time'"
            )
        if passes is None:
            raise SafetyError(
                "pace='lockstep' is for an emulator that is served with --lockstep, and this drive has no producer "
                "heartbeat (1017h) that would show that time waits on this bus; open it with pace='real-time'"
            )
        self._is_lockstep_proved = True

    def give_up(self) -> None:
        """Restore the drives' settings and watchdogs; drives not proved off keep them and get no more signs of life."""
        per_node, heard = self._drives.description.num_axes, self._drives.link.wording.sign_of_life
        for k, node in enumerate(self._drives.nodes):
            axes = range(k * per_node, (k + 1) * per_node)
            is_untouched = not self._watch.is_set(k) and not self._lending.has_lent(set(axes))
            if is_untouched and not self._axes.may_turn[axes.start : axes.stop].any():
                continue
            if all(self._is_proved_off(axis) for axis in axes):
                with logged():
                    self._lending.give_back(set(axes))
                with logged():
                    self._watch.restore(k)
                self._axes.take_for_off(self._axes.of_nodes([k]))
                continue
            self._axes.lost.update(axes)
            self.cease()  # again, if need be: if the proof has started the node, it waits for no heartbeat
            logger.error(
                "node %d could not be proved to be off: %s. Look at the machine, and keep the emergency stop at hand",
                node,
                f"its watchdog stays on and it gets no more {heard}, so that the drive stops by itself"
                if self._watch.is_set(k)
                else "it has no watchdog",
            )

    def _is_proved_off(self, axis: int) -> bool:
        """Return whether the statusword, read twice in a row, shows an axis off: a single answer may be an old one.

        "Off" is a state that no single frame enables; an axis in a state closer to operation is taken there first.
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
                # A node that has missed its master is stopped and does not answer. It is made operational, not
                # pre-operational, since some drives do not watch their master in pre-operational.
                is_woken = True
                with logged():
                    self._drives.must_start()
                    self._drives.start()
            if off == 2:
                return True
        return False
