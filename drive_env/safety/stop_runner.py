"""Runs the stops of some drives: which axes, the values lent meanwhile, and the axes left to the watchdogs."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.roles import Role
from drive_env.drives.limits import NO_LIMIT
from drive_env.safety.axes import Axes
from drive_env.safety.bounds import increments_per_count, read_own, read_vl_rate, unit_of
from drive_env.safety.errors import SafetyError, logged
from drive_env.safety.lending import Lending
from drive_env.safety.limits_in_force import STOP_WITHIN, LimitsInForce
from drive_env.safety.looks import answer_time
from drive_env.safety.objects import (
    CONTROLWORD,
    DISABLE_OPERATION_OPTION,
    FAULT_REACTION_OPTION,
    HALT_OPTION,
    HM,
    HOMING_RAMP,
    MODE,
    PV,
    QUICK_STOP_OPTION,
    VL,
    VL_DECELERATION,
    VL_REFERENCE,
)
from drive_env.safety.stop_ends import LATENCY, ends_by_itself, outside, stop_way
from drive_env.safety.stopping import GRACE, REPEAT, SHARE, AxisStop, Phase, Sample, Stop
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import WatchedDrives

logger = logging.getLogger(__name__)


WEIGHT_LOOK, WEIGHT_SHARE = 0.06, 0.03  # s at rest; share of the current limit above which it may be a weight
WAKE_PERIOD = 0.2  # s
COASTS = 0  # the option code that lets an axis coast
# Options of a stop that would let an axis coast or ramp by its profile, however long that takes, and the options lent
# instead: a quick stop's ramp (6085h), by which stopping distances are predicted, if there is a choice.
RAMPS = {
    QUICK_STOP_OPTION: {COASTS: 2, 1: 2, 5: 6},
    DISABLE_OPERATION_OPTION: {COASTS: 1},
    HALT_OPTION: {COASTS: 1},
    FAULT_REACTION_OPTION: {COASTS: 2, 1: 2},
}
# The ramps that "disable operation" may use, and in which modes: 6084h in all; some drives use one ramp for both
# directions in pv, and another in hm and vl.
SLOW_DOWN_RAMPS = {
    (cia402.PROFILE_DECELERATION, 0): (),
    (cia402.PROFILE_ACCELERATION, 0): (PV,),
    HOMING_RAMP: (HM,),
    **dict.fromkeys((*VL_DECELERATION, VL_REFERENCE), (VL,)),
}
# Option codes of 605Ah that end in switch on disabled, and those with the same ramp that end in quick stop active.
_ENDS_HELD = {1: 5, 2: 6}


class StopRunner:
    """The stop that is under way, if any.

    Args:
        drives: The drives.
        axes: Their state; hold its lock to begin or step a stop.
        limits: The limits in force.
        lending: Lends the drives another quick stop option.
        cease: Ends the heartbeats, so that unreachable drives stop by themselves.

    Attributes:
        current: The stop; None if no axis is stopping or held.
    """

    def __init__(
        self, drives: WatchedDrives, axes: Axes, limits: LimitsInForce, lending: Lending, cease: Callable[[], None]
    ) -> None:
        self.current: Stop | None = None
        self._drives = drives
        self._known = drives.description.dictionary
        self._axes = axes
        self._limits = limits
        self._lending = lending
        self._cease = cease
        self._woken_at = 0.0
        self._told_of: set[int] = set()  # axes already reported as held under a weight
        self._opened: set[int] = set()  # axes whose last write was the manufacturer's mode, not a controlword
        self._modes: dict[int, int] = {}  # axis that ignores commands -> its mode of operation as read
        self._asked_at: dict[int, float] = {}  # axis -> when its mode was asked for [s]
        self._beyond: dict[int, tuple[float, float]] = {}  # axis beyond its travel -> when, and how fast
        self._held: set[int] = set()  # axes whose quick stop option was checked in this stop

    def make_sure_of_ramps(self) -> None:
        """Make quick stops ramp by 6085h and other stops ramp, too: an option code of 0 would let an axis coast.

        Raises:
            SafetyError: If a drive accepts no other option for its quick stop.
        """
        for key, ramps in RAMPS.items():
            if not self._drives.description.has(key):
                continue
            for axis, option in enumerate(read_own(self._drives, key, 2).tolist()):
                if option not in ramps or self._lending.lend(key, axis, ramps[option]) or option != COASTS:
                    continue
                if key == QUICK_STOP_OPTION:
                    raise SafetyError(
                        f"axis {axis}: its quick stop lets it coast (605Ah = 0), and it takes no other option; write "
                        "605Ah = 2 where the drive allows it"
                    )
                logger.warning("axis %d: %s = 0 lets it coast", axis, self._known.find(key).label)

    def keep_ramps(self, key: Key, raw: Integers, where: Mask) -> None:
        """Lend a ramp in place of an option without one that is about to be written; the drive gets that option later.

        Raises:
            SafetyError: If a drive does not accept the ramp.
        """
        if key not in RAMPS:
            return
        options = np.broadcast_to(raw, where.shape)
        for axis in np.flatnonzero(where & np.isin(options, list(RAMPS[key])) & ~self._is_lent(key)).tolist():
            if not self._lending.lend(key, axis, RAMPS[key][int(options[axis])]) and options[axis] == COASTS:
                raise SafetyError(
                    f"axis {axis}: {self._known.find(key).label} = 0 would let it coast, and it takes no other option; "
                    "nothing was sent"
                )

    def cuts(self, words: Integers) -> Mask:
        """Return the axes whose voltage controlwords cut at once, by the present 605Ch of each axis."""
        cuts: Mask = cia402.cuts_voltage(words)
        disables = cia402.matches(words, cia402.COMMANDS["disable operation"])
        key = DISABLE_OPERATION_OPTION
        if disables.any() and self._drives.description.has(key) and not self._cannot_coast(key):
            entry = self._known.find(key)
            options = [self._drives.read_raw(entry, axis) for axis in range(self._drives.num_axes)]
            cuts = cuts | disables & (np.array(options) == COASTS)
        return cuts

    def slow_ramps(self) -> Mask:
        """Return the axes that "disable operation" would take out of their travel or brake for longer than STOP_WITHIN.

        A drive need not obey a quick stop during that ramp: only cutting the voltage would remain.
        """
        ramp, bounds = self._disabling_ramp(), self._limits.bounds()
        speed = np.where(np.abs(self._axes.speed) > np.abs(self._axes.velocity), self._axes.speed, self._axes.velocity)
        way = speed**2 / (2.0 * np.maximum(ramp, 1.0)) + np.abs(speed) * LATENCY
        end = self._axes.position + np.sign(speed) * way
        leaves = (end < bounds.low) | (end > bounds.high)
        slow: Mask = (ramp < bounds.braking) & (leaves | (np.abs(speed) > STOP_WITHIN * ramp))
        return slow

    def may_ramp_slowly(self) -> Mask:
        """Return the axes that "disable operation" brakes less than a quick stop does."""
        return self._disabling_ramp() < self._limits.bounds().braking

    def _disabling_ramp(self) -> Floats:
        """Return the lowest deceleration of "disable operation" in the present mode [inc/s^2]; inf if unknown."""
        ramp = np.full(self._drives.num_axes, np.inf)
        for key, modes in SLOW_DOWN_RAMPS.items():
            if not self._drives.description.has(key):
                continue
            count = increments_per_count(unit_of(self._drives.description, key), self._axes.rotor)
            own: Floats = np.asarray(read_own(self._drives, key, 0) * np.nan_to_num(count), float)
            if key in (*VL_DECELERATION, VL_REFERENCE):
                own = read_vl_rate(self._drives, VL_DECELERATION, self._axes.rotor)
            counts = ~np.isnan(count) & (own > 0.0 if modes else True)  # a mode whose own ramp is 0 uses 6084h
            ramp = np.where(counts & np.isin(self._axes.mode, modes or self._axes.mode), np.minimum(ramp, own), ramp)
        return ramp

    def _cannot_coast(self, key: Key) -> bool:
        """Return whether the EDS allows no option that coasts."""
        low = self._known.find(key).low
        return low is not None and low > COASTS

    def _is_lent(self, key: Key) -> Mask:
        return np.array([self._lending.is_lent(key, axis) for axis in range(self._drives.num_axes)])

    def end_hold(self, axis: int) -> None:
        """Restore the quick stop option of an axis that is enabled anew, or lend its 6085h ramp instead."""
        if not self._lending.is_lent(QUICK_STOP_OPTION, axis):
            return
        with logged():
            ramp = RAMPS[QUICK_STOP_OPTION].get(self._lending.owned(QUICK_STOP_OPTION, axis))
            if ramp is None:
                self._lending.give_back_one(QUICK_STOP_OPTION, axis)
            else:
                self._lending.lend(QUICK_STOP_OPTION, axis, ramp)

    def stop_for(self, what: str, remedy: str) -> NoReturn:
        """Stop all axes that count as live, and raise SafetyError with the cause and the remedy."""
        with self._axes.lock:
            self.begin(self._axes.may_turn, holds=True)
        raise SafetyError(f"{what}: the drives were quick-stopped; {remedy}")

    def begin(self, axes: Mask, *, holds: bool) -> None:
        """Begin to stop axes, or continue; an axis that need not hold its position any more is switched off."""
        now = self._axes.now()
        stop = self.current
        if stop is None:
            stop = self.current = Stop({}, self._send, self._sample)
        bounds = self._limits.latest
        for axis in map(int, np.flatnonzero(axes)):
            self._held.discard(axis)
            self._told_of.discard(axis)
            self._modes.pop(axis, None)
            known = stop.axes.get(axis)
            if known is not None and known.phase not in (Phase.OFF, Phase.LOST):
                if known.phase is Phase.REST and holds:
                    del stop.axes[axis]  # it moved again
                else:
                    if not holds:
                        known.release()
                    continue
            speed = max(abs(self._axes.speed[axis]), abs(self._axes.velocity[axis]))
            braking = 0.0 if bounds is None else float(bounds.braking[axis])
            rest = 0.0 if bounds is None else float(bounds.rest[axis])
            leaves = bounds is not None and bool(ends_by_itself(self._axes, bounds)[axis])
            follows = functools.partial(self._follows, axis) if leaves else None
            self._beyond.pop(axis, None)
            stop.axes[axis] = AxisStop(now, speed, braking, rest, holds, follows)
        stop.step(now)

    def _follows(self, axis: int) -> bool:
        """Return whether an axis should go on to its set-point, since a quick stop would take it out of its travel.

        Outside its travel it may go on only while its loops brake it or bring it back.
        """
        bounds, axes = self._limits.latest, self._axes
        if bounds is None or not cia402.matches(int(axes.status[axis]), cia402.OPERATION_ENABLED):
            return False
        speed, place = axes.newest_speed(), axes.position.astype(float)
        if outside(bounds, place + stop_way(axes, bounds, speed))[axis] <= bounds.slack[axis]:
            return False
        is_out = outside(bounds, place)[axis] > bounds.settled[axis]
        leaves = speed[axis] * (1.0 if place[axis] > bounds.high[axis] else -1.0) > bounds.rest[axis]
        if not (is_out and leaves):
            self._beyond.pop(axis, None)
            return True
        now, fast = axes.now(), float(abs(speed[axis]))
        since, before = self._beyond.setdefault(axis, (now, fast))
        if now - since < GRACE:
            return True
        self._beyond[axis] = now, fast
        return bool(before - fast >= SHARE * bounds.braking[axis] * (now - since))

    def hold(self) -> None:
        """Keep stopping axes in quick stop active at first; ask those that ignore commands for their mode."""
        stop = self.current
        if stop is None:
            return
        self._ask_modes(stop)
        if self._drives.description.has(QUICK_STOP_OPTION):
            self._lend_hold(stop)

    def _ask_modes(self, stop: Stop) -> None:
        """Ask axes that ignore commands for their mode of operation: another master may have written it."""
        per_node, now = self._drives.description.num_axes, self._axes.now()
        for axis, one in list(stop.axes.items()):
            is_due = now >= self._asked_at.get(axis, -math.inf) + REPEAT
            if one.phase in (Phase.OFF, Phase.LOST) or not is_due or not self._ignores(axis):
                continue
            self._asked_at[axis] = now
            entry = self._known.find(MODE)
            node, part = divmod(axis, per_node)
            data = self._drives.sdo(node).ask(*self._drives.description.key(entry, part), answer_time(self._drives))
            if data is not None:
                self._modes[axis] = int(self._drives.description.decode(entry, data))

    def _lend_hold(self, stop: Stop) -> None:
        """Lend an option that ends in quick stop active: switched off, an axis would be pulled on by a weight."""
        entry, per_node = self._known.find(QUICK_STOP_OPTION), self._drives.description.num_axes
        for axis, one in list(stop.axes.items()):
            if not one.holds or one.phase is not Phase.RAMP or axis in self._held:
                continue
            node, part = divmod(axis, per_node)
            data = self._drives.sdo(node).ask(*self._drives.description.key(entry, part), answer_time(self._drives))
            if data is None:
                continue
            self._held.add(axis)
            option = int(self._drives.description.decode(entry, data))
            if option in _ENDS_HELD:
                with logged():
                    self._lending.lend(QUICK_STOP_OPTION, axis, _ENDS_HELD[option])

    def _release_what_no_weight_pulls(self, stop: Stop) -> None:
        """Switch off held axes that need no current at rest: while it holds, a drive may not watch its master."""
        now, bounds = self._axes.now(), self._limits.latest
        for axis, one in stop.axes.items():
            if one.phase is not Phase.REST or not one.holds or one.rests_for(now) < WEIGHT_LOOK:
                continue
            limit = NO_LIMIT if bounds is None else int(bounds.current[axis])
            if limit >= NO_LIMIT or abs(self._axes.mean_current[axis]) <= WEIGHT_SHARE * limit:
                one.release()
            elif axis not in self._told_of:
                self._told_of.add(axis)
                logger.warning(
                    "axis %d is held in quick stop active: it takes a current of %d at rest, as under a weight; it "
                    "falls when its voltage goes, unless a brake holds it", axis, int(self._axes.mean_current[axis]),
                )  # fmt: skip

    def _send(self, axis: int, word: int) -> None:
        """Send a controlword without waiting for an answer."""
        known = self._drives.description
        node, part = divmod(axis, known.num_axes)
        entry, value = self._known.find(CONTROLWORD), word
        own_mode = self._own_mode(axis)
        if own_mode is not None and axis not in self._opened:  # alternately, until it takes commands
            self._opened.add(axis)
            entry, value = self._known.find(Role.MODE_GATE), own_mode
        else:
            self._opened.discard(axis)
        with logged():
            self._drives.sdo(node).command(*known.key(entry, part), known.encode(entry, value))

    def _own_mode(self, axis: int) -> int | None:
        """Return the manufacturer's mode by which an axis takes commands again; None if it takes them."""
        device = self._drives.device
        if device is None or not self._ignores(axis):
            return None
        return device.mode_gate.get(self._modes.get(axis, int(self._axes.mode[axis])))

    def _ignores(self, axis: int) -> bool:
        """Return whether an axis last reported that it takes no commands, and its drive has a manufacturer's mode."""
        device = self._drives.device
        gated = device is not None and bool(device.mode_gate)
        return gated and not cia402.matches(int(self._axes.status[axis]), cia402.REMOTE)

    def _sample(self, axis: int) -> Sample:
        return Sample(float(self._axes.seen[axis]), int(self._axes.status[axis]), float(self._axes.speed[axis]))

    def step(self) -> None:
        """Advance the stop under way."""
        stop = self.current
        assert stop is not None
        now = self._axes.now()
        before = {axis: one.phase for axis, one in stop.axes.items()}
        stop.step(now)
        self._release_what_no_weight_pulls(stop)
        if now >= self._woken_at and any(one.is_unseen(now) for one in stop.axes.values()):
            # A node that has missed its master is stopped and answers nothing. Operational, not pre-operational, where
            # some drives do not watch their master.
            self._woken_at = now + WAKE_PERIOD
            self._drives.must_start()
            with logged():
                self._drives.start()
        for axis, one in stop.axes.items():
            if one.phase is before[axis]:
                continue
            if one.phase is Phase.CUT and one.why:
                logger.error("axis %d: %s; its voltage is switched off", axis, one.why)
            elif one.phase is Phase.LOST:
                logger.error("axis %d does not answer, and is left to its watchdog", axis)
                self._axes.lost.add(axis)
                self._cease()

    def judged(self) -> Mask:
        """Return which axes are checked against the limits: live, not lost, not stopping."""
        judged = self._axes.live.copy()
        judged[list(self._axes.lost)] = False
        if self.current is not None:
            for axis, stop in self.current.axes.items():
                # An axis enabled by another program since then is no longer held here.
                is_enabled = stop.is_over and cia402.matches(int(self._axes.status[axis]), cia402.OPERATION_ENABLED)
                judged[axis] &= is_enabled
        return judged
