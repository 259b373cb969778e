"""The equation of motion of an axis, integrated with smooth weighting functions, and its least-squares solution."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drive_env.drives.interface import CYCLE
from mechanics.arrays import Floats, Integers

SMOOTHED = 9  # samples over which a signal is averaged
STANDS, SLOWEST = 0.02, 0.5  # of the greatest speed, and rad/s: below, the sign of friction changes gradually


class Motion(NamedTuple):
    """A motion of one axis, each field of shape (samples,)."""

    angle: Floats  # rad
    current: Floats  # A
    speed: Floats  # rad/s
    smooth: Floats  # rad/s, moving average
    sign: Floats  # -1...1: the direction of dry friction


class BalanceRows(NamedTuple):
    """The momentum balance, integrated with n weighting functions.

    columns: Coefficients of J/K, dry friction, viscous friction, offset, slope over the angle, drag; shape (n, 6).
    charge, duration: [A*s] and [s], shape (n,).
    moves: Number of the move of each row, shape (n,).
    weights: The weighting functions, shape (n, samples).
    """

    columns: Floats
    charge: Floats
    duration: Floats
    moves: Integers
    weights: Floats


class Solved(NamedTuple):
    """The solution in the order of the columns: values, standard deviations, and degrees of freedom."""

    mean: Floats
    spread: Floats
    freedom: int


def motion(angle: Floats, current: Floats, demand: Floats) -> Motion:
    """Return an axis' motion from its angles [rad], currents [A] and set-points of speed [rad/s], shape (samples,)."""
    speed = np.gradient(angle) / CYCLE
    smooth = smoothed(speed)
    # The demand gives the threshold, the measured speed the sign.
    still = max(STANDS * float(np.abs(demand).max()), SLOWEST)
    return Motion(angle, current, speed, smooth, np.clip(smooth / still, -1.0, 1.0))


def smoothed(signal: Floats) -> Floats:
    """Return a signal averaged over `SMOOTHED` samples."""
    return np.convolve(np.pad(signal, SMOOTHED // 2, mode="edge"), np.ones(SMOOTHED) / SMOOTHED, mode="valid")


def step(t: Floats, begin: float, end: float) -> Floats:
    """Return a smooth step from 0 at `begin` to 1 at `end`; all times in the same unit."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip((t - begin) / (end - begin), 0.0, 1.0)))


def balance_rows(did: Motion, weights: Sequence[Floats], moves: Sequence[int]) -> BalanceRows:
    """Return the balance integrated with weighting functions, shape (samples,) each; `moves`: the move of each."""
    w = np.array(weights)
    away = did.angle - float(did.angle.mean())
    signals = np.stack([did.sign, did.speed, np.ones_like(away), away, np.abs(did.speed) * did.speed], axis=1)
    momentum = -np.gradient(w, axis=1) / CYCLE @ did.speed
    return BalanceRows(
        np.column_stack([momentum, w @ signals]) * CYCLE,
        w @ did.current * CYCLE,
        w.sum(axis=1) * CYCLE,
        np.array(moves, np.int64),
        w,
    )


def solve(X: Floats, y: Floats, duration: Floats, moves: Integers) -> Solved:
    """Solve by least squares weighted by duration; the deviations assume errors that are equal within a move."""
    weight = 1.0 / np.sqrt(duration)
    scale = np.maximum(np.sqrt(np.mean(X**2, axis=0)), 1e-15)
    A, b = X / scale * weight[:, None], y * weight
    inverse = np.linalg.pinv(A.T @ A)
    mean = inverse @ A.T @ b
    rest = b - A @ mean
    names = np.unique(moves)
    scores = np.array([A[moves == k].T @ rest[moves == k] for k in names])
    freedom = max(len(y) - len(scale), 1)
    robust = inverse @ (scores.T @ scores) @ inverse * len(names) / max(len(names) - 1, 1)
    plain = inverse * float(rest @ rest) / freedom
    spread = np.sqrt(np.maximum(np.diag(robust), np.diag(plain)))
    return Solved(mean / scale, spread / scale, max(min(len(names) - 1, freedom), 1))
