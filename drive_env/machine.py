"""The emulated machines' side that no bus shows: true parameters, disturbances, supply, power.

A task may use it to make a world, never to act; `drives.machine` is None on a real drive.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drive_env import motors
from drive_env.devices import Device
from drive_env.firmware.record import STATE, get_lanes, set_lanes
from drive_env.motors import Motor
from mechanics.loads import Load

if TYPE_CHECKING:
    from drive_env.drives import EmulatedDrives

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

VELOCITY_FILTER_DAMPING = 0.7


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

    Raises:
        ValueError: If a name is none of a group or parameter.
    """
    chosen = _chosen(table, randomise)
    shares = np.empty((len(machines), len(table)))
    noise = np.empty(len(machines))
    for k, number in enumerate(machines):
        if k > 0 and number == machines[k - 1]:
            noise[k], shares[k] = noise[k - 1], shares[k - 1]
            continue
        generator = np.random.default_rng((seed, number))
        noise[k] = generator.integers(1, 2**32)
        shares[k] = generator.random(len(table))
    values: dict[str, Floats] = {}
    for k, row in enumerate(table.values()):
        if row.name in chosen:
            values[row.name] = row.low + shares[:, k] * (row.high - row.low)
        else:
            values[row.name] = np.full(len(machines), row.ideal if ideal else row.default)
    return values, noise


# Parameters that may be negative: errors, offsets and phases. Those that may be 0: losses and faults. All others are
# positive.
_SIGNED = ("offset", "error", "phase", "ambient")
_MAY_VANISH = (
    "cogging_torque", "coulomb", "breakaway", "viscous", "damping", "stiffness", "broken", "open_a", "open_b",
    "short_conductance", "noise", "dead_time", "resistance",
    "supply_sinks",
)  # fmt: skip


def check_parameter(name: str, values: Floats) -> None:
    """Raise ValueError unless every value is one that a machine can have."""
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name} must be finite, not {values[~np.isfinite(values)][0]}")
    if any(word in name for word in _SIGNED) or values.size == 0:
        return
    if name == "stage.adc_bits" and values.min() < 1.0:
        raise ValueError(f"{name} must be 1 or more, not {values.min():g}")
    if any(name.endswith(word) for word in _MAY_VANISH):
        if values.min() < 0.0:
            raise ValueError(f"{name} must be 0 or more, not {values.min():g}")
    elif values.min() <= 0.0:
        raise ValueError(f"{name} must be above 0, not {values.min():g}")


def _chosen(table: Mapping[str, MachineParameter], randomise: bool | Collection[str]) -> set[str]:
    if isinstance(randomise, bool):
        return set(table) if randomise else set()
    groups = {name.split(".")[0] for name in table}
    chosen: set[str] = set()
    for wanted in (randomise,) if isinstance(randomise, str) else randomise:
        if wanted not in table and wanted not in groups:
            raise ValueError(
                f"nothing to randomise is named {wanted!r}; there are {', '.join(sorted(groups))} and "
                f"{', '.join(table)}"
            )
        chosen |= {name for name in table if name == wanted or name.split(".")[0] == wanted}
    return chosen


class Machines:
    """The emulated machines behind drives: one value per machine, shape (num_machines,), unless said otherwise."""

    def __init__(self, drives: EmulatedDrives) -> None:
        self._drives = drives

    @property
    def parameters(self) -> dict[str, Floats]:
        """True parameters by name [SI], each of shape (num_machines,)."""
        return {name: values.copy() for name, values in self._drives._parameters.items()}

    @property
    def diverged(self) -> Mask:
        """Which machines left physics and are frozen, shape (num_machines,)."""
        return np.concatenate([group.load.plant.diverged != 0 for group in self._drives._groups])

    @property
    def load_torque(self) -> Floats:
        """External torque on the load [N*m], shape (num_machines,); set it to a value or one per machine."""
        return np.concatenate([group.load.plant.load_torque for group in self._drives._groups])

    @load_torque.setter
    def load_torque(self, value: ArrayLike) -> None:
        values = self._per_machine(value, "load torque")
        for group in self._drives._groups:
            group.load.plant.load_torque[:] = values[group.machines]

    @property
    def supply(self) -> Floats:
        """Open-circuit supply voltage [V], shape (num_axes,)."""
        return self._axis_field("supply_voltage")

    @supply.setter
    def supply(self, value: ArrayLike) -> None:
        drives = self._drives
        volts = np.broadcast_to(np.asarray(value, float), (drives.num_axes,))
        if not np.all(np.isfinite(volts)) or np.any(volts < 0.0):
            raise ValueError(f"supply voltage must be 0 V or more, not {np.min(volts):g} V")
        set_lanes(drives._records, "supply_voltage", volts)

    @property
    def rotor_angle(self) -> Floats:
        """True rotor angle [rad], shape (num_axes,)."""
        return self._axis_field("theta_m")

    @property
    def rotor_speed(self) -> Floats:
        """True rotor speed [rad/s], shape (num_axes,)."""
        return self._axis_field("omega_m")

    @property
    def motor_torque(self) -> Floats:
        """True motor torque, mean of the last current tick [N*m], shape (num_axes,)."""
        return self._axis_field("tau_m")

    @property
    def switches(self) -> NDArray[np.int64]:
        """Inputs as the load presses them, bits of 60FDh, shape (num_axes,)."""
        return self._axis_field("inputs").astype(np.int64)

    @property
    def enable_input(self) -> Mask:
        """Whether the enable input is closed, shape (num_axes,); set it to a value or one per axis."""
        return self._axis_field("enable_input") > 0

    @enable_input.setter
    def enable_input(self, value: ArrayLike) -> None:
        drives = self._drives
        closed = np.broadcast_to(np.asarray(value, bool), (drives.num_axes,))
        set_lanes(drives._records, "enable_input", closed.astype(np.int32))

    @property
    def temperatures(self) -> tuple[Floats, Floats]:
        """Winding and stage temperature [degC], each of shape (num_axes,)."""
        return self._axis_field("T_winding"), self._axis_field("T_stage")

    def set_temperatures(self, winding: ArrayLike, stage: ArrayLike) -> None:
        """Set winding and stage temperature [degC], as if the axis had worked before."""
        for name, value in (("T_winding", winding), ("T_stage", stage)):
            values = np.broadcast_to(np.asarray(value, float), (self._drives.num_axes,))
            set_lanes(self._drives._records, name, values)

    def set(self, name: str, value: ArrayLike, where: Mask | None = None) -> None:
        """Set a true parameter [SI] of the machines where the mask is true; bad input changes nothing.

        Raises:
            ValueError: If there is no such parameter, the value is not finite, or no machine can have it.
        """
        drives = self._drives
        if name not in drives._parameters:
            raise ValueError(f"machines have no parameter {name!r}; they have {', '.join(drives._parameters)}")
        mask = self._mask(where)
        check_parameter(name, self._per_machine(value, name)[mask])
        values = np.where(mask, self._per_machine(value, name), drives._parameters[name])
        drives._apply_parameter(name, values, mask)
        drives._parameters[name] = values

    def reset(self, where: Mask | None = None) -> None:
        """Put machines to rest at zero and switch their drives on anew; a diverged machine lives again."""
        mask = self._mask(where)
        drives = self._drives
        for group in drives._groups:
            group.load.reset(mask[group.machines])
        axes = np.repeat(mask, drives.num_axes // drives.num_machines)
        for field in STATE:
            for part in range(field.depth):
                set_lanes(drives._records, field.name, np.full(drives.num_axes, field.initial), axes, part)
        set_lanes(drives._records, "random", drives._noise_seeds, axes)
        drives._reported[mask] = False
        drives._restart(axes)

    def power_cycle(self, where: Mask | None = None) -> None:
        """Switch the supply of the drives off and on: stored values return, counters and positions start at zero."""
        drives = self._drives
        drives._restart(np.repeat(self._mask(where), drives.num_axes // drives.num_machines))

    def _axis_field(self, name: str) -> Floats:
        return get_lanes(self._drives._records, name, self._drives.num_axes).astype(float)

    def _mask(self, where: Mask | None) -> Mask:
        if where is None:
            return np.ones(self._drives.num_machines, bool)
        mask = np.asarray(where)
        if mask.shape != (self._drives.num_machines,) or mask.dtype != bool:
            raise ValueError(
                f"where must be a boolean array of shape ({self._drives.num_machines},), not {mask.dtype} {mask.shape}"
            )
        return mask

    def _per_machine(self, value: ArrayLike, name: str) -> Floats:
        values = np.asarray(value, float)
        if values.shape not in ((), (self._drives.num_machines,)):
            raise ValueError(
                f"{name} takes one value or one for each of {self._drives.num_machines} machines, not shape "
                f"{values.shape}"
            )
        if np.any(np.isnan(values)):
            raise ValueError(f"{name} must be a number, not nan")
        return np.broadcast_to(values, (self._drives.num_machines,)).copy()


def velocity_filter(cutoff: Floats, rate: float) -> tuple[Floats, Floats, Floats]:
    """Return b, a1, a2 of the second-order low-pass b (1 + z^-1)^2 / (1 + a1 z^-1 + a2 z^-2), bilinear, prewarped.

    Args:
        cutoff: Corner frequency [Hz], below half the rate.
        rate: Sampling rate [Hz].
    """
    K = np.tan(np.pi * cutoff / rate)
    norm = 1.0 / (1.0 + 2.0 * VELOCITY_FILTER_DAMPING * K + K * K)
    return K * K * norm, 2.0 * (K * K - 1.0) * norm, (1.0 - 2.0 * VELOCITY_FILTER_DAMPING * K + K * K) * norm


def apply_to_records(drives: EmulatedDrives, name: str, values: Floats, axes: Mask) -> bool:
    """Write a motor or stage parameter into the records; return False for one that is the mechanics'."""
    records, device = drives._records, drives.device
    if name in _FIELDS:
        field, part = _FIELDS[name]
        set_lanes(records, field, values, axes, part)
        if name in _AT_TEMPERATURE:
            # The thermal model sets the live value once a millisecond; until then it is the one at 25 degC.
            set_lanes(records, _AT_TEMPERATURE[name], values, axes)
        return True
    special: dict[str, Callable[[], None]] = {
        "motor.encoder_interpolation": lambda: _set_encoder(drives, values, axes),
        "stage.dead_time": lambda: set_lanes(records, "dead_time_duty", values * device.current_rate, axes),
        "stage.adc_gain_error_a": lambda: set_lanes(records, "adc_gain", 1.0 + values, axes, 0),
        "stage.adc_gain_error_b": lambda: set_lanes(records, "adc_gain", 1.0 + values, axes, 1),
        "stage.adc_bits": lambda: _set_adc(drives, values, axes),
        "stage.velocity_filter": lambda: _set_filter(drives, values, axes),
    }
    if name not in special:
        return False
    special[name]()
    return True


def _set_encoder(drives: EmulatedDrives, interpolation: Floats, axes: Mask) -> None:
    set_lanes(drives._records, "encoder_interpolation", interpolation, axes)
    set_lanes(drives._records, "encoder_counts", drives.motor.encoder_counts * interpolation, axes)


def _set_adc(drives: EmulatedDrives, bits: Floats, axes: Mask) -> None:
    set_lanes(drives._records, "adc_step", 2.0 * drives.device.current_full_scale / 2.0**bits, axes)
    set_lanes(drives._records, "adc_step_lsb", 65536.0 / 2.0**bits, axes)


def _set_filter(drives: EmulatedDrives, cutoff: Floats, axes: Mask) -> None:
    limit = 0.45 * drives.device.velocity_rate
    if np.any(cutoff[axes] > limit) or np.any(cutoff[axes] <= 0.0):
        worst = cutoff[axes][np.argmax(np.abs(cutoff[axes] - 0.5 * limit))]
        raise ValueError(f"stage.velocity_filter must lie above 0 and up to {limit:.0f} Hz, not {worst:g} Hz")
    b, a1, a2 = velocity_filter(cutoff, drives.device.velocity_rate)
    set_lanes(drives._records, "velocity_filter_b", b, axes)
    set_lanes(drives._records, "velocity_filter_a", a1, axes, 0)
    set_lanes(drives._records, "velocity_filter_a", a2, axes, 1)
