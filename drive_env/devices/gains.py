"""Raw gains of a cascade of PI loops from bandwidths, and back.

The scale is the motion chip's: with f the current bandwidth [Hz], V the supply, w_v the velocity bandwidth [rad/s], T_i
the integration time and k_v the position gain [1/s], the raw integers are

    P_T = 25600 2 pi f L / V     I_T = 65536 dt_c R / L     P_V = 8784 w_v J / K_t     I_V = 65536 dt_v / T_i
    P_P = 3.75 k_v

for a current loop of full scale 100 A; the functions take the scale from the device's data. A device names the cascade
in its `gains.toml` (`cascade = "pi"`); it may have only some of these gains, with the others fixed, and count them in
other units than the chip, named in its bindings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drive_env.devices import Device
from drive_env.devices.gain_set import FEED_FORWARD
from drive_env.dictionary.units import RPM, UNITS, Context, find_unit
from drive_env.motors import Motor
from mechanics.arrays import Floats, Integers

RAW_MAX = 32767  # the chip's registers are signed
VELOCITY_FILTER_DAMPING = 0.7
DEFAULT_INTEGRATION = 5.0  # T_i as a multiple of 1/w_v

RawGains = Sequence[int] | Integers  # in the order of the device's gain set
Part = tuple[str, str]  # of a cascade: loop, and "P" or "I"


class SiGains(NamedTuple):
    """Raw gains in SI units; nan for a gain that the drive lacks.

    torque_p [V/A], torque_integration [s], velocity_p [A s/rad], velocity_integration [s], position_p [1/s].
    """

    torque_p: float
    torque_integration: float
    velocity_p: float
    velocity_integration: float
    position_p: float


def gains_in_si(device: Device, supply: float, gains: RawGains) -> SiGains:
    """Return gains of a device's set as gains [SI] with a supply voltage [V]; an integrator that is off has time inf.

    Raises:
        ValueError: If the device names no cascade.
    """
    torque_p, torque_i, velocity_p, velocity_i, position_p = as_chip(device, gains)
    return SiGains(
        torque_p=torque_p * supply / (256.0 * device.current_full_scale),
        torque_integration=65536.0 / device.current_rate / torque_i if torque_i else math.inf,
        velocity_p=velocity_p * device.current_full_scale / (256.0 * RPM * 32768.0),
        velocity_integration=65536.0 / device.velocity_rate / velocity_i if velocity_i else math.inf,
        position_p=position_p / _POSITION_P_SCALE,
    )


def bandwidth_gains(
    device: Device,
    motor: Motor,
    inertia: float,
    *,
    current_hz: float,
    velocity_hz: float,
    position_hz: float,
    supply: float | None = None,
    integration: float = DEFAULT_INTEGRATION,
) -> Integers:
    """Return the device's gains for the bandwidths wanted, shape (count,).

    Args:
        device: The drive.
        motor: The motor.
        inertia: Total inertia, rotor and load [kg*m^2].
        current_hz: Bandwidth of the current loop [Hz].
        velocity_hz: Bandwidth of the velocity loop [Hz].
        position_hz: Gain k_v of the position loop over 2 pi [Hz].
        supply: Supply voltage [V]; the motor's own by default.
        integration: Integration time of the velocity loop as a multiple of 1/w_v.

    Raises:
        ValueError: If a gain leaves its range, or the device names no cascade.
    """
    w_v = 2.0 * math.pi * velocity_hz
    raw = (
        _torque_p_scale(device, motor, supply) * 2.0 * math.pi * current_hz,
        65536.0 / device.current_rate * motor.R_s / motor.L_q,
        _velocity_p_scale(device, motor, inertia) * w_v,
        65536.0 / device.velocity_rate * w_v / integration,
        _POSITION_P_SCALE * 2.0 * math.pi * position_hz,
    )
    own = _of_device(device, np.array(raw)).tolist()
    for gain, value in zip(device.gains.rows, own, strict=True):
        if not gain.lowest - 0.5 <= value < gain.highest + 0.5:
            raise ValueError(f"{gain.title} would be {value:.0f}, outside 1...{gain.highest}; choose another bandwidth")
    return np.array([round(value) for value in own], np.int64)


# --- the baseline rule ------------------------------------------------------------------------------------------------
class Rule(NamedTuple):
    """A rule that computes gains from the identified total inertia and the motor's data sheet.

    With T the sum of the small time constants:

        w_v = speed / T    T_i = integration / w_v    k_v = position * w_v

    current_hz is the bandwidth of the current loop [Hz].
    """

    current_hz: float
    speed: float
    integration: float
    position: float


# Standard dynamics (drive_env/loops/dynamics.py) on rigid axes, by inertia and lags alone, on drawn machines of all
# drives and motors (tests/tune/test_baseline_rule.py): at least 51 degrees, 16 dB and Ms 1.5 with the velocity filter
# as shipped, 48 degrees and 10 dB with the slowest, 150 Hz, of which no drive tells; their variants keep theirs, too.
# With the filter as shipped alone 0.48, 3 and 0.6 would do: J is half, and a trial is stopped by the ripple that an
# encoder of 4096 counts makes, from a speed of 0.3 on. A current loop by its own lags (1100...1400 Hz) is no better.
# The rule cannot know two effects: few counts of an encoder make the current swing at rest (qube_servo_3, 2048), and a
# spring near the velocity loop makes it oscillate.
BASELINE_RULE = Rule(current_hz=1000.0, speed=0.25, integration=4.0, position=0.6)


def rule_gains(
    device: Device, motor: Motor, inertia: ArrayLike, rule: Rule = BASELINE_RULE, *, supply: float | None = None
) -> Integers:
    """Return a rule's raw gains, shape (n, count) in the order of the device's set, clipped to their ranges.

    Args:
        device: The drive.
        motor: The motor, by its data sheet.
        inertia: Total inertia, rotor and load [kg*m^2], shape (n,). A drive measures inertia over torque constant;
            multiplied by the data sheet's torque constant, it gives the right gains even if the motor's actual constant
            differs.
        rule: The rule's constants.
        supply: Supply voltage [V]; the motor's own by default.

    Raises:
        ValueError: If the device names no cascade.
    """
    J = np.atleast_1d(np.asarray(inertia, float))
    small = float(small_time_constants(device, device.stage["velocity_filter"].default, rule.current_hz))
    w_v = rule.speed / small
    raw = np.stack(
        [
            np.full_like(J, _torque_p_scale(device, motor, supply) * 2.0 * math.pi * rule.current_hz),
            np.full_like(J, 65536.0 / device.current_rate * motor.R_s / motor.L_q),
            _velocity_p_scale(device, motor, 1.0) * J * w_v,
            np.full_like(J, 65536.0 / device.velocity_rate * w_v / rule.integration),
            np.full_like(J, _POSITION_P_SCALE * rule.position * w_v),
        ],
        axis=-1,
    )
    return device.gains.clipped(_of_device(device, raw))


def small_time_constants(device: Device, velocity_filter: ArrayLike, current_hz: float = 1000.0) -> Floats:
    """Return the sum of the small time constants of the velocity loop [s].

    They are the lag of the current loop, one and a half PWM periods until the voltage acts, the velocity filter's
    delay, and one period of the velocity loop: half for the difference of counts, half for holding its output.

    Args:
        device: The drive.
        velocity_filter: Corner frequency of the velocity filter [Hz].
        current_hz: Bandwidth of the current loop [Hz].
    """
    from drive_env.devices.gains import VELOCITY_FILTER_DAMPING  # imports the compiler

    filters = 2.0 * VELOCITY_FILTER_DAMPING / (2.0 * math.pi * np.asarray(velocity_filter, float))
    return np.asarray(1.0 / (2.0 * math.pi * current_hz) + 1.5 / device.current_rate + filters
                      + 1.0 / device.velocity_rate)  # fmt: skip


# --- other devices' gains ---------------------------------------------------------------------------------------------
PI = "pi"  # the cascade's name in a device's data
# The chip's gains in their order, torque, velocity, position: loop and part, and their unit.
_CHIP = {
    ("current", "P"): "current P",
    ("current", "I"): "I",
    ("velocity", "P"): "velocity P",
    ("velocity", "I"): "I",
    ("position", "P"): "position P",
}


def check_linear_model(device: Device) -> None:
    """Raise ValueError unless a device's loops are those of the linear model: every gain of the cascade, once."""
    if lacks := _lacks(device):
        raise ValueError(
            f"{device.name}: this drive has no linear model of its loops: {lacks}; drive-tune sweep and auto --by tpe "
            "need none, and find gains by trials"
        )


def has_linear_model(device: Device) -> bool:
    """Return whether a device's loops are those of the linear model."""
    return not _lacks(device)


def _lacks(device: Device) -> str:
    """Return the parts that a device lacks for the linear model; "" if it lacks none."""
    if device.gains.cascade != PI:
        return "its gains.toml names no cascade"
    own = [(row.loop, row.part) for row in device.gains.rows if (row.loop, row.part) != FEED_FORWARD]
    missing = [f"{part} of the {loop} loop" for loop, part in _CHIP if (loop, part) not in own]
    if missing:
        return f"its gains.toml has no {', no '.join(missing)}"
    return "" if len(own) == len(_CHIP) else f"its gains.toml has {len(own)} gains, and the cascade {len(_CHIP)}"


def cascade_columns(device: Device) -> list[int]:
    """Return the columns of the cascade in a device's gain set: P, I of current, P, I of velocity, P of position.

    Raises:
        ValueError: If the drive has no linear model of its loops.
    """
    check_linear_model(device)
    own = [(row.loop, row.part) for row in device.gains.rows]
    return [own.index(part) for part in _CHIP]


class GainScale(NamedTuple):
    """Converts a gain's integers to another unit: raw = per * value^power. 0 stays 0, and means off."""

    per: float
    power: float  # 1, or -1 if the integers count a time

    def raw(self, value: ArrayLike) -> Floats:
        """Return the integers of values, not rounded."""
        return self._along(self.per, value)

    def value(self, raw: ArrayLike) -> Floats:
        """Return the values of integers."""
        return self._along(self.per**-self.power, raw)

    def one_value(self, raw: int) -> float:
        """Return the value of one integer, as `value` does."""
        return self.per**-self.power * raw**self.power if raw else 0.0

    def _along(self, per: float, x: ArrayLike) -> Floats:
        given = np.asarray(x, float)
        return np.where(given == 0.0, 0.0, per * np.where(given == 0.0, 1.0, given) ** self.power)


def loop_scales(device: Device) -> list[GainScale]:
    """Return the scale of each gain to the loops' units: duty/A, A s/rad, 1/s; for an I the share of P e per sample."""
    context, found = _context(device), []
    rates = {"current": device.current_rate, "velocity": device.velocity_rate}
    for row in device.gains.rows:
        factor = float(find_unit(device.bindings[row.key].unit).factor(context))
        found.append(GainScale(1.0 / (rates[row.loop] * factor), -1.0) if row.is_time else GainScale(1.0 / factor, 1.0))
    return found


def per_chip(device: Device) -> dict[Part, GainScale]:
    """Return the scale of a device's integers to the chip's, by loop and part; exactly 1 for equal units.

    Feed-forward, which the chip does not have, is left out.

    Raises:
        ValueError: If the device names no cascade, or has a gain that the cascade lacks, or a gain twice.
    """
    known = device.gains
    if known.cascade != PI:
        raise ValueError(
            f"{device.name} names no cascade of its loops, so that no gains follow from its motor; give its gains.toml "
            f'cascade = "{PI}" if its loops are that one, or set gains by hand and use drive-tune sweep'
        )
    context = _context(device)
    scales: dict[Part, GainScale] = {}
    for row, own in zip(known.rows, loop_scales(device), strict=True):
        part = row.loop, row.part
        if part == FEED_FORWARD:
            continue
        if part not in _CHIP:
            raise ValueError(
                f"{device.name}: gains.toml: {row.name} is {row.part} of the {row.loop} loop, which the cascade "
                f'"{PI}" does not have; it has {", ".join(f"{p} of {loop}" for loop, p in _CHIP)}'
            )
        if part in scales:
            raise ValueError(
                f"{device.name}: gains.toml: {row.name} is a second {row.part} of the {row.loop} loop; the cascade "
                f'"{PI}" has one'
            )
        scales[part] = GainScale(float(own.raw(UNITS[_CHIP[part]].factor(context))), own.power)
    return scales


def as_chip(device: Device, gains: RawGains) -> list[float]:
    """Return gains of a device's set in the chip's units, in the order of `Gains`; nan for one that the device lacks.

    Raises:
        ValueError: If the device names no cascade.
    """
    scales = per_chip(device)
    given = {(row.loop, row.part): raw for row, raw in zip(device.gains.rows, gains, strict=True)}
    return [float(scales[part].value(given[part])) if part in scales else math.nan for part in _CHIP]


def si_scales(device: Device, supply: float) -> dict[Part, GainScale]:
    """Return the scale of a device's integers to SI, by loop and part; for an I to 1/T_i [1/s].

    P of current [V/A], of velocity [A s/rad], of position [1/s]; the supply [V] is the drive's.

    Raises:
        ValueError: If the device names no cascade.
    """
    chip = {
        ("current", "P"): 256.0 * device.current_full_scale / supply,  # Q8.8, duty of the supply per full scale
        ("current", "I"): 65536.0 / device.current_rate,
        ("velocity", "P"): 256.0 * RPM * 32768.0 / device.current_full_scale,
        ("velocity", "I"): 65536.0 / device.velocity_rate,
        ("position", "P"): _POSITION_P_SCALE,
    }
    return {part: GainScale(float(own.raw(chip[part])), own.power) for part, own in per_chip(device).items()}


def _of_device(device: Device, raw: Floats) -> Floats:
    """Convert raw gains of the chip, shape (..., 5), to a device's units, (..., count).

    A feed-forward, which the chip does not have, is 0.
    """
    order, scales = list(_CHIP), per_chip(device)
    none = np.zeros(raw.shape[:-1])
    parts = [(row.loop, row.part) for row in device.gains.rows]
    return np.stack([scales[p].raw(raw[..., order.index(p)]) if p in scales else none for p in parts], axis=-1)


def _context(device: Device) -> Context:
    return Context(65536.0, device.current_full_scale / 32768.0)


_POSITION_P_SCALE = 4096.0 * 2.0 * math.pi / 65536.0 / RPM  # raw per 1/s


def _torque_p_scale(device: Device, motor: Motor, supply: float | None) -> float:
    """Return raw torque P per rad/s of bandwidth."""
    return 256.0 * device.current_full_scale * motor.L_q / (motor.voltage if supply is None else supply)


def _velocity_p_scale(device: Device, motor: Motor, inertia: float) -> float:
    """Return raw velocity P per rad/s of bandwidth."""
    return 256.0 * RPM * 32768.0 / device.current_full_scale * inertia / motor.torque_constant
