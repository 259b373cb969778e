"""True parameters of emulated machines: their table, drawing of machines, and writing values into the records."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env.devices import Device
from drive_env.devices.gains import VELOCITY_FILTER_DAMPING
from drive_env.emulator.machine_numbers import machine_numbers
from drive_env.firmware.common.encoder import encoder_count
from drive_env.firmware.record import get_lanes, set_lanes
from drive_env.motors import Motor
from mechanics.arrays import Floats, Integers, Mask
from mechanics.load import Load
from mechanics.reading.near_names import did_you_mean

Records = NDArray[np.void]
Write = Callable[[Records, Device, Motor, Floats, Mask], None]

# Wiring of a motor's cable, each 0 or 1: the values that 2080h:01, 2070h:01 and 2070h:02 need for the motor to turn.
WIRING = ("motor.encoder_direction", "motor.hall_polarity", "motor.hall_direction")


class MachineParameter(NamedTuple):
    """A parameter of the machine: default, range of randomisation, value of an ideal machine, unit."""

    name: str
    unit: str
    default: float
    low: float
    high: float
    ideal: float


class MachineKind(NamedTuple):
    """Properties of the machines of a firmware in addition to those of all machines; a row of `machine_kinds.py`.

    Attributes:
        motor_parameters: (motor) -> parameters of the motor, in the order in which they are drawn.
        wiring_parameters: (motor) -> parameters of its cables, drawn after all others.
        set_constants: (records, device, motor): writes the fields that are not parameters.
        writes: Name of a parameter -> function that writes its values, one per axis, into the records of some axes.
        noise: Field with the state of the axes' noise generator; "" without one.
        connect: (records, device, axes): connects what the axes of one drive share; None: nothing.
    """

    motor_parameters: Callable[[Motor], list[MachineParameter]]
    wiring_parameters: Callable[[Motor], list[MachineParameter]]
    set_constants: Callable[[Records, Device, Motor], None]
    writes: Mapping[str, Write]
    noise: str
    connect: Callable[[Records, Device, Mask], None] | None = None


def parameter_table(
    kind: MachineKind, device: Device, motor: Motor, load: Load, load_defaults: Mapping[str, float]
) -> dict[str, MachineParameter]:
    """Return every parameter of a machine by name, with the prefix `motor.`, `stage.` or `load.`.

    Raises:
        ValueError: If the device names a parameter of its stage that its firmware does not know.
    """
    rows = kind.motor_parameters(motor)
    for name, row in device.stage.items():
        if f"stage.{name}" not in kind.writes:
            known = sorted(one.removeprefix("stage.") for one in kind.writes if one.startswith("stage."))
            raise ValueError(
                f"{device.name}: [stage.{name}] is no parameter of firmware {device.firmware_name!r}; there are "
                f"{', '.join(known)}{did_you_mean(name, known)}"
            )
        rows.append(MachineParameter(f"stage.{name}", row.unit, row.default, row.low, row.high, row.ideal))
    for parameter in load.parameters:
        value = load_defaults[parameter.name]
        rows.append(
            MachineParameter(
                f"load.{parameter.name}", parameter.unit, value, parameter.low * value, parameter.high * value, value
            )
        )
    # Last, so that all others are drawn as without them.
    rows += kind.wiring_parameters(motor)
    return {row.name: row for row in rows}


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

    Machine 5 of a seed is the same machine in every set, and the choice of drawn parameters does not change the others.

    Args:
        table: All parameters.
        seed: Seed of the set.
        machines: Numbers of the machines.
        randomise: True draws all, False none; or names, a group's ("load") or a parameter's ("load.inertia").
        ideal: Whether to use ideal values instead of defaults.
        wired_as_known: Whether to draw wiring only if it is named itself: for drives commissioned for the motor's
            wiring.

    Raises:
        ValueError: For an unknown group or parameter.
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


# Parameters that may be negative: errors, offsets and phases. Those that may be 0: losses and faults. All others must
# be positive.
_SIGNED = ("offset", "error", "phase", "ambient", "index_angle")
_VANISHING_GROUPS = ("load.", "bus.", "fault.")  # all of their values may be 0
_MAY_VANISH = (
    "cogging_torque", "detent_torque", "saturation", "coulomb", "viscous", "broken", "open_a", "open_b",
    "short_conductance", "short_a", "short_b", "index_inverted", "brake_opens_in", "brake_closes_in", "noise",
    "dead_time", "resistance", "supply_sinks", "idle_power", "emergency_stop",
    "mains_phase_lost", "brake_switch", "brake_supply",
)  # fmt: skip


def check_one_supply(volts: Floats, links: Integers) -> None:
    """Raise ValueError for axes that share a DC link and would have different supplies [V]."""
    axes = np.flatnonzero(volts != volts[links])
    if axes.size:
        axis, first = int(axes[0]), int(links[axes[0]])
        raise ValueError(
            f"axes {first} and {axis} share a DC link, which has one supply, not {volts[first]:g} V and "
            f"{volts[axis]:g} V; give both the same"
        )


def check_parameter(name: str, values: Floats) -> None:
    """Raise ValueError unless every value is possible for a machine."""
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
    # For a load its field decides whether it may be 0: mechanics/load_values.py refuses a body without mass.
    if name.startswith(_VANISHING_GROUPS) or any(name.endswith(word) for word in _MAY_VANISH):
        if values.min() < 0.0:
            raise ValueError(f"{name} must be 0 or more, not {values.min():g}")
    elif values.min() <= 0.0:
        raise ValueError(f"{name} must be above 0, not {values.min():g}")


def check_known(name: str, known: Collection[str]) -> None:
    """Raise ValueError, listing the known ones, unless machines have a parameter of that name."""
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


def field(name: str, part: int = 0, live: str = "") -> Write:
    """Return a function that writes a parameter into a field of the record unchanged.

    Args:
        name: The field.
        part: Element of a deep field.
        live: Field that the thermal model updates once a period, initially the value at 25 degC; "" for none.
    """

    def write(records: Records, device: Device, motor: Motor, values: Floats, axes: Mask) -> None:
        set_lanes(records, name, values, axes, part)
        if live:
            set_lanes(records, live, values, axes)

    return write


def change_encoder(records: Records, field: str, values: Floats, axes: Mask) -> None:
    """Change how encoders count from now on, by a field of the record; their present counts stay."""

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


def set_encoder_counts(records: Records, motor: Motor, interpolation: Floats, axes: Mask) -> None:
    """Set the counts per turn of encoders to the motor's, each interpolated by a factor."""
    set_lanes(records, "encoder_interpolation", interpolation, axes)
    set_lanes(records, "encoder_counts", motor.encoder_counts * interpolation, axes)


def set_velocity_filter(records: Records, device: Device, cutoff: Floats, axes: Mask) -> None:
    """Set the corner frequency [Hz] of the velocity filter; ValueError for one that the rate does not allow."""
    limit = 0.45 * device.velocity_rate
    if np.any(cutoff[axes] > limit) or np.any(cutoff[axes] <= 0.0):
        worst = cutoff[axes][np.argmax(np.abs(cutoff[axes] - 0.5 * limit))]
        raise ValueError(f"stage.velocity_filter must lie above 0 and up to {limit:.0f} Hz, not {worst:g} Hz")
    b, a1, a2 = velocity_filter(cutoff, device.velocity_rate)
    set_lanes(records, "velocity_filter_b", b, axes)
    set_lanes(records, "velocity_filter_a", a1, axes, 0)
    set_lanes(records, "velocity_filter_a", a2, axes, 1)


# Parameters of the machines of every firmware.
COMMON: dict[str, Write] = {
    "motor.R_s": field("R_nominal", live="R_s"),
    "motor.psi_m": field("psi_nominal", live="psi_m"),
    "motor.thermal_resistance": field("thermal_resistance"),
    "motor.thermal_time": field("thermal_time"),
    "motor.ambient": field("ambient"),
    "motor.encoder_broken": field("encoder_broken"),
    "motor.encoder_direction": lambda records, device, motor, values, axes: change_encoder(
        records, "encoder_true_direction", values, axes
    ),
    "motor.encoder_interpolation": lambda records, device, motor, values, axes: set_encoder_counts(
        records, motor, values, axes
    ),
    "motor.encoder_line_error": field("encoder_line_error"),
    "motor.encoder_line_phase": field("encoder_line_phase"),
    "motor.index_angle": field("index_angle"),
    "motor.open_a": field("open_a"),
    "motor.open_b": field("open_b"),
    "stage.velocity_filter": lambda records, device, motor, values, axes: set_velocity_filter(
        records, device, values, axes
    ),
    "stage.supply_resistance": field("supply_resistance"),
    "stage.dc_capacitance": field("dc_capacitance"),
    "stage.idle_current": field("idle_current"),
    "stage.supply_sinks": field("supply_sinks"),
    "stage.on_resistance": field("on_resistance"),
    "stage.thermal_resistance": field("stage_thermal_resistance"),
    "stage.thermal_time": field("stage_thermal_time"),
    "stage.short_conductance": field("short_conductance"),
}
