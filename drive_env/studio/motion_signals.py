"""Test signals of an axis as rows of set-points: steps, square waves, sweeps, torque pulses; and their job.

A signal that would leave the limits of its axis is refused before anything moves. The effect of a current cannot be
computed before: position and speed are monitored while it acts, on a bus by the envelope, otherwise by this module.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import signal

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.quantities import find_unit
from drive_env.dictionary.roles import Role
from drive_env.drives import motion
from drive_env.drives.currents import read_current_limit
from drive_env.drives.interface import Drives
from drive_env.drives.lent_object import lent
from drive_env.drives.limits import DEFAULT_SPEED
from drive_env.studio.motion_jobs import check_enabled, mode_of, only, parsed
from mechanics.arrays import Floats

if TYPE_CHECKING:
    from drive_env.dictionary.entries import ObjectName
    from drive_env.studio.session import Session

QUIET, AFTER = 0.05, 0.2  # s at rest before a signal, and after one that leaves the axis at rest
LONGEST = 10.0  # s
MOST_PUSH = 1.0  # s, longest current in one direction: a free axis accelerates during all of it
LOOK = 0.005  # s of emulated time between two checks of the limits
BRAKING = 5.0  # s, longest wait for rest after a current
FEWEST = 4  # samples per period of the highest frequency
FADED = 0.1  # share of a sweep over which it fades in and out
RESTS, REST_LOOK = 0.004, 0.05  # rev that an axis at rest may move in this time [s]: some counts of a coarse encoder
SWITCHED_OFF = 2**31  # a following error window that switches its monitoring off
# s of a torque pulse, in which 6077h must show at least this share: later, loops that hold the axis compensate for it.
ONSET, FOLLOWED_SHARE = 0.01, 0.2
POSITION, VELOCITY, CURRENT = cia402.POSITION_ACTUAL, cia402.VELOCITY_ACTUAL, cia402.TORQUE_ACTUAL
CURRENTS = (cia402.TARGET_TORQUE, cia402.TORQUE_OFFSET)


class MotionSignal(NamedTuple):
    """A test signal: its title, the mode, the played object, its shape, and a default height."""

    title: str
    mode: str
    target: int
    shape: str
    height: str


SIGNALS = {
    "position_step": MotionSignal("Position step (csp)", "csp", cia402.TARGET_POSITION, "step", "5 deg"),
    "position_square": MotionSignal("Position square wave (csp)", "csp", cia402.TARGET_POSITION, "square", "5 deg"),
    "position_sweep": MotionSignal("Position sweep (csp)", "csp", cia402.TARGET_POSITION, "sweep", "5 deg"),
    "velocity_step": MotionSignal("Velocity step (csv)", "csv", cia402.TARGET_VELOCITY, "step", "100 rpm"),
    "velocity_square": MotionSignal("Velocity square wave (csv)", "csv", cia402.TARGET_VELOCITY, "square", "100 rpm"),
    "velocity_sweep": MotionSignal("Velocity sweep (csv)", "csv", cia402.TARGET_VELOCITY, "sweep", "100 rpm"),
    "current_step": MotionSignal("Torque pulse, the axis is free (cst)", "cst", cia402.TARGET_TORQUE, "step", "0.5 A"),
    "current_square": MotionSignal("Current square wave (cst)", "cst", cia402.TARGET_TORQUE, "square", "0.5 A"),
    "current_sweep": MotionSignal("Current sweep (cst)", "cst", cia402.TARGET_TORQUE, "sweep", "0.5 A"),
    "load_step": MotionSignal("Load step: torque pulse while it holds its position (csp, 60B2h)", "csp",
                              cia402.TORQUE_OFFSET, "step", "0.5 A"),
}  # fmt: skip
# For each shape the parameters that it uses: title, unit.
SHAPES = {
    "step": {"held": "Held [s]"},
    "square": {"held": "Half a period [s]", "cycles": "Periods"},
    "sweep": {"low": "From [Hz]", "high": "To [Hz]", "lasts": "Duration [s]"},
}


@dataclass(frozen=True)
class SignalSettings:
    """The settings of a test signal: a row of `SIGNALS`, and its parameters.

    Attributes:
        name: Name of the row.
        height: Height or amplitude, with its unit.
        travel: Greatest distance from the present position, with its unit.
        speed: Greatest speed, with its unit; "" selects the drive's own limit.
        held: Duration of the height [s]; for a square wave half a period.
        cycles: Number of periods of a square wave.
        low, high: First and last frequency of a sweep [Hz].
        lasts: Duration of a sweep [s].
    """

    name: str
    height: str
    travel: str = "1 rev"
    speed: str = ""
    held: float = 0.2
    cycles: float = 2
    low: float = 1.0
    high: float = 20.0
    lasts: float = 5.0


class AxisRoom(NamedTuple):
    """Present position and range of an axis [rev], its greatest speed [rev/s], quick stop [rev/s^2], inf if unknown."""

    here: float
    low: float
    high: float
    speed: float
    braking: float

    def why_left(self, position: Floats, velocity: Floats) -> str:
        """Return why samples of position [rev] and velocity [rev/s] leave the range; "" if even a stop ends inside."""
        end = position + np.sign(velocity) * velocity**2 / (2.0 * self.braking)
        if (fast := float(np.abs(velocity).max())) > self.speed:
            return f"it turned at {60.0 * fast:.4g} rpm, and {60.0 * self.speed:.4g} rpm are allowed"
        if end.min() < self.low or end.max() > self.high:
            way = float(end.max() if end.max() > self.high else end.min()) - self.here
            return f"its stop would end {way:.3g} rev from where it stood, and {self.told} are allowed"
        return ""

    @property
    def told(self) -> str:
        """The range of the axis as text."""
        return f"{self.low - self.here:.3g} to {self.high - self.here:.3g} rev"


def signals_of(
    modes: tuple[str, ...], has: Callable[[Key], bool], plays: Callable[[Key], bool] = lambda key: True
) -> dict[str, str]:
    """Return the titles of the signals that an axis can play; {} if its drive has no actual position or velocity.

    Args:
        modes: Modes of its drive.
        has: Whether the drive has an object.
        plays: Whether the drive accepts an object in every cycle.
    """
    if not (has((POSITION, 0)) and has((VELOCITY, 0))):
        return {}
    able = {name: one for name, one in SIGNALS.items() if one.mode in modes and has((one.target, 0))}
    return {name: one.title for name, one in able.items() if plays((one.target, 0))}


def course(settings: SignalSettings, cycle: float) -> Floats:
    """Return a signal over its height for each cycle [s], in -1...1, 0 at both ends; shape (n,).

    A square wave begins and ends with half of `held`, and a sweep of speed or current with its crest, so that the axis
    returns to its first position.

    Raises:
        ValueError: For an impossible duration or impossible frequencies.
    """
    row = SIGNALS[settings.name]
    is_current = row.target in CURRENTS
    rest = [np.zeros(max(1, round(pause / cycle))) for pause in (QUIET, 0.0 if row.mode == "cst" else AFTER)]
    if row.shape == "sweep":
        wave = _sweep(settings, cycle, row.target)
    else:
        cycles = round(settings.cycles) if row.shape == "square" else 0
        if not (cycle <= settings.held and (row.shape == "step" or cycles >= 1)):
            raise ValueError(f"{settings.held:g} s, {settings.cycles:g} times, is no signal; give more than 0 of both")
        if is_current and settings.held > MOST_PUSH:
            raise ValueError(
                f"held for {settings.held:g} s: a current pushes one way for {MOST_PUSH:g} s at most, since a free "
                "axis gains speed as long as it does; make it shorter"
            )
        _check_duration(settings.held * max(1, 2 * cycles))
        half = round(settings.held / cycle)
        k = np.arange(half * max(1, 2 * cycles))
        wave = np.ones(half) if row.shape == "step" else np.where((k + half // 2) // half % 2 == 0, 1.0, -1.0)
    return np.concatenate([rest[0], wave, rest[1]])


def _sweep(settings: SignalSettings, cycle: float, target: int) -> Floats:
    low, high, lasts = settings.low, settings.high, settings.lasts
    least, most = (0.5 / MOST_PUSH if target in CURRENTS else 0.0), 1.0 / (FEWEST * cycle)
    if not (max(least, 1.0 / lasts if lasts > 0.0 else math.inf) <= low < high <= most):
        raise ValueError(
            f"a sweep from {low:g} to {high:g} Hz in {lasts:g} s is impossible: it takes {most:g} Hz at most, and at "
            f"least {max(least, 1.0 / max(lasts, cycle)):g} Hz to begin with; change the frequencies, or its duration"
        )
    _check_duration(lasts)
    t = np.arange(round(lasts / cycle)) * cycle
    phase = -90.0 if target == cia402.TARGET_POSITION else 0.0
    return np.asarray(signal.chirp(t, low, lasts, high, phi=phase) * signal.windows.tukey(len(t), FADED))


def _check_duration(duration: float) -> None:
    if duration > LONGEST:
        raise ValueError(f"the signal takes {duration:g} s, and {LONGEST:g} s are the most; make it shorter")


def play_signal(session: Session, axis: int, settings: SignalSettings) -> Callable[[Drives], str]:
    """Return the job that plays a signal on an enabled axis, and restores its mode.

    The job returns a message to show; "" for none.

    Raises:
        ValueError: Raised by the job for a signal that would leave the limits of the axis; nothing moves then.
        RuntimeError: Raised by the job for an axis that is not enabled or turns; or that left its limits and is
            stopped.
    """

    def job(drives: Drives) -> str:
        row, where, cycle = SIGNALS[settings.name], only(drives, axis), session.description.cycle
        wave = course(settings, cycle)
        height = parsed(session, axis, settings.height, row.target)
        if height == 0:
            raise ValueError(f"a height of {settings.height} does nothing; give one, e.g. {row.height}")
        check_enabled(drives, axis)
        if _turns(drives, session, axis):
            raise RuntimeError(f"axis {axis} turns already; bring it to rest first")
        room = _room(drives, session, axis, settings)
        _check_jump(drives, session, axis, row, height)
        offset = int(drives.read(row.target)[axis]) if row.target == cia402.TORQUE_OFFSET else 0
        _check_limits(drives, session, axis, row, (offset + height, height, wave), room)
        given_back = nullcontext() if row.target != cia402.TORQUE_OFFSET else lent(drives, row.target, offset, where)
        with _held_to(drives, session, axis, room), given_back, _in_mode(drives, session, axis, row.mode, room):
            return _play(drives, session, axis, row, np.rint(height * wave).astype(np.int64), room)

    return job


def size_of(session: Session, axis: int, name: ObjectName) -> float:
    """Return the size of a count of an object [rev, rev/s, rev/s^2, A]; ValueError if its unit is unknown."""
    entry = session.description.dictionary.find(name)
    unit = find_unit(entry.unit, session.scales[axis])
    if unit is None:
        raise ValueError(f"the unit of {entry.label} is not known, so that no limit could be held; no signal is played")
    return unit.factor


def _room(drives: Drives, session: Session, axis: int, settings: SignalSettings) -> AxisRoom:
    """Return the allowed range and speed of an axis: those of the settings, within its drive's limits."""
    known, count = session.description, size_of(session, axis, POSITION)
    travel = count * parsed(session, axis, settings.travel, cia402.TARGET_POSITION)
    if travel <= 0.0:
        raise ValueError(f"a travel of {settings.travel} lets nothing move; give how far the axis may go, e.g. 1 rev")
    here = count * int(drives.read(POSITION)[axis])
    low, high = here - travel, here + travel
    ends = [(cia402.POSITION_LIMITS, 1), (cia402.POSITION_LIMITS, 2)]
    if all(known.has(key) for key in ends):
        home = int(drives.read(cia402.HOME_OFFSET)[axis]) if known.has((cia402.HOME_OFFSET, 0)) else 0
        own = [count * (int(drives.read(key)[axis]) - home) for key in ends]
        if own[0] < own[1]:  # an empty range is no limit
            low, high = max(low, own[0]), min(high, own[1])
    speed = DEFAULT_SPEED
    if known.has((cia402.MAX_PROFILE_VELOCITY, 0)) and (
        own_speed := int(drives.read(cia402.MAX_PROFILE_VELOCITY)[axis])
    ):
        speed = min(speed, own_speed * size_of(session, axis, cia402.MAX_PROFILE_VELOCITY))
    if settings.speed.strip():
        name = cia402.TARGET_VELOCITY if known.has((cia402.TARGET_VELOCITY, 0)) else cia402.PROFILE_VELOCITY
        speed = min(speed, parsed(session, axis, settings.speed, name) * size_of(session, axis, name))
        if speed <= 0.0:
            raise ValueError(f"a highest speed of {settings.speed} lets nothing move; give one above 0")
    ramp = cia402.QUICK_STOP_DECELERATION
    braking = int(drives.read(ramp)[axis]) * size_of(session, axis, ramp) if known.has((ramp, 0)) else 0.0
    return AxisRoom(here, low, high, speed, braking or math.inf)


def _check_limits(
    drives: Drives, session: Session, axis: int, row: MotionSignal, asked: tuple[int, int, Floats], room: AxisRoom
) -> None:
    """Raise ValueError for a signal that leaves the axis' limits; `asked`: its peak and height [counts], and course."""
    peak, height, wave = asked
    size, cycle = size_of(session, axis, row.target), session.description.cycle
    if row.target in CURRENTS:
        if session.description.role(Role.CURRENT_LIMIT) is None:
            raise ValueError(f"axis {axis} tells no current limit; its current is left to its own loops")
        most = float(read_current_limit(drives)[axis])
        if abs(peak * size) > most:
            raise ValueError(
                f"{peak * size:.4g} A are more than the current limit, {most:.4g} A; make the height smaller"
            )
        return
    if row.target == cia402.TARGET_VELOCITY:
        way, top = np.cumsum(wave) * cycle * height * size, abs(height * size)
    else:
        way = wave * height * size
        top = float(np.abs(np.diff(way)).max()) / cycle if row.shape == "sweep" else 0.0
    if top > room.speed:
        raise ValueError(
            f"{60.0 * top:.4g} rpm are more than the {60.0 * room.speed:.4g} rpm that the axis may turn; make the "
            "height or the frequency smaller"
        )
    if room.here + way.min() < room.low or room.here + way.max() > room.high:
        raise ValueError(
            f"the axis would go {way.min():.3g} to {way.max():.3g} rev, and {room.told} are allowed; make the signal "
            "smaller or shorter, or the travel larger within the drive's own limits (607Dh)"
        )


def _check_jump(drives: Drives, session: Session, axis: int, row: MotionSignal, height: int) -> None:
    """Raise ValueError for a position jump that would cause a fault, or lost steps of a stepper."""
    if row.target != cia402.TARGET_POSITION or row.shape == "sweep":
        return
    if session.description.role(Role.MICROSTEPS) is not None:
        raise ValueError("a stepper loses steps in a jump of its position; take a sweep, or a move")
    window = (cia402.FOLLOWING_WINDOW, 0)
    jump, most = abs(height) * (2 if row.shape == "square" else 1), 0
    if session.description.has(window):
        most = int(drives.read(window)[axis])
    if 0 < most < SWITCHED_OFF and jump >= most:
        count = size_of(session, axis, POSITION)
        raise ValueError(
            f"a jump of {jump * count:.3g} rev is beyond the following error window (6065h), {most * count:.3g} rev: "
            "the drive would go into fault; make the height smaller"
        )


@contextmanager
def _held_to(drives: Drives, session: Session, axis: int, room: AxisRoom) -> Iterator[None]:
    """Limit a bus' envelope to the axis' range during the block; it allows oscillating currents, which are intended."""
    envelope = drives.safety
    if envelope is None:
        yield
        return
    count, per_speed = size_of(session, axis, POSITION), size_of(session, axis, VELOCITY)

    def of_axis(value: float) -> list[float | None]:
        return [value if k == axis else None for k in range(drives.num_axes)]

    limits = envelope.limits
    low, high = of_axis(room.low / count), of_axis(room.high / count)
    speed = of_axis(room.speed / per_speed)
    envelope.change(replace(limits, position=(low, high), velocity=speed, oscillation=False))
    try:
        yield
    finally:
        envelope.change(limits)


@contextmanager
def _in_mode(drives: Drives, session: Session, axis: int, mode: str, room: AxisRoom) -> Iterator[None]:
    """Bring an enabled axis at rest to a mode; restore its mode, at rest, at the end.

    After an error the session stops the axis.
    """
    where, before = only(drives, axis), mode_of(drives, axis)
    motion.select_mode(drives, mode, where=where)
    yield
    if mode == "cst":  # it turns: position modes must not take over a turning axis
        motion.select_mode(drives, motion.turning_mode(drives), where=where)
        waited = 0.0
        while _turns(drives, session, axis, room):
            if (waited := waited + REST_LOOK) > BRAKING:
                raise TimeoutError(f"axis {axis} did not come to rest {BRAKING:g} s after the signal; it is stopped")
    if before:
        motion.select_mode(drives, before, where=where)


def _turns(drives: Drives, session: Session, axis: int, room: AxisRoom | None = None) -> bool:
    """Let some time pass and return whether an axis moved; RuntimeError if it left its range, which None disables."""
    before = int(drives.read(POSITION)[axis])
    if room is None:
        drives.advance(REST_LOOK)
    else:
        _watched(drives, session, axis, room, REST_LOOK, None)
    return abs(int(drives.read(POSITION)[axis]) - before) * size_of(session, axis, POSITION) > RESTS


def _play(drives: Drives, session: Session, axis: int, row: MotionSignal, rows: np.ndarray, room: AxisRoom) -> str:
    """Play the rows of a signal, added to its object's value; return the message to show, "" for none."""
    cycle, where = session.description.cycle, only(drives, axis)
    now = drives.read(row.target)
    played = now + rows[:, None] * where
    # A drive may add the offset only while set-points arrive.
    place = drives.read(cia402.TARGET_POSITION) if row.target == cia402.TORQUE_OFFSET else None
    piece = round(LOOK / cycle) if drives.time_waits else len(rows)  # on a bus the envelope monitors it, without gaps
    current = []
    for first in range(0, len(rows), piece):
        part = played[first : first + piece]
        play = {row.target: part}
        if place is not None:
            play[cia402.TARGET_POSITION] = np.broadcast_to(place, part.shape)
        current.append(_watched(drives, session, axis, room, len(part) * cycle, play))
    if row.target != cia402.TORQUE_OFFSET:
        return ""
    seen = np.concatenate(current)
    first, height = int(np.argmax(rows != 0)), float(np.abs(rows).max()) * size_of(session, axis, row.target)
    moved = abs(float(seen[first : first + round(ONSET / cycle)].mean() - seen[:first].mean()))
    if moved >= FOLLOWED_SHARE * height:
        return ""
    return (
        f"the current (6077h) changed by {moved:.3g} A for a torque offset of {height:.3g} A: in csp this drive does "
        "not add 60B2h; take the torque pulse of the free axis"
    )


def _watched(
    drives: Drives, session: Session, axis: int, room: AxisRoom, duration: float, play: dict[int, np.ndarray] | None
) -> Floats:
    """Let time pass [s] while rows are played, and return the current of each cycle [A], shape (n,).

    Raises:
        RuntimeError: If the axis left its range; the session stops it.
    """
    names = [name for name in (POSITION, VELOCITY, CURRENT) if session.description.has((name, 0))]
    trace = drives.record(names, duration, play=play, period=session.description.cycle)
    seen = {name: np.asarray(trace[name][:, axis] * size_of(session, axis, name), float) for name in names}
    if why := room.why_left(seen[POSITION], seen[VELOCITY]):
        raise RuntimeError(f"axis {axis} was stopped: {why}; make the signal smaller or shorter")
    return seen.get(CURRENT, np.zeros(len(trace)))
