"""An axis's plant from a measured velocity loop: inertia, resonance, delay and velocity filter, with their intervals.

The linear model is fitted to what was measured, images of held set-points included, so nothing need be known above
half the bus's rate. Weights are what coherence says of the noise. A rigid axis has three unknowns, one whose load
swings has six; which of the two it is, the data decide, by Bayes's information criterion.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d
from scipy.optimize import least_squares
from scipy.stats import t as student

from tuning.held_samples import seen_by_bus
from tuning.linear_model import Plant, controllers, velocity_open_loop, velocity_plant

if TYPE_CHECKING:
    from drive_env.devices import Device
    from tuning.identification import Estimate

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Mask = NDArray[np.bool_]

LINEAR = 0.01  # share by which the linear model may be off at a line for reasons that repeat: friction, cogging
VALLEY, NEIGHBOURS = 0.02, 5  # the same, of the greatest among so many neighbours
FEWEST = 12  # lines
LEAST_GAIN = 10.0  # by which the criterion must improve for a resonance to be believed
SURE = 3.0  # standard deviations of a resonance's distance from its anti-resonance, at least
# What repeats and is not in the linear model, as standard deviations: logarithms, and s of the delay. The bridge's dead
# time swallows some of what small currents ask for, friction broadens a resonance.
SYSTEMATIC = {
    "inertia": 0.02, "velocity_filter": 0.01, "loop_delay": 10e-6, "anti_resonance": 0.006, "resonance": 0.002,
    "damping": 0.15,
}  # fmt: skip
# Half of an interval over the value, above which it is no identification.
WIDEST = {
    "inertia": 0.3, "velocity_filter": 0.3, "loop_delay": 0.4, "anti_resonance": 0.1, "resonance": 0.1, "damping": 2.0,
}  # fmt: skip
# s, standard deviation of what is expected of the delay before it is measured: without any, a few low frequencies
# cannot tell it from the velocity filter, and both get lost.
EXPECTED_DELAY = 50e-6
RIGID_ENOUGH = 1.5  # misfit of a rigid axis up to which no resonance is looked for
NAMES = ("inertia", "velocity_filter", "loop_delay", "anti_resonance", "resonance", "damping")
_UNITS = dict(zip(NAMES, ("kg*m^2", "Hz", "s", "Hz", "Hz", "1"), strict=True))
_LOWEST_FILTER, _HIGHEST_FILTER, _LONGEST_DELAY = 50.0, 2000.0, 5e-3


class PlantFit(NamedTuple):
    """The fitted plant, and each parameter with its interval; `reason` says why there is none."""

    plant: Plant
    estimates: dict[str, Estimate]
    misfit: float  # RMS of the residuals over what noise and LINEAR explain; about 1 if the model fits
    reason: str = ""


def fit_plant(
    device: Device, gains: NDArray[np.int64], f: Floats, seen: Complex, spread: Floats, start: Plant
) -> PlantFit:
    """Fit the plant of one axis to its closed velocity loop as a bus sees it.

    Args:
        device: The drive.
        gains: Raw gains in force, shape (5,).
        f: Frequencies that are trusted [Hz], shape (n,).
        seen: Set-point to velocity, both as on the bus, shape (n,).
        spread: Standard deviation of each line over its size, shape (n,).
        start: What the data sheet says.
    """
    if len(f) < FEWEST:
        return _refusal(start, f"only {len(f)} frequencies are coherent, of {FEWEST} that are needed")
    size = np.abs(seen)
    # In the valley of an anti-resonance what is not linear, small elsewhere, is all that is left.
    around = maximum_filter1d(size, NEIGHBOURS)
    weight = 1.0 / np.sqrt(size**2 * (spread**2 / 2.0 + LINEAR**2) + (VALLEY * around) ** 2)
    rough = _rough_loop(device, gains, f, seen)
    begin = _with_inertia(start, device, gains, f, rough)
    best = rigid = _solve(device, gains, f, seen, weight, begin)
    if _misfit(rigid) > RIGID_ENOUGH:
        for pair in _candidate_pairs(device, gains, f, seen, weight, rough, begin):
            found = _solve(device, gains, f, seen, weight, pair)
            least = LEAST_GAIN if best is rigid else 0.0
            if _criterion(found) < _criterion(best) - least and _is_sure(found):
                best = found
    return _with_intervals(*best, f)


def _solve(
    device: Device, gains: NDArray[np.int64], f: Floats, seen: Complex, weight: Floats, start: Plant
) -> tuple[Plant, Floats, Floats]:
    """Return plant, residuals and their derivatives by the parameters, as `_unpack` takes them."""

    def residuals(p: Floats) -> Floats:
        off = _residuals(device, gains, f, seen, weight, _unpack(p, start))
        return np.append(off, (p[2] / _SCALE - 1.0 / device.velocity_rate) / EXPECTED_DELAY)

    p = _pack(start)
    low = np.array([p[0] - 5.0, math.log(_LOWEST_FILTER), -_SCALE * 1e-3, math.log(f[0] / 2), 0.005, math.log(1e-3)])
    high = np.array([p[0] + 5.0, math.log(_HIGHEST_FILTER), _SCALE * _LONGEST_DELAY, math.log(2 * f[-1]), 3.0, 0.0])
    result = least_squares(
        residuals,
        np.clip(p, low[: len(p)] + 1e-6, high[: len(p)] - 1e-6),
        bounds=(low[: len(p)], high[: len(p)]),
        loss="soft_l1",
        max_nfev=30,
        x_scale=np.array([0.1, 0.1, 0.1, 0.02, 0.05, 0.3])[: len(p)],
    )
    return _unpack(result.x, start), np.asarray(result.fun), np.asarray(result.jac)


def _residuals(
    device: Device, gains: NDArray[np.int64], f: Floats, seen: Complex, weight: Floats, plant: Plant
) -> Floats:
    def closed(at: Floats) -> Complex:
        L = velocity_open_loop(device, plant, gains, at)
        return np.asarray(L / (1.0 + L))

    off = (seen_by_bus(device, f, closed) - seen) * weight
    return np.asarray(np.nan_to_num(np.concatenate([off.real, off.imag]), nan=1e6, posinf=1e6, neginf=-1e6))


_BEYOND = 20.0  # uncertainty of a logarithm that is as good as infinite
_SCALE = 1e4  # of the delay's parameter, 1/s


def _pack(plant: Plant) -> Floats:
    p = [math.log(plant.inertia), math.log(plant.velocity_filter), plant.delay * _SCALE]
    if plant.is_elastic:
        p += [math.log(plant.anti_resonance), math.log(plant.resonance / plant.anti_resonance), math.log(plant.damping)]
    return np.array(p)


def _unpack(p: Floats, like: Plant) -> Plant:
    known = {"inertia": math.exp(p[0]), "velocity_filter": math.exp(p[1]), "delay": p[2] / _SCALE}
    if len(p) == 6:
        known |= {
            "anti_resonance": math.exp(p[3]),
            "resonance": math.exp(p[3] + p[4]),
            "damping": math.exp(p[5]),
        }
    return replace(like, **known)


def _misfit(solution: tuple[Plant, Floats, Floats]) -> float:
    _, residuals, jacobian = solution
    return math.sqrt(float(np.sum(residuals**2)) / max(len(residuals) - jacobian.shape[1], 1))


def _is_sure(solution: tuple[Plant, Floats, Floats]) -> bool:
    """Return whether resonance and anti-resonance are apart for certain."""
    plant, _, jacobian = solution
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(_misfit(solution), 1.0) ** 2
    return bool(math.log(plant.resonance / plant.anti_resonance) > SURE * math.sqrt(max(covariance[4, 4], 0.0)))


def _criterion(solution: tuple[Plant, Floats, Floats]) -> float:
    _, residuals, jacobian = solution
    n = len(residuals)
    return float(n * math.log(float(np.mean(residuals**2))) + jacobian.shape[1] * math.log(n))


# --- where to begin ---------------------------------------------------------------------------------------------------
def _rough_loop(device: Device, gains: NDArray[np.int64], f: Floats, seen: Complex) -> Complex:
    """Return velocity per demanded current with the images still in it."""
    from tuning.held_samples import unhold

    closed = unhold(device, f, seen, np.zeros(f.shape, complex))
    z = np.exp(2j * math.pi * f / device.velocity_rate)
    return np.asarray(closed / (1.0 - closed) / controllers(device, gains).velocity(z))


def _with_inertia(plant: Plant, device: Device, gains: NDArray[np.int64], f: Floats, rough: Complex) -> Plant:
    ratio = np.abs(velocity_plant(device, plant, gains, f)) / np.abs(rough)
    return replace(plant, inertia=plant.inertia * float(np.median(ratio[: max(4, len(f) // 4)])))


def _candidate_pairs(
    device: Device,
    gains: NDArray[np.int64],
    f: Floats,
    seen: Complex,
    weight: Floats,
    rough: Complex,
    rigid: Plant,
) -> list[Plant]:
    """Return plants with a pair to begin with: the deepest swing of the response, and the best of a coarse grid."""
    level = 20.0 * np.log10(np.abs(rough / velocity_plant(device, rigid, gains, f)))
    pairs = []
    for valley in range(len(f) - 1):
        peak = valley + int(np.argmax(level[valley:]))
        pairs.append((level[peak] - level[valley], f[valley], f[peak]))
    _, low, high = max(pairs)
    plants = [replace(rigid, anti_resonance=float(low), resonance=float(high), damping=0.03)] if high > low else []

    def cost(plant: Plant) -> float:
        off = _residuals(device, gains, f, seen, weight, plant)
        return float(np.sum(np.log1p(off**2)))  # a resonance a line beside the true one is not quite wrong

    def scaled(plant: Plant) -> Plant:
        ratio = float(np.median(np.abs(velocity_plant(device, plant, gains, f) / rough)))
        return replace(plant, inertia=plant.inertia * ratio)

    grid = [
        scaled(replace(rigid, anti_resonance=float(low), resonance=float(low * ratio), damping=0.03))
        for low in np.geomspace(f[0], f[-1] * 0.8, 16)
        for ratio in (1.15, 1.4, 1.8, 2.6)
    ]
    return plants + sorted(grid, key=cost)[:3]


# --- intervals --------------------------------------------------------------------------------------------------------
def _with_intervals(plant: Plant, residuals: Floats, jacobian: Floats, f: Floats) -> PlantFit:
    from tuning.identification import Estimate, refused

    freedom = max(len(residuals) - jacobian.shape[1], 1)
    misfit = math.sqrt(float(np.sum(residuals**2)) / freedom)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(misfit, 1.0) ** 2
    reach = float(student.ppf(0.975, freedom))
    p = _pack(plant)

    def positive(name: str, row: list[float], unit: str) -> Estimate:
        direction = np.array(row)
        spread = math.sqrt(max(float(direction @ covariance @ direction), 0.0) + SYSTEMATIC[name] ** 2)
        half = min(reach * spread, _BEYOND)
        middle = float(direction @ p)
        return Estimate(math.exp(middle), math.exp(middle - half), math.exp(middle + half), unit)

    rest = [0.0] * (len(p) - 3)
    estimates = {
        "inertia": positive("inertia", [1.0, 0.0, 0.0, *rest], "kg*m^2"),
        "velocity_filter": positive("velocity_filter", [0.0, 1.0, 0.0, *rest], "Hz"),
    }
    half = reach * math.hypot(math.sqrt(max(float(covariance[2, 2]), 0.0)) / _SCALE, SYSTEMATIC["loop_delay"])
    estimates["loop_delay"] = Estimate(plant.delay, plant.delay - half, plant.delay + half, "s")
    if plant.is_elastic:
        estimates["anti_resonance"] = positive("anti_resonance", [0.0, 0.0, 0.0, 1.0, 0.0, 0.0], "Hz")
        estimates["resonance"] = positive("resonance", [0.0, 0.0, 0.0, 1.0, 1.0, 0.0], "Hz")
        estimates["damping"] = positive("damping", [0.0, 0.0, 0.0, 0.0, 0.0, 1.0], "1")
    else:
        reason = f"none shows between {f[0]:.0f} and {f[-1]:.0f} Hz"
        if misfit > RIGID_ENOUGH:
            reason = f"the response from {f[0]:.0f} to {f[-1]:.0f} Hz is neither that of a rigid axis nor of one spring"
        estimates |= {name: refused(_UNITS[name], reason) for name in ("anti_resonance", "resonance", "damping")}
    estimates |= {name: _checked(name, estimate) for name, estimate in estimates.items()}
    if plant.is_elastic and plant.resonance > f[-1]:
        reason = f"it lies above {f[-1]:.0f} Hz, up to which the axis could be seen"
        estimates |= {name: refused(_UNITS[name], reason) for name in ("resonance", "damping")}
    return PlantFit(plant, estimates, misfit)


def _checked(name: str, estimate: Estimate) -> Estimate:
    """Return an estimate, or its refusal if its interval says nothing."""
    from tuning.identification import refused

    if not estimate.is_known or (estimate.high - estimate.low) / 2.0 <= WIDEST[name] * abs(estimate.value):
        return estimate
    return refused(
        estimate.unit,
        f"excitation too weak: {estimate.value:.4g} lies anywhere between {estimate.low:.4g} and {estimate.high:.4g}",
    )


def _refusal(plant: Plant, reason: str) -> PlantFit:
    from tuning.identification import refused

    return PlantFit(plant, {name: refused(_UNITS[name], reason) for name in NAMES}, math.nan, reason)
