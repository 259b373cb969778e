"""Effects of the machines' faults: the quantities that a fault changes, each with a function from its normal value."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

import numpy as np

from mechanics.arrays import Floats

Given = Mapping[str, float]


class Quantity(NamedTuple):
    """A quantity that a fault changes.

    kind: "record", a field of the drives' records, one per axis; "load", a parameter of the load, one per machine;
        "jam", the torque that holds the load [N*m at the rotor], one per axis.
    name: Name of the field or parameter.
    part: Index in a field of the record that holds several values per axis.
    """

    kind: str
    name: str = ""
    part: int = 0


class Change(NamedTuple):
    """A quantity and its value under the fault: value(normal value, fault parameters, rated torque [N*m])."""

    quantity: Quantity
    value: Callable[[Floats, Given, float], Floats]


def _record(name: str, value: Callable[[Floats, Given, float], Floats], part: int = 0) -> Change:
    return Change(Quantity("record", name, part), value)


def _broken(sound: Floats, given: Given, rated: float) -> Floats:
    return np.ones_like(sound)


def _vanished(sound: Floats, given: Given, rated: float) -> Floats:
    return np.zeros_like(sound)


def _phase(number: int) -> Callable[[Floats, Given, float], Floats]:
    return lambda sound, given, rated: np.ones_like(sound) if given["phase"] == number else sound


def _shorted(number: int) -> Callable[[Floats, Given, float], Floats]:
    return lambda sound, given, rated: sound + given["conductance"] if given["phase"] == number else sound


def _pressed(number: int, end: float) -> Callable[[Floats, Given, float], Floats]:
    return lambda sound, given, rated: np.full_like(sound, end) if given["switch"] == number else sound


def _left(sound: Floats, given: Given, rated: float) -> Floats:
    return sound * given["left"]


def _multiplied(sound: Floats, given: Given, rated: float) -> Floats:
    return sound * given["factor"]


# Fields of the record that belong to the DC link: one value for all axes of a drive, whichever axis the fault names.
OF_LINK = ("supply_voltage", "short_conductance")
ENCODER_GAIN = Quantity("record", "encoder_gain")
ENCODER_DIRECTION = Quantity("record", "encoder_true_direction")
ENCODER_NOISE = Quantity("record", "encoder_noise")

# A fault changes those of its fields that the drive's firmware has (`of_drives`). R_s and psi_m follow the temperature
# each millisecond, so a fault changes their value at 25 degC.
CHANGES: dict[str, tuple[Change, ...]] = {
    "encoder_lost_counts": (Change(ENCODER_GAIN, lambda sound, given, rated: sound * (1.0 - given["share"])),),
    "encoder_stuck": (Change(ENCODER_GAIN, _vanished),),
    "encoder_reversed": (Change(ENCODER_DIRECTION, lambda sound, given, rated: 1.0 - sound),),
    "encoder_noise": (Change(ENCODER_NOISE, lambda sound, given, rated: np.hypot(sound, given["angle"])),),
    "halls_lost": (_record("hall_broken", _broken),),
    "current_offset": (_record("adc_offset_error", lambda sound, given, rated: sound + given["current"]),),
    "open_phase": tuple(_record(f"open_{letter}", _phase(number)) for number, letter in enumerate("abc")),
    "demagnetised": (_record("psi_nominal", lambda sound, given, rated: sound * (1.0 - given["share"])),),
    "winding_short": tuple(_record(name, _left) for name in ("R_nominal", "L_d", "L_q", "L_s")),
    "stage_short": tuple(
        _record(name, _shorted(number)) for number, name in enumerate(("short_conductance", "short_a", "short_b"), -1)
    ),
    "supply_dip": (_record("supply_voltage", lambda sound, given, rated: np.minimum(sound, given["voltage"])),),
    "supply_surge": (_record("supply_voltage", lambda sound, given, rated: np.maximum(sound, given["voltage"])),),
    "brake_stuck": (_record("brake_mode", _broken),),
    # The switch is pressed at any position of the load.
    "limit_switch": tuple(
        _record(name, _pressed(number, end), number)
        for number in (0, 1)
        for name, end in (("switch_low", -np.inf), ("switch_high", np.inf))
    ),
    "enable_lost": (_record("enable_input", _vanished),),
    "jam": (Change(Quantity("jam"), lambda sound, given, rated: sound + given["torque"] * rated),),
    "broken_coupling": tuple(Change(Quantity("load", name), _vanished) for name in ("stiffness", "damping")),
    # Only the first of these that the load has is changed (payload_of).
    "payload_jump": tuple(Change(Quantity("load", name), _multiplied) for name in ("payload", "mass", "inertia")),
}
# Faults without duration: MachineFaults applies them once.
MOMENTS = ("encoder_jump", "node_reset")


def of_drives(name: str, changes: tuple[Change, ...], fields: Collection[str], device: str) -> tuple[Change, ...]:
    """Return the changes of a fault that apply to drives with these record fields.

    Args:
        name: Name of the fault.
        changes: All changes of the fault.
        fields: Names of the fields of the drives' records.
        device: Name of the device, for the message.

    Raises:
        ValueError: If no change applies to these drives and their motors.
    """
    found = tuple(one for one in changes if one.quantity.kind != "record" or one.quantity.name in fields)
    if not found:
        raise ValueError(f"fault {name}: a {device} and its motor have nothing that this fault changes")
    return found


def changes_of(
    name: str, load_parameters: tuple[str, ...], load: str, num_axes: int, has_switches: bool = True
) -> tuple[Change, ...]:
    """Return the changes that a fault makes to a machine.

    Args:
        name: Name of the fault.
        load_parameters: Names of the load's parameters.
        load: Name of the load, for messages.
        num_axes: Number of axes of a machine.
        has_switches: Whether the load has limit switches.

    Raises:
        ValueError: If the load lacks the property that the fault changes.
    """
    changes = CHANGES[name]
    if name == "broken_coupling" and (num_axes > 1 or "stiffness" not in load_parameters):
        raise ValueError(
            f"fault broken_coupling: load {load!r} has no coupling between one rotor and its load that could break; "
            "take one that has: two_mass, three_mass, belt, ball_screw, vertical_screw, geared_joint"
        )
    if name == "limit_switch" and not has_switches:
        raise ValueError(
            f"fault limit_switch: load {load!r} has no switches; take one that has: belt, ball_screw, gantry"
        )
    if name == "payload_jump":
        found = [change for change in changes if change.quantity.name in load_parameters]
        if not found:
            raise ValueError(f"fault payload_jump: load {load!r} has no parameter payload, mass or inertia to change")
        return (found[0],)
    return changes
