"""Trajectories to follow: position, velocity and acceleration of an episode, drawn with an environment's generator."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from mechanics.arrays import Floats

# Generator, number of samples, their period [s] -> the result of `draw`.
Trajectory = Callable[[np.random.Generator, int, float], ArrayLike]

TRAJECTORIES = ("hold", "moves", "sines", "run")
SINES = 3
FREQUENCIES = (0.5, 5.0)  # Hz
SOFT_START = 0.1  # s
LONGEST_REST = 0.1  # s between two moves
SHORTEST_MOVE = 0.05  # s
PEAK_OF_MEAN = 1.875  # peak over mean velocity of a move of fifth order


def draw(
    kind: str | Trajectory, rng: np.random.Generator, length: int, period: float, amplitude: float, speed: float
) -> Floats:
    """Return position [rev], velocity [rev/s], acceleration [rev/s^2], shape (3, length); it begins at rest at 0.

    Args:
        kind: "hold" stays; "moves" goes to random places and rests there; "sines" adds three sines; "run" goes on at
            the speed from the first moment, faster than a load can follow. A function of generator, length and period
            returns any trajectory.
        rng: Random generator.
        length: Number of samples.
        period: Their period [s].
        amplitude: Largest position [rev].
        speed: Largest velocity [rev/s].

    Raises:
        ValueError: For a function's result of another shape, or not finite.
    """
    if callable(kind):
        return checked(kind(rng, length, period), (3, length))
    if kind == "hold":
        return np.zeros((3, length))
    if kind == "run":
        t = np.arange(length) * period
        return np.stack([speed * t, np.full(length, speed), np.zeros(length)])
    if kind == "moves":
        return _moves(rng, length, period, amplitude, speed)
    return _sines(rng, length, period, amplitude, speed)


def checked(rows: ArrayLike, *shapes: tuple[int, ...]) -> Floats:
    """Return a user's position, velocity and acceleration; ValueError if shape or values are invalid."""
    found = np.asarray(rows, float)
    if found.shape not in shapes or not np.isfinite(found).all():
        what = "numbers that are not finite" if found.shape in shapes else f"shape {found.shape}"
        raise ValueError(
            "a trajectory has rows of position [rev], velocity [rev/s] and acceleration [rev/s^2] in shape "
            f"{' or '.join(map(str, shapes))}, finite, not {what}"
        )
    return found


def _moves(rng: np.random.Generator, length: int, period: float, amplitude: float, speed: float) -> Floats:
    found = np.zeros((3, length))
    start = place = 0.0
    t = np.arange(length) * period
    while start < t[-1]:
        target = rng.uniform(-amplitude, amplitude)
        way = target - place
        duration = max(PEAK_OF_MEAN * abs(way) / (speed * rng.uniform(0.3, 1.0)), SHORTEST_MOVE)
        first, last = np.searchsorted(t, (start, start + duration))
        x = (t[first:last] - start) / duration
        found[0, first:last] = place + way * (x * x * x) * (10.0 - 15.0 * x + 6.0 * x**2)
        found[1, first:last] = way / duration * 30.0 * x**2 * (1.0 - x) ** 2
        found[2, first:last] = way / duration**2 * 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x)
        found[0, last:] = target
        place = target
        start += duration + rng.uniform(0.0, LONGEST_REST)
    return found


def _sines(rng: np.random.Generator, length: int, period: float, amplitude: float, speed: float) -> Floats:
    t = np.arange(length) * period
    low, high = np.log(FREQUENCIES)
    omega = 2.0 * np.pi * np.exp(rng.uniform(low, high, SINES))[:, None]
    phase = rng.uniform(0.0, 2.0 * np.pi, (SINES, 1))
    share = rng.dirichlet(np.ones(SINES))[:, None] / omega
    sines = np.sum(share * (np.sin(omega * t + phase) - np.sin(phase)), axis=0)
    x = np.minimum(t / SOFT_START, 1.0)
    position = sines * x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    velocity = np.gradient(position, period) if length > 1 else np.zeros(length)
    size = min(amplitude / max(np.abs(position).max(), 1e-9), speed / max(np.abs(velocity).max(), 1e-9))
    position, velocity = position * size, velocity * size
    return np.stack([position, velocity, np.gradient(velocity, period) if length > 1 else velocity])
