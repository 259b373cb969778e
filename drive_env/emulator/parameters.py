"""True parameters of emulated machines: the table of them, drawing a machine, and bringing values into the records."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env import motors
from drive_env.devices import Device
from drive_env.emulator.machine_numbers import machine_numbers
from drive_env.firmware.record import get_lanes, set_lanes
from drive_env.firmware.servo.sensors import encoder_count
from drive_env.motors import Motor
from mechanics.load import Load
from mechanics.near_names import did_you_mean

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Records = NDArray[np.void]

VELOCITY_FILTER_DAMPING = 0.7


# How a motor's cable is wired, each 0 or 1: what 2080h:01, 2070h:01 and 2070h:02 must say for the motor to turn.
WIRING = ("motor.encoder_direction", "motor.hall_polarity", "motor.hall_direction")


class MachineParameter(NamedTuple):
    """A number of the machine that may be set: default, range of randomisation, value of an ideal machine, unit."""

    name: str
    unit: str
    default: float
    low: float
    high: float
    ideal: float


# Parameters that are a field of the record as they stand: name -> (field, part).
_FIELDS = {
    "motor.R_s": ("R_nominal", 0),
    "motor.L_d": ("L_d", 0),
    "motor.L_q": ("L_q", 0),
    "motor.psi_m": ("psi_nominal", 0),
    "motor.thermal_resistance": ("thermal_resistance", 0),
    "motor.thermal_time": ("thermal_time", 0),
    "motor.ambient": ("ambient", 0),
    "motor.hall_polarity": ("hall_true_polarity", 0),
    "motor.hall_direction": ("hall_true_direction", 0),
    "motor.hall_offset": ("hall_true_offset", 0),
    "motor.hall_broken": ("hall_broken", 0),
    "motor.encoder_broken": ("encoder_broken", 0),
    "motor.open_a": ("open_a", 0),
    "motor.open_b": ("open_b", 0),
    "motor.cogging_torque": ("cogging_torque", 0),
    "motor.cogging_phase": ("cogging_phase", 0),
    "motor.encoder_line_error": ("encoder_line_error", 0),
    "motor.encoder_line_phase": ("encoder_line_phase", 0),
    "motor.commutation_offset": ("commutation_offset", 0),
    "stage.dead_time_current": ("dead_time_current", 0),
    "stage.adc_noise": ("adc_noise", 0),
    "stage.adc_offset_a": ("adc_offset_error", 0),
    "stage.adc_offset_b": ("adc_offset_error", 1),
    "stage.supply_resistance": ("supply_resistance", 0),
    "stage.dc_capacitance": ("dc_capacitance", 0),
    "stage.chopper_resistance": ("chopper_resistance", 0),
    "stage.idle_current": ("idle_current", 0),
    "stage.supply_sinks": ("supply_sinks", 0),
    "stage.on_resistance": ("on_resistance", 0),
    "stage.thermal_resistance": ("stage_thermal_resistance", 0),
    "stage.thermal_time": ("stage_thermal_time", 0),
    "stage.short_conductance": ("short_conductance", 0),
}


_AT_TEMPERATURE = {"motor.R_s": "R_s", "motor.psi_m": "psi_m"}


def parameter_table(
    device: Device, motor: Motor, load: Load, load_defaults: Mapping[str, float]
) -> dict[str, MachineParameter]:
    """Return every parameter of a machine by name: `motor.`, `stage.` and `load.` with a dot."""
    rows: list[MachineParameter] = []
    for name in ("R_s", "L_d", "L_q", "psi_m", "inertia", "cogging_torque", "coulomb", "viscous"):
        value = getattr(motor, name)
        low, high = motors.RANGES[name]
        faultless = 0.0 if name in ("cogging_torque", "coulomb", "viscous") else value
        rows.append(MachineParameter(f"motor.{name}", _MOTOR_UNITS[name], value, low * value, high * value, faultless))
    for name in ("encoder_line_error", "commutation_offset"):
        value = getattr(motor, name)
        low, high = motors.RANGES[name]
        rows.append(MachineParameter(f"motor.{name}", "rad", value, low * value, high * value, 0.0))
    for name in ("cogging_phase", "encoder_line_phase"):
        rows.append(MachineParameter(f"motor.{name}", "rad", 0.0, 0.0, 2.0 * np.pi, 0.0))
    for name, unit, value in (
        ("thermal_time", "s", motor.thermal_time),
        ("ambient", "degC", 25.0),
        ("hall_offset", "rad", 0.0),
        # Broken cables: 1 is broken. Never drawn: a world with faults is made on purpose.
        ("hall_broken", "1", 0.0),
        ("encoder_broken", "1", 0.0),
        ("open_a", "1", 0.0),
        ("open_b", "1", 0.0),
    ):
        rows.append(MachineParameter(f"motor.{name}", unit, value, value, value, value))
    # An ideal winding does not warm.
    heat = motor.thermal_resistance
    rows.append(MachineParameter("motor.thermal_resistance", "K/W", heat, 0.7 * heat, 1.4 * heat, 0.0))
    rows.append(MachineParameter("stage.short_conductance", "S", 0.0, 0.0, 0.0, 0.0))
    rows.append(MachineParameter("motor.encoder_interpolation", "1", 1.0, 1.0, 1.0, 4096.0))
    rows += [
        MachineParameter(f"stage.{name}", row.unit, row.default, row.low, row.high, row.ideal)
        for name, row in device.stage.items()
    ]
    for parameter in load.parameters:
        value = load_defaults[parameter.name]
        rows.append(
            MachineParameter(
                f"load.{parameter.name}", parameter.unit, value, parameter.low * value, parameter.high * value, value
            )
        )
    # Last, so that all others are drawn as they were without them.
    for name in WIRING:
        wired = float(getattr(motor, name.removeprefix("motor.")))
        rows.append(MachineParameter(name, "1", wired, 0.0, 1.0, wired))
    return {row.name: row for row in rows}


_MOTOR_UNITS = {
    "R_s": "ohm", "L_d": "H", "L_q": "H", "psi_m": "V*s", "inertia": "kg*m^2", "cogging_torque": "N*m",
    "coulomb": "N*m", "viscous": "N*m*s/rad",
}  # fmt: skip


def draw_parameters(
    table: Mapping[str, MachineParameter],
    seed: int,
    machines: Sequence[int],
    randomise: bool | Collection[str],
    ideal: bool,
    *,
    wired_as_known: bool = False,
) -> tuple[dict[str, Floats], Floats]:
    """Return each machine's parameters, and the seed of its noise, shape (machines,).

    A machine is known by its number: machine 5 of a set is the same machine in every set with that seed, and which
    parameters are drawn changes nothing about the others.

    Args:
        table: The parameters there are.
        seed: Seed of the set.
        machines: Numbers of the machines.
        randomise: True draws all, False none; or names, a group's ("load") or a parameter's ("load.inertia").
        ideal: Use ideal values in place of defaults.
        wired_as_known: Draw no wiring unless it is named itself: for drives that were commissioned for the motor's.

    Raises:
        ValueError: If a name is none of a group or parameter.
    """
    chosen = _chosen(table, randomise)
    if wired_as_known:
        named = () if isinstance(randomise, bool) else (randomise,) if isinstance(randomise, str) else randomise
        chosen -= {name for name in WIRING if name not in named}
    noise, shares = machine_numbers(seed, machines, len(table))
    values: dict[str, Floats] = {}
    for k, row in enumerate(table.values()):
        if row.name in chosen:
            values[row.name] = row.low + shares[:, k] * (row.high - row.low)
            if row.name in WIRING:
                values[row.name] = np.rint(values[row.name])
        else:
            values[row.name] = np.full(len(machines), row.ideal if ideal else row.default)
    return values, noise


# Parameters that may be negative: errors, offsets and phases. Those that may be 0: losses and faults. All others are
# positive.
_SIGNED = ("offset", "error", "phase", "ambient")
_MAY_VANISH = (
    "cogging_torque", "coulomb", "viscous", "broken", "open_a", "open_b", "short_conductance", "noise", "dead_time",
    "resistance", "supply_sinks",
)  # fmt: skip


def check_parameter(name: str, values: Floats) -> None:
    """Raise ValueError unless every value is one that a machine can have."""
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name} must be finite, not {values[~np.isfinite(values)][0]}")
    if any(word in name for word in _SIGNED) or values.size == 0:
        return
    if name in WIRING:
        other = values[(values != 0.0) & (values != 1.0)]
        if other.size:
            raise ValueError(f"{name} must be 0 or 1, as the cable is wired, not {other[0]:g}")
        return
    if name == "stage.adc_bits" and values.min() < 1.0:
        raise ValueError(f"{name} must be 1 or more, not {values.min():g}")
    # Of a load, its field decides whether it may vanish: mechanics/load_values.py refuses a body without mass.
    if name.startswith("load.") or any(name.endswith(word) for word in _MAY_VANISH):
        if values.min() < 0.0:
            raise ValueError(f"{name} must be 0 or more, not {values.min():g}")
    elif values.min() <= 0.0:
        raise ValueError(f"{name} must be above 0, not {values.min():g}")


def check_known(name: str, known: Collection[str]) -> None:
    """Raise ValueError, with those that there are, unless machines have a parameter of that name."""
    if name not in known:
        raise ValueError(
            f"machines have no parameter {name!r}; they have {', '.join(known)}{did_you_mean(name, known)}"
        )


def _chosen(table: Mapping[str, MachineParameter], randomise: bool | Collection[str]) -> set[str]:
    if isinstance(randomise, bool):
        return set(table) if randomise else set()
    groups = {name.split(".")[0] for name in table}
    chosen: set[str] = set()
    for wanted in (randomise,) if isinstance(randomise, str) else randomise:
        if wanted not in table and wanted not in groups:
            raise ValueError(
                f"nothing to randomise is named {wanted!r}; there are {', '.join(sorted(groups))} and "
                f"{', '.join(table)}{did_you_mean(wanted, (*groups, *table))}"
            )
        chosen |= {name for name in table if name == wanted or name.split(".")[0] == wanted}
    return chosen


def velocity_filter(cutoff: Floats, rate: float) -> tuple[Floats, Floats, Floats]:
    """Return b, a1, a2 of the second-order low-pass b (1 + z^-1)^2 / (1 + a1 z^-1 + a2 z^-2), bilinear, prewarped.

    Args:
        cutoff: Corner frequency [Hz], below half the rate.
        rate: Sampling rate [Hz].
    """
    K = np.tan(np.pi * cutoff / rate)
    norm = 1.0 / (1.0 + 2.0 * VELOCITY_FILTER_DAMPING * K + K * K)
    return K * K * norm, 2.0 * (K * K - 1.0) * norm, (1.0 - 2.0 * VELOCITY_FILTER_DAMPING * K + K * K) * norm


def apply_to_records(records: Records, device: Device, motor: Motor, name: str, values: Floats, axes: Mask) -> bool:
    """Write a motor or stage parameter into the records; return False for one that is the mechanics'."""
    if name == "motor.commutation_offset":
        # A drive that runs is aligned: the error of its angle changes with the offset.
        change = values - get_lanes(records, "commutation_offset", len(values)).astype(float)
        set_lanes(records, "angle_zero", get_lanes(records, "angle_zero", len(values)).astype(float) + change, axes)
    if name in _FIELDS:
        field, part = _FIELDS[name]
        set_lanes(records, field, values, axes, part)
        if name in _AT_TEMPERATURE:
            # The thermal model sets the live value once a millisecond; until then it is the one at 25 degC.
            set_lanes(records, _AT_TEMPERATURE[name], values, axes)
        return True
    special: dict[str, Callable[[], None]] = {
        "motor.encoder_direction": lambda: change_encoder(records, "encoder_true_direction", values, axes),
        "motor.encoder_interpolation": lambda: _set_encoder(records, motor, values, axes),
        "stage.dead_time": lambda: set_lanes(records, "dead_time_duty", values * device.current_rate, axes),
        "stage.adc_gain_error_a": lambda: set_lanes(records, "adc_gain", 1.0 + values, axes, 0),
        "stage.adc_gain_error_b": lambda: set_lanes(records, "adc_gain", 1.0 + values, axes, 1),
        "stage.adc_bits": lambda: _set_adc(records, device, values, axes),
        "stage.velocity_filter": lambda: _set_filter(records, device, values, axes),
    }
    if name not in special:
        return False
    special[name]()
    return True


def change_encoder(records: Records, field: str, values: Floats, axes: Mask) -> None:
    """Let encoders count otherwise from here on, by a field of the record: what they have counted they keep."""

    def lanes(name: str) -> Floats:
        return get_lanes(records, name, len(values)).astype(float)

    def count() -> Floats:
        edges = (lanes("theta_m") + lanes("encoder_error")) * lanes("encoder_counts") / (2.0 * np.pi)
        gained, backwards = edges * lanes("encoder_gain"), lanes("encoder_true_direction")
        shown: Floats = encoder_count.py_func(gained, backwards)  # type: ignore[attr-defined]
        return shown

    before = count()
    set_lanes(records, field, values, axes)
    moved = count() - before
    for name in ("count", "count_zero"):
        set_lanes(records, name, lanes(name) + moved, axes)


def _set_encoder(records: Records, motor: Motor, interpolation: Floats, axes: Mask) -> None:
    set_lanes(records, "encoder_interpolation", interpolation, axes)
    set_lanes(records, "encoder_counts", motor.encoder_counts * interpolation, axes)


def _set_adc(records: Records, device: Device, bits: Floats, axes: Mask) -> None:
    set_lanes(records, "adc_step", 2.0 * device.current_full_scale / 2.0**bits, axes)
    set_lanes(records, "adc_step_lsb", 65536.0 / 2.0**bits, axes)


def _set_filter(records: Records, device: Device, cutoff: Floats, axes: Mask) -> None:
    limit = 0.45 * device.velocity_rate
    if np.any(cutoff[axes] > limit) or np.any(cutoff[axes] <= 0.0):
        worst = cutoff[axes][np.argmax(np.abs(cutoff[axes] - 0.5 * limit))]
        raise ValueError(f"stage.velocity_filter must lie above 0 and up to {limit:.0f} Hz, not {worst:g} Hz")
    b, a1, a2 = velocity_filter(cutoff, device.velocity_rate)
    set_lanes(records, "velocity_filter_b", b, axes)
    set_lanes(records, "velocity_filter_a", a1, axes, 0)
    set_lanes(records, "velocity_filter_a", a2, axes, 1)
