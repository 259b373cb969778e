"""Inertia, dry and viscous friction and constant load, all over K_t, from the momentum balance of moves there and back.

Between two times, the charge that flowed equals the change of speed plus what friction and load took:

    integral of i = J/K_t (omega_2 - omega_1) + c integral of sign(omega) + v (theta_2 - theta_1) + o (t_2 - t_1)

Each equation is weighted by a smooth window, over a cruise or from the middle of one to the middle of the next in the
other direction; the oscillation of an elastic load averages out. Losses of a transmission proportional to its load
cancel in part, since half of the time they help to brake; if they are significant, the rest is estimated
(`transmission_loss.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.devices.gains import as_chip
from drive_env.dictionary.units import RPM
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import CYCLE
from drive_env.drives.raw_gains import write_gains
from drive_env.emulator.parameters import velocity_filter
from drive_env.motors import Motor
from mechanics.arrays import Floats, Integers, Mask
from tuning.estimate import Estimate, refused
from tuning.identify.confidence import gain_error, interval, t_quantile
from tuning.identify.momentum_balance import BalanceRows, Motion, Solved, balance_rows, motion, solve, step
from tuning.identify.transmission_loss import find_losses, friction_of_whole_ways
from tuning.identify.working_state import GUESS, Working, cautious_gains, go_back, still_enabled
from tuning.lateness import late_first
from tuning.link_energy import LINK_SHARE, fed_back, link_energy
from tuning.oscillation_watch import SOFTER, OscillationError, watch_of
from tuning.stop_causes import stop_causes
from tuning.target import Target

MOST_RATIO = 30.0  # over the rotor's: beyond, a cautious excitation hardly moves the load (Yaskawa: 15 to 30)
SPEED_SHARE, CURRENT_SHARE, ROOM_SHARE = 0.7, 0.5, 0.75  # of the limits
SLOWER = 0.9  # factor by which the speed of moves that would overcharge the DC link is reduced repeatedly
SHARES = (1.0, 0.65, 0.35)  # of the greatest speed, in this order
COARSE, FINE = (1, (0.6, 0.3)), (2, SHARES)  # number of repetitions, and shares of the greatest speed
RAMP, CRUISE = (30, 250), (60, 140)  # cycles, least and greatest number
CORRECTION, FOLLOW = 10, 5.0  # cycles between corrections of the position; gain of the correction [1/s]
STILL = 40  # cycles at rest at the beginning
NUDGE = 1.0  # rad, of a move of one axis alone
LINKED_CURRENT, LINKED_WAY = 0.08, 0.15  # of current and move: greater values mean that another axis is pulled along
LEAST_COUNTS = 40.0  # counts that a cruise must pass
WIDEST, WIDEST_FRICTION = 0.25, 0.2  # greatest half width of an interval over its value
SLOPE, DRAG = 4, 5  # columns of the balance
FEWEST_MOVES = 5  # least number of moves to fit more than four terms
CLEAR = 4.0  # times its standard deviation: least size of an effect that most loads do not have
# Least slope of a position-dependent load over that which cogging and sensor offsets can cause: both repeat in each
# move, so that no standard deviation shows them, and look like a slope on a short way.
OVER_RIPPLE = 3.0
# Relative error of all values over K_t, 95 %: commutation, temperature, ripple between samples, losses of a
# transmission.
TORQUE_MODEL = 0.018
VISCOUS_MODEL = 0.02  # additional one of viscous friction: a transmission loses part of the friction behind it


class Mechanics(NamedTuple):
    """The mechanics of one axis from its moves, in data sheet units: J/K_t times the data sheet's K_t."""

    inertia: Estimate
    coulomb: Estimate
    viscous: Estimate
    offset: Estimate


class Rough(NamedTuple):
    """Rough mechanics of one axis to plan its next moves.

    Inertia [kg*m^2], current that holds the axis [A], and least current of dry friction in motion [A].
    """

    inertia: float
    holding: float
    friction: float


@dataclass(frozen=True)
class Plan:
    """The moves of every axis: set-points of speed [rad/s], shape (rows, num_axes), and the cruises of each."""

    speed: Floats
    cruises: tuple[tuple[tuple[int, int, int], ...], ...]  # first and last row, and number of the move, for every axis


def plan_moves(
    working: Working, inertia: Floats, holding: Floats, friction: Floats, times: int, shares: tuple[float, ...],
    linked: bool = False,
) -> Plan:  # fmt: skip
    """Plan moves within the axes' travel, speed and current that do not overcharge the DC link.

    Args:
        working: The drives.
        inertia: Total inertia as far as known [kg*m^2], shape (num_axes,).
        holding: Current that holds the axis [A], shape (num_axes,).
        friction: Least current of dry friction [A], shape (num_axes,).
        times: Number of repetitions of each speed.
        shares: Speeds over the greatest.
        linked: Whether the axes of a machine move as one, within the limits of all.
    """
    target = working.target
    down, up = working.room()
    if linked:
        down, up = _of_machines(target, down, np.max), _of_machines(target, up, np.min)
        inertia, holding = _of_machines(target, inertia, np.max), _of_machines(target, np.abs(holding), np.max)
        friction = _of_machines(target, friction, np.min)
    columns, cruises = [], []
    held = link_energy(target)
    for k in range(target.num_axes):
        spare = CURRENT_SHARE * max(working.current[k] - abs(holding[k]), 0.1 * working.current[k])
        acceleration = float(spare * target.motor.torque_constant / inertia[k])

        def fits(speed: Floats) -> bool:
            most = fed_back(target.motor, speed[:, None], CYCLE, inertia[k], holding[k], friction[k])  # noqa: B023
            return bool(most[0] <= LINK_SHARE * held[k])  # noqa: B023

        limit = SPEED_SHARE * target.speed
        column, marks = _moves(float(down[k]), float(up[k]), acceleration, limit, times, shares, fits)
        columns.append(column)
        cruises.append(marks)
    longest = max(map(len, columns))
    speed_rows = np.zeros((longest + STILL, target.num_axes))
    for k, column in enumerate(columns):
        speed_rows[: len(column), k] = column
    return Plan(speed_rows, tuple(cruises))


def _moves(
    down: float, up: float, acceleration: float, limit: float, times: int, shares: tuple[float, ...],
    fits: Callable[[Floats], bool],
) -> tuple[Floats, tuple[tuple[int, int, int], ...]]:  # fmt: skip
    """Plan one axis' set-points of speed [rad/s] and its cruises.

    Args:
        down: Signed angle that it may turn backwards [rad], at most 0.
        up: Signed angle that it may turn forwards [rad].
        acceleration: Greatest acceleration [rad/s^2].
        limit: Greatest speed [rad/s].
        times: Number of repetitions of each speed.
        shares: Speeds over the greatest.
        fits: Whether a move does not overcharge the DC link.
    """
    # If there is little room, first move to one side, then use the whole room.
    sign = 1.0 if up >= -down else -1.0
    longer, shorter = ROOM_SHARE * max(up, -down), ROOM_SHARE * min(up, -down)
    longest, speed = _fastest(acceleration, longer, limit)
    first = 0.0
    if speed < limit and shorter > 0.0 and np.isfinite(longer + shorter):
        first = -sign * shorter
        if fits(_bump(first)):
            longest, speed = _fastest(acceleration, longer + shorter, limit)
        else:
            first = 0.0
    while not fits(_there_and_back(speed, _ramp(speed, acceleration), CRUISE[0])):
        speed *= SLOWER
    rows = [np.zeros(STILL), _bump(first)]
    marks: list[tuple[int, int, int]] = []
    number = 0
    for share in shares:
        w = share * speed
        ramp = _ramp(w, acceleration)
        # A weight feeds back energy while it goes down: prefer short cruises at a high speed, and more of them.
        cruise = longest
        while cruise > CRUISE[0] and not fits(_there_and_back(w, ramp, cruise)):
            cruise -= 10
        for _ in range(round(times * longest / cruise)):
            at = sum(map(len, rows))
            rows.append(sign * _there_and_back(w, ramp, cruise))
            marks.append((at + ramp, at + ramp + cruise, number))
            second = at + 3 * ramp + cruise
            marks.append((second, second + cruise, number))
            number += 1
    rows.append(_bump(-first))
    return np.concatenate(rows), tuple(marks)


def _there_and_back(speed: float, ramp: int, cruise: int) -> Floats:
    """Return a move as speeds [rad/s]: a ramp of so many cycles, a cruise, and the same back."""
    rise, level = _rise(ramp), np.ones(cruise)
    return speed * np.concatenate([rise, level, 1.0 - 2.0 * _rise(2 * ramp), -level, rise - 1.0])


def _of_machines(target: Target, values: Floats, choose: Callable[..., Floats]) -> Floats:
    """Reduce the values of each machine's axes to one by `choose`, shape (num_axes,)."""
    axes = target.axes_per_machine
    return np.repeat(choose(values.reshape(-1, axes), axis=1), axes)


def _rise(cycles: int) -> Floats:
    """Return a smooth step from 0 to 1: its edges do not excite an elastic load."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * (np.arange(cycles) + 1.0) / cycles))


def _bump(way: float) -> Floats:
    """Return a slow move by an angle [rad] as speeds."""
    if way == 0.0:
        return np.zeros(0)
    cycles = 2 * RAMP[1]
    shape = 1.0 - np.cos(2.0 * np.pi * (np.arange(cycles) + 0.5) / cycles)
    return np.concatenate([way * shape / (cycles * CYCLE), np.zeros(STILL)])


def _ramp(speed: float, acceleration: float) -> int:
    """Return the number of cycles of a smooth ramp; its steepest slope is pi/2 times its mean slope."""
    return int(np.clip(np.ceil(0.5 * np.pi * abs(speed) / acceleration / CYCLE), *RAMP))


def _fastest(acceleration: float, way: float, limit: float) -> tuple[int, float]:
    """Return duration [cycles] and speed [rad/s] of a cruise; a way is half a ramp, a cruise and half a ramp."""
    cruise, w = CRUISE[1], 0.0
    steepness = acceleration / (0.5 * np.pi)
    most = min(steepness * RAMP[1] * CYCLE, limit)
    for cruise in range(CRUISE[1], CRUISE[0] - 1, -10):
        # w (cruise + ramp) = way with ramp = max(w / steepness, shortest).
        T = cruise * CYCLE
        w = 0.5 * steepness * (np.sqrt(T**2 + 4.0 * way / steepness) - T) if np.isfinite(way) else most
        w = min(w, way / (T + RAMP[0] * CYCLE), most)
        if w >= most:
            break
    return cruise, float(w)


def move(working: Working, plan: Plan) -> tuple[Floats, Floats, Mask]:
    """Make the moves in csv; return angles [rad], currents [A], (rows, num_axes), and axes that were not stopped."""
    drives = working.target.drives
    # Friction makes the velocity loop drift with every reversal: the position is corrected slowly.
    begin = working.angle(drives.read(cia402.POSITION_ACTUAL))
    way = begin + np.cumsum(plan.speed, axis=0) * CYCLE
    fastest = np.abs(plan.speed).max(axis=0)
    angles, currents, alive = [], [], working.where.copy()
    error = np.zeros(len(begin))
    for k in range(0, len(plan.speed), CORRECTION):
        part = plan.speed[k : k + CORRECTION] + np.clip(FOLLOW * error, -0.3 * fastest, 0.3 * fastest)
        raw = np.where(working.where, np.rint(part * working.speed_counts()), 0).astype(np.int64)
        trace = drives.record(
            [cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL, cia402.STATUSWORD],
            len(raw) * CYCLE,
            play={cia402.TARGET_VELOCITY: raw},
        )
        angles.append(working.angle(trace[cia402.POSITION_ACTUAL]))
        currents.append(trace[cia402.TORQUE_ACTUAL] * ampere_per_count(drives))
        alive &= still_enabled(trace[cia402.STATUSWORD][-1])
        error = way[k + len(raw) - 1] - angles[-1][-1]
    return np.concatenate(angles), np.concatenate(currents), alive


def identify_mechanics(working: Working, holding: Floats) -> tuple[list[Mechanics], Floats]:
    """Move the axes, enabled in csv at rest; return the mechanics of each, and total inertias [kg*m^2].

    Machines move at the same time. The axes of one move one after the other while the others hold, unless they are
    linked: then they move together, and each inertia is the share that its drive moves.
    """
    target = working.target
    count = target.num_axes
    results = [_none("") for _ in range(count)]
    inertia = np.full(count, GUESS * target.motor.inertia)
    position = np.arange(count) % target.axes_per_machine
    linked = target.axes_per_machine > 1 and are_linked(working)
    turns = [working.where] if linked else [working.where & (position == k) for k in range(target.axes_per_machine)]
    for moving in turns:
        if not moving.any():
            continue
        found = _identify_moving(replace(working, where=moving), holding, inertia, linked)
        for k in np.flatnonzero(moving):
            results[k] = found[k]
    return results, inertia


def are_linked(working: Working) -> bool:
    """Return whether the axes of a machine are linked: one that moves alone is resisted by the others."""
    target, drives = working.target, working.target.drives
    first = working.where & (np.arange(target.num_axes) % target.axes_per_machine == 0)
    down, up = working.room()
    way = np.where(up >= -down, 1.0, -1.0) * np.minimum(NUDGE, 0.25 * np.maximum(up, -down))
    shape = _bump(1.0)
    pulled = np.zeros(target.num_axes, bool)
    for sign in (1.0, -1.0):
        raw = np.where(first, np.rint(sign * np.outer(shape, way) * working.speed_counts()), 0).astype(np.int64)
        trace = drives.record(
            [cia402.TORQUE_ACTUAL, cia402.POSITION_ACTUAL], len(raw) * CYCLE, play={cia402.TARGET_VELOCITY: raw}
        )
        if sign > 0.0:
            current = trace[cia402.TORQUE_ACTUAL] * ampere_per_count(drives)
            angle = working.angle(trace[cia402.POSITION_ACTUAL])
            rise = current[-STILL // 2 :].mean(axis=0) - current[: STILL // 2].mean(axis=0)
            pulled = np.abs(rise) > LINKED_CURRENT * working.current
            pulled |= np.abs(angle[-1] - angle[0]) > LINKED_WAY * np.abs(way)
    return bool(np.any(working.where & ~first & pulled))


def _identify_moving(working: Working, holding: Floats, inertia: Floats, linked: bool) -> list[Mechanics]:
    """Move the axes and return the mechanics of each; `inertia` is updated in place."""
    target = working.target
    results: list[Mechanics] = []
    softness = np.ones(target.num_axes, np.int64)
    friction, holding = np.zeros(target.num_axes), holding.copy()
    for times, shares in (COARSE, FINE):

        def plan() -> Plan:
            return plan_moves(working, inertia, holding, friction, times, shares, linked)  # noqa: B023

        moves, angle, current, alive, gains = _moved(working, plan, cautious_gains(target, inertia), softness)
        results = []
        causes = [] if alive.all() else stop_causes(target.drives)
        for k in range(target.num_axes):
            if not alive[k]:
                why = f"the drive switched off during the moves: {causes[k]}"
                results.append(_none(late_first(target.drives, why)))
                continue
            found, rough = _balance(working, k, angle[:, k], current[:, k], moves, gains[k])
            results.append(found)
            # At rest dry friction can hold any part of the load up to its own value; in motion its part is known.
            holding[k], friction[k] = rough.holding, rough.friction
            inertia[k] = np.clip(rough.inertia, 0.7 * target.motor.inertia, 2.0 * MOST_RATIO * target.motor.inertia)
    return results


def _moved(
    working: Working, plan: Callable[[], Plan], gains: Integers, softness: Integers
) -> tuple[Plan, Floats, Floats, Mask, Integers]:
    """Move, again with softer gains if an axis oscillates; return plan, the result of `move`, and the gains."""
    drives = working.target.drives
    watch = watch_of(drives)
    gains = working.target.device.gains.softened(gains, softness, "velocity")
    write_gains(drives, gains, working.where)
    for again in (True, False):
        go_back(working, "csv")
        moves = plan()
        try:
            angle, current, alive = move(working, moves)
        except OscillationError:
            if not again:
                raise
        if watch is None or not (again and (working.where & watch.swung).any()):
            break
        swung = working.where & watch.swung
        gains = watch.soften(drives, swung, gains, "csv")
        softness[swung] *= SOFTER
    return moves, angle, current, alive, gains


def _none(reason: str) -> Mechanics:
    return Mechanics(*(refused(unit, reason) for unit in ("kg*m^2", "A", "A*s/rad", "A")))


def hidden_ripple(target: Target, k: int, gains: Integers, inertia: float) -> float:
    """Return the mean current of an accelerating axis over the mean of its samples.

    The velocity demand steps once per millisecond, and the current follows; every sample is taken at the same phase of
    this ripple, at its minimum. A simulation of the velocity loop's windows gives the ratio.
    """
    device, motor = target.device, target.motor
    supply = float(target.supply[k])
    windows, ticks = round(device.velocity_rate * CYCLE), round(device.current_rate / device.velocity_rate)
    dt, h = 1.0 / device.current_rate, 1.0 / device.velocity_rate
    torque_p, torque_i, velocity_p, velocity_i, _ = as_chip(device, gains)
    P_T, I_T = torque_p / (256.0 * device.current_full_scale) * supply, torque_i / 65536.0
    P_V, I_V = velocity_p * device.current_full_scale / (256.0 * 32768.0 * RPM), velocity_i / 65536.0
    b, a1, a2 = (float(x) for x in velocity_filter(np.asarray(device.stage["velocity_filter"].default), 1.0 / h))
    decay = float(np.exp(-motor.R_s * dt / motor.L_q))
    i = i_sum = omega = theta = before = z1 = z2 = total = applied = 0.0
    samples = means = 0.0
    for ms in range(80):
        reference, mean, last = ms + 1.0, 0.0, 0.0
        for _ in range(windows):
            raw = (theta - before) / h
            before = theta
            filtered = b * raw + z1
            z1 = 2.0 * b * raw - a1 * filtered + z2
            z2 = b * raw - a2 * filtered
            error = P_V * (reference - filtered)
            total += I_V * error
            asked = error + total
            for _ in range(ticks):
                last = i
                deviation = P_T * (asked - i)
                i_sum += I_T * deviation
                i = decay * i + (1.0 - decay) / motor.R_s * applied
                applied = deviation + i_sum
                mean += i / (windows * ticks)
                omega += dt * i * motor.torque_constant / inertia
                theta += dt * omega
        if ms >= 20:
            samples, means = samples + last, means + mean
    return means / samples


def _balance(
    working: Working, k: int, angle: Floats, current: Floats, plan: Plan, gains: Integers
) -> tuple[Mechanics, Rough]:
    """Return the estimates of one axis, and its rough mechanics."""
    target = working.target
    motor, K = target.motor, target.motor.torque_constant
    cruises = plan.cruises[k]
    did = motion(angle, current, plan.speed[: len(angle), k])
    rows = balance_rows(did, *_weights(len(angle), cruises))
    passed = abs(angle[cruises[0][1]] - angle[cruises[0][0]]) * motor.encoder_counts / (2.0 * np.pi)
    way = max(float(np.ptp(angle)), 1e-9)
    least = 2.0 * OVER_RIPPLE / way * _ripple(target) / math.sqrt(max(way / (2.0 * np.pi), 1.0))
    fit = _fit(rows, least)
    hidden = hidden_ripple(target, k, gains, max(float(fit.mean[0] * K), 0.5 * motor.inertia))
    J, fit, unseen = _with_losses(did, cruises, motor, rows, fit, least, hidden)
    t = t_quantile(fit.freedom)
    offset, spread = float(fit.mean[3]), t * float(fit.spread[3])
    rough = Rough(J, offset + math.copysign(spread, offset), max(float(fit.mean[1] - t * fit.spread[1]), 0.0))
    down, up = working.room()
    too_short = max(up[k], -down[k]) < np.pi
    why = "travel too short" if too_short else "excitation too weak"
    if passed < LEAST_COUNTS:
        reason = (
            f"{why}: a move passes {passed:.0f} counts of the encoder, and {LEAST_COUNTS:.0f} are needed; allow more "
            f"{'travel' if too_short else 'current'} than {max(up[k], -down[k]):.2g} rad and {working.current[k]:.2g} A"
        )
        return _none(reason), rough
    scale = float(np.hypot(gain_error(target.device, motor), TORQUE_MODEL))
    half = np.hypot(t * fit.spread, unseen)
    half[0] *= K
    if MOST_RATIO * motor.inertia < J:
        inertia = refused("kg*m^2", (
            f"inertia ratio above {MOST_RATIO:.0f}: the moves give about {J / motor.inertia:.0f} rotor inertias, which "
            "cannot be separated from friction in so slow a motion; take a gear or a larger motor, or enter the inertia"
        ))  # fmt: skip
    elif not J > 0.0 or half[0] > WIDEST * J:
        inertia = refused("kg*m^2", f"{why}: the interval would be {half[0]:.2g} around {J:.2g} kg*m^2")
    else:
        inertia = interval(J, float(half[0]), float(np.hypot(scale, _periodic(working, k, J, plan))), "kg*m^2")
    coulomb = _friction(float(fit.mean[1]), float(half[1]), scale, "A", why)
    viscous = _friction(float(fit.mean[2]), float(half[2]), float(np.hypot(scale, VISCOUS_MODEL)), "A*s/rad", why)
    # Offsets of the sensors turn with the field and average out; those of a brushed motor's one channel do not.
    sensor = 0.95 * abs(target.device.stage["adc_offset_a"].high) if motor.kind == "dc" else 0.0
    holding = interval(float(fit.mean[3]), float(half[3]), scale, "A", sensor)
    return Mechanics(inertia, coulomb, viscous, holding), rough


def _with_losses(
    did: Motion, cruises: tuple[tuple[int, int, int], ...], motor: Motor, rows: BalanceRows, fit: Solved, least: float,
    hidden: float,
) -> tuple[float, Solved, Floats]:  # fmt: skip
    """Return inertia [kg*m^2], fit, and half width of its unknowns' remaining range, with a transmission's losses.

    Args:
        did: Motion of the axis.
        cruises: First and last sample of every cruise, and the number of its move.
        motor: Its motor.
        rows: The balance.
        fit: Its solution without losses.
        least: As in `_fit`.
        hidden: Result of `hidden_ripple`.
    """
    K = motor.torque_constant
    losses = find_losses(did, cruises, motor, fit.mean[1:3]) if len(np.unique(rows.moves)) >= FEWEST_MOVES else ()
    if not losses:
        return float(fit.mean[0] * K) * hidden, fit, np.zeros(4)
    fits = [
        _fit(rows._replace(charge=rows.charge - one.share * (rows.weights @ one.while_braking) * CYCLE), least)
        for one in losses
    ]
    inertias = [
        one.load_alone(float(found.mean[0] * K) * hidden, motor.inertia)
        for one, found in zip(losses, fits, strict=True)
    ]
    unseen = np.zeros(4)
    unseen[0] = np.abs(np.array(inertias) - inertias[0]).max() / K
    if not losses[0].is_clear:
        return inertias[0], fit, unseen
    ways = friction_of_whole_ways(did, cruises, losses[0], float(fits[0].mean[0]))
    unseen[1:] = np.abs(ways.mean - fits[0].mean[1:])
    mean = np.concatenate([fits[0].mean[:1], 0.5 * (ways.mean + fits[0].mean[1:])])
    return inertias[0], fits[0]._replace(mean=mean), unseen


def _periodic(working: Working, k: int, inertia: float, plan: Plan) -> float:
    """Return the inertia's relative error by cogging and sensor offsets, 95 %.

    Both repeat with the angle: over many turns they average out, on a short way they are the same in each move.
    """
    motor = working.target.motor
    way = np.cumsum(plan.speed[:, k]) * CYCLE
    turns = float(np.ptp(way)) * motor.n_p / (2.0 * np.pi)
    steepest = float(np.abs(np.diff(plan.speed[:, k])).max()) / CYCLE
    accelerating = 2.0 / np.pi * steepest * inertia / motor.torque_constant
    averaged = np.sqrt(max(turns, 1.0) * len(SHARES))
    return float(1.96 * _ripple(working.target) / max(accelerating, 1e-9) / averaged)


def _ripple(target: Target) -> float:
    """Return the RMS current of cogging and sensor offsets, which repeat with the angle [A]."""
    motor = target.motor
    offsets = [target.device.stage[name] for name in ("adc_offset_a", "adc_offset_b")]
    # Uniform between their limits; each acts as a cosine of the angle.
    sensors = np.hypot(*((row.high - row.low) / 12.0**0.5 for row in offsets)) / 2.0**0.5
    return float(np.hypot(motor.cogging_torque / motor.torque_constant, sensors) / 2.0**0.5)


def _friction(value: float, half: float, scale: float, unit: str, why: str) -> Estimate:
    found = interval(value, half, scale, unit)
    if not value > 0.0 or found.high - value > WIDEST_FRICTION * value:
        return refused(unit, (
            f"{why}: {value:.2g} {unit} may be off by {half:.2g}; it is at most {max(found.high, 0.0):.2g} {unit}"
        ))  # fmt: skip
    return found


def _weights(samples: int, cruises: tuple[tuple[int, int, int], ...]) -> tuple[list[Floats], list[int]]:
    """Return smooth weighting functions, shape (samples,) each, and the number of the move of each.

    One for every cruise, one for every change between two cruises; together they add up to 1. Smooth edges let the
    oscillation of an elastic load average out; sharp ones do not.
    """
    t = np.arange(samples, dtype=float)
    weights, moves = [], []
    for j, (first, last, number) in enumerate(cruises):
        begin = first + (last - first) // 5  # the loop is settling before
        centre = 0.5 * (begin + last)
        weights.append(np.minimum(step(t, begin, centre), 1.0 - step(t, centre, last)))
        moves.append(number)
        if j + 1 < len(cruises) and cruises[j + 1][2] == number:
            a, b, _ = cruises[j + 1]
            a += (b - a) // 5
            weights.append(step(t, centre, last) * (1.0 - step(t, a, 0.5 * (a + b))))
            moves.append(number)
    return weights, moves


def _fit(rows: BalanceRows, least: float) -> Solved:
    """Fit J/K, dry and viscous friction and offset, with further terms if the data show them.

    A fan's drag or a position-dependent load is included only if it is significant; otherwise it may still exist, so
    the intervals are widened by the change that it would make.

    Args:
        rows: The balance.
        least: Least slope that cogging and offsets cannot cause [A/rad].
    """
    X, y, duration, moves = rows.columns, rows.charge, rows.duration, rows.moves
    chosen = [0, 1, 2, 3]
    result = solve(X[:, chosen], y, duration, moves)
    doubts = np.zeros(4)
    for extra in (DRAG, SLOPE) if len(np.unique(moves)) >= FEWEST_MOVES else ():
        tried = solve(X[:, [*chosen, extra]], y, duration, moves)
        clearness = abs(tried.mean[-1]) / max(tried.spread[-1], 1e-30)
        if clearness > CLEAR and (extra != SLOPE or abs(tried.mean[-1]) > least):
            chosen.append(extra)
            result = tried
        else:
            doubts += (np.clip(clearness - 1.0, 0.0, 1.0) * (tried.mean[:4] - result.mean[:4])) ** 2
    t = t_quantile(result.freedom)
    return Solved(result.mean[:4], np.sqrt(result.spread[:4] ** 2 + doubts / t**2), result.freedom)
