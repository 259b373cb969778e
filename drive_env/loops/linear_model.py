"""The cascade as transfer functions, exact for its sampling: of the drive's firmware without its limits.

The winding, the rotor and an elastic load are one linear system in continuous time. The current loop samples it every
tick and computes a duty that acts during the next one; the velocity and the position loop sample it once per window of
several ticks. Limits, friction, quantisation, noise, and the d axis are neglected.

    current    C(z) = P (1 + I / (1 - z^-1))           "advanced" PI of the motion chip: I is a share of P e
    velocity   C(z) = P (1 + I / (1 - z^-1)), F(z) the second-order filter of the difference of counts
    position   P

All angles are the rotor's; f is in Hz throughout.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from drive_env.devices.gains import RawGains, cascade_columns, loop_scales
from drive_env.loops.sampled import CascadeGains, LinearMachines, LoopRates, held, response, window
from drive_env.loops.sampled import mean_velocity as mean_velocity_of
from mechanics.arrays import Complex, Floats

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.motors import Motor


class KnownValue(Protocol):
    """An identified value; nan with a reason if it was refused."""

    @property
    def value(self) -> float:
        """The value."""

    @property
    def reason(self) -> str:
        """The reason of its refusal; "" if it was not refused."""


class KnownAxis(Protocol):
    """Identified values of an axis, by name."""

    @property
    def estimates(self) -> Mapping[str, KnownValue]:
        """The values."""


@dataclass(frozen=True)
class Plant:
    """One axis as controlled by its loops.

    Attributes:
        R, L: Resistance [ohm] and inductance [H] of a phase, in the torque-making axis.
        supply: Supply voltage [V].
        torque_constant: Torque per ampere of peak i_q [N*m/A].
        inertia: Total inertia at the rotor [kg*m^2].
        viscous: Viscous friction at the rotor [N*m*s/rad].
        anti_resonance, resonance: Frequencies of rotor and load on an elastic shaft [Hz]; infinite if rigid.
        damping: Damping ratio of the resonance.
        delay: Delay of the velocity loop in addition to current loop and filter [s]: one period, half for the
            difference of counts and half for holding its output.
        velocity_filter: Corner of the velocity filter [Hz].
        counts: Encoder counts per turn.
        emf_constant: Voltage per speed [V*s/rad]; nan: that of a PMSM, torque_constant / 1.5.

    Raises:
        ValueError: If a value is impossible for an axis.
    """

    R: float
    L: float
    supply: float
    torque_constant: float
    inertia: float
    viscous: float = 0.0
    anti_resonance: float = math.inf
    resonance: float = math.inf
    damping: float = 0.02
    delay: float = 200e-6
    velocity_filter: float = 400.0
    counts: int = 4096
    emf_constant: float = math.nan

    def __post_init__(self) -> None:
        for name in ("R", "L", "supply", "torque_constant", "inertia", "velocity_filter"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be above 0 and finite, not {getattr(self, name):g}")
        if self.is_elastic and not 0.0 < self.anti_resonance < self.resonance:
            raise ValueError(
                f"the anti-resonance, {self.anti_resonance:g} Hz, must lie above 0 and below the resonance, "
                f"{self.resonance:g} Hz; give inf for both if the load is rigid"
            )

    @property
    def is_elastic(self) -> bool:
        """Whether the load is connected by a spring."""
        return math.isfinite(self.anti_resonance) and math.isfinite(self.resonance)

    @property
    def rotor_inertia(self) -> float:
        """Return the rotor's part of the inertia [kg*m^2]; all of it if the axis is rigid."""
        return self.inertia * (self.anti_resonance / self.resonance) ** 2 if self.is_elastic else self.inertia

    @classmethod
    def from_data_sheet(cls, device: Device, motor: Motor, supply: float, inertia: float, **more: Any) -> Plant:
        """Return a rigid axis with a motor's catalogue values and the device's own delay and filter.

        Args:
            device: The drive.
            motor: The motor.
            supply: Supply voltage [V].
            inertia: Total inertia at the rotor [kg*m^2].
            more: Fields that replace these.
        """
        return cls(**_data_sheet(device, motor) | {"supply": supply, "inertia": inertia} | more)

    @classmethod
    def from_identification(cls, device: Device, motor: Motor, supply: float, identification: KnownAxis) -> Plant:
        """Return an axis as identified; refused values are the data sheet's, without an elastic pair it is rigid.

        Raises:
            ValueError: If the inertia was refused, since no loop can be computed without one.
        """
        found = {name: estimate.value for name, estimate in identification.estimates.items()}
        inertia = found.get("inertia", math.nan)
        if not math.isfinite(inertia):
            reason = getattr(identification.estimates.get("inertia"), "reason", "") or "it was not measured"
            raise ValueError(f"the axis has no identified inertia: {reason}")
        fields = {"R": "resistance", "L": "inductance", "delay": "loop_delay", "velocity_filter": "velocity_filter",
                  "damping": "damping"}  # fmt: skip
        known = {field: found[name] for field, name in fields.items() if math.isfinite(found.get(name, math.nan))}
        pair = [found.get(name, math.nan) for name in ("anti_resonance", "resonance")]
        if all(math.isfinite(frequency) for frequency in pair):
            known |= {"anti_resonance": pair[0], "resonance": pair[1]}
        viscous = found.get("viscous", math.nan)
        if math.isfinite(viscous):
            known["viscous"] = max(viscous, 0.0) * motor.torque_constant
        return cls.from_data_sheet(device, motor, supply, inertia, **known)


# --- the loops --------------------------------------------------------------------------------------------------------
def current_open_loop(device: Device, plant: Plant, gains: RawGains, f: ArrayLike) -> Complex:
    """Return the open loop of the current loop at frequencies below half its rate, with the rotor free to turn.

    Args:
        device: The drive.
        plant: The axis.
        gains: Raw integers in the order of the device's gain set.
        f: Frequencies [Hz], shape (n,).
    """
    at = _below(f, device.current_rate)
    one = linear(plant)
    T = 1.0 / device.current_rate
    Phi, Gamma, _, _ = held(one.A, one.B, one.speed, T)
    z = np.exp(2j * math.pi * at * T)
    winding = response(Phi, Gamma, one.current, z[None])[0, :, 0, 0]
    return np.asarray(controllers(device, gains).current(z) * plant.supply * winding / z)


def velocity_open_loop(device: Device, plant: Plant, gains: RawGains, f: ArrayLike) -> Complex:
    """Return the open loop of the velocity loop at frequencies below half its rate.

    Args:
        device: The drive.
        plant: The axis.
        gains: Raw integers in the order of the device's gain set.
        f: Frequencies [Hz], shape (n,).
    """
    at = _below(f, device.velocity_rate)
    z = np.exp(2j * math.pi * at / device.velocity_rate)
    return np.asarray(controllers(device, gains).velocity(z) * velocity_plant(device, plant, gains, at))


def velocity_plant(device: Device, plant: Plant, gains: RawGains, f: ArrayLike) -> Complex:
    """Return the plant of the velocity loop: filtered velocity [rad/s] per demanded current [A].

    Only the gains of the current loop matter.
    """
    at = _below(f, device.velocity_rate)
    velocity = mean_velocity(device, plant, gains, at)
    return np.asarray(velocity * velocity_filter_response(device, plant, at))


def position_open_loop(device: Device, plant: Plant, gains: RawGains, f: ArrayLike) -> Complex:
    """Return the open loop of the position loop, the velocity loop closed within, below half its rate.

    Args:
        device: The drive.
        plant: The axis.
        gains: Raw integers in the order of the device's gain set.
        f: Frequencies [Hz], shape (n,).
    """
    at = _below(f, device.velocity_rate)
    z = np.exp(2j * math.pi * at / device.velocity_rate)
    regulator = controllers(device, gains)
    # The position loop uses the angle itself: the sum of the differences.
    angle = mean_velocity(device, plant, gains, at) / device.velocity_rate / (1.0 - 1.0 / z)
    inner = regulator.velocity(z) * angle
    return np.asarray(regulator.position * inner / (1.0 + velocity_open_loop(device, plant, gains, at)))


def outer_loop(device: Device, plant: Plant, gains: RawGains, f: ArrayLike, velocity: Complex) -> Complex:
    """Return the open loop of the position loop around a given velocity loop, measured or computed.

    Args:
        device: The drive.
        plant: The axis; its velocity filter is divided out of the velocity loop, since positions do not pass it.
        gains: Raw integers in the order of the device's gain set.
        f: Frequencies [Hz], shape (n,).
        velocity: Open loop of the velocity loop there, shape (n,).
    """
    at = _below(f, device.velocity_rate)
    z = np.exp(2j * math.pi * at / device.velocity_rate)
    speed = velocity / (1.0 + velocity) / velocity_filter_response(device, plant, at)
    return np.asarray(controllers(device, gains).position * speed / (device.velocity_rate * (1.0 - 1.0 / z)))


OPEN_LOOPS = {"current": current_open_loop, "velocity": velocity_open_loop, "position": position_open_loop}


# --- their parts ------------------------------------------------------------------------------------------------------
class Controllers(NamedTuple):
    """The regulators in SI: duty per A, A per rad/s, 1/s; the integral gains are shares of P e per sample."""

    current_p: float
    current_i: float
    velocity_p: float
    velocity_i: float
    position: float

    def current(self, z: Complex) -> Complex:
        """Return the current regulator at z, duty per A."""
        return np.asarray(self.current_p * (1.0 + self.current_i / (1.0 - 1.0 / z)))

    def velocity(self, z: Complex) -> Complex:
        """Return the velocity regulator at z, A per rad/s."""
        return np.asarray(self.velocity_p * (1.0 + self.velocity_i / (1.0 - 1.0 / z)))


def controllers(device: Device, gains: RawGains) -> Controllers:
    """Return raw gains in SI; ValueError for a device whose loops differ from this model."""
    scales = loop_scales(device)
    return Controllers(*(scales[k].one_value(int(gains[k])) for k in cascade_columns(device)))


def velocity_filter_response(device: Device, plant: Plant, f: ArrayLike) -> Complex:
    """Return the response, at frequencies [Hz], of velocity filter and of the axis' delay beyond one loop period."""
    from drive_env.emulator.parameters import velocity_filter

    at = np.asarray(f, float)
    b, a1, a2 = velocity_filter(np.asarray(plant.velocity_filter), device.velocity_rate)
    back = np.exp(-2j * math.pi * at / device.velocity_rate)
    more = np.exp(-2j * math.pi * at * (plant.delay - 1.0 / device.velocity_rate))
    return np.asarray(b * (1.0 + back) ** 2 / (1.0 + a1 * back + a2 * back**2) * more)


def mean_velocity(device: Device, plant: Plant, gains: RawGains, f: Floats) -> Complex:
    """Return the difference of rotor angles over a window [rad/s] per demanded current [A], held for the window."""
    regulator = controllers(device, gains)
    at = np.ascontiguousarray(f, float).tobytes()
    return _mean_velocity(LoopRates.of(device), regulator.current_p, regulator.current_i, plant, at)


@lru_cache(maxsize=256)
def _mean_velocity(rates: LoopRates, P: float, share: float, plant: Plant, frequencies: bytes) -> Complex:
    one = np.ones((1, 1))
    gains = CascadeGains(P * one, share * one, one, one, one)
    f = np.frombuffer(frequencies)
    result = mean_velocity_of(rates, window(rates, linear(plant), gains), f[None])[0, :, 0, 0]
    result.setflags(write=False)  # every caller gets the same array
    return np.asarray(result)


def linear(plant: Plant) -> LinearMachines:
    """Return an axis as one machine of a set."""
    A, B = _machine(plant)
    rows = np.eye(len(B))[None]
    return LinearMachines(
        A[None], B[None, :, None], rows[:, [_CURRENT]], rows[:, [_SPEED]], np.array([[plant.supply]]),
        np.array([[plant.velocity_filter]]),
    )  # fmt: skip


_CURRENT, _SPEED = 0, 1  # indices of states


def _machine(plant: Plant) -> tuple[Floats, Floats]:
    """Return A, B of the states current, rotor speed, and for an elastic load its twist and its speed; input: voltage.

    The rotor's angle is not a state: with it the system would have two poles at 0 and no basis of modes.
    """
    emf = plant.torque_constant / 1.5 if math.isnan(plant.emf_constant) else plant.emf_constant
    J = plant.rotor_inertia
    size = 4 if plant.is_elastic else 2
    A = np.zeros((size, size))
    A[_CURRENT, :2] = -plant.R / plant.L, -emf / plant.L
    A[_SPEED, :2] = plant.torque_constant / J, -plant.viscous / J
    if plant.is_elastic:
        load = plant.inertia - J
        stiffness = load * (2.0 * math.pi * plant.anti_resonance) ** 2
        friction = 2.0 * plant.damping * stiffness / (2.0 * math.pi * plant.resonance)
        # States 2 and 3: twist (angle of the load ahead of the rotor), and speed of the load.
        A[1, 2], A[1, 3] = stiffness / J, friction / J
        A[1, 1] -= friction / J
        A[2, 3], A[2, 1] = 1.0, -1.0
        A[3, 2], A[3, 3], A[3, 1] = -stiffness / load, -friction / load, friction / load
    B = np.zeros(size)
    B[_CURRENT] = 1.0 / plant.L
    return A, B


def _below(f: ArrayLike, rate: float) -> Floats:
    at = np.asarray(f, float)
    if at.ndim != 1 or (at.size and not (at.min() > 0.0 and at.max() < 0.5 * rate)):
        raise ValueError(f"frequencies must be one row above 0 and below {0.5 * rate:g} Hz, half the loop's rate")
    return at


def _data_sheet(device: Device, motor: Motor) -> dict[str, Any]:
    return {
        "R": motor.R_s,
        "L": motor.L_q,
        "torque_constant": motor.torque_constant,
        "emf_constant": motor.n_p * motor.psi_m,
        "delay": 1.0 / device.velocity_rate,
        "velocity_filter": device.stage["velocity_filter"].default,
        "counts": motor.encoder_counts,
    }
