"""Relay feedback after Astrom and Hagglund (1984): a relay makes an axis oscillate, which gives the gains.

The relay works in cst: the current is +h or -h by the sign of the velocity error, updated once per communication cycle,
and the axis oscillates at the frequency at which axis, bus and relay together shift the phase by 180 degrees. Only the
axis is evaluated: the ratio of the fundamentals of recorded velocity and current is a point of its frequency response.
An axis is an integrator with lags, so the point gives its slope K_t/J and the sum of its lags; from these follow
ultimate gain and period of the drive's own, faster loop.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env import cia402, motion
from drive_env.drives.currents import ampere_per_count, read_current_limit, to_counts
from drive_env.drives.interface import CYCLE
from drive_env.trials.positioning import wrapped
from mechanics.arrays import Floats, Mask
from tuning.rules.lags import slow_enough, velocity_lag
from tuning.rules.optima import take_current
from tuning.rules.proposal import Proposal, Workbench

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.loops.linear_model import Plant
    from drive_env.motors import Motor
    from tuning.target import Target


TIME, TRANSIENT = 0.3, 0.1  # s, duration of the experiment, and of the transient omitted at its beginning
SHARE = 0.4  # relay amplitude over the rated current
# Greatest relay amplitude over the drive's current limit: to an envelope, a swing of half the limit is an oscillation.
OF_LIMIT = 0.45
TRAVEL_SHARE = 0.8  # of the travel: beyond it the relay is off
OFF = 1.5  # greatest ratio between the inertia seen in the oscillation and the axis'
LEAST_COUNTS = 0.5  # of the encoder: the smallest amplitude that is more than noise
LEAST_SWINGS = 6  # smallest number of periods to evaluate
# The current is held for a cycle: recorded at the cycle's end, it acted half a cycle earlier on average.
HELD = 0.5 * CYCLE
# PI gains from the ultimate point (Tyreus, Luyben 1992): lower gain and better damping than Ziegler and Nichols.
GAIN_SHARE, TIME_SHARE = 1.0 / 3.2, 2.2
POSITION_SHARE = 0.25  # k_v over the velocity loop's crossover


class Ultimate(NamedTuple):
    """The point at which a P velocity loop would oscillate: its gain [A*s/rad] and its period [s]."""

    gain: float
    period: float


class Swing(NamedTuple):
    """The oscillation of every axis under a relay, each of shape (num_axes,); nan and a reason for an axis without one.

    frequency: Frequency of the oscillation [Hz].
    amplitude: Amplitude of the velocity [rad/s].
    slope: Acceleration per current [rad/(A*s^2)], K_t/J.
    lag: Sum of the small lags from current to measured velocity [s].
    reason: Why there is no result; "" with a result.
    """

    frequency: Floats
    amplitude: Floats
    slope: Floats
    lag: Floats
    reason: tuple[str, ...]

    def ultimate(self, axis: int) -> Ultimate:
        """Return the ultimate point of an integrator with this slope and lag."""
        return ultimate_of_integrator(float(self.slope[axis]), float(self.lag[axis]))


def ultimate_of_integrator(slope: float, lag: float) -> Ultimate:
    """Return the ultimate point of slope e^(-s lag) / s: it oscillates where the lag shifts the phase by 90 degrees."""
    w = math.pi / (2.0 * lag)
    return Ultimate(w / slope, 2.0 * math.pi / w)


def relay_rule(device: Device, motor: Motor, plant: Plant) -> Proposal:
    """Propose the gains that a relay experiment on this axis would give, computed from the model.

    `relay_experiment` measures the ultimate point instead.
    """
    bench = Workbench(device, plant)
    lag = velocity_lag(plant, take_current(bench, device, plant))
    lag = slow_enough(bench, plant, lag, 0.5 * math.pi * GAIN_SHARE)
    slope = plant.torque_constant / plant.inertia
    return finish(bench, ultimate_of_integrator(slope, lag), slope)


def gains_from_swing(device: Device, plant: Plant, slope: float, ultimate: Ultimate) -> Proposal:
    """Propose gains from a measured ultimate point.

    Args:
        device: The drive.
        plant: The axis: its winding and supply, which a relay does not measure, and its inertia, by which it is checked
            that the axis did not oscillate at its load's resonance.
        slope: Acceleration per current [rad/(A*s^2)].
        ultimate: The ultimate point.

    Raises:
        ValueError: If the axis oscillated with another inertia than its own.
    """
    expected = plant.torque_constant / plant.inertia
    if not 1.0 / OFF < slope / expected < OFF:
        raise ValueError(
            f"the axis swung like {1.0 / slope * plant.torque_constant:.2g} kg*m^2, and its inertia is "
            f"{plant.inertia:.2g}: it swings at its load's resonance, where the relay method does not work; take "
            "margin_45"
        )
    bench = Workbench(device, plant)
    take_current(bench, device, plant)
    return finish(bench, ultimate, slope)


def finish(bench: Workbench, ultimate: Ultimate, slope: float) -> Proposal:
    """Set velocity and position gains from an ultimate point, and return the proposal."""
    crossover = bench.p("velocity", GAIN_SHARE * ultimate.gain) * slope
    bench.time("velocity", TIME_SHARE * ultimate.period)
    bench.p("position", POSITION_SHARE * crossover)
    return bench.proposal()


def relay_experiment(target: Target) -> Swing:
    """Make axes oscillate by a relay and evaluate the oscillation; the drives are in cst during it and off afterwards.

    The current loop must work: write its gains first. The relay of an axis is switched off near the end of its travel.
    """
    drives, n = target.drives, target.num_axes
    limit = np.minimum(OF_LIMIT * read_current_limit(drives), target.current)
    height = np.minimum(SHARE * target.motor.rated_current, limit)
    scale, counts, origin = target.increments(), target.speed_counts(), drives.read(cia402.POSITION_ACTUAL)
    low, high = TRAVEL_SHARE * target.low * scale, TRAVEL_SHARE * target.high * scale
    drives.write(cia402.TARGET_TORQUE, 0)
    motion.enable(drives, mode="cst")
    cycles = round(TIME / CYCLE)
    per_count = ampere_per_count(drives)
    speed, current = np.zeros((cycles, n)), np.zeros((cycles, n))
    inside = np.ones(n, bool)
    bias = np.zeros(n)
    torque = np.broadcast_to(height, n)
    try:
        for k in range(cycles):
            played = {cia402.TARGET_TORQUE: to_counts(drives, torque)[None]}
            trace = drives.record(
                [cia402.VELOCITY_ACTUAL, cia402.TORQUE_ACTUAL, cia402.POSITION_ACTUAL], CYCLE, play=played
            )
            speed[k] = trace[cia402.VELOCITY_ACTUAL][0] / counts
            current[k] = trace[cia402.TORQUE_ACTUAL][0] * per_count
            way = wrapped(trace[cia402.POSITION_ACTUAL][0] - origin)
            inside &= (way > low) & (way < high)
            # A constant load shifts the oscillation; the mean current that keeps the mean speed at 0 compensates for
            # it.
            bias += np.where(inside, -0.02 * height * np.tanh(way / (0.05 * 2.0 * math.pi * scale)), 0.0)
            bias = np.clip(bias, -0.5 * height, 0.5 * height)
            torque = np.where(inside, bias - height * np.sign(speed[k] + (speed[k] == 0.0)), 0.0)
        drives.record([cia402.VELOCITY_ACTUAL], 5 * CYCLE, play={cia402.TARGET_TORQUE: np.zeros((5, n), np.int64)})
    finally:
        motion.disable(drives)
    count = 2.0 * math.pi / target.motor.encoder_counts
    return evaluate(speed, current, inside, count)


def evaluate(speed: Floats, current: Floats, inside: Mask, count_angle: float) -> Swing:
    """Evaluate recorded oscillations.

    Args:
        speed: Velocity once per cycle [rad/s], shape (n, num_axes).
        current: Actual current once per cycle [A], shape (n, num_axes).
        inside: Axes that stayed away from the ends of their travel, shape (num_axes,).
        count_angle: Angle of one count of the encoder [rad].
    """
    count = speed.shape[1]
    result = {name: np.full(count, math.nan) for name in ("frequency", "amplitude", "slope", "lag")}
    reasons = [""] * count
    first = round(TRANSIENT / CYCLE)
    for axis in range(count):
        if not inside[axis]:
            reasons[axis] = "the travel is too short: the relay drove the axis to its end"
            continue
        v, i = speed[first:, axis], current[first:, axis]
        found = fundamental(v)
        periods = found * len(v) * CYCLE
        if not periods >= LEAST_SWINGS:
            reasons[axis] = (
                f"the axis did not swing {LEAST_SWINGS} times: friction is too high, or the inertia too large"
            )
            continue
        V, amps = line(v, found), line(i, found)
        w = 2.0 * math.pi * found
        if abs(V) / w < LEAST_COUNTS * count_angle:
            reasons[axis] = (
                f"the axis swung by less than {LEAST_COUNTS:g} counts: friction is too high, or the inertia too large"
            )
            continue
        G = V / amps
        phase = np.angle(G * 1j)  # in addition to the 90 degrees of the integrator
        result["frequency"][axis], result["amplitude"][axis] = found, abs(V)
        result["slope"][axis] = abs(G) * w
        lag = -phase / w + HELD
        if lag <= 0.0:
            reasons[axis] = (
                f"the phase at {found:.0f} Hz leads an integrator's: the oscillation is not that of a rigid axis"
            )
            result["slope"][axis] = math.nan
            continue
        result["lag"][axis] = lag
    return Swing(result["frequency"], result["amplitude"], result["slope"], result["lag"], tuple(reasons))


def fundamental(x: Floats) -> float:
    """Return the frequency of the strongest line [Hz]; nan for a constant signal."""
    y = (x - x.mean()) * np.hanning(len(x))
    if not np.any(y):
        return math.nan
    size = 16 * len(x)
    spectrum = np.abs(np.fft.rfft(y, size))
    k = int(spectrum.argmax())
    if 0 < k < len(spectrum) - 1:
        a, b, c = np.log(np.maximum(spectrum[k - 1 : k + 2], 1e-300))
        k = k + 0.5 * (a - c) / (a - 2.0 * b + c)
    return float(k / (size * CYCLE))


def line(x: Floats, frequency: float) -> complex:
    """Return the complex amplitude at a frequency, by least squares with a constant and a slope."""
    t = np.arange(len(x)) * CYCLE
    w = 2.0 * math.pi * frequency * t
    columns = np.stack([np.cos(w), np.sin(w), np.ones_like(t), t], axis=1)
    a, b, *_ = np.linalg.lstsq(columns, x, rcond=None)[0]
    return complex(a, -b)
