"""Fits an axis' plant to a measured velocity loop: inertia, resonance, delay and velocity filter, with intervals.

The linear model is fitted to the measurement including the images of held set-points, so that nothing need be known
above half the bus's rate. Weights follow from the coherence. A rigid axis has four unknowns, one with an elastic load
seven, one with two springs in a row ten; Bayes's information criterion selects the model.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.optimize import least_squares
from scipy.stats import t as student

from drive_env.loops.linear_model import Plant, controllers, velocity_open_loop, velocity_plant
from mechanics.arrays import Complex, Floats, Integers
from tuning.response.held_samples import seen_by_bus

if TYPE_CHECKING:
    from drive_env.devices import Device
    from tuning.estimate import Estimate


LINEAR = 0.01  # relative error of the linear model at a line by effects that repeat: friction, cogging
VALLEY, NEIGHBOURS = 0.02, 5  # the same error, of the greatest among so many neighbours
FEWEST = 12  # least number of lines
LEAST_GAIN = 10.0  # least improvement of the criterion with which a resonance is accepted
SURE = 3.0  # standard deviations: least distance of a resonance from its anti-resonance
# Errors that repeat and are not in the linear model, as standard deviations of logarithms, and of the delay in s. Dead
# time of the bridge takes part of small currents, friction broadens a resonance.
SYSTEMATIC = {
    "inertia": 0.02, "velocity_filter": 0.04, "loop_delay": 15e-6, "anti_resonance": 0.008, "resonance": 0.004,
    "damping": 0.15,
}  # fmt: skip
# Greatest half width of an interval over the value; wider ones are refused.
WIDEST = {
    "inertia": 0.3, "velocity_filter": 0.3, "loop_delay": 0.4, "anti_resonance": 0.1, "resonance": 0.1, "damping": 2.0,
}  # fmt: skip
# s, standard deviation of the prior of the delay: without it, a few low frequencies cannot separate delay and velocity
# filter, and both are lost.
EXPECTED_DELAY = 50e-6
# Expected share, and its deviation, of the resistance that dead time may add to the winding's: currents that swing
# through zero rarely see all of it, and only this prior separates it from the lag of the velocity filter.
EXPECTED_LOSS, LOSS_SPREAD = 0.5, 0.4
LEVEL = 0.03  # greatest relative change of a resonance with the amplitude, beyond noise
DISTORTED = 0.13  # greatest relative difference of passes beyond noise
PAIR = ("anti_resonance", "resonance", "damping")
DAMPED = {"anti_resonance": 0.03, "resonance": 0.03, "damping": 0.0}  # share of the damping by which a pair may shift
ABOUT = 1.1  # of a pair: range of lines around it that show it if its frequencies are close together
SECONDS, SPACING = 6, 0.25  # number of starting points for a second pair, and their least distance (logarithmic)
RATIOS = (1.15, 1.4, 1.8, 2.6)  # of a resonance over its anti-resonance, at starting points
# Starting points of the search for a pair: the best of those around the largest swing, between the lines next to its
# ends, and of a grid over all frequencies. A lightly damped pair is found from close starting points only.
BETWEEN, DAMPINGS, LOWS, BEGINNINGS = 7, (0.005, 0.02, 0.08), 16, 5
GOOD_MISFIT = 2.0  # greatest misfit of a fit from which margins may be read between lines
RIGID_ENOUGH = 1.5  # misfit up to which no further resonance is searched
NAMES = ("inertia", "velocity_filter", "loop_delay", "anti_resonance", "resonance", "damping")
_UNITS = dict(zip(NAMES, ("kg*m^2", "Hz", "s", "Hz", "Hz", "1"), strict=True))
_FIELDS = {"loop_delay": "delay"}  # names of estimates that differ from the plant's field
NORMAL_95 = 1.96  # standard deviations to either side that contain 95 %
_LOWEST_FILTER, _HIGHEST_FILTER, _LONGEST_DELAY = 50.0, 2000.0, 5e-3


class Pair(NamedTuple):
    """An anti-resonance and the resonance above it [Hz], and their damping, in addition to those of a plant."""

    anti_resonance: float
    resonance: float
    damping: float

    def response(self, f: Floats) -> Complex:
        """Return the factor by which the pair changes velocity per torque; 1 far below."""
        swing = 2.0 * self.damping * 1j * f / self.resonance
        return np.asarray((1.0 - (f / self.anti_resonance) ** 2 + swing) / (1.0 - (f / self.resonance) ** 2 + swing))


class PlantFit(NamedTuple):
    """The fitted plant, and each parameter with its interval; `reason` says why the fit is refused, "" if it is not.

    The plant has the first pair of anti-resonance and resonance; `second` is a second one above it.
    """

    plant: Plant
    estimates: dict[str, Estimate]
    misfit: float  # RMS of the residuals over the part explained by noise and LINEAR; about 1 if the model fits
    reason: str = ""
    second: Pair | None = None
    lost: float = 0.0  # resistance that dead time adds to the winding of an excited axis [ohm]
    distortion: float = 0.0  # relative difference of passes of both directions, beyond noise

    @property
    def is_good(self) -> bool:
        """Whether the fit is good enough to read margins between lines from it."""
        return not self.reason and self.misfit <= GOOD_MISFIT

    def open_loop(self, device: Device, gains: Integers, f: Floats) -> Complex:
        """Return the velocity loop's open loop at frequencies [Hz], shape (n,)."""
        return _open_loop(device, _Model(self.plant, self.second), gains, f, self.lost)

    def drawn(self, rng: np.random.Generator, count: int) -> Iterator[PlantFit]:
        """Yield fits with each parameter drawn from its interval; refused parameters are not varied."""
        for _ in range(count):
            values = {}
            for name, estimate in self.estimates.items():
                if math.isfinite(estimate.value) and math.isfinite(estimate.high - estimate.low):
                    at = rng.normal(estimate.value, (estimate.high - estimate.low) / (2.0 * NORMAL_95))
                    values[_FIELDS.get(name, name)] = max(at, 0.1 * estimate.value)
            # If one of the two was refused it is not varied, and the other must not cross it.
            ends = [values.get(name, getattr(self.plant, name)) for name in ("anti_resonance", "resonance")]
            if not self.plant.is_elastic or ends[0] < ends[1]:
                yield self._replace(plant=replace(self.plant, **values))  # type: ignore[arg-type]  # none of them is counts


class _Model(NamedTuple):
    plant: Plant
    second: Pair | None = None
    loss: float = EXPECTED_LOSS  # share of the resistance that dead time may add


class _Solution(NamedTuple):
    model: _Model
    residuals: Floats
    jacobian: Floats  # derivatives of the residuals by the parameters in the order of `_unpack`


def _open_loop(device: Device, model: _Model, gains: Integers, f: Floats, lost: float) -> Complex:
    # The winding of a model is the data sheet's; the resistance added by dead time is included here.
    L = velocity_open_loop(device, replace(model.plant, R=model.plant.R + lost), gains, f)
    return L if model.second is None else L * model.second.response(f)


def fit_plant(
    device: Device, gains: Integers, f: Floats, seen: Complex, spread: Floats, start: Plant,
    parts: Sequence[Complex] = (), distortion: float = 0.0, lost: float = 0.0, less: Seen | None = None,
) -> PlantFit:  # fmt: skip
    """Fit the plant of one axis to its closed velocity loop as a bus sees it.

    Args:
        device: The drive.
        gains: Raw gains in force, shape (count,).
        f: Trusted frequencies [Hz], shape (n,).
        seen: Response from set-point to velocity, both as on the bus, shape (n,).
        spread: Relative standard deviation of each line, shape (n,).
        start: Plant from the data sheet.
        parts: Responses of single passes, which differ in direction, shape (n,) each. Their differences widen the
            intervals.
        distortion: Relative difference of passes beyond noise; above `DISTORTED` resonances are refused.
        lost: Resistance that dead time may add [ohm]: see `dead_time_resistance`.
        less: The same axis excited less. If that gives another resonance or none, the resonance is refused.
    """
    if len(f) < FEWEST:
        return _refusal(start, f"only {len(f)} frequencies are coherent, and {FEWEST} are needed")
    rough = _rough_loop(device, gains, f, seen)
    begin = _with_inertia(start, device, gains, f, rough)
    loop = _Loop(device, gains, f, seen, _weight(seen, spread), lost)
    best = rigid = _solve(loop, _Model(begin))
    # With a confirming measurement a resonance is searched even if a rigid axis would explain the response.
    if _misfit(rigid) > RIGID_ENOUGH or less is not None:
        ones = [_solve(loop, _Model(pair)) for pair in _candidate_pairs(loop, rough, begin)]
        best = _better(rigid, ones)
        if _misfit(best) > RIGID_ENOUGH and len(f) > 2 * FEWEST:
            best = _better(best, [_solve(loop, model) for model in _candidate_seconds(loop, ones)])
    scatter, doubt = _scatter(loop, best, spread, parts), ""
    if less is not None and best.model.plant.is_elastic:
        change, doubt = _by_level(loop, best, less)
        scatter = np.hypot(scatter, change)
    fit = _with_intervals(best, f, scatter, lost)._replace(distortion=distortion)
    # If the resonance was confirmed, passes may differ for other reasons.
    if (doubt or less is None) and distortion > DISTORTED:
        why = (
            f"the response depends on the direction of the excitation, by {100.0 * distortion:.0f} % beyond noise: "
            "with backlash or static friction, a resonance depends on the amplitude"
        )
        doubt = f"{doubt}; {why}" if doubt else why
    return _doubted(fit, doubt) if doubt else fit


def _weight(seen: Complex, spread: Floats) -> Floats:
    size = np.abs(seen)
    # In the valley of an anti-resonance only the non-linear part remains, which is small elsewhere.
    around = maximum_filter1d(size, NEIGHBOURS)
    return np.asarray(1.0 / np.sqrt(size**2 * (spread**2 / 2.0 + LINEAR**2) + (VALLEY * around) ** 2))


def _by_level(loop: _Loop, found: _Solution, less: Seen) -> tuple[Floats, str]:
    """Return changes of parameters beyond noise with less excitation, and why the resonance is refused, else ""."""
    p = _with_resonance(_pack(found.model))
    if len(less.f) < FEWEST:
        return np.zeros(len(p)), (
            f"with a weaker excitation, only {len(less.f)} frequencies are coherent, and {FEWEST} are needed to "
            "confirm it"
        )
    weight = _weight(less.seen, less.spread)
    again = _solve(loop._replace(f=less.f, seen=less.seen, weight=weight), found.model)
    q = _with_resonance(_pack(again.model))
    deviation = _deviations(again)
    change = np.abs(q - p)
    doubt = 2.0 * deviation[-1]
    if doubt > WIDEST["resonance"]:
        reason = f"with a weaker excitation, its uncertainty is {100.0 * doubt:.0f} %, which does not confirm it"
        return np.zeros(len(p)), reason
    if change[-1] > max(LEVEL, doubt):
        return np.zeros(len(p)), (
            f"it lies at {math.exp(p[-1]):.4g} Hz, and at {math.exp(q[-1]):.4g} Hz with a weaker excitation: with "
            "backlash or static friction, there is no single resonance frequency"
        )
    return np.sqrt(np.maximum(change**2 - deviation**2, 0.0)), ""


def _with_resonance(p: Floats) -> Floats:
    """Append the logarithm of an elastic axis' resonance, the sum of two parameters; 0 for a rigid axis."""
    return np.append(p, p[FIRST] + p[FIRST + 1]) if len(p) > FIRST else np.append(p, 0.0)


def _deviations(solution: _Solution) -> Floats:
    """Return the standard deviations of the parameters, and of the resonance's logarithm."""
    covariance = _covariance(solution)
    own = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if len(own) <= FIRST:
        return np.append(own, 0.0)
    both = covariance[FIRST : FIRST + 2, FIRST : FIRST + 2]
    return np.append(own, math.sqrt(max(float(both.sum()), 0.0)))


def _covariance(solution: _Solution) -> Floats:
    jacobian = solution.jacobian
    return np.asarray(np.linalg.pinv(jacobian.T @ jacobian) * max(_misfit(solution), 1.0) ** 2)


def _better(simple: _Solution, found: list[_Solution]) -> _Solution:
    """Return the best of the fits, or the simpler one if the improvement is too small."""
    sure = [solution for solution in found if _is_sure(solution)]
    best = min(sure, key=_criterion, default=simple)
    return best if _criterion(best) < _criterion(simple) - LEAST_GAIN else simple


def _scatter(loop: _Loop, found: _Solution, spread: Floats, parts: Sequence[Complex]) -> Floats:
    """Return half the difference of parameters between single passes, and between quiet lines and all lines.

    Parameters of the model, and finally the resonance's, shape (parameters + 1,).
    """
    p = _with_resonance(_pack(found.model))
    if not parts:
        return np.zeros(len(p))

    def parameters(part: _Loop) -> Floats:
        return _with_resonance(_pack(_solve(part, found.model).model))

    passes = [parameters(loop._replace(seen=part, weight=loop.weight / math.sqrt(len(parts)))) for part in parts]
    plant, quiet = found.model.plant, spread <= np.median(spread)
    if plant.is_elastic:
        # Only the few lines around a pair of close frequencies show it; without these the fit would take any other
        # pair.
        quiet |= (loop.f > plant.anti_resonance / ABOUT) & (loop.f < plant.resonance * ABOUT)
    fewer = parameters(loop._replace(f=loop.f[quiet], seen=loop.seen[quiet], weight=loop.weight[quiet]))
    return np.asarray(0.5 * np.hypot(np.ptp(passes, axis=0), fewer - p))


def _doubted(fit: PlantFit, reason: str) -> PlantFit:
    """Return a fit in which anti-resonance, resonance and damping are refused, with the reason."""
    from tuning.estimate import refused

    return fit._replace(estimates=fit.estimates | {name: refused(_UNITS[name], reason) for name in PAIR})


class Seen(NamedTuple):
    """A closed velocity loop at its trusted frequencies, shape (n,) each; fields as in `fit_plant`."""

    f: Floats  # Hz
    seen: Complex
    spread: Floats


class _Loop(NamedTuple):
    """A closed velocity loop as seen on the bus, with the weight of each line."""

    device: Device
    gains: Integers
    f: Floats
    seen: Complex
    weight: Floats
    lost: float  # ohm, as in `fit_plant`


def _solve(loop: _Loop, start: _Model) -> _Solution:
    def residuals(p: Floats) -> Floats:
        off = _residuals(loop, _unpack(p, start))
        delay = (p[2] / _SCALE - 1.0 / loop.device.velocity_rate) / EXPECTED_DELAY
        return np.concatenate([off, [delay, (p[3] - EXPECTED_LOSS) / LOSS_SPREAD]])

    p, f = _pack(start), loop.f
    pair = (math.log(f[0] / 2), 0.005, math.log(1e-3)), (math.log(2 * f[-1]), 3.0, 0.0)
    low = np.array([p[0] - 5.0, math.log(_LOWEST_FILTER), -_SCALE * 1e-3, 0.0, *pair[0], *pair[0]])[: len(p)]
    high = np.array([p[0] + 5.0, math.log(_HIGHEST_FILTER), _SCALE * _LONGEST_DELAY, 2.0, *pair[1], *pair[1]])[: len(p)]
    result = least_squares(
        residuals,
        np.clip(p, low + 1e-6, high - 1e-6),
        bounds=(low, high),
        loss="soft_l1",
        max_nfev=60,
        x_scale=np.array([0.1, 0.1, 0.1, 0.3, 0.02, 0.05, 0.3, 0.02, 0.05, 0.3])[: len(p)],
    )
    found, jacobian = _unpack(result.x, start), np.asarray(result.jac)
    if found.second is not None and found.second.anti_resonance < found.plant.anti_resonance:
        first = Pair(found.plant.anti_resonance, found.plant.resonance, found.plant.damping)
        found = _Model(replace(found.plant, **found.second._asdict()), first, found.loss)
        own = list(range(FIRST))
        jacobian = jacobian[:, [*own, *range(FIRST + 3, FIRST + 6), *range(FIRST, FIRST + 3)]]
    return _Solution(found, np.asarray(result.fun), jacobian)


def _residuals(loop: _Loop, model: _Model) -> Floats:
    def closed(at: Floats) -> Complex:
        L = _open_loop(loop.device, model, loop.gains, at, model.loss * loop.lost)
        return np.asarray(L / (1.0 + L))

    off = (seen_by_bus(loop.device, loop.f, closed) - loop.seen) * loop.weight
    return np.asarray(np.nan_to_num(np.concatenate([off.real, off.imag]), nan=1e6, posinf=1e6, neginf=-1e6))


_BEYOND = 20.0  # standard deviation of a logarithm that counts as infinite
_SCALE = 1e4  # of the delay's parameter, 1/s
FIRST = 4  # index of the first pair's first parameter; those before it are a rigid axis'


def _pack(model: _Model) -> Floats:
    plant = model.plant
    p = [math.log(plant.inertia), math.log(plant.velocity_filter), plant.delay * _SCALE, model.loss]
    if plant.is_elastic:
        p += _packed_pair(plant.anti_resonance, plant.resonance, plant.damping)
    if model.second is not None:
        p += _packed_pair(*model.second)
    return np.array(p)


def _packed_pair(anti_resonance: float, resonance: float, damping: float) -> list[float]:
    return [math.log(anti_resonance), math.log(resonance / anti_resonance), math.log(damping)]


def _unpack(p: Floats, like: _Model) -> _Model:
    known = {"inertia": math.exp(p[0]), "velocity_filter": math.exp(p[1]), "delay": p[2] / _SCALE}
    pairs = [Pair(math.exp(p[k]), math.exp(p[k] + p[k + 1]), math.exp(p[k + 2])) for k in range(FIRST, len(p), 3)]
    if pairs:
        known |= pairs[0]._asdict()
    return _Model(replace(like.plant, **known), pairs[1] if len(pairs) > 1 else None, float(p[3]))


def _misfit(solution: _Solution) -> float:
    residuals, jacobian = solution.residuals, solution.jacobian
    return math.sqrt(float(np.sum(residuals**2)) / max(len(residuals) - jacobian.shape[1], 1))


def _is_sure(solution: _Solution) -> bool:
    """Return whether every resonance is significantly apart from its anti-resonance."""
    covariance = _covariance(solution)
    p = _pack(solution.model)
    return all(bool(p[k] > SURE * math.sqrt(max(covariance[k, k], 0.0))) for k in range(FIRST + 1, len(p), 3))


def _criterion(solution: _Solution) -> float:
    n = len(solution.residuals)
    return float(n * math.log(float(np.mean(solution.residuals**2))) + solution.jacobian.shape[1] * math.log(n))


# --- starting points --------------------------------------------------------------------------------------------------
def _rough_loop(device: Device, gains: Integers, f: Floats, seen: Complex) -> Complex:
    """Return velocity per demanded current, still with the images."""
    from tuning.response.held_samples import unhold

    closed = unhold(device, f, seen, np.zeros(f.shape, complex))
    z = np.exp(2j * math.pi * f / device.velocity_rate)
    return np.asarray(closed / (1.0 - closed) / controllers(device, gains).velocity(z))


def _with_inertia(plant: Plant, device: Device, gains: Integers, f: Floats, rough: Complex) -> Plant:
    ratio = np.abs(velocity_plant(device, plant, gains, f)) / np.abs(rough)
    return replace(plant, inertia=plant.inertia * float(np.median(ratio[: max(4, len(f) // 4)])))


def _candidate_pairs(loop: _Loop, rough: Complex, rigid: Plant) -> list[Plant]:
    """Return starting points with one resonance: around the response's largest swing, and on a coarse grid."""
    device, gains, f = loop.device, loop.gains, loop.f
    level = 20.0 * np.log10(np.abs(rough / velocity_plant(device, rigid, gains, f)))
    pairs = []
    for valley in range(len(f) - 1):
        peak = valley + int(np.argmax(level[valley:]))
        pairs.append((level[peak] - level[valley], f[valley], f[peak]))
    _, valley_hz, peak_hz = max(pairs)

    def scaled(low: float, high: float, damping: float) -> Plant:
        plant = replace(rigid, anti_resonance=float(low), resonance=float(high), damping=damping)
        ratio = float(np.median(np.abs(velocity_plant(device, plant, gains, f) / rough)))
        return replace(plant, inertia=plant.inertia * ratio)

    between = np.linspace(-1.0, 1.0, BETWEEN) * float(np.median(np.diff(f)))
    near = [
        scaled(valley_hz + a, peak_hz + b, damping)
        for a, b, damping in product(between, between, DAMPINGS)
        if f[0] <= valley_hz + a < peak_hz + b
    ]
    grid = [scaled(low, low * ratio, 0.03) for low in np.geomspace(f[0], f[-1] * 0.8, LOWS) for ratio in RATIOS]
    return [
        one for some in (near, grid) for one in sorted(some, key=lambda plant: _cost(loop, _Model(plant)))[:BEGINNINGS]
    ]


def _candidate_seconds(loop: _Loop, ones: list[_Solution]) -> list[_Model]:
    """Return starting points with two resonances: the one that was found, and another below or above it."""
    models = []
    for plant in {round(one.model.plant.resonance): one.model.plant for one in ones}.values():
        mine = Pair(plant.anti_resonance, plant.resonance, min(plant.damping, 0.05))
        for low in np.geomspace(2.0 * loop.f[0], loop.f[-1] * 0.9, 24):
            for ratio in (1.08, *RATIOS):
                first, second = sorted((mine, Pair(float(low), float(low * ratio), 0.03)))
                models.append(_Model(replace(plant, **first._asdict()), second))
    # With two springs in a row the first resonance is below the second anti-resonance.
    apart = [m for m in models if m.second is not None and m.second.anti_resonance > m.plant.resonance]
    chosen: list[_Model] = []
    for model in sorted(apart, key=lambda model: _cost(loop, model)):
        # Spread over the whole range: the best starting points are often neighbours that lead nowhere.
        if all(abs(math.log(_middle(model) / _middle(other))) > SPACING for other in chosen):
            chosen.append(model)
    return chosen[:SECONDS]


def _middle(model: _Model) -> float:
    """Return the product of a starting point's two anti-resonances [Hz^2]."""
    assert model.second is not None
    return model.second.anti_resonance * model.plant.anti_resonance


def _cost(loop: _Loop, model: _Model) -> float:
    return float(np.sum(np.log1p(_residuals(loop, model) ** 2)))  # limits the cost of one line off


# --- intervals --------------------------------------------------------------------------------------------------------
def _with_intervals(solution: _Solution, f: Floats, scatter: Floats, lost: float) -> PlantFit:
    from tuning.estimate import Estimate, refused

    (plant, second, loss), residuals, jacobian = solution
    freedom = max(len(residuals) - jacobian.shape[1], 1)
    misfit = _misfit(solution)
    covariance = _covariance(solution)
    reach = float(student.ppf(0.975, freedom))
    p = _pack(solution.model)

    def positive(name: str, row: list[float], unit: str) -> Estimate:
        direction = np.array(row + [0.0] * (len(p) - len(row)))
        variance = max(float(direction @ covariance @ direction), 0.0) + SYSTEMATIC[name] ** 2
        variance += float(scatter[-1] if name == "resonance" else scatter[int(np.flatnonzero(direction)[0])]) ** 2
        if name in PAIR:
            # It is unknown which bearing or spring dissipates the energy: this shifts a well damped pair.
            variance += (DAMPED[name] * plant.damping) ** 2
        spread = math.sqrt(variance)
        half = min(reach * spread, _BEYOND)
        middle = float(direction @ p)
        return Estimate(math.exp(middle), math.exp(middle - half), math.exp(middle + half), unit)

    estimates = {
        "inertia": positive("inertia", [1.0, 0.0, 0.0], "kg*m^2"),
        "velocity_filter": positive("velocity_filter", [0.0, 1.0, 0.0], "Hz"),
    }
    half = reach * math.hypot(math.sqrt(max(float(covariance[2, 2]), 0.0)) / _SCALE, SYSTEMATIC["loop_delay"])
    estimates["loop_delay"] = Estimate(plant.delay, plant.delay - half, plant.delay + half, "s")
    if plant.is_elastic:
        own = [0.0] * FIRST
        estimates["anti_resonance"] = positive("anti_resonance", [*own, 1.0], "Hz")
        estimates["resonance"] = positive("resonance", [*own, 1.0, 1.0], "Hz")
        estimates["damping"] = positive("damping", [*own, 0.0, 0.0, 1.0], "1")
    else:
        reason = f"no resonance between {f[0]:.0f} and {f[-1]:.0f} Hz"
        if misfit > RIGID_ENOUGH:
            reason = (
                f"the response from {f[0]:.0f} to {f[-1]:.0f} Hz fits neither a rigid axis nor one with one or two "
                "springs"
            )
        estimates |= {name: refused(_UNITS[name], reason) for name in PAIR}
    estimates |= {name: _checked(name, estimate) for name, estimate in estimates.items()}
    if plant.is_elastic and plant.resonance > f[-1]:
        reason = f"it lies above {f[-1]:.0f} Hz, the highest frequency measured"
        estimates |= {name: refused(_UNITS[name], reason) for name in ("resonance", "damping")}
    return PlantFit(plant, estimates, misfit, second=second, lost=loss * lost)


def _checked(name: str, estimate: Estimate) -> Estimate:
    """Return an estimate, or its refusal if its interval is too wide."""
    from tuning.estimate import refused

    if not estimate.is_known or (estimate.high - estimate.low) / 2.0 <= WIDEST[name] * abs(estimate.value):
        return estimate
    return refused(
        estimate.unit,
        f"excitation too weak: {estimate.value:.4g} has an interval of {estimate.low:.4g} to {estimate.high:.4g}",
    )


def _refusal(plant: Plant, reason: str) -> PlantFit:
    from tuning.estimate import refused

    return PlantFit(plant, {name: refused(_UNITS[name], reason) for name in NAMES}, math.nan, reason)
