"""Winding resistance and inductance from the current regulator's integrator and the entered supply voltage.

The integrator adds P I e every tick, so its change over a millisecond is the sum of the current's error over all 25
ticks, with much better resolution than a sample of the current. Set-point less error is the mean current, P e plus the
integrator the mean duty; the rest is the winding's balance of flux over each millisecond,

    integral of V duty = R integral of i + L (i_end - i_start) + K_e (theta_end - theta_start) + V t_dead f(i) + c

Its unknowns are fitted by least squares over some hundred milliseconds of current pulses in both directions that hardly
move the rotor. f is the relative voltage loss by dead time: it saturates at an unknown current, over which the result
is averaged. K_e and dead time have priors, the data sheet's and the stage's ranges: if the rotor hardly moves they
matter little, otherwise the data dominate.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from drive_env import cia402, motion
from drive_env.devices.gains import cascade_columns, per_chip
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count, to_counts
from drive_env.drives.interface import CYCLE
from mechanics.arrays import Floats, Integers, Mask
from tuning.estimate import Estimate, refused
from tuning.identify.confidence import gain_error, interval, t_quantile
from tuning.identify.working_state import Working, still_enabled
from tuning.response.dead_time import dead_time
from tuning.stop_causes import stop_causes
from tuning.target import Target

# Amplitude of a pulse over the allowed current, and the cycles of a level; a pulse is +, -, -, +, so that speed and way
# end at 0. Short ones have as many changes of the current in a third of the time: they give the inductance, long ones
# the resistance, and those with little current the loss by dead time.
PULSES = ((0.95, 3), (0.95, 1), (0.95, 1), (0.7, 3), (0.7, 1), (0.45, 3), (0.25, 3))
REPEATS, BRIEFLY = 8, 6
LOOP_GAIN, LOOP_HZ = 4.0, 600.0  # P of the loop: in winding resistances, up to this bandwidth
# Of the current limit: from this current on the loop overcomes dead time. At mains voltage that takes more than R times
# the current; in a loop of a few R no current would flow, which a drive reports as an open phase.
OVERCOMES = 0.25
INTEGRAL_SHARE = 0.1  # of the integral gain that cancels the winding's lag: it measures, it need not control
LEAST_INTEGRAL = 8  # of 65536, a share of P e per tick: with less the sum over a millisecond is too coarse
HOLD_HZ, HOLD_DAMPING = 7.0, 0.7  # our own slow position loop during the pulses
# Over the data sheet's value, mean and standard deviation: unit-to-unit spread and temperature.
RESISTANCE_PRIOR, EMF_PRIOR = (1.1, 0.25), (0.965, 0.06)
# Relative error of R and L, 95 %, by effects not modelled: sag of the supply, lag of the encoder, changes within a
# tick.
RESISTANCE_MODEL, INDUCTANCE_MODEL = 0.01, 0.02
# The same, per share of the driving voltage lost by dead time: how it fades at small currents is unknown.
RESISTANCE_LOSS, INDUCTANCE_LOSS = 0.12, 0.07
LEAST_NOISE = 0.005  # of the flux: a smaller residual does not make the result more certain
SATURATIONS = 8  # number of currents tried at which dead time may saturate
MOST_ROUNDS, SETTLED = 12, 2e-3  # of the fit, and the relative change of values at which it ends
SUPPLY_IDLE = 0.1  # A, that the logic draws through the supply line
WIDEST = 0.1  # greatest half width of an interval over its value


PROBE = 10  # rows at rest that measure how long the reads take on a bus in real time
LATE, MOST_LATE = 1.5, 0.02  # cycles between rows: more is late; and the greatest share of late rows

TURN = 2  # column of the balance


class Pulses(NamedTuple):
    """A recording with one row per millisecond: n rows, or n + 1 if both ends count; (rows, num_axes)."""

    demand: Floats  # A, n
    current: Floats  # A, n + 1: the last tick's
    angle: Floats  # rad, n + 1
    duty_sum: Floats  # n + 1
    block: Integers  # n: number of the pulse
    alive: Mask  # num_axes: enabled until the end
    step: float = CYCLE  # s from row to row; more if the reads could not keep up with the drive


class Winding(NamedTuple):
    """Estimates of one axis' winding from pulses."""

    resistance: Estimate
    inductance: Estimate


def loop_gains(working: Working) -> tuple[Floats, float]:
    """Return raw P of the current loop of every axis, and raw I, for a loop that measures rather than controls."""
    target, motor = working.target, working.target.motor
    known, per = target.device.gains, per_chip(target.device)
    top_p, top_i = (known.rows[k].highest for k in _columns(target))
    stage = target.device.stage
    lost = target.supply * stage["dead_time"].high * target.device.current_rate
    volts_per_ampere = np.maximum(LOOP_GAIN * motor.R_s, lost / (OVERCOMES * working.current))
    volts_per_ampere = np.minimum(volts_per_ampere, 2.0 * np.pi * LOOP_HZ * motor.L_q)
    P = np.rint(per["current", "P"].raw(256.0 * target.device.current_full_scale * volts_per_ampere / target.supply))
    cancels = 65536.0 * motor.R_s / motor.L_q / target.device.current_rate
    integral = per["current", "I"].raw(max(INTEGRAL_SHARE * cancels, LEAST_INTEGRAL))
    return np.clip(P, 1, top_p), float(np.clip(np.rint(integral), 1, top_i))


def _columns(target: Target) -> tuple[int, int]:
    """Return the columns of P and I of the current loop."""
    P, integral, *_ = cascade_columns(target.device)
    return P, integral


def pulse(working: Working, holding: Floats, repeats: int = REPEATS) -> Pulses:
    """Apply current pulses in cst around the holding currents [A]; the axes are enabled in cst, at rest."""
    target, drives = working.target, working.target.drives
    motor, count = target.motor, target.num_axes
    P, integral = loop_gains(working)
    of_p, of_i = (target.device.gains.keys[k] for k in _columns(target))
    drives.write(of_p, P.astype(np.int64), where=working.where)
    drives.write(of_i, int(integral), where=working.where)
    J = 3.0 * motor.inertia / motor.torque_constant
    stiffness, damping = J * (2.0 * np.pi * HOLD_HZ) ** 2, 2.0 * HOLD_DAMPING * J * 2.0 * np.pi * HOLD_HZ
    room = np.maximum(working.current - np.abs(holding), 0.0)
    levels, blocks = _levels(repeats)
    in_real_time = not drives.time_waits
    per_count = ampere_per_count(drives)
    # On a bus in real time, first measure how long the reads take.
    for played in (np.zeros(PROBE), levels) if in_real_time else (levels,):
        rows = len(played)
        demand = np.zeros((rows, count))
        current, angle, duty_sum = (np.zeros((rows + 1, count)) for _ in range(3))
        duty_sum[0] = drives.read(Role.TORQUE_ERROR_SUM)
        angle[0] = working.angle(drives.read(cia402.POSITION_ACTUAL))
        times = np.zeros(rows + 1)
        times[0] = time.perf_counter()
        for k in range(rows):
            speed = (angle[k] - angle[max(k - 2, 0)]) / (2 * CYCLE)
            steer = -stiffness * (angle[k] - working.base) - damping * speed
            asked = np.clip(holding + played[k] * room + steer, -working.current, working.current)
            raw = np.where(working.where, to_counts(drives, asked), 0)
            demand[k] = raw * per_count
            trace = drives.record(
                [cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL], CYCLE, play={cia402.TARGET_TORQUE: raw[None, :]}
            )
            current[k] = trace[cia402.TORQUE_ACTUAL][0] * per_count
            duty_sum[k + 1] = drives.read(Role.TORQUE_ERROR_SUM)
            angle[k + 1] = working.angle(drives.read(cia402.POSITION_ACTUAL))
            times[k + 1] = time.perf_counter()
        late = float(np.mean(np.diff(times) > LATE * CYCLE)) if in_real_time else 0.0
        if late > MOST_LATE:
            break
    current[rows] = drives.read(cia402.TORQUE_ACTUAL) * per_count
    alive = still_enabled(drives.read(cia402.STATUSWORD))
    step = (times[-1] - times[0]) / rows if late > MOST_LATE else CYCLE
    return Pulses(demand, current, angle, duty_sum / (32768.0 * 256.0), blocks[:rows], alive, step)


def identify_winding(working: Working, pulses: Pulses, electrical_angle: Floats, pole_pairs: float) -> list[Winding]:
    """Estimate resistance and inductance of every axis.

    Args:
        working: The drives.
        pulses: Recording of `pulse`.
        electrical_angle: Angles of the rotors at the first row [rad], shape (num_axes,).
        pole_pairs: Electrical turns per turn in the direction of counting.
    """
    if pulses.step > CYCLE:
        return [_none(
            "the current regulator's integrator can only be read by SDO, and a cycle with its reads took "
            f"{1e3 * pulses.step:.1f} ms instead of {1e3 * CYCLE:g}: in real time they are not in step with the "
            "current; the inductance needs an emulator in lockstep (--lockstep) or a faster bus, or take the data "
            "sheet's"
        )] * working.target.num_axes  # fmt: skip
    able = working.where & pulses.alive
    causes = [] if able.all() else stop_causes(working.target.drives)
    return [
        _winding(working, _of_axis(pulses, k), k, float(electrical_angle[k]), pole_pairs)
        if able[k]
        else _none(f"the drive switched off during the current pulses: {causes[k]}")
        for k in range(working.target.num_axes)
    ]


class _Window(NamedTuple):
    """The terms of the balance of each millisecond, shape (n,), and the modelled currents within it, (n, ticks)."""

    flux: Floats  # V s
    charge: Floats  # A s
    change: Floats  # A
    turn: Floats  # rad
    path: Floats  # A, current at every tick, and at the end
    angle: Floats  # rad electrical


class _AxisWinding(NamedTuple):
    demand: Floats
    current: Floats
    angle: Floats
    duty_sum: Floats
    block: Integers


def _of_axis(pulses: Pulses, k: int) -> _AxisWinding:
    return _AxisWinding(
        pulses.demand[:, k], pulses.current[:, k], pulses.angle[:, k], pulses.duty_sum[:, k], pulses.block
    )


def _levels(repeats: int) -> tuple[Floats, Integers]:
    levels: list[float] = []
    blocks: list[int] = []
    for repeat in range(repeats):
        for share, cycles in PULSES:
            level = share if repeat % 2 == 0 else -share
            levels += [level] * cycles + [-level] * 2 * cycles + [level] * cycles
            blocks += [blocks[-1] + 1 if blocks else 0] * 4 * cycles
    return np.array(levels), np.array(blocks)


class _Regulator(NamedTuple):
    """The simulated current loop of an axis."""

    P: float  # duty per ampere
    share: float  # of P e, by which the integrator grows every tick
    supply: float  # V
    dt: float  # s, of a tick
    ticks: int  # in a millisecond


class _WindingModel(NamedTuple):
    """The winding of an axis in one round of the fit."""

    R: float
    L: float
    emf: float  # K_e
    lost: float  # V, lost by dead time
    saturation: float  # A, from which dead time loses the full voltage
    brushed: bool


def _winding(working: Working, axis: _AxisWinding, k: int, electrical: float, pole_pairs: float) -> Winding:
    target, motor, device = working.target, working.target.motor, working.target.device
    supply = float(target.supply[k])
    P_raw, I_raw = loop_gains(working)
    per = per_chip(device)
    regulator = _Regulator(
        P=float(per["current", "P"].value(P_raw[k])) / (256.0 * device.current_full_scale),
        share=float(per["current", "I"].value(I_raw)) / 65536.0,
        supply=supply,
        dt=1.0 / device.current_rate,
        ticks=round(CYCLE * device.current_rate),
    )
    brushed = motor.kind == "dc"
    emf = motor.torque_constant / (1.0 if brushed else 1.5)
    angle = electrical + pole_pairs * (0.5 * (axis.angle[1:] + axis.angle[:-1]) - axis.angle[0])
    row = device.stage["dead_time_current"]
    results: list[_Solved] = []
    R, L, lost = motor.R_s, motor.L_q, 0.0
    for saturation in map(float, np.geomspace(row.low, row.high, SATURATIONS)):
        # Currents within a millisecond are modelled with the values of the last round, until these converge.
        for _ in range(MOST_ROUNDS):
            before = np.array([R, L, lost])
            window = _window(working, axis, regulator, _WindingModel(R, L, emf, lost, saturation, brushed), angle)
            solved = _fit(working, window, axis.block, supply, emf, saturation)
            R, L = max(float(solved.mean[0]), 0.2 * motor.R_s), max(float(solved.mean[1]), 0.2 * motor.L_q)
            lost = float(solved.mean[3])
            moved = np.abs(np.array([R, L, lost]) - before) / np.array([R, L, max(abs(lost), 0.01 * supply)])
            if moved.max() < SETTLED:
                break
        results.append(solved)
    return _judge(working, axis, _average(results, axis.block))


def _window(
    working: Working, axis: _AxisWinding, regulator: _Regulator, model: _WindingModel, angle: Floats
) -> _Window:
    """Return the balance of every millisecond; `angle` is the electrical angle in its middle [rad], shape (n,)."""
    device = working.target.device
    P, share, supply, dt, ticks = regulator
    turn = np.diff(axis.angle)
    r, s_0 = axis.demand, axis.duty_sum[:-1]
    errors = np.diff(axis.duty_sum) / (P * share)  # sum over the ticks
    # Simulate tick by tick from the end of the last millisecond.
    start = axis.current[:-1].copy()
    # A count is a large part of a millisecond's turn: smoothed, since it is only used for modelling.
    back = model.emf * np.convolve(np.pad(turn, 1, mode="edge"), (0.25, 0.5, 0.25), mode="valid") / CYCLE
    for _ in range(2):
        path = _simulate(axis, start, back, angle, regulator, model)
        start = np.append(axis.current[0], path[:-1, ticks])
    creep = np.append(0.0, path[:, ticks] - path[:, ticks - 1])  # between the last sample and the end
    ends = axis.current + creep
    modelled = r[:, None] - path[:, :ticks]
    moment = (modelled * (ticks - np.arange(ticks))).sum(1) + 0.5 * (ticks + 1) * (errors - modelled.sum(1))
    sums = ticks * s_0 + share * P * moment
    last = np.append(0.0, P * (r - axis.current[1:])) + axis.duty_sum  # duty of the tick before each boundary
    # A duty acts one tick late.
    duty = P * errors + sums - last[1:] + last[:-1]
    charge = dt * (ticks * r - errors + 0.5 * (ends[1:] - ends[:-1]))
    # The encoder was read at the last window of the velocity loop: a turn is older than the charge by that lag. The
    # part of the speed that follows charge, which has no quantisation, is computed; the rest is interpolated.
    lag = 1.0 / device.velocity_rate
    moved = charge - charge.mean()
    gained = float(np.gradient(turn) @ moved) / float(moved @ moved) / CYCLE * charge
    other = turn - CYCLE * (np.cumsum(gained) - 0.5 * gained)
    turn = turn + lag * gained + lag / CYCLE * np.diff(other, append=other[-1])
    # The supply line's voltage falls with the current of the stage; braking does not feed back.
    factor = 1.0 if model.brushed else 1.5
    mean_duty, mean = duty / ticks, charge / CYCLE
    drawn = np.maximum(factor * mean_duty * mean, 0.0) + SUPPLY_IDLE
    link = supply - device.stage["supply_resistance"].default * drawn
    return _Window(link * dt * duty, charge, np.diff(ends), turn, path, angle)


def _simulate(
    axis: _AxisWinding, start: Floats, back: Floats, angle: Floats, regulator: _Regulator, model: _WindingModel
) -> Floats:
    """Return the current at every tick of every millisecond and at its end, shape (n, ticks + 1).

    Args:
        axis: The demand, and the integrator at the start of every millisecond.
        start: Current at the start of every millisecond [A], shape (n,).
        back: Back-EMF there [V], shape (n,).
        angle: Electrical angle there [rad], shape (n,).
        regulator: The current loop.
        model: The winding.
    """
    P, share, supply, dt, ticks = regulator
    R, L, _, lost, saturation, brushed = model
    r, s_0 = axis.demand, axis.duty_sum[:-1]
    path = np.empty((len(r), ticks + 1))
    decay = np.exp(-R * dt / L)
    i, s = start.copy(), s_0.copy()
    applied = np.append(0.0, (P * (r[:-1] - start[1:]))) + s_0
    for n in range(ticks):
        path[:, n] = i
        p = P * (r - i)
        s = s + share * p
        u = supply * applied - back - lost * dead_time(angle, i, saturation, brushed)
        i = decay * i + (1.0 - decay) / R * u
        applied = p + s
    path[:, ticks] = i
    return path


class _Fit(NamedTuple):
    mean: Floats  # R, L, K_e, voltage lost by dead time, constant
    spread: Floats
    freedom: int


class _Solved(NamedTuple):
    """The balance solved for one saturation current."""

    mean: Floats
    spread: Floats
    rest: float  # sum of squares
    penalty: float  # misfit to the priors


def _fit(working: Working, window: _Window, blocks: Integers, supply: float, emf: float, saturation: float) -> _Solved:
    stage, rate = working.target.device.stage, working.target.device.current_rate
    low, high = stage["dead_time"].low, stage["dead_time"].high
    R = working.target.motor.R_s
    prior = np.array([RESISTANCE_PRIOR[0] * R, 0.0, EMF_PRIOR[0] * emf, 0.5 * (low + high) * rate * supply, 0.0])
    deviation = np.array(
        [RESISTANCE_PRIOR[1] * R, np.inf, EMF_PRIOR[1] * emf, (high - low) / 12**0.5 * rate * supply, np.inf]
    )
    brushed = working.target.motor.kind == "dc"
    count = 2.0 * np.pi / working.target.motor.encoder_counts
    lost = dead_time(window.angle[:, None], window.path[:, :-1], saturation, brushed).mean(1) * CYCLE
    X = np.stack([window.charge, window.change, window.turn, lost, np.full(len(lost), CYCLE)], 1)
    # The sampled change is noisy, the simulated one is not: it is the instrument.
    Z = X.copy()
    Z[1:, 1] = window.path[1:, -1] - window.path[:-1, -1]
    keep = blocks > 0  # the first pulse is omitted: the loop settles
    return _solve(X[keep], Z[keep], window.flux[keep], blocks[keep], prior, deviation, count)


def _average(results: list[_Solved], blocks: Integers) -> _Fit:
    rest, penalty = np.array([result.rest for result in results]), np.array([result.penalty for result in results])
    # Chi square with the degrees of freedom of pulses instead of milliseconds, plus the misfit to the priors.
    freedom = int(blocks.max()) - 4
    misfit = freedom * rest / rest.min() + penalty
    weight = np.exp(-0.5 * (misfit - misfit.min()))
    weight /= weight.sum()
    means, spreads = np.array([r.mean for r in results]), np.array([r.spread for r in results])
    mean = weight @ means
    spread = np.sqrt(weight @ (spreads**2 + (means - mean) ** 2))
    return _Fit(mean, spread, freedom)


def _solve(
    X: Floats, Z: Floats, y: Floats, blocks: Integers, prior: Floats, deviation: Floats, count: float
) -> _Solved:
    """Return coefficients, deviations for errors equal within a pulse, squared residuals, and the priors' misfit."""
    scale = np.maximum(np.sqrt(np.mean(X**2, axis=0)), 1e-15)
    A, B = X / scale, Z / scale
    weight = np.zeros(X.shape[1])
    b, variance, floor = np.zeros(X.shape[1]), 0.0, float(np.mean((LEAST_NOISE * y) ** 2))
    known = np.isfinite(deviation)
    # Turns are differences of counts, whose rounding would bias K_e: its known variance is subtracted.
    blur = np.zeros(X.shape[1])
    blur[TURN] = min(len(y) * count**2 / 12.0 / scale[TURN] ** 2, 0.5 * float(A[:, TURN] @ A[:, TURN]))
    for _ in range(3):
        normal = B.T @ A + np.diag(weight - blur) + 1e-9 * len(y) * np.eye(len(scale))
        b = np.linalg.solve(normal, B.T @ y + weight * prior * scale)
        variance = float(np.mean((y - A @ b) ** 2)) + floor
        weight = np.where(known, variance / (deviation * scale) ** 2, 0.0)
    rest = y - A @ b
    scores = np.array([B[blocks == k].T @ rest[blocks == k] for k in np.unique(blocks)])
    inverse = np.linalg.inv(normal)
    meat = scores.T @ scores + np.diag(weight) * variance
    spread = np.sqrt(np.diag(inverse @ meat @ inverse.T))
    b, spread = b / scale, spread / scale
    penalty = float(np.sum(((b - prior)[known] / deviation[known]) ** 2))
    return _Solved(b, spread, float(rest @ rest) + len(y) * floor, penalty)


def _judge(working: Working, axis: _AxisWinding, found: _Fit) -> Winding:
    """Return the estimates with their intervals, or with the reason of a refusal."""
    target = working.target
    t = t_quantile(found.freedom)
    gain = gain_error(target.device, target.motor)
    estimates = []
    largest = float(dead_time(np.zeros(1), np.array([1.0]), 1e-9, target.motor.kind == "dc")[0])
    driving = max(float(found.mean[0]), 0.2 * target.motor.R_s) * float(np.abs(axis.current).max())
    lost = largest * abs(float(found.mean[3])) / max(driving, 1e-9)
    for k, (unit, model, loss) in enumerate((
        ("ohm", RESISTANCE_MODEL, RESISTANCE_LOSS), ("H", INDUCTANCE_MODEL, INDUCTANCE_LOSS),
    )):  # fmt: skip
        value, half = float(found.mean[k]), t * float(found.spread[k])
        if not value > 0.0 or float(np.hypot(half / value, model)) > WIDEST:
            swing = float(np.ptp(axis.current))
            estimates.append(refused(unit, (
                f"excitation too weak: the pulses of {swing:.2g} A peak to peak give an interval of "
                f"{half:.2g} {unit} around {value:.2g} {unit}; allow a greater current"
            )))  # fmt: skip
        else:
            estimates.append(interval(value, half, float(np.linalg.norm([gain, model, loss * lost])), unit))
    return Winding(estimates[0], estimates[1])


def _none(reason: str) -> Winding:
    return Winding(refused("ohm", reason), refused("H", reason))


def to_torque_mode(working: Working, holding: Floats) -> None:
    """Change from a velocity mode to cst, with the currents that hold the axes [A]."""
    drives = working.target.drives
    drives.write(cia402.TARGET_TORQUE, to_counts(drives, holding), where=working.where)
    motion.select_mode(drives, "cst", working.where)
