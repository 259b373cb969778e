"""The target of a tuner: drives, their motors, and the limits within which the axes may be moved.

A tuner gets a target and nothing else, so that it works with emulated machines and on a bus.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.default_device import DEFAULT_DEVICE
from drive_env.devices.gain_set import LOAD_ANGLE
from drive_env.devices.gains import check_linear_model
from drive_env.dictionary.roles import Role
from drive_env.drives.chosen_axes import ChosenAxes, chosen_parts
from drive_env.drives.interface import Drives, Observer
from drive_env.drives.observed import ObservedDrives
from drive_env.drives.speeds import per_increment
from drive_env.trials.positioning import wrapped
from mechanics.arrays import Floats, Integers, Mask
from tuning.lateness import Punctuality, late_first
from tuning.stop_causes import ToldCauses

if TYPE_CHECKING:
    from drive_env import EmulatedDrives
    from drive_env.devices import Device
    from drive_env.drives.interface import BusSide
    from drive_env.motors import Motor
    from mechanics.load import Load
    from tuning.runs.inputs import Input

Travel = tuple[float, float]  # signed angles that a rotor may turn from its present angle [rad], low <= 0 <= high

# How axes of a bus are coupled: separate machines; joints of one machine; parts of one rigid thing, which must move
# together.
AXES = ("apart", "coupled", "linked")
LOCKSTEP_PATIENCE = 5.0  # s, timeout of answers in lockstep: a late answer means that the computer is busy
FREE: Travel = (-math.inf, math.inf)
MEASURED_BY = (
    (cia402.POSITION_ACTUAL, 0), (cia402.VELOCITY_ACTUAL, 0), (cia402.TORQUE_ACTUAL, 0),
    (cia402.INTERPOLATION_PERIOD, 1), (cia402.INTERPOLATION_PERIOD, 2),
)  # fmt: skip
LONGEST_TRAVEL = 1e9  # rad: far beyond what counters of 32 bits hold
# How far the envelope lets an axis overshoot its travel: as a share of the travel, with lower and upper limit [rad].
SLACK, SLACK_ENDS = 0.05, (0.02 * 2.0 * np.pi, 0.5 * 2.0 * np.pi)
SPEED_SLACK = 2.0  # times the rated speed: excitations stay below it, an overshoot may exceed it
# The same for a stepper with closed loop: it lags behind a trial's ramp, and is faster while it catches up.
CATCHING_UP = 3.0


@dataclass(frozen=True)
class Target:
    """Drives to tune, and what the user knows of them.

    Attributes:
        drives: Emulated drives, or drives on a bus.
        device: Device of the drives.
        motor: Data sheet values of the motor, the same for every axis.
        supply: Supply voltage as the user enters it [V], shape (num_axes,).
        low: Signed angle that each rotor may turn backwards from its angle when the target was made [rad], shape
            (num_axes,), at most 0; -infinity if it may turn freely.
        high: The same forwards, at least 0.
        speed: Greatest speed of a rotor during excitation [rad/s].
        current: Greatest commanded current during excitation [A, peak i_q].
        axes_per_machine: Number of axes that one machine couples; axes are in machine-major order.
        linked: Whether the axes of a machine move one rigid thing, as those of a gantry: none may move far without the
            others.
        machine: The emulated load's name, or the channel of the bus.
        bus: Options of `open_drives` that open the drives of a bus again; empty for emulated ones.
        inputs: The user's own files for device, motor and load, for the certificate.
    """

    drives: Drives
    device: Device
    motor: Motor
    supply: Floats
    low: Floats
    high: Floats
    speed: float
    current: float
    axes_per_machine: int = 1
    linked: bool = False
    machine: str = ""
    bus: Mapping[str, Any] = field(default_factory=dict)
    inputs: tuple[Input, ...] = ()

    def __post_init__(self) -> None:
        for name in ("supply", "low", "high"):
            if getattr(self, name).shape != (self.num_axes,):
                raise ValueError(f"{name} must have shape ({self.num_axes},), not {getattr(self, name).shape}")
        least, most = self.device.undervoltage, self.device.overvoltage
        beyond = self.supply[~((self.supply > least) & (self.supply < most))]
        if beyond.size:
            raise ValueError(
                f"supply {beyond[0]:g} V lies outside {least:g}...{most:g} V, with which a {self.device.name} works; "
                "give the voltage at the drive's terminals"
            )
        wrong = np.flatnonzero(~((self.low <= 0.0) & (self.high >= 0.0) & (self.low < self.high)))
        if wrong.size:
            k = int(wrong[0])
            number = self.axis_numbers[k]
            raise ValueError(
                f"axis {number}: travel {self.low[k]:g} to {self.high[k]:g} rad must contain 0, where the rotor is "
                "now, and must not be empty; give the free way to both sides"
            )
        for name, unit in (("speed", "rad/s"), ("current", "A")):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} {getattr(self, name):g} {unit} must be above 0 and finite")

    @property
    def num_axes(self) -> int:
        """Number of axes."""
        return int(self.drives.num_axes)

    @property
    def axis_numbers(self) -> tuple[int, ...]:
        """The number of each axis in results; of chosen axes their number among all."""
        return tuple(map(int, self.drives.axis_numbers))

    def together(self, where: Mask) -> Mask:
        """Extend a mask of moving axes: of a machine with linked axes all move if one does."""
        if not self.linked:
            return where
        lanes = self.axes_per_machine
        return np.asarray(np.repeat(where.reshape(-1, lanes).any(axis=1), lanes))

    def slowest(self, inertia: Floats) -> Floats:
        """Return the inertia [kg*m^2] to plan motions with, shape (num_axes,): the greatest of linked axes.

        Linked axes with different motions would strain the machine.
        """
        ends = (-1, self.axes_per_machine if self.linked else 1)
        return np.asarray(np.repeat(inertia.reshape(ends).max(axis=1), ends[1]))

    def increments(self) -> Floats:
        """Return the position increments per radian of every rotor, 2058h over 2 pi, shape (num_axes,)."""
        return np.asarray(self.drives.read(Role.POSITION_SCALE), float) / (2.0 * math.pi)

    def travel_left(self, origin: Integers) -> tuple[Floats, Floats]:
        """Return the signed angles that the rotors may still turn from here [rad], down and up, each shape (num_axes,).

        Args:
            origin: Their positions when the target was made [inc], shape (num_axes,).
        """
        here = wrapped(self.drives.read(cia402.POSITION_ACTUAL) - origin) / self.increments()
        return np.minimum(self.low - here, 0.0), np.maximum(self.high - here, 0.0)

    def speed_counts(self) -> Floats:
        """Return the counts of 606Ch and 60FFh per rad/s of each rotor, shape (num_axes,)."""
        return np.asarray(self.increments() * per_increment(self.drives, cia402.VELOCITY_ACTUAL))

    def close(self) -> None:
        """Close the drives."""
        self.drives.close()

    def __enter__(self) -> Target:
        return self

    def __exit__(self, *error: Any) -> None:
        # Not close(): the exit of drives on a bus also stops the axes if there is an exception.
        self.drives.__exit__(*error)


def emulated(
    device: str = DEFAULT_DEVICE,
    load: str | Path | Load = "two_mass",
    motor: str | None = None,
    *,
    num_machines: int = 1,
    seed: int = 0,
    supply: float | None = None,
    travel: Travel | Iterable[Travel] | None = None,
    speed: float | None = None,
    current: float | None = None,
    factory_fresh: bool = False,
    **options: Any,
) -> Target:
    """Create emulated machines and return them as a target.

    Args:
        device: Name of the device.
        load: A load's name, the path of an MJCF, or a `mechanics.Load`.
        motor: Name of the motor; the device's usual one by default.
        num_machines: Number of machines, each with its drives.
        seed: Seed of everything random.
        supply: Supply voltage of the machines, known to the tuner [V]; the motor's by default.
        travel: Signed angles that the rotors may turn [rad], if less than the load allows: one (low, high), or one per
            axis of a machine; the load's own by default.
        speed: Greatest speed during excitation [rad/s]; the motor's rated speed by default.
        current: Greatest current during excitation [A]; the motor's rated current by default.
        factory_fresh: Keep the drives' factory settings, with all gains 0, instead of commissioning them for the motor.
        options: `chosen`, the numbers (from 0) of the axes of each machine to tune, all by default (the others stay
            off); and further options of `EmulatedDrives`, such as `randomise` and `parameters`.

    Raises:
        ValueError: For an unknown name, an impossible machine, or a travel that does not contain 0.
    """
    from drive_env import EmulatedDrives

    chosen: Sequence[int] | None = options.pop("chosen", None)
    drives = EmulatedDrives(
        device,
        load=load,
        motor=motor,
        commissioned=not factory_fresh,
        num_machines=num_machines,
        seed=seed,
        supply=supply,
        **options,
    )
    limits = {"supply": supply, "travel": travel, "speed": speed, "current": current}
    return of_machines(drives, drives, chosen=chosen, **limits)  # type: ignore[arg-type]


def of_machines(
    drives: Drives,
    made: EmulatedDrives,
    *,
    supply: float | None = None,
    travel: Travel | Iterable[Travel] | None = None,
    speed: float | None = None,
    current: float | None = None,
    chosen: Sequence[int] | None = None,
) -> Target:
    """Return existing emulated machines as a target.

    Args:
        drives: Interface by which the tuner accesses the machines.
        made: The machines; device, motor and load are taken from them.
        supply: Supply voltage [V]; the motor's by default.
        travel: Signed angles that the rotors may turn [rad], as in `emulated`.
        speed: Greatest speed during excitation [rad/s]; the motor's rated speed by default.
        current: Greatest current during excitation [A]; the motor's rated current by default.
        chosen: Numbers (from 0) of the axes of each machine to tune, all by default. `travel` is of these axes.

    Raises:
        ValueError: For a travel that does not contain 0, or an axis that the machines do not have.
    """
    from mechanics.shaft import one, way
    from tuning.linked_axes import are_linked

    alone = one(made.load)
    own = way(alone)
    linked, total = are_linked(alone), made.load.num_axes
    parts = list(range(total) if chosen is None else chosen_parts(chosen, total, f"load {made.load.name}"))
    if linked and len(parts) < total:
        raise ValueError(
            f"--axis {', '.join(map(str, parts))}: the axes of {made.load.name} pull at one thing, and none of them "
            "moves far without the others; leave --axis out"
        )
    narrow_low, narrow_high = _ways(FREE if travel is None else travel, len(parts))
    lanes = made.num_machines
    axes = np.add.outer(np.arange(lanes) * total, parts).ravel()
    here = np.asarray(made.machine.rotor_angle)[axes]
    # The load's ends are positions: a rotor at one of them, or slightly beyond, has no travel to that side.
    low = np.maximum(np.minimum(np.tile(own.low[parts], lanes) - here, 0.0), np.tile(narrow_low, lanes))
    high = np.minimum(np.maximum(np.tile(own.high[parts], lanes) - here, 0.0), np.tile(narrow_high, lanes))
    volts = made.device.supply_of(made.motor) if supply is None else supply
    limits = _limits(made.motor, len(axes), volts, speed, current)
    return Target(
        drives if len(parts) == total else ChosenAxes(drives, axes.tolist()),
        made.device,
        made.motor,
        low=low,
        high=high,
        axes_per_machine=len(parts),
        linked=linked,
        machine=made.load.name,
        **limits,
    )


def on_bus(
    device: str = DEFAULT_DEVICE,
    motor: str | None = None,
    *,
    interface: str | None = None,
    channel: str | None = None,
    nodes: Iterable[int] | None = None,
    supply: ArrayLike | None = None,
    travel: Travel | Iterable[Travel],
    speed: float | None = None,
    current: float | None = None,
    axes: str = "apart",
    **options: Any,
) -> Target:
    """Open drives of a bus and return them as a target with a safety envelope.

    By default the envelope allows each axis its own travel and SLACK of it to either side; a tuner plans all motions
    within the travel, except for overshoot.

    Args:
        device: Name of the device.
        motor: Name of the motor of every node; the device's usual one by default.
        interface: Interface as in python-can; from DRIVE_ENV_INTERFACE if not given.
        channel: Channel; from DRIVE_ENV_CHANNEL if not given.
        nodes: Node-IDs, or positions on EtherCAT; the first one by default.
        supply: Supply voltage [V], one value or one per axis; the motor's by default.
        travel: Signed angles that the rotors may turn from their present angle [rad]: one (low, high), or one per axis.
        speed: Greatest speed during excitation [rad/s]; the motor's rated speed by default.
        current: Greatest current during excitation [A]; the motor's rated current by default.
        axes: How the nodes' axes are coupled, one of `AXES`; it cannot be read from a bus.
        options: `chosen`, the numbers (from 0) of the axes of each node to tune, all by default (the others are never
            commanded); and further options of `open_drives`.

    Raises:
        ValueError: For an unknown name, a travel that does not contain 0, or an axis that the device does not have.
        BusError: If a node does not answer.
    """
    check_coupling(axes)
    chosen: Sequence[int] | None = options.pop("chosen", None)
    from drive_env.devices import find_device
    from drive_env.master.open_drives import default_nodes, open_drives
    from drive_env.motors import find_motor

    row = find_motor(find_device(device).default_motor if motor is None else motor)
    numbers = default_nodes(interface) if nodes is None else tuple(nodes)
    if chosen is not None:  # checked before any access to a node
        chosen_parts(chosen, find_device(device).num_axes, device)
    opened = open_drives(device, interface=interface, channel=channel, nodes=numbers, **options)
    drives: Drives = opened
    try:
        address = address_of(interface, channel, numbers, options)
        if chosen is not None:
            drives = of_nodes(opened, chosen)
            address["axes"] = list(chosen_parts(chosen, opened.description.num_axes, device))
        target = of_bus(
            drives, row, address, supply=supply, travel=travel, speed=speed, current=current, axes=axes,
        )  # fmt: skip
        if "safety" not in options:
            hold_to_travel(target)
    except BaseException:
        drives.close()
        raise
    return target


def of_nodes(drives: BusSide, parts: Iterable[int]) -> Drives:
    """Return axes of every node of a bus by their numbers in the node; raises as `chosen_parts`."""
    count = drives.description.num_axes
    chosen = chosen_parts(parts, count, drives.description.name)
    if len(chosen) == count:
        return drives
    return ChosenAxes(drives, [node * count + part for node in range(len(drives.nodes)) for part in chosen])


def of_bus(
    drives: Drives,
    motor: Motor,
    address: Mapping[str, Any],
    *,
    supply: ArrayLike | None = None,
    travel: Travel | Iterable[Travel],
    speed: float | None = None,
    current: float | None = None,
    axes: str = "apart",
) -> Target:
    """Return opened drives of a bus as a target; call `hold_to_travel` to give its limits to their envelope.

    Args:
        drives: The drives.
        motor: Motor of every node.
        address: Options of `open_drives` that open them again.
        supply: Supply voltage [V], one value or one per axis; the motor's by default.
        travel: Signed angles that the rotors may turn from their present angle [rad], as in `on_bus`.
        speed: Greatest speed during excitation [rad/s]; the motor's rated speed by default.
        current: Greatest current during excitation [A]; the motor's rated current by default.
        axes: How the nodes' axes are coupled, one of `AXES`.

    Raises:
        ValueError: For a travel that does not contain 0.
    """
    check_coupling(axes)
    low, high = _ways(travel, drives.num_axes)
    device = drives.device
    assert device is not None, "a device of a name is known"
    volts = device.supply_of(motor) if supply is None else supply
    limits = _limits(motor, drives.num_axes, volts, speed, current)
    machine = f"{address.get('channel', 'a bus')}, node {', '.join(map(str, address.get('nodes', ())))}"
    if "axes" in address:
        machine += f", axis {', '.join(map(str, address['axes']))}"
    lanes = 1 if axes == "apart" else drives.num_axes
    return Target(drives, device, motor, low=low, high=high, axes_per_machine=lanes, linked=axes == "linked",
                  machine=machine, bus=address, **limits)  # fmt: skip


def check_measurable(device: Device, modes: Iterable[str], objects: Iterable[Key] = ()) -> None:
    """Raise ValueError unless a device has a linear model of its loops, modes by their abbreviations, and objects."""
    check_linear_model(device)
    own, has = device.allowed_values.get((cia402.MODE, 0)), device.new_dictionary().has
    lacks = [mode for mode in modes if own is not None and cia402.MODES[mode] not in own]
    lacks = lacks or [f"{index:04X}h:{sub:02X}" for index, sub in (*MEASURED_BY, *objects) if not has((index, sub))]
    if lacks:
        raise ValueError(
            f"{device.name}: this drive has no {', no '.join(lacks)}, by which its loops are measured; if it has them "
            "after all, complete its EDS, and 6060:0 in its device.toml; drive-tune sweep needs pv alone"
        )


def check_coupling(axes: str) -> None:
    """Raise ValueError unless the word is one of `AXES`."""
    if axes not in AXES:
        raise ValueError(f"--axes {axes} must be one of {', '.join(AXES)}")


@contextmanager
def timed(target: Target) -> Iterator[tuple[Target, DriveTime]]:
    """Yield the target with drives that remember time, emergencies and SYNCs, and the clock of this time.

    An error of the envelope or of a motion raised in the block then names late SYNCs before its own reason.
    """
    clock = DriveTime()
    drives = ObservedDrives(target.drives, clock, ToldCauses(target.num_axes), Punctuality(target.drives))
    try:
        yield replace(target, drives=drives), clock
    except (RuntimeError, TimeoutError) as error:  # raised by the envelope and by motion
        if error.args and isinstance(error.args[0], str):
            error.args = (late_first(drives, error.args[0]), *error.args[1:])
        raise


class DriveTime(Observer):
    """Counts the time that passes on drives: the cost of a tuner on hardware.

    Attributes:
        seconds: Time so far [s].
    """

    def __init__(self) -> None:
        self.seconds = 0.0

    def passes(self, duration: float) -> None:
        """Add the duration to `seconds`."""
        self.seconds += duration


def _ways(travel: Travel | Iterable[Travel], num_axes: int) -> tuple[Floats, Floats]:
    """Return lower and upper ends of travel [rad], shape (num_axes,) each, from one range for all or one per axis."""
    ways = np.asarray(list(travel), float)
    if ways.shape not in ((2,), (num_axes, 2)):
        raise ValueError(
            f"{len(ways)} ranges of travel are given, for {num_axes} axis/axes; give one for all, or one for each"
        )
    if np.any(np.isnan(ways) | (np.isfinite(ways) & (np.abs(ways) > LONGEST_TRAVEL))):
        raise ValueError(
            f"a travel of {ways.min():g} to {ways.max():g} rad is impossible; an axis has {LONGEST_TRAVEL:g} rad to "
            "either side at most, or is free"
        )
    low, high = np.broadcast_to(ways, (num_axes, 2)).T.copy()
    return low, high


def _limits(
    motor: Motor, num_axes: int, supply: ArrayLike, speed: float | None, current: float | None
) -> dict[str, Any]:
    return {
        "supply": np.broadcast_to(np.asarray(supply, float), (num_axes,)).copy(),
        "speed": motor.rated_speed if speed is None else speed,
        "current": motor.rated_current if current is None else current,
    }


def address_of(
    interface: str | None, channel: str | None, nodes: tuple[int, ...], options: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the options that open these drives again, without those that a file cannot store, such as an open bus."""
    from drive_env.master.can.port import CHANNEL_VARIABLE, INTERFACE_VARIABLE

    found = {
        "interface": interface or os.environ.get(INTERFACE_VARIABLE),
        "channel": channel or os.environ.get(CHANNEL_VARIABLE),
        "nodes": list(nodes),
    } | {name: value for name, value in options.items() if isinstance(value, str | int) and name in _ADDRESS}
    return {name: value for name, value in found.items() if value is not None}


_ADDRESS = ("bitrate", "pace")


def hold_to_travel(target: Target) -> None:
    """Limit the envelope to each axis' travel, with room for overshoot, and to the speed of its motor."""
    from drive_env.drives.limits import Limits

    drives = target.drives
    here, scale = drives.read(cia402.POSITION_ACTUAL), target.increments()
    width = np.where(np.isfinite(target.high - target.low), target.high - target.low, 0.0)
    slack = np.clip(SLACK * width, *SLACK_ENDS)
    low, high = here + (target.low - slack) * scale, here + (target.high + slack) * scale
    slack_of_speed = SPEED_SLACK if target.device.gains.loop_of_kind(LOAD_ANGLE) is None else CATCHING_UP
    speed = np.ceil(slack_of_speed * target.motor.rated_speed * target.speed_counts())
    assert drives.safety is not None, "drives of a bus are opened with an envelope"
    drives.safety.change(Limits(position=(low.tolist(), high.tolist()), velocity=speed.tolist()))
