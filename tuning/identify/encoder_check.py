"""Checks pole pairs and the wiring of encoder and halls: the field turns in open loop, and the rotor must follow it.

With commutation in open loop (2055h) the current of 2004h points along an angle that the velocity demand turns (2102h).
The rotor follows: electrical turns of the field over turns counted by the encoder give the pole pairs, and the sign
shows whether the encoder counts in the direction of the field. Commutation by encoder needs both to be correct before
any torque is commanded: with a reversed encoder the motor runs away. The same holds for halls that commutate.

A brushed motor has no field to turn: a short current pulse in both directions, lengthened until the encoder counts,
moves the rotor by a few counts and gives the direction before any loop is closed over the encoder.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import to_counts
from drive_env.drives.interface import CYCLE
from drive_env.safety.envelope import swinging_allowed
from mechanics.arrays import Floats, Mask
from tuning.estimate import Estimate, refused
from tuning.identify.wiring import Halls, judge_halls
from tuning.identify.working_state import BY_FIELD, Working, enable, read_role, still_enabled, switch_off
from tuning.oscillation_watch import shaken
from tuning.stop_causes import stop_causes

# unit of angles: 1/65536 electrical turn
RAISE, REST, TURN = 20, 60, 240  # cycles: current rises (gravity acts at once), rotor settles, field turns
MOST_TURN, LEAST_TURN = 1.0, 0.2  # electrical turns of the field
SHARE = 0.9  # of the allowed current
TOO_SHORT = "travel too short"  # first words of the reason if nothing was turned
MARGIN = 0.1  # rad of room that is not used
TOLERANCE = 0.35  # of a pole pair: a larger deviation from a whole number is rejected
STUCK = 0.25  # of the field's turn: a rotor that moves less does not follow
# Of a brushed motor: current (as a share) and cycles of a quarter of the pulse; counts that must be seen, and least
# correlation with the pulse, which an axis that falls or coasts does not reach.
PUSHES = ((0.5, 4), (0.5, 8), (SHARE, 16), (SHARE, 32), (SHARE, 64))
LEAST_COUNTS, LIKENESS = 10, 0.7
PULSED = 1.2  # of the current limit, RMS over 25 ms: above, the current loop oscillates


class EncoderCheck(NamedTuple):
    """The result of the check for one axis."""

    pole_pairs: Estimate
    direction: Estimate
    ratio: float = math.nan  # of the field's turns to the encoder's; nan if the rotor did not follow
    halls: Halls = Halls()

    @property
    def is_good(self) -> bool:
        """Whether torque may be commanded: no measurement contradicts the drive's settings."""
        return not self.direction.is_known or self.direction.value > 0.0

    def is_whole(self, configured: int) -> bool:
        """Return whether the ratio is a whole number, or so close to the drive's setting that this may be correct."""
        if self.pole_pairs.is_known or not math.isfinite(self.ratio):
            return True
        return abs(abs(self.ratio) - configured) <= _tolerance(configured)


def check_encoders(working: Working) -> list[EncoderCheck]:
    """Turn the fields of three-phase motors and check the encoders, axis by axis; switch all axes off at the end."""
    target, drives = working.target, working.target.drives
    count = target.num_axes
    if target.motor.kind == "dc":
        none = refused("1", "a brushed motor has no pole pairs")
        return [EncoderCheck(none, direction) for direction in _push(working)]
    configured = drives.read(Role.POLE_PAIRS).astype(float)
    commutation = drives.read(Role.COMMUTATION)
    where, reasons = able(working)
    if not where.any():
        return [EncoderCheck(refused("1", reason), refused("1", reason)) for reason in reasons]
    try:
        drives.write(Role.COMMUTATION, BY_FIELD, where=where)
        drives.write(Role.OPEN_LOOP_CURRENT, 0, where=where)
        enable(working, "csv", where)
        away, back, field, halls, reasons = _turn(working, where, configured)
        alive = still_enabled(drives.read(cia402.STATUSWORD))
    finally:
        switch_off(drives, where)
        drives.write(Role.OPEN_LOOP_CURRENT, 0, where=where)
        drives.write(Role.COMMUTATION, commutation, where=where)
    # The encoder must count up with the field unless 2057h reverses the sign of positions.
    shaft = 1.0 - 2.0 * read_role(target, Role.SHAFT_DIRECTION)
    found = []
    causes = [] if alive.all() else stop_causes(drives)
    for k in range(count):
        if not where[k] or reasons[k]:
            found.append(EncoderCheck(refused("1", reasons[k]), refused("1", reasons[k])))
        elif not alive[k]:
            reason = (
                "the axis was switched off while the field turned: it left its travel, or the drive switched itself "
                f"off ({causes[k]})"
            )
            found.append(EncoderCheck(refused("1", reason), refused("1", reason)))
        else:
            check = _judge(field[k], shaft[k] * away[k], shaft[k] * back[k], target.motor.n_p)
            found.append(check._replace(halls=halls[k]) if check.direction.is_known else check)
    return found


def _push(working: Working) -> list[Estimate]:
    """Push brushed motors in both directions and return their encoders' directions; switch all axes off at the end."""
    drives, count = working.target.drives, working.target.num_axes
    found: list[Estimate] = [refused("1", "not asked for")] * count
    waiting = working.where.copy()
    try:
        enable(working, "cst", waiting)
        with swinging_allowed(drives), shaken(drives, PULSED * working.current):
            for share, quarter in PUSHES:
                # The pulse is symmetric, so that the rotor ends at rest and at its old position.
                sign = np.concatenate([np.repeat((1.0, -1.0, -1.0, 1.0), quarter), np.zeros(quarter)])
                raw = np.where(waiting, sign[:, None] * to_counts(drives, share * working.current), 0).astype(np.int64)
                angle = working.angle(
                    drives.record([cia402.POSITION_ACTUAL], len(raw) * CYCLE, play={cia402.TARGET_TORQUE: raw})[
                        cia402.POSITION_ACTUAL
                    ]
                )
                stay_inside(working, waiting)
                alive = still_enabled(drives.read(cia402.STATUSWORD))
                for k in np.flatnonzero(waiting):
                    towards = _likeness(angle[:, k], sign)
                    seen = np.ptp(angle[:, k]) >= LEAST_COUNTS * 2.0 * np.pi / working.target.motor.encoder_counts
                    if seen and abs(towards) >= LIKENESS:
                        way = float(np.sign(towards))
                        found[k] = Estimate(way, way, way, "1")
                    elif not alive[k]:
                        found[k] = refused("1", "the axis was switched off while it was pushed: it left its travel")
                    else:
                        found[k] = refused(
                            "1", "the rotor did not follow the current: check whether it is blocked or a cable is open"
                        )
                        continue
                    waiting[k] = False
                switch_off(drives, working.where & ~waiting)
                if not waiting.any():
                    break
    finally:
        switch_off(drives, working.where)
    return found


def _likeness(angle: Floats, torque: Floats) -> float:
    """Return the correlation, -1...1, of a motion with that of a free mass under a torque, without parabolic trends."""
    t = np.linspace(-1.0, 1.0, len(angle))
    trend = np.stack([np.ones_like(t), t, t * t], axis=1)
    pair = np.stack([angle, np.cumsum(np.cumsum(torque))], axis=1)
    rest = pair - trend @ np.linalg.lstsq(trend, pair, rcond=None)[0]
    sizes = np.linalg.norm(rest, axis=0)
    return float(rest[:, 0] @ rest[:, 1] / max(sizes[0] * sizes[1], 1e-30))


def able(working: Working) -> tuple[Mask, list[str]]:
    """Return which axes have enough travel on both sides for the field to pull their rotor; and why others have not."""
    down, up = working.room()
    # When switched on, the field pulls the rotor by at most half an electrical turn. From any position it can turn the
    # rotor back by as much.
    needed = np.pi / working.target.motor.n_p + MARGIN
    able = np.minimum(up, -down) >= needed
    reasons = [
        ""
        if able[k]
        else f"{TOO_SHORT}: the field may pull the rotor {needed:.2g} rad to either side, and there are {-down[k]:.2g} "
        f"and {up[k]:.2g}; begin in the middle of the travel"
        for k in range(working.target.num_axes)
    ]
    return np.asarray(working.where & able), reasons


def _way(working: Working) -> tuple[Floats, Mask]:
    """Return how far the fields turn from the rotors' positions [electrical rad], and which axes have room for it."""
    n_p = working.target.motor.n_p
    down, up = working.room()
    least = LEAST_TURN * 2.0 * np.pi / n_p
    # If possible all axes of a machine turn in the same direction: the ends of a beam would block each other otherwise.
    free = np.stack([up, -down]).reshape(2, -1, working.target.axes_per_machine).min(axis=2)
    common = np.repeat(np.where(free[0] >= free[1], 1.0, -1.0), working.target.axes_per_machine)
    together = np.repeat(free.max(axis=0) - MARGIN >= least, working.target.axes_per_machine)
    sign = np.where(together, common, np.where(up >= -down, 1.0, -1.0))
    way = np.minimum(np.where(sign > 0.0, up, -down) - MARGIN, MOST_TURN * 2.0 * np.pi / n_p)
    return sign * way * n_p, np.asarray(way >= least)


def _turn(working: Working, where: Mask, configured: Floats) -> tuple[Floats, Floats, Floats, list[Halls], list[str]]:
    """Turn the fields in both directions.

    Returns:
        Turned angles of the rotors [rad], there and back; of the fields [rad]; the halls' result on the way there; and
        why an axis was not turned.
    """
    drives = working.target.drives
    current = to_counts(drives, SHARE * working.current)
    for k in range(1, 5):
        drives.write(Role.OPEN_LOOP_CURRENT, current * k // 4, where=where)
        drives.advance(RAISE // 4 * CYCLE)
        stay_inside(working, where)
    stands = [_rest(working)]
    turn, able = _way(working)
    turn = np.where(able, turn, 0.0)
    # A raised cosine of speed is smooth, so that the rotor does not oscillate.
    shape = 1.0 - np.cos(2.0 * np.pi * (np.arange(TURN) + 0.5) / TURN)
    has_halls = Role.HALL_ANGLE in working.target.device.roles
    seen = [_field_and_halls(working)]
    for sign in (1.0, -1.0):
        speed = sign * turn / configured / (TURN * CYCLE) * shape[:, None]
        raw = np.where(where, np.rint(speed * working.speed_counts()), 0).astype(np.int64)
        raw[-1] = 0
        passed = np.zeros(len(turn))
        before = _angle(working, Role.FIELD_ANGLE)
        for k in range(0, TURN, TURN // 10):
            drives.record(
                [cia402.POSITION_ACTUAL], TURN // 10 * CYCLE, play={cia402.TARGET_VELOCITY: raw[k : k + TURN // 10]}
            )
            now = _angle(working, Role.FIELD_ANGLE)
            if sign > 0.0:
                seen.append(_field_and_halls(working))
            passed += (now - before + np.pi) % (2.0 * np.pi) - np.pi
            before = now
            stay_inside(working, where)
        stands.append(_rest(working))
        if sign > 0.0:
            turned = passed
    short = f"{TOO_SHORT}: the field pulled the rotor to where less than {LEAST_TURN:g} electrical turns are free"
    reasons = [short if chosen and not can else "" for chosen, can in zip(where, able, strict=True)]
    field, hall = np.array(seen).transpose(1, 2, 0)
    halls = [judge_halls(*both) if has_halls else Halls() for both in zip(field, hall, strict=True)]
    return stands[1] - stands[0], stands[2] - stands[1], turned, halls, reasons


def stay_inside(working: Working, where: Mask) -> None:
    """Switch off axes outside their travel, whose rotors have lost the field and fall."""
    down, up = working.room()
    out = where & ((up < 0.0) | (down > 0.0))
    if out.any():
        switch_off(working.target.drives, out)


def _angle(working: Working, name: Role) -> Floats:
    return np.asarray(working.target.drives.read(name) * (2.0 * np.pi / 65536.0))


def _field_and_halls(working: Working) -> tuple[Floats, Floats]:
    """Return the angles of field and halls [electrical rad]; 0 for halls that the drive does not read."""
    halls = read_role(working.target, Role.HALL_ANGLE) * (2.0 * np.pi / 65536.0)
    return _angle(working, Role.FIELD_ANGLE), np.asarray(halls)


def _rest(working: Working) -> Floats:
    """Return the angles at which the rotors come to rest [rad]."""
    trace = working.target.drives.record([cia402.POSITION_ACTUAL], 2 * REST * CYCLE)
    return np.asarray(working.angle(trace[cia402.POSITION_ACTUAL])[REST:].mean(axis=0))


def _judge(field: float, away: float, back: float, expected: int) -> EncoderCheck:
    """Judge an encoder by the turn of the field [electrical rad] and the rotor's angles there and back [rad]."""
    rotor = 0.5 * (away - back)
    would = field / expected
    if abs(rotor) < STUCK * abs(would) or abs(away + back) > 0.5 * abs(away - back):
        reason = (
            f"the rotor did not follow the field: it went {away:.2g} rad there and {back:.2g} rad back, and "
            f"{would:.2g} rad were expected; check whether it is blocked, a phase is open, or the current is too low"
        )
        return EncoderCheck(refused("1", reason), refused("1", reason))
    ratio = field / rotor
    direction = Estimate(float(np.sign(ratio)), float(np.sign(ratio)), float(np.sign(ratio)), "1")
    # Friction changes the rotor's position of rest: the error is half the difference between there and back.
    spread = abs(away + back) / 2.0 / abs(rotor) * abs(ratio)
    nearest = round(abs(ratio))
    if nearest < 1 or abs(abs(ratio) - nearest) + spread > _tolerance(nearest):
        reason = (
            f"the field made {abs(ratio):.2f} electrical turns (give or take {spread:.2f}) per turn that the encoder "
            "counted, which is not a whole number: check the encoder's counts per turn, or allow more travel and "
            "current"
        )
        return EncoderCheck(refused("1", reason), direction, ratio)
    return EncoderCheck(Estimate(float(nearest), float(nearest), float(nearest), "1"), direction, ratio)


def _tolerance(pole_pairs: int) -> float:
    return max(TOLERANCE, 0.02 * pole_pairs)
