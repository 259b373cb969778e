"""Commissioning of a drive for a motor from the motor's data; used if there is no written preset.

The values are meant to move any sound machine, not to be optimal. `preset` follows a device's `commissioning.toml`:
objects in the order of writing, each with an integer, or with a quantity of the rule:

    rule = "servo"                                          # or "stepper"
    [objects]
    "Position window" = 200
    "Motor Pole Pairs" = { of = "pole_pairs" }              # a quantity of `_servo` or `_stepper`
    "Profile velocity" = { of = "speed", times = 65536, per = 60 }
    "Hall Polarity" = { of = "hall_polarity", unless = 0 }  # left out where the quantity is that

`standard_preset` needs no file: it writes the objects in a drive's bindings, each in the unit named there. With a file
(rule = "standard") the objects listed there get the given values instead, for any motor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.devices.standard_objects import HOMING_HERE
from drive_env.dictionary.codec import code_of, encode_one
from drive_env.dictionary.position_scale import position_scale, set_point_ratio, velocity_ratio
from drive_env.dictionary.roles import Role
from drive_env.dictionary.units import Context

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.dictionary.entries import Entry, ObjectDictionary
    from drive_env.motors import Motor

# Servo. Gains of the cascade for a total inertia of three rotors, the velocity loop with T_i = 5/w_v.
ROTORS = 3.0  # total inertia, in rotors
BANDWIDTHS = {"current_hz": 1000.0, "velocity_hz": 20.0, "position_hz": 5.0}
PEAK = 2.0  # of the rated current
SPEED, HOMING_SPEED, SLOW_SPEED = 0.5, 0.05, 0.01  # of the rated speed
TORQUE = 0.4  # of the rated torque, for ramps of that inertia
WINDOW = 0.003  # revolutions, of rest at a target
LAG = 10.0  # revolutions, of a following error: the loops have no feed-forward, and lag v/k_v
WINDOW_TIME = 0.002  # s
RPM = 30.0 / math.pi  # of a rad/s

# Stepper. Positions are microsteps, currents 1/255 of the largest.
FULL, STEPS = 255, 32  # the largest current, and the number of steps of the driver's current
STANDBY = 0.5  # of the run current: half the holding torque
MICROSTEPS = 8  # 2^8 of a full step
REVOLUTIONS = 2.0  # rev/s of moves, within the flat part of any row's torque
RAMP = 10.0  # rev/s^2
STOP = 100.0  # rev/s^2: a quick stop in csp and csv must stop 6,000 rpm within a second
BOW = 0.05  # s of an S-shaped ramp (6086h = 1) to its acceleration
# Blank time and off time of its chopper (TMC5160 class). In spread cycle the ripple of a phase current is at least its
# rise in the blank time, in which nothing is measured, plus its fall in both slow decays of a cycle:
#
#     ripple = (u t_blank + 2 R i t_off) / L
#
# The factory's blank time of 36 clocks and off time of 172 suit windings of some millihenries. If the ripple is more
# than `MOST_RIPPLE` of the run current, the other values in the chip's data sheet are used: a blank time of 24 clocks
# ("1 or 2 for most applications", TBL) and the off time 3 of its first example of a CHOPCONF (000100C3h). The chopper's
# frequency grows, and with it the losses of switching, which is why it is not done for every motor.
MOST_RIPPLE = 0.05  # of the run current
CLOCK = 16e6  # Hz
FACTORY_BLANK, FACTORY_OFF = 36.0, 12.0 + 32.0 * 5.0  # clocks: 2092h = 2, 2097h = 5
SHORT_BLANK, SHORT_OFF = 1, 3  # 2092h, 2097h


def preset(device: Device, motor: Motor, table: Mapping[str, Any]) -> dict[str, int]:
    """Return the values of a `commissioning.toml` for a motor: object name -> raw value, in the order of writing.

    Raises:
        ValueError: If a gain leaves the drive's range: the motor does not suit this drive; or for an unknown rule or
            quantity.
    """
    if table["rule"] == STANDARD:
        return standard_preset(device, motor, table["objects"])
    if (rule := RULES.get(table["rule"])) is None:
        raise ValueError(
            f"commissioning.toml: no rule is named {table['rule']!r}; there are {', '.join((*RULES, STANDARD))}"
        )
    quantities = rule(device, motor)
    found = {}
    for name, row in table["objects"].items():
        if isinstance(row, int):
            found[name] = row
            continue
        if row["of"] not in quantities:
            known = ", ".join(quantities)
            raise ValueError(f"commissioning.toml: {name} has no quantity {row['of']!r}; there are {known}")
        value = quantities[row["of"]]
        if value != row.get("unless"):
            found[name] = round(value * row.get("times", 1) / row.get("per", 1))
    return found


def _servo(device: Device, motor: Motor) -> dict[str, float]:
    """Return the quantities of a servo drive, rounded as people choose numbers."""
    from drive_env.devices.gains import bandwidth_gains

    brushed = motor.kind == "dc"
    ramp = TORQUE * motor.rated_torque / (ROTORS * motor.inertia)  # rad/s^2
    current = min(PEAK * motor.rated_current, device.nominal_current)  # at most the stage's continuous current
    gains = bandwidth_gains(device, motor, ROTORS * motor.inertia, **BANDWIDTHS)
    peak_ma = max(round(current * 10.0) * 100, 1)
    rated_ma = max(round(1e3 * motor.rated_current / math.sqrt(2.0)), 1)
    return {
        "motor_type": 1 if brushed else 3,
        "encoder_init_mode": 0 if brushed else 1,  # use offset
        "pole_pairs": motor.n_p,
        "encoder_direction": motor.encoder_direction,
        "encoder_counts": motor.encoder_counts,
        "hall_polarity": motor.hall_polarity,
        "hall_direction": motor.hall_direction,
        "current_ma": peak_ma,
        "rated_rms_ma": rated_ma,
        # Rounded up, so that the peak current limits alone.
        "peak_over_rated_permille": math.ceil(1e3 * peak_ma / rated_ma),
        "rated_rpm": max(motor.rated_speed * RPM, 1.0),
        "thermal_time_s": motor.thermal_time,
        **dict(zip(device.gains.names, gains.tolist(), strict=True)),
        "line_inductance_per_volt": 2e3 * motor.L_q / device.supply_of(motor),  # mH between two terminals, per V
        "electrical_time_ms": 1e3 * motor.L_q / motor.R_s,
        "speed_rpm": _rounded(max(SPEED * motor.rated_speed * RPM, 1.0), 3),
        "ramp_rpm_per_s": _rounded(ramp * RPM),
        "ramp_rev_per_s2": _rounded(ramp / (2.0 * math.pi)),
    }


def _stepper(device: Device, motor: Motor) -> dict[str, float]:
    """Return the quantities of a stepper's drive; speeds and ramps in microsteps."""
    full_steps = 4 * motor.n_p
    scale = full_steps * 2**MICROSTEPS
    # The last current setting that is not above the rated current.
    share = min(motor.rated_current / device.current_full_scale, 1.0)
    step = max(math.floor(STEPS * share), 1)
    run = step * (FULL + 1) // STEPS - 1
    current, supply = device.current_full_scale * step / STEPS, device.supply_of(motor)
    ripple = (supply * FACTORY_BLANK + 2.0 * motor.R_s * current * FACTORY_OFF) / CLOCK / motor.L_q
    short = ripple > MOST_RIPPLE * current
    return {
        "microsteps": MICROSTEPS,
        "full_steps": full_steps,
        "run_current": run,
        "standby_current": round(STANDBY * run),
        "blank_time": SHORT_BLANK if short else 0,  # 0: keep the factory's
        "off_time": SHORT_OFF if short else 0,
        "encoder_counts": motor.encoder_counts,
        "speed": round(REVOLUTIONS * scale),
        "ramp": round(RAMP * scale),
        "stop": round(STOP * scale),
        "jerk": round(round(RAMP * scale) / BOW),
        "corner_speed": round(corner_speed(motor, current, supply) / (2.0 * math.pi) * 4 * 2**MICROSTEPS),
    }


RULES = {"servo": _servo, "stepper": _stepper}
STANDARD = "standard"


def corner_speed(motor: Motor, current: float, supply: float) -> float:
    """Return the electrical speed [rad/s] at which a current [A] across the flux takes the whole supply [V].

    (R i + psi w)^2 + (L i w)^2 = u^2; the flux is that at the current. 0 if the resistance alone takes the supply.
    """
    psi = motor.psi_m / math.sqrt(1.0 + motor.saturation * current**2)
    a = psi**2 + (motor.L_q * current) ** 2
    b = motor.R_s * current * psi
    c = (motor.R_s * current) ** 2 - supply**2
    return max((math.sqrt(max(b * b - a * c, 0.0)) - b) / a, 0.0)


def _rounded(value: float, digits: int = 2) -> float:
    """Return a number with a few digits, as people choose it."""
    unit = 10.0 ** (math.floor(math.log10(value)) + 1 - digits)
    return round(value / unit) * unit


# --- any CiA 402 drive ------------------------------------------------------------------------------------------------
# Fields whose value here means no limit; an object with limits of its own may not allow it.
NO_LIMIT = ("velocity_limit", "position_min", "position_max")
SPEEDS = ("max_velocity", "homing_fast", "homing_slow")


def standard_preset(device: Device, motor: Motor, given: Mapping[str, int] | None = None) -> dict[str, int]:
    """Return object ("6081:0") -> raw value, in the order of writing.

    Args:
        device: The drive.
        motor: The motor to commission it for.
        given: Values that do not depend on the motor; None: no such values.

    Raises:
        ValueError: If a gain leaves the drive's range: the motor does not suit this drive.
    """
    from drive_env.devices.gains import bandwidth_gains

    dictionary = device.new_dictionary()
    given = dict(given or {})
    found = {key: raw for key, raw in _scale(device, dictionary, motor).items() if key not in given}
    for key, (raw, _) in _of_motor(device, motor, found | given).items():
        found.setdefault(_text(key), raw)
    gains = bandwidth_gains(device, motor, ROTORS * motor.inertia, **BANDWIDTHS)
    found |= {_text(row.key): int(raw) for row, raw in zip(device.gains.rows, gains, strict=True)}
    for index, rated in (
        (cia402.RATED_CURRENT, 1e3 * motor.rated_current),
        (cia402.RATED_TORQUE, 1e3 * motor.rated_torque),
    ):
        if dictionary.has(index) and dictionary.find(index).access not in ("ro", "const"):
            entry = dictionary.find(index)
            assert entry.low is not None and entry.high is not None, "a number"
            found[_text((index, 0))] = min(max(round(rated), 1, entry.low), entry.high)
    methods = device.allowed_values.get((cia402.HOMING_METHOD, 0), ())
    if methods and dictionary.find(cia402.HOMING_METHOD).default not in methods:
        found[_text((cia402.HOMING_METHOD, 0))] = next((one for one in HOMING_HERE if one in methods), methods[-1])
    return found | given


def beyond_limits(device: Device, motor: Motor, given: Mapping[str, int]) -> dict[Key, str]:
    """Return the objects that cannot hold what `standard_preset` would write, with what they hold instead."""
    return {key: why for key, (_, why) in _of_motor(device, motor, given).items() if why and _text(key) not in given}


def _of_motor(device: Device, motor: Motor, given: Mapping[str, int]) -> dict[Key, tuple[int, str]]:
    """Return the raw values that follow from a motor, each with the effect of its object's limits ("" if none)."""
    dictionary = device.new_dictionary()
    context = Context(_increments(device, dictionary, given), device.current_full_scale / 32768.0, device.rated_current)
    ratios = {"velocity_ratio": velocity_ratio(device.roles), "set_point_ratio": set_point_ratio(device.roles)}
    of_roles: dict[str, Any] = {
        name: scale.increments([np.array(float(given.get(_text(k), dictionary.find(k).default))) for k in scale.keys])
        for name, scale in ratios.items() if scale is not None
    }  # fmt: skip
    context = context._replace(**of_roles)
    values = _values(motor)
    found: dict[Key, tuple[int, str]] = {}
    fastest = math.inf
    # First the speed limit, since other speeds must not exceed it.
    for key, binding in sorted(device.bindings.items(), key=lambda row: row[1].field != "velocity_limit"):
        entry = dictionary.find(key)
        if binding.field not in values:
            continue
        code = code_of(entry, binding)
        value = min(values[binding.field], fastest) if binding.field in SPEEDS else values[binding.field]
        assert entry.low is not None and entry.high is not None and isinstance(entry.default, int), "a number"
        free = encode_one(code._replace(low=-(2**63), high=2**63), value, code.factor(context))
        raw = max(free, 1) if value > 0.0 and free == 0 else free
        why = ""
        if not entry.low <= raw <= entry.high:
            raw = min(max(raw, entry.low), entry.high)
            if binding.field in NO_LIMIT:
                raw = _widest(entry, binding.field)
            meant = "no limit" if binding.field in NO_LIMIT else f"{free}"
            why = f"{meant} lies outside its limits {entry.low} to {entry.high}: commissioned with {raw}"
        if is_written := entry.access not in ("ro", "const"):
            found[key] = raw, why
        limit = given.get(_text(key), raw if is_written else entry.default)
        if binding.field == "velocity_limit" and limit:
            fastest = limit * float(code.factor(context))
    return {key: found[key] for key in device.bindings if key in found}


def _widest(entry: Entry, field: str) -> int:
    """Return an object's raw value closest to no limit: its default, otherwise its widest value."""
    assert entry.low is not None and entry.high is not None and isinstance(entry.default, int), "a number"
    sign = -1 if field == "position_min" else 1
    if sign * entry.default > 0 and entry.low <= entry.default <= entry.high:
        return entry.default
    return entry.low if sign < 0 else entry.high


def _values(motor: Motor) -> dict[str, float]:
    brushed = motor.kind == "dc"
    ramp = TORQUE * motor.rated_torque / (ROTORS * motor.inertia)
    return {
        "motor_type": 1.0 if brushed else 3.0,
        "commutation_mode": 3.0,  # by the encoder
        "pole_pairs": motor.n_p,
        "encoder_direction": float(motor.encoder_direction),
        "encoder_steps": motor.encoder_counts,
        "encoder_init_mode": 0.0 if brushed else 1.0,  # use offset
        "hall_polarity": float(motor.hall_polarity),
        "hall_direction": float(motor.hall_direction),
        "i_max": PEAK * motor.rated_current,
        "max_velocity": SPEED * motor.rated_speed,
        "acceleration": ramp,
        "deceleration": ramp,
        "quick_stop_deceleration": 2.0 * ramp,
        "vl_min": 0.0,
        "vl_max": motor.rated_speed,
        "vl_min_forwards": 0.0,
        "vl_max_forwards": motor.rated_speed,
        "vl_min_backwards": 0.0,
        "vl_max_backwards": motor.rated_speed,
        "vl_reference": motor.rated_speed,
        "vl_ramp_time": motor.rated_speed / ramp,
        "vl_slow_down_time": motor.rated_speed / ramp,
        "vl_brake_time": 0.5 * motor.rated_speed / ramp,
        "vl_acceleration_speed": ramp,
        "vl_acceleration_time": 1.0,
        "vl_deceleration_speed": ramp,
        "vl_deceleration_time": 1.0,
        "vl_quick_stop_speed": 2.0 * ramp,
        "vl_quick_stop_time": 1.0,
        "homing_fast": HOMING_SPEED * motor.rated_speed,
        "homing_slow": SLOW_SPEED * motor.rated_speed,
        "homing_acceleration": ramp,
        "following_error_window": LAG * 2.0 * math.pi,
        "position_window": WINDOW * 2.0 * math.pi,
        "position_window_time": WINDOW_TIME,
        "position_min": -math.inf,
        "position_max": math.inf,
        "velocity_limit": 0.0,
    }


def _scale(device: Device, dictionary: ObjectDictionary, motor: Motor) -> dict[str, int]:
    """Return the scale of positions in encoder counts; {} if the factory's values are valid."""
    scale = position_scale(device.roles)
    if scale is None:
        return {}
    factory = [int(dictionary.find(key).default) for key in scale.keys]
    if all(value > 0 for value in factory):
        return {}
    first = motor.encoder_counts if Role.FEED not in device.roles else round(motor.encoder_counts)
    return {_text(key): round(first) if k == 0 else 1 for k, key in enumerate(scale.keys)}


def _increments(device: Device, dictionary: ObjectDictionary, found: Mapping[str, int]) -> float:
    scale = position_scale(device.roles)
    if scale is None:
        return 65536.0
    values = [found.get(_text(key), dictionary.find(key).default) for key in scale.keys]
    return float(scale.increments([np.array(float(value)) for value in values]))


def _text(key: Key) -> str:
    return f"{key[0]:04X}:{key[1]}"
