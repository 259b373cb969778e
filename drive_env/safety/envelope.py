"""The envelope around a program that moves drives on a bus: limits, an oscillation detector, stops.

Four lines of defence, each in case the previous one fails: - a command beyond a limit is refused before it is sent
(`before_write`, `before_play`; `commands.py`); - the drives are watched, by the samples of every communication cycle
and otherwise by a separate thread (`watch.py`, `judging.py`), and stopped by grades (`stop_runner.py`, `stopping.py`);
- limits that are tighter than the drives' own are written to them for the time of motion (`limits_in_force.py`,
`lending.py`); - the drives themselves notice that the process has died (`watchdogs.py`, `master/can/error_control.py`).

An axis is live if its statusword says so, or from just before a frame is sent that could enable it. A watchdog is given
up only if the statusword, read back, shows every axis of its node off.

A program that stays within the limits reads the same integers with and without the envelope.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.entries import Entry
from drive_env.dictionary.roles import Role
from drive_env.drives.interface import Drives
from drive_env.drives.limits import Limits
from drive_env.safety import signals
from drive_env.safety.axes import Axes
from drive_env.safety.bounds import (
    ACCELERATION,
    DECELERATION,
    FOLLOWING_WINDOW,
    MAX_PROFILE_VELOCITY,
    POSITION_HIGH,
    POSITION_LOW,
    QUICK_STOP_DECELERATION,
    current_limits,
    current_scales,
    motion_gains,
)
from drive_env.safety.commands import Commands
from drive_env.safety.errors import SafetyError as SafetyError
from drive_env.safety.lending import Lending
from drive_env.safety.limits_in_force import STOP_WITHIN, LimitsInForce
from drive_env.safety.objects import CONTROLWORD, MODE, SET_POINTS, STATUSWORD, STORE, VL_BRAKING
from drive_env.safety.rotor import HOME_OFFSET, scale_objects
from drive_env.safety.stop_runner import RAMPS, SLOW_DOWN_RAMPS, StopRunner
from drive_env.safety.stopping import Stop
from drive_env.safety.watch import Watch
from drive_env.safety.watchdogs import Watchdogs
from mechanics.arrays import Integers, Mask

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import WatchedDrives

logger = logging.getLogger(__name__)


DEVICE_OBJECTS = 0x2000  # below are the communication objects
# Objects that limit the drives or give their stopping distance.
_BOUNDS = (
    POSITION_LOW, POSITION_HIGH, FOLLOWING_WINDOW, MAX_PROFILE_VELOCITY, QUICK_STOP_DECELERATION, ACCELERATION,
    DECELERATION, HOME_OFFSET, *VL_BRAKING,
)  # fmt: skip


class Envelope:
    """The limits in force on some drives.

    Args:
        limits: The limits of the program.
        drives: The drives.

    Raises:
        ValueError: For limits that do not fit the number of axes.
    """

    def __init__(self, limits: Limits, drives: WatchedDrives) -> None:
        limits.check_axes(drives.num_axes)
        self._drives = drives
        self._known = drives.description.dictionary
        self._axes = Axes(drives)
        self._lending = Lending(drives)
        self._limits = LimitsInForce(limits, drives, self._axes, self._lending)
        self._watchdogs = Watchdogs(drives, self._axes, self._limits, self._lending)
        self._stops = StopRunner(drives, self._axes, self._limits, self._lending, self._watchdogs.cease)
        self._watch = Watch(
            drives, self._axes, self._limits, self._stops, self._watchdogs,
            prepare=lambda: drives.prepare_watch(self), poll=lambda: drives.poll(self),
        )  # fmt: skip
        self._commands = Commands(drives, self._axes, self._limits, self._watch.modes)
        self._checked_stop: Stop | None = None  # the stop under way when the controlword being written was checked
        self._is_closing = False
        self._disabling = np.zeros(drives.num_axes, bool)  # the last controlword was "disable operation"
        self._played: dict[Key, Integers] = {}  # modes and set-points of the rows being played
        self._of_further_axes = drives.description.of_further_axes()
        self._set_points = frozenset((*SET_POINTS, drives.description.role(Role.TARGET_INSIDE)))

    @property
    def limits(self) -> Limits:
        """The limits of the program."""
        return self._limits.user

    @limits.setter
    def limits(self, limits: Limits) -> None:
        self._limits.user = limits

    @property
    def epoch(self) -> int:
        """The number by which samples are requested: it grows with every controlword."""
        return self._axes.epoch

    # --- what drives on a bus call --------------------------------------------------------------------------------
    def change(self, limits: Limits) -> None:
        """Replace the limits; those of position are in the present counts of 6064h."""
        limits.check_axes(self._drives.num_axes)
        self._limits.change(limits)

    def leave_alone(self, axes: Iterable[int]) -> None:
        """Note axes that the program never moves: no limits are lent to their drives."""
        self._lending.left_alone = frozenset(axes)

    def enter(self) -> None:
        """Begin a call of the program; raise once for a stop that the supervisor has made since the last call."""
        self.alive()
        if self._watch.booted:
            self._after_restart()
        self._watch.raise_pending()

    def alive(self) -> None:
        """Note that the program waits for an answer."""
        self._watch.alive()

    def before_write(self, entry: Entry, raw: Integers, where: Mask) -> None:
        """Raise SafetyError for a value that would pass a limit; arm the watch before the first command of motion."""
        key = (entry.index, entry.sub)
        self._check_place(entry)
        self._watch.await_stop()
        if key == CONTROLWORD:
            self._before_controlword(raw, where)
            return
        self._watchdogs.check_not_held(entry)
        if key in SLOW_DOWN_RAMPS:
            self._check_no_ramp_runs(entry, where)
        if entry.index >= DEVICE_OBJECTS and not self._axes.is_armed and self._finds_live(where):
            self._arm()
        self._commands.check_write(entry, raw, where)
        self._note_mode(key, where)  # after the checks: a refused write changes nothing
        if key in self._set_points:
            self._arm()
        if self._axes.is_armed:
            self._stops.keep_ramps(key, raw, where)
        if (entry.index == STORE or self._is_mapped_over(key)) and self._is_ours():
            self._give_all_back(entry)
        if key in scale_objects(self._drives.description):
            self._limits.keep_place()

    def after_failed_write(self, entry: Entry) -> None:
        """Note that a drive may or may not have executed a write."""
        key = (entry.index, entry.sub)
        self._commands.forget(key)
        if key in scale_objects(self._drives.description):
            self._limits.place_again()
        elif self._is_limit(key):
            self._limits.forget()

    def after_write(self, entry: Entry, raw: Integers, where: Mask) -> None:
        """Update what depends on an object that was written: mode, set-points, scale, limits."""
        key = (entry.index, entry.sub)
        self._note_mode(key, where)
        if key == CONTROLWORD:
            self._after_controlword(raw, where)
        elif key == MODE:
            self._axes.mode = np.where(where, raw, self._axes.mode)
        elif key in self._set_points:
            self._commands.note(key, raw, where)
        elif key in scale_objects(self._drives.description):
            self._limits.place()
        elif self._is_limit(key):
            self._limits.forget()
            if key == HOME_OFFSET and self._axes.is_armed:
                self._limits.lend()  # also corrects software limits

    def _give_all_back(self, entry: Entry) -> None:
        """Give limits and watchdogs back before the drives store or map what they have; the next command arms anew."""
        if self._watch.look_for_live():
            raise SafetyError(
                f"{entry.label}: the drives would lose the limits and the watchdog that they were lent while an axis "
                "is enabled; nothing was sent. Disable it first"
            )
        self._lending.give_back(set(range(self._drives.num_axes)))
        self.close()
        self._check_none_lost()

    def _is_mapped_over(self, key: Key) -> bool:
        """Return whether an object is of process data that were mapped for as long as the drives are open."""
        process = self._drives.link.process
        return any(process.before(node, key) is not None for node in range(len(self._drives.nodes)))

    def _is_limit(self, key: Key) -> bool:
        """Return whether the limits or the stopping distance depend on an object."""
        gains = motion_gains(self._drives.device).values()
        of_current = current_limits(self._drives) + current_scales(self._drives)
        return key in _BOUNDS or key in of_current or key in gains

    def _note_mode(self, key: Key, where: Mask) -> None:
        """Note that an axis may ignore commands for a moment, until both of its modes have changed."""
        if key in (MODE, self._drives.description.role(Role.MODE_GATE)):
            self._axes.forget_motion(where)
            self._axes.mode_written = np.where(where, self._axes.now(), self._axes.mode_written)

    def write_lent(self, entry: Entry, axis: int, value: int) -> bool:
        """Store the user's value of an object that the envelope has overridden. False if it is not overridden."""
        key = (entry.index, entry.sub)
        if not self._lending.is_lent(key, axis):
            return False
        if key in RAMPS and value not in RAMPS[key]:
            self._lending.pass_on(key, axis, value)
            return True
        self._lending.settle(key, axis, value)
        if key in RAMPS:
            self._lending.lend(key, axis, RAMPS[key][value])
        self._limits.forget()
        self._limits.lend()
        return True

    def own(self, entry: Entry, axis: int, found: int) -> int:
        """Return the program's own value of an object; `found`, the value read, if none is lent."""
        return self._lending.own((entry.index, entry.sub), axis, self._watchdogs.own(entry, axis, found))

    def before_play(self, played: Mapping[Entry, Integers]) -> None:
        """Raise SafetyError for rows that would pass a limit; arm the watch if they command motion."""
        self._watch.await_stop()
        if not played:
            return
        for entry in played:
            self._check_place(entry)
            self._watchdogs.check_not_held(entry)
        words = next((rows for entry, rows in played.items() if (entry.index, entry.sub) == CONTROLWORD), None)
        self._commands.check_play(played, words)
        enables = self._axes.everywhere if words is None else cia402.may_enable(words).any(axis=0)
        if words is not None:
            self._check_ends(words, [(entry.index, entry.sub) for entry in played])
        if words is not None or any((entry.index, entry.sub) in self._set_points for entry in played):
            self._arm()
        if words is not None and enables.any():
            self._commands.check_modes(enables, played=played)
            self._commands.check_played_starts(words, played)
            self._commands.check_turning(enables & ~self._axes.live)
            self._prove_watchdogs(enables)
            self._axes.assume(enables)
        self._checked_stop = self._stops.current
        self._played = {
            key: rows
            for entry, rows in played.items()
            if len(rows) and ((key := (entry.index, entry.sub)) == MODE or key in self._set_points)
        }

    def _check_place(self, entry: Entry) -> None:
        """Raise SafetyError for an object that addresses a further axis directly: that axis would not be monitored."""
        found = self._of_further_axes.get((entry.index, entry.sub))
        if found is not None:
            first, axis = found
            raise SafetyError(
                f"{entry.label} is {first.label} of axis {axis} of a node, and is not monitored by this index; nothing "
                f"was sent. Write {first.index:04X}h, with one value per axis or where=..."
            )

    def _check_ends(self, words: Integers, played: Sequence[Key]) -> None:
        """Stop axes that turn before rows cut their voltage or ramp too slowly; refuse rows that first let them turn.

        Raises:
            SafetyError: If an earlier row lets an axis turn that a later one cuts, or disables by a slow ramp.
        """
        after = np.cumsum(cia402.may_enable(words), axis=0) > 0
        if (cuts := self._stops.cuts(words)).any():
            self._check_cuts(after, cuts)
            self._brake(np.asarray(cuts.any(axis=0)))
        disables = cia402.matches(words, cia402.COMMANDS["disable operation"]) & ~cuts
        if not disables.any():
            return
        slow = self._stops.may_ramp_slowly() | (not SLOW_DOWN_RAMPS.keys().isdisjoint(played))
        if (wrong := np.flatnonzero((after & disables).any(axis=0) & slow)).size:
            raise SafetyError(
                f"axis {int(wrong[0])}: these rows disable operation after they have enabled it, by a ramp (6084h) "
                "that brakes less than a quick stop and that no quick stop could shorten; nothing was sent. Have 6084h "
                "at least at 6085h, or play a quick stop (6040h = 2), and write 7 afterwards"
            )
        self._brake_slow_ramps(np.asarray(disables.any(axis=0)))

    def _brake_slow_ramps(self, disables: Mask) -> None:
        """Quick-stop axes that "disable operation" would let run on: that ramp, once begun, obeys no quick stop."""
        if not disables.any() or not self._watch.look_for_live():
            return
        slow = disables & self._axes.live & self._stops.slow_ramps()
        if slow.any():
            logger.warning(
                "axis %d: by the ramp of \"disable operation\" (6084h) it would leave its limits, or turn for longer "
                "than %g s: it is quick-stopped, and switched off", int(np.flatnonzero(slow)[0]), STOP_WITHIN,
            )  # fmt: skip
            self._brake(slow)

    def _check_no_ramp_runs(self, entry: Entry, where: Mask) -> None:
        """Raise SafetyError for a change of deceleration while "disable operation" brings an axis to rest by it."""
        disabling = where & self._disabling
        if disabling.any() and self._watch.look_for_live() and np.any(disabling & self._axes.live):
            raise SafetyError(
                f"{entry.label} is the ramp by which axis {int(np.flatnonzero(disabling)[0])} is being disabled, and "
                "no quick stop could shorten another one; nothing was sent. Wait until it is off"
            )

    def _check_cuts(self, after: Mask, cuts: Mask) -> None:
        """Raise SafetyError for rows that cut the voltage of an axis which an earlier row lets turn."""
        if (wrong := np.flatnonzero((after & cuts).any(axis=0))).size:
            raise SafetyError(
                f"axis {int(wrong[0])}: these rows take the voltage away after they have enabled it, and it may turn "
                "by then; nothing was sent. Play a quick stop (6040h = 2), and write 0 afterwards"
            )

    def after_play(self, played: Mapping[Entry, Integers]) -> None:
        """Update what depends on rows that were played, as `after_write` does for their last row."""
        self._played = {}
        for entry, rows in played.items():
            if len(rows):
                self.after_write(entry, rows[-1], self._axes.everywhere)

    def after_failed_play(self, played: Mapping[Entry, Integers]) -> None:
        """Note that the drives may have executed any of the rows."""
        self._played = {}
        for entry in played:
            self.after_failed_write(entry)

    def before_reset(self, nodes: Sequence[int]) -> None:
        """Bring axes of nodes, by position, to rest and switch them off: a reset takes their voltage away."""
        self._watch.await_stop()
        axes = self._axes.of_nodes(nodes)
        self._brake(axes)
        for axis in np.flatnonzero(axes & self._axes.live):
            self._drives.write_raw(self._known.find(CONTROLWORD), int(axis), cia402.DISABLE_VOLTAGE)
        self._axes.take_for_off(axes)

    def after_reset(self, nodes: Sequence[int]) -> None:
        """Note that nodes, by position, were reset: their error control has its own values again."""
        for k in nodes:
            self._watchdogs.forget(k)
            self._watch.booted.discard(k)
        self._lending.forget(set(np.flatnonzero(self._axes.of_nodes(nodes)).tolist()))
        self._commands.forget()
        self._axes.aim.clear()
        self._axes.epoch += 1
        self._axes.is_armed = False  # the next command arms anew; nodes still running remain watched
        self._limits.forget()
        if self._axes.rotor.is_placed:
            self._limits.place()

    def before_start(self) -> None:
        """Have a stop come to its end; raise SafetyError where an axis could not be proved off by it."""
        self._watch.await_stop()
        self._check_none_lost()

    def restarted(self, node: int) -> None:
        """Note that a node (by position) has booted without a reset of ours."""
        if self._is_ours():
            self._watch.note_restart(node)

    def _after_restart(self) -> None:
        """Forget the state of nodes that restarted, and report it to the program at its next call."""
        nodes = sorted(self._watch.booted)
        self._drives.forget(nodes)
        self.after_reset(nodes)  # a boot-up says nothing of the axes: reset communication leaves them running
        numbers = ", ".join(str(self._drives.nodes[k]) for k in nodes)
        self._watch.look_for_live()
        self._stops.stop_for(
            f"node {numbers} has restarted by itself", "check its power; what was set since its boot is lost"
        )

    def has_lost(self, node: int) -> bool:
        """Return whether an axis of a node, by position, could not be proved to be off."""
        return bool(self._axes.lost & set(np.flatnonzero(self._axes.of_nodes([node])).tolist()))

    def watched(self) -> list[Entry]:
        """Return the objects to sample at every SYNC, most important first; the same list until the limits change."""
        return self._watch.looks.watched()

    def sampled(self, chosen: Sequence[Entry]) -> None:
        """Note the objects that come with every SYNC; the other watched ones are read."""
        self._watch.looks.sampled(chosen)

    def observe(
        self, rows: Mapping[Key, Integers], epoch: int, where: Mask | None = None, coming: int | None = None
    ) -> None:
        """Check samples, each object of shape (rows, num_axes); stop and raise SafetyError beyond a limit.

        Args:
            rows: The samples, one communication cycle apart.
            epoch: The envelope's epoch when they were requested.
            where: The axes that they belong to; None: all.
            coming: The number of the played row that is sent next.
        """
        if coming is not None:
            self._note_rows(coming)
        self._watch.observe(rows, epoch, where)

    def _note_rows(self, coming: int) -> None:
        """Note the axes' mode from the newest played row, and the set-points from the row sent next."""
        for key, rows in self._played.items():
            if key != MODE:
                self._commands.note(key, rows[min(coming, len(rows) - 1)], self._axes.everywhere)
            elif np.any(self._axes.mode != rows[coming - 1]):
                self._note_mode(key, self._axes.mode != rows[coming - 1])
                self._axes.mode = rows[coming - 1].copy()

    def stop(self, reason: str) -> None:
        """Bring live axes to rest by grades and switch them off; failures are logged.

        Axes that this program has not armed are left alone: it neither enabled nor commanded them. Neither Ctrl-C nor
        SIGTERM cuts the stop short.
        """
        if not self._is_ours():
            return
        with self._uninterrupted():
            if not self._watch.look_for_live():
                return
            logger.warning("stopping the drives: %s", reason)
            with self._axes.lock:
                self._stops.begin(self._axes.may_turn, holds=False)
            self._watch.await_stop(ends=True)

    def stop_at_once(self, reason: str) -> None:
        """Have live axes quick-stopped at the supervisor's next turn, whatever the program's thread is doing.

        Any thread may call it; it returns at once. The program gets a SafetyError at its next call, or in the one that
        is under way. An axis pulled by a weight is held, as after any stop for a limit.

        Args:
            reason: What the error says.
        """
        self._watch.ask_to_stop(reason)

    def close(self) -> None:
        """Stop live axes; restore the drives' own values and watchdogs once the axes are proved off."""
        if self._is_ours():
            with self._uninterrupted():
                self.stop("the drives are closed while enabled")
                self._watchdogs.give_up()
        self._end_watching()

    def _is_ours(self) -> bool:
        """Return whether this program has enabled, commanded or armed anything."""
        return self._axes.is_armed or self._watch.is_supervised or bool(self._axes.may_turn.any())

    # --- signals --------------------------------------------------------------------------------------------------
    def interrupt(self) -> bool:
        """Begin to stop, since a signal ends the program; return whether a stop for a signal is already under way.

        Called from a signal handler, between any two instructions of the program: it only notifies the supervisor.
        """
        if self._is_closing or self._watch.is_told_to_end:
            return True
        if not self._axes.may_turn.any():
            return False
        self._watch.tell_to_end()
        return False

    def carry_on(self) -> None:
        """Report the stop to the program after all, since it continues."""
        self._watch.carry_on()

    @contextlib.contextmanager
    def _uninterrupted(self) -> Iterator[None]:
        """Keep signals that the library handles from ending a block: a stop counts as under way meanwhile."""
        before, self._is_closing = self._is_closing, True
        try:
            yield
        finally:
            self._is_closing = before

    # --- commands -------------------------------------------------------------------------------------------------
    def _before_controlword(self, words: Integers, where: Mask) -> None:
        enables = where & cia402.may_enable(words)
        if enables.any() or np.any(where & cia402.leads_on(words)):
            self._arm()
            self._commands.check_start(words, where)
            self._commands.check_modes(enables)
            self._commands.check_turning(enables & ~self._axes.live)
            self._prove_watchdogs(enables)
            self._axes.assume(enables)
        if np.any(cuts := where & self._stops.cuts(words)):
            self._brake(cuts)
        disables = where & cia402.matches(words, cia402.COMMANDS["disable operation"])
        self._brake_slow_ramps(disables & ~cuts)
        self._checked_stop = self._stops.current

    def _after_controlword(self, words: Integers, where: Mask) -> None:
        with self._axes.lock:
            self._axes.epoch += 1
            self._axes.in_flight &= ~where
        disables = cia402.matches(words, cia402.COMMANDS["disable operation"])
        self._disabling = np.where(where, disables, self._disabling)
        idle = where & ~cia402.may_enable(words)
        self._axes.forget_motion(idle)
        for asked in (self._axes.asked_speed, self._axes.asked_current):
            asked[idle] = 0.0
        self._commands.note_start(words, where)
        if np.any(where & cia402.may_enable(words)):
            self._watch.forget_signal()
        if np.any(enabled := where & cia402.may_enable(words)):
            self._commands.note_running(enabled)
            with self._axes.lock:
                if self._stops.current is not self._checked_stop:
                    # An axis was stopped between check and frame; the frame may have undone that.
                    self._stops.current = None
                    self._stops.begin(enabled, holds=True)
                    return
                self._stops.current = None
            for axis in np.flatnonzero(enabled).tolist():
                self._stops.end_hold(axis)

    def _prove_watchdogs(self, enables: Mask) -> None:
        """Verify that the watchdogs are still set before axes are enabled: a node may have restarted."""
        if not np.any(enables & ~self._axes.live):
            return
        self._watchdogs.check()
        if not self._axes.is_armed:
            self._drives.must_start()
            self._arm()

    def _finds_live(self, where: Mask) -> bool:
        """Return whether an axis about to be changed is live because another program or master has enabled it."""
        status = self._known.find(STATUSWORD)
        return any(cia402.is_live(self._drives.read_raw(status, int(axis))) for axis in np.flatnonzero(where))

    # --- arming ---------------------------------------------------------------------------------------------------
    def _arm(self) -> None:
        """Make ready for motion: nodes operational, limits known and lent, watchdogs on, every axis seen.

        Raises:
            SafetyError: If an axis cannot be watched; BusError or ObjectAccessError if a node does not answer.
        """
        self._check_none_lost()
        self._drives.start()
        if self._axes.is_armed:
            return
        self._limits.bounds()
        self._axes.mode = self._watch.modes().copy()
        try:
            if not self._drives.is_dry:
                self._watchdogs.set()
            self._watch.begin()
            self._lend()
            self._watch.first_look()
        except BaseException:
            with self._uninterrupted():
                self.stop("the drives cannot be monitored")
                self._watchdogs.give_up()
            self._end_watching()
            raise
        self._axes.is_armed = True
        signals.guard(self)

    def _check_none_lost(self) -> None:
        if self._axes.lost:
            raise SafetyError(
                f"axis {min(self._axes.lost)} could not be confirmed to be off, and is left to its watchdog; check "
                "it, and open the drives again"
            )

    def _lend(self) -> None:
        """Lend the drives limits that are tighter than their own, and ramps for stops by which they would coast."""
        self._limits.lend()
        self._stops.make_sure_of_ramps()

    def _end_watching(self) -> None:
        self._watch.end()
        signals.release(self)

    def _brake(self, axes: Mask) -> None:
        """Stop axes that turn; their voltage is cut once they are at rest."""
        rest = self._limits.bounds().rest  # also updates the conversion of speeds for the look below
        if self._drives.is_dry or not self._watch.look_for_live():
            return
        turning = axes & self._axes.live & (np.maximum(np.abs(self._axes.speed), np.abs(self._axes.velocity)) > rest)
        if turning.any():
            self._arm()  # also for axes enabled by another program, which must be stopped here, too
            with self._axes.lock:
                self._stops.begin(turning, holds=False)
            self._watch.await_stop()


@contextlib.contextmanager
def swinging_allowed(drives: Drives) -> Iterator[None]:
    """Disable the oscillation detector of the drives' envelope, if they have one; the other limits stay."""
    envelope = drives.safety
    if envelope is None:
        yield
        return
    limits = envelope.limits
    envelope.limits = replace(limits, oscillation=False)
    try:
        yield
    finally:
        envelope.limits = limits
