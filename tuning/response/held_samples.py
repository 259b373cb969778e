"""A fast loop as seen on a bus: set-points are held for a communication cycle, samples are taken once per cycle.

A set-point of the bus acts from the beginning of a cycle and is held for its windows; a sample is the value of the last
window before. So at f the loop gets the set-point times H(f), and at f + k/T its images; sampling folds the responses
to them back. For a closed loop T(f), with m windows of h in a cycle of T = m h, the bus shows

    T_bus(f) = sum over k = 0 ... m-1 of T(f_k) H(f_k) exp(-j 2 pi f_k h)    f_k = f + k / T
    H(f) = 1/m sum over n = 0 ... m-1 of exp(-j 2 pi f n h)

which is exact for a linear loop. Up to a fifth of the bus's rate the images are negligible; at two fifths they are a
quarter of the result, and only a model of the loop above half the bus's rate can remove them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from drive_env.devices import Device
from mechanics.arrays import Complex, Floats

Response = Callable[[Floats], Complex]  # of frequencies above 0 and below half the velocity loop's rate [Hz], (n,)


def seen_by_bus(device: Device, f: Floats, closed_loop: Response) -> Complex:
    """Return T_bus at frequencies [Hz] below half the bus's rate, shape (n,)."""
    own, images = split(device, f, closed_loop)
    return np.asarray(own + images)


def split(device: Device, f: Floats, closed_loop: Response) -> tuple[Complex, Complex]:
    """Return the part of T_bus that is T at f itself, and the part of its images."""
    at = f + device.communication_rate * np.arange(windows(device))[:, None]
    # A sampled loop's response is periodic in its rate, and conjugate above half of it.
    above = at > 0.5 * device.velocity_rate
    answer = closed_loop(np.where(above, device.velocity_rate - at, at).reshape(-1)).reshape(at.shape)
    folded = np.where(above, answer.conj(), answer) * _hold(device, at)
    return np.asarray(folded[0]), np.asarray(folded[1:].sum(axis=0))


def unhold(device: Device, f: Floats, seen: Complex, images: Complex) -> Complex:
    """Return T(f) from the samples of the bus, with the images removed."""
    return np.asarray((seen - images) / _hold(device, f))


def windows(device: Device) -> int:
    """Return the number of windows of the velocity loop in a communication cycle."""
    return round(device.velocity_rate / device.communication_rate)


def _hold(device: Device, f: Floats) -> Complex:
    """Return H(f) times the delay of the sample, one window."""
    back = np.exp(-2j * math.pi * f / device.velocity_rate)
    return np.asarray(np.mean([back**n for n in range(windows(device))], axis=0) * back)
