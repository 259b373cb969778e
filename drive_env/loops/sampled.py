"""Machines as sampled by the loops of their drives: many at once, with any number of axes each.

Currents, speeds and twists of a machine are one linear system in continuous time. The current loops sample it every
tick and compute duties that act during the next one; the velocity and position loops sample it once per window of
several ticks. In a machine with several axes each loop is evaluated with the loops of the other axes closed. Limits,
friction, quantisation, noise, and the d axis are neglected.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.devices.gains import cascade_columns, loop_scales
from mechanics.arrays import Complex, Floats, Integers

if TYPE_CHECKING:
    from drive_env.devices import Device


RIGID = 1e-6  # a mode whose squared frequency is below this share of the greatest is rigid motion
_TERMS = 14  # of Taylor's series of exp(X), |X| <= 1/2: the error is 2e-17


class LoopRates(NamedTuple):
    """Rates of a drive's loops, and of its master's cycles [Hz]."""

    current_rate: float
    velocity_rate: float
    communication_rate: float

    @classmethod
    def of(cls, device: Device) -> LoopRates:
        """Return the rates of a device."""
        return cls(device.current_rate, device.velocity_rate, device.communication_rate)


class LinearMachines(NamedTuple):
    """Machines in continuous time: dx/dt = A x + B u, with the voltages u of the axes [V].

    A: (machines, states, states).
    B: (machines, states, axes).
    current, speed: Rows that give the current [A] and speed [rad/s] of each rotor from the states,
        (machines, axes, states).
    supply: Supply voltage of each axis [V], (machines, axes).
    velocity_filter: Corner of each axis's velocity filter [Hz], (machines, axes).
    """

    A: Floats
    B: Floats
    current: Floats
    speed: Floats
    supply: Floats
    velocity_filter: Floats


class Windings(NamedTuple):
    """The motors of machines, (machines, axes) each; supply and velocity filter as in `LinearMachines`.

    R, L: Resistance and inductance of a phase, in the torque-making axis [ohm], [H]. emf: Voltage per speed [V*s/rad].
    torque: Torque per current [N*m/A].
    """

    R: Floats
    L: Floats
    emf: Floats
    torque: Floats
    supply: Floats
    velocity_filter: Floats


def linear_machines(windings: Windings, M: Floats, D: Floats, K: Floats, rotors: Floats) -> LinearMachines:
    """Return machines from the matrices of their loads: M q'' + D q' + K q = torque.

    Args:
        windings: Their motors.
        M: Inertia, (machines, joints, joints).
        D: Damping, likewise.
        K: Stiffness, likewise.
        rotors: Joint coordinates of each rotor's angle, (axes, joints).
    """
    (count, joints), axes = M.shape[:2], len(rotors)
    # Springs hold the twists along the eigenvectors of K; the angle of a free rotation is not a state.
    squares, twists = np.linalg.eigh(K)
    elastic = squares.max(axis=0) > RIGID * max(float(squares.max()), 1e-300)
    squares, twists = squares[:, elastic], twists[:, :, elastic]
    springs, size = int(elastic.sum()), axes + joints + int(elastic.sum())
    A, B = np.zeros((count, size, size)), np.zeros((count, size, axes))
    one, speeds, held_ = np.arange(axes), slice(axes, axes + joints), slice(axes + joints, size)
    A[:, one, one] = -windings.R / windings.L
    A[:, :axes, speeds] = -(windings.emf / windings.L)[:, :, None] * rotors
    A[:, speeds, :axes] = np.linalg.solve(M, windings.torque[:, None, :] * rotors.T)
    A[:, speeds, speeds] = -np.linalg.solve(M, D)
    if springs:
        A[:, speeds, held_] = -np.linalg.solve(M, twists * squares[:, None, :])
        A[:, held_, speeds] = np.swapaxes(twists, 1, 2)
    B[:, one, one] = 1.0 / windings.L
    current, speed = np.zeros((count, axes, size)), np.zeros((count, axes, size))
    current[:, one, one] = 1.0
    speed[:, :, speeds] = rotors
    return LinearMachines(A, B, current, speed, windings.supply, windings.velocity_filter)


class CascadeGains(NamedTuple):
    """Gains of each axis in SI, (machines, axes) each; the integral gains are shares of P e per sample.

    current_p [duty/A], velocity_p [A s/rad], position [1/s].
    """

    current_p: Floats
    current_i: Floats
    velocity_p: Floats
    velocity_i: Floats
    position: Floats

    @classmethod
    def of(cls, device: Device, raw: Integers) -> CascadeGains:
        """Return raw gains, (machines, axes, count), in SI; ValueError for a device without a linear model."""
        scales = loop_scales(device)
        return cls(*(scales[k].value(raw[..., k]) for k in cascade_columns(device)))


class LoopWindow(NamedTuple):
    """The system in a window of the velocity loop while the demanded currents i are held: x' = W x + H i.

    W: (machines, states, states). H: (machines, states, axes). turn, turn_of_demand: How far the rotors turn [rad] by
    state, (machines, axes, states), and by demanded current, (machines, axes, axes).
    """

    W: Floats
    H: Floats
    turn: Floats
    turn_of_demand: Floats


def held(A: Floats, B: Floats, speed: Floats, T: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Return Phi, Gamma of systems whose inputs are held for T [s], and likewise for the rotors' turns."""
    machines, states, axes = B.shape
    size = states + 2 * axes
    block = np.zeros((machines, size, size))
    block[:, :states, :states], block[:, :states, states : states + axes] = A * T, B * T
    block[:, states + axes :, :states] = speed * T
    step = exponential(block)
    inputs = slice(states, states + axes)
    return (
        step[:, :states, :states], step[:, :states, inputs], step[:, states + axes :, :states],
        step[:, states + axes :, inputs],
    )  # fmt: skip


def exponential(X: Floats) -> Floats:
    """Return exp(X) of small matrices, (..., n, n), to rounding: Taylor's series of X / 2^k, squared k times.

    On busy cores SciPy's takes 20 ms instead of 0.1 because of its threads; a fit needs hundreds.
    """
    norm = float(np.abs(X).sum(axis=-2).max())
    halvings = max(0, math.ceil(math.log2(norm)) + 1) if norm > 0.0 else 0
    small, one = X / 2.0**halvings, np.eye(X.shape[-1])
    result = one
    for k in range(_TERMS, 0, -1):
        result = one + small @ result / k
    for _ in range(halvings):
        result = result @ result
    return np.asarray(result)


def window(rates: LoopRates, machines: LinearMachines, gains: CascadeGains) -> LoopWindow:
    """Return a window of machines whose current loops have these gains, currents regulated."""
    A, B, current, speed, supply, _ = machines
    Phi, Gamma, of_state, of_voltage = held(A, B, speed, 1.0 / rates.current_rate)
    count, states, axes = B.shape
    size, one = states + 2 * axes, np.arange(axes)
    # States: the machine's, the computed but not yet applied voltages, the regulators' integrals.
    pending, integral = states + one, states + axes + one
    P, share = gains.current_p, gains.current_i
    tick, drive = np.zeros((count, size, size)), np.zeros((count, size, axes))
    tick[:, :states, :states] = Phi
    tick[:, :states, pending] = Gamma
    tick[:, pending, :states] = -(supply * P * (1.0 + share))[..., None] * current
    tick[:, pending, integral] = supply
    drive[:, pending, one] = supply * P * (1.0 + share)
    tick[:, integral, :states] = -(P * share)[..., None] * current
    tick[:, integral, integral] = 1.0
    drive[:, integral, one] = P * share
    turned = np.concatenate([of_state, of_voltage, np.zeros_like(of_voltage)], axis=2)
    W, H = np.broadcast_to(np.eye(size), tick.shape), np.zeros_like(drive)
    turn, turn_of_demand = np.zeros_like(turned), np.zeros((count, axes, axes))
    for _ in range(round(rates.current_rate / rates.velocity_rate)):
        turn, turn_of_demand = turn + turned @ W, turn_of_demand + turned @ H
        W, H = tick @ W, tick @ H + drive
    return LoopWindow(np.asarray(W), H, turn, turn_of_demand)


def response(W: Floats, H: Floats, rows: Floats, z: Complex) -> Complex:
    """Return rows (z - W)^-1 H by the modes of W, which are simple.

    Args:
        W: (machines, states, states).
        H: (machines, states, inputs).
        rows: (machines, outputs, states).
        z: (machines, n).

    Returns:
        Shape (machines, n, outputs, inputs).
    """
    poles, shapes = np.linalg.eig(W)
    residues = np.einsum("mos,msi->msoi", rows @ shapes, np.linalg.solve(shapes, H.astype(complex)))
    count, states, outputs, inputs = residues.shape
    weights = 1.0 / (z[:, :, None] - poles[:, None, :])
    return np.asarray((weights @ residues.reshape(count, states, -1)).reshape(count, -1, outputs, inputs))


def mean_velocity(rates: LoopRates, one: LoopWindow, f: Floats) -> Complex:
    """Return the mean velocity of rotors over a window [rad/s] per demanded current [A], (machines, n, axes, axes).

    Args:
        rates: The drive's rates.
        one: Result of `window` for the machines.
        f: Frequencies [Hz], (machines, n).
    """
    z = np.exp(2j * math.pi * f / rates.velocity_rate)
    turned = response(one.W, one.H, one.turn, z) + one.turn_of_demand[:, None]
    return np.asarray(rates.velocity_rate / z[..., None, None] * turned)


class OuterLoops(NamedTuple):
    """Open loops of the velocity and of the position loop of each axis, complex, (machines, axes, n)."""

    velocity: Complex
    position: Complex


def open_loops(
    rates: LoopRates, machines: LinearMachines, gains: CascadeGains, f: Floats, one: LoopWindow | None = None
) -> OuterLoops:
    """Return the open outer loops of machines, for each axis with all loops of the others closed.

    Args:
        rates: The drive's rates.
        machines: The machines.
        gains: Their gains.
        f: Frequencies [Hz] above 0 and below half the velocity loop's rate, (machines, n).
        one: The window of these machines and gains; computed by default.
    """
    plant = mean_velocity(rates, window(rates, machines, gains) if one is None else one, f)
    return loops_around(rates, plant, machines.velocity_filter, gains, f)


def loops_around(rates: LoopRates, plant: Complex, corner: Floats, gains: CascadeGains, f: Floats) -> OuterLoops:
    """Return the open outer loops around machines whose current loops are closed; arguments as for `open_loops`.

    Args:
        rates: The drive's rates.
        plant: Result of `mean_velocity` for the machines.
        corner: Corner of each axis's velocity filter [Hz], (machines, axes).
        gains: Gains of the outer loops.
        f: Frequencies of the plant [Hz], (machines, n).
    """
    from drive_env.emulator.parameters import velocity_filter

    back = np.exp(-2j * math.pi * f / rates.velocity_rate)[..., None]
    b, a1, a2 = (value[:, None, :] for value in velocity_filter(corner, rates.velocity_rate))
    filtered = b * (1.0 + back) ** 2 / (1.0 + a1 * back + a2 * back**2)
    P, share, outer = (values[:, None, :] for values in gains[2:])
    regulator = P * (1.0 + share / (1.0 - back))
    angle = outer / (rates.velocity_rate * (1.0 - back))
    axes = plant.shape[-1]
    own = np.einsum("mfaa->mfa", plant)
    if axes > 1:
        whole = regulator * (filtered + angle)
        closed = np.linalg.solve(np.eye(axes) + plant * whole[:, :, None, :], plant)
        own = np.einsum("mfaa->mfa", closed)
        own = own / (1.0 - whole * own)
    velocity = regulator * filtered * own
    position = angle * regulator * own / (1.0 + velocity)
    return OuterLoops(*(np.ascontiguousarray(np.moveaxis(loop, 1, 2)) for loop in (velocity, position)))


class ClosedLoops(NamedTuple):
    """Machines with all loops closed, sampled once a window: x' = A x + B r, angles = C x; r: demanded angles [rad]."""

    A: Floats
    B: Floats
    C: Floats

    @property
    def growth(self) -> Floats:
        """Rate of the fastest growing motion [1/s], (machines,); at most 0 if none grows."""
        radius = np.abs(np.linalg.eigvals(self.A)).max(axis=-1)
        return np.asarray(np.log(np.maximum(radius, 1e-300)))


def closed_loops(rates: LoopRates, machines: LinearMachines, gains: CascadeGains, one: LoopWindow) -> ClosedLoops:
    """Return machines with all loops closed."""
    from drive_env.emulator.parameters import velocity_filter

    rate, (count, size, axes) = rates.velocity_rate, one.H.shape
    b, a1, a2 = velocity_filter(machines.velocity_filter, rate)
    # States: the window's, the previous mean velocity, two of the filter, integral of the error, previous angle.
    at = [slice(size + k * axes, size + (k + 1) * axes) for k in range(5)]
    mean, first, second, total, angle = at
    whole, eye = size + 5 * axes, np.eye(axes)

    def rows(**parts: Floats) -> Floats:
        places = {"mean": mean, "first": first, "second": second, "total": total, "angle": angle}
        made = np.zeros((count, axes, whole))
        for name, values in parts.items():
            made[:, :, places[name]] = values[..., None] * eye
        return made

    unit = np.ones((count, axes))
    filtered = rows(mean=b, first=unit)
    place = rows(mean=unit / rate, angle=unit)
    P, share, outer = (values[..., None] for values in gains[2:])
    error = -outer * place - filtered
    summed = rows(total=unit) + error
    demand = P * (error + share * summed)
    error_r = outer * eye
    demand_r = P * (1.0 + share) * error_r
    A, B = np.zeros((count, whole, whole)), np.zeros((count, whole, axes))
    A[:, :size, :size], A[:, mean, :size] = one.W, rate * one.turn
    A[:, :size] += one.H @ demand
    A[:, mean] += rate * one.turn_of_demand @ demand
    A[:, first] = rows(mean=2.0 * b, second=unit) - a1[..., None] * filtered
    A[:, second] = rows(mean=b) - a2[..., None] * filtered
    A[:, total], A[:, angle] = summed, place
    B[:, :size], B[:, mean], B[:, total] = one.H @ demand_r, rate * one.turn_of_demand @ demand_r, error_r
    return ClosedLoops(A, B, place)


def step_overshoot(rates: LoopRates, closed: ClosedLoops, growth: Floats | None = None) -> Floats:
    """Return the overshoot of each axis after a step of its set-point in csp, over the step, (machines, axes).

    The larger of two steps counts: of its own set-point alone, and of all axes together, as a gantry moves, whose
    bridge otherwise holds each axis at the other one. The set-point moves there within a communication cycle, as
    interpolated by csp, and the angle is sampled once per cycle. For an unstable machine the overshoot is infinite.

    Args:
        rates: The drive's rates.
        closed: The machines.
        growth: `closed.growth`, computed by default.
    """
    cycle = round(rates.velocity_rate / rates.communication_rate)
    (count, states, axes), cycles = closed.B.shape, round(STEP_TIME * rates.communication_rate)
    A, ramp, constant = np.broadcast_to(np.eye(states), closed.A.shape), 0.0 * closed.B, 0.0 * closed.B
    for k in range(cycle):
        ramp = closed.A @ ramp + closed.B * (k + 1) / cycle
        constant = closed.A @ constant + closed.B
        A = closed.A @ A
    # The set-points are states; each doubling covers as many cycles again as are computed already.
    size, unit = states + axes, np.broadcast_to(np.eye(axes), (count, axes, axes))
    ahead = np.zeros((count, size, size))
    ahead[:, :states, :states], ahead[:, :states, states:], ahead[:, states:, states:] = A, constant, unit
    looks = np.concatenate([closed.C, 0.0 * unit], axis=2)
    with np.errstate(over="ignore", invalid="ignore"):
        while looks.shape[1] < cycles * axes:
            looks, ahead = np.concatenate([looks, looks @ ahead], axis=1), ahead @ ahead
        # By cycle, axis that moves, and axis whose set-point steps.
        moved = (looks[:, : cycles * axes] @ np.concatenate([ramp, unit], axis=1)).reshape(count, cycles, axes, axes)
        most = np.fmax(np.einsum("mkaa->mka", moved), moved.sum(axis=-1)).max(axis=1)
    stable = (closed.growth if growth is None else growth)[:, None] <= STILL
    return np.where(stable & np.isfinite(most), np.maximum(most - 1.0, 0.0), np.inf)


STEP_TIME = 0.3  # s after a step, in which the overshoot is looked for
STILL = 1e-7  # per window: a motion that grows by less stands still
