"""The emulated machines' side that no bus shows: true parameters, disturbances, supply, power.

A task may use it to set up a world, never to act; `drives.machine` is None on a real drive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drive_env.dictionary.roles import Role
from drive_env.drives.arguments import checked_mask
from drive_env.emulator.machine_faults import InjectedFault, MachineFaults
from drive_env.emulator.parameters import check_known, check_one_supply, check_parameter
from drive_env.emulator.record_snapshot import RecordSnapshot
from drive_env.faults.schedule import Order
from drive_env.faults.table import FAULTS
from drive_env.firmware.record import get_lanes, set_lanes
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from drive_env.drives.interface import Drives
    from drive_env.emulator.inside import Inside
    from drive_env.emulator.parameters import MachineParameter
    from mechanics.load import Load


INPUTS_FIELD = "inputs_set"  # of firmware that has general inputs
ERRORS_FIELD = "error_bits"  # of firmware with a table of numbered errors
# Drives with two axes: outputs of an axis (every second one), and their place in the native control.
AXES, AXIS_OUTPUTS, NATIVE_OUTPUTS = 2, 3, 28
INPUTS_SHIFT = 16  # general inputs and outputs are bits 16 to 23 of their objects
AFTER_POWER_ON = ("blinking", "off")  # of the run lamp and the error lamp
_BRAKES = ("open", "closed", "with_stage", "output")  # numbers of firmware/common/brake.py


def checked_supply(value: ArrayLike, num_axes: int) -> Floats:
    """Return the supply voltage of each axis [V], shape (num_axes,); ValueError for an impossible one."""
    volts = np.broadcast_to(np.asarray(value, float), (num_axes,))
    bad = ~np.isfinite(volts) | (volts < 0.0)
    if np.any(bad):
        raise ValueError(f"supply voltage must be finite and 0 V or more, not {volts[bad][0]:g} V")
    return volts


class Machines:
    """The emulated machines behind drives: one value per machine, shape (num_machines,), unless stated otherwise.

    Attributes:
        drives: The drives that turn these machines.
        inside: The inside of the drives.
    """

    def __init__(self, drives: Drives, inside: Inside, faults: MachineFaults) -> None:
        self.drives = drives
        self.inside = inside
        self._faults = faults
        self._rest: RecordSnapshot | None = None  # state of a machine at rest
        self._lamps: list[tuple[slice, Callable[[], tuple[str, str]]]] = []  # of nodes: axes, patterns

    @property
    def load(self) -> Load:
        """The load of each machine."""
        return self.inside.load

    @property
    def parameters(self) -> dict[str, Floats]:
        """True parameters by name [SI], each of shape (num_machines,)."""
        return {name: values.copy() for name, values in self.inside.parameters.items()}

    @property
    def parameter_rows(self) -> Mapping[str, MachineParameter]:
        """Description of each parameter by name: unit, default, and range for random machines."""
        return self.inside.parameter_rows

    @property
    def diverged(self) -> Mask:
        """Which machines have diverged and are frozen, shape (num_machines,)."""
        return np.concatenate([group.load.plant.diverged != 0 for group in self.inside.groups])

    @property
    def load_torque(self) -> Floats:
        """External torque on the load [N*m; N on a belt], shape (num_machines,); set one value or one per machine."""
        return np.concatenate([group.load.plant.load_torque for group in self.inside.groups])

    @load_torque.setter
    def load_torque(self, value: ArrayLike) -> None:
        values = self._per_machine(value, "load torque")
        for group in self.inside.groups:
            group.load.plant.load_torque[:] = values[group.machines]

    @contextmanager
    def pushed(self) -> Iterator[Callable[[ArrayLike], None]]:
        """Yield a function that puts torques on the axes in addition to `load_torque`, until the block ends.

        It is called with torques at the rotors [N*m], shape (num_axes,); joints of the load that no axis turns are not
        affected.
        """
        from mechanics.shaft import way

        groups = self.inside.groups
        before = [(group.load.plant.disturbance.copy(), group.load.plant.load_torque.copy()) for group in groups]
        turning = way(groups[0].load).joints
        onto = np.linalg.pinv(turning)  # joint forces for a torque at each rotor

        def push(torque: ArrayLike) -> None:
            each = np.broadcast_to(np.asarray(torque, float), (self.inside.num_axes,)).reshape(-1, len(turning))
            for group, (motion, calm) in zip(groups, before, strict=True):
                group.load.plant.disturbance[:] = motion * calm + onto @ each[group.machines].T
                group.load.plant.load_torque[:] = 1.0

        try:
            yield push
        finally:
            for group, (motion, calm) in zip(groups, before, strict=True):
                group.load.plant.disturbance[:] = motion
                group.load.plant.load_torque[:] = calm

    def load_profile(
        self, at: ArrayLike | None, torque: ArrayLike | None = None, *, of: str = "time", period: float | None = None
    ) -> None:
        """Add a torque from a table to `load_torque`, interpolated linearly, in all machines; None removes it.

        Args:
            at: Times from now [s], or positions of the first axis's joint or carriage [rad or m]; increasing, (n,).
            torque: On the load [N*m; N where the load moves in a line], shape (n,) or (num_machines, n).
            of: "time" or "position".
            period: Period after which the table repeats; None: the first and last values hold outside.

        Raises:
            ValueError: For an invalid table; nothing is changed then.
        """
        inside = self.inside
        if of not in ("time", "position"):
            raise ValueError(f"a load profile is of time or of position, not of {of!r}")
        points = np.zeros(0) if at is None else np.asarray(at, float)
        values = np.zeros(0) if torque is None else np.asarray(torque, float)
        if points.ndim != 1 or np.any(np.diff(points) <= 0.0) or not np.all(np.isfinite(points)):
            raise ValueError("a load profile needs one finite, increasing row of times or positions")
        if values.shape not in (points.shape, (inside.num_machines, *points.shape)) or not np.all(np.isfinite(values)):
            raise ValueError(
                f"a load profile of {len(points)} points needs finite torques of shape ({len(points)},) or "
                f"({inside.num_machines}, {len(points)}), not {values.shape}"
            )
        if period is not None and (not len(points) or not period >= points[-1] - points[0] or not period > 0.0):
            raise ValueError(f"the period of a load profile must be above 0 and span its points, not {period:g}")
        rows = np.broadcast_to(values, (inside.num_machines, len(points)))
        for group in inside.groups:
            group.load.set_profile(points, rows[group.machines], of_position=of == "position", period=period or 0.0)

    def schedule(self, name: str, times: ArrayLike, values: ArrayLike, where: Mask | None = None) -> None:
        """Schedule changes of a parameter, e.g. a payload that is picked up, or a supply line that warms.

        Args:
            name: A parameter, as in `set`.
            times: Times from now [s], whole communication cycles, shape (n,).
            values: Its new values [SI], shape (n,) or (n, num_machines).
            where: Machines.

        Raises:
            ValueError: As in `set`, at once, and for times that are past or not whole cycles.
        """
        inside = self.inside
        check_known(name, inside.parameters)
        mask, rows = self._mask(where), np.asarray(values, float)
        cycles = [inside.cycles(float(time)) for time in np.atleast_1d(np.asarray(times, float))]
        if rows.shape not in ((len(cycles),), (len(cycles), inside.num_machines)):
            raise ValueError(
                f"a schedule of {len(cycles)} times needs values of shape ({len(cycles)},) or "
                f"({len(cycles)}, {inside.num_machines}), not {rows.shape}"
            )
        check_parameter(name, rows)
        if name.startswith("load."):
            inside.groups[0].load.values.check(name.removeprefix("load."), rows)
        inside.schedule += [(inside.cycle + cycle, name, row, mask) for cycle, row in zip(cycles, rows, strict=True)]
        inside.schedule.sort(key=lambda change: change[0])

    @property
    def brake(self) -> NDArray[np.str_]:
        """Holding brake of each axis: "open", "closed", "with_stage" or "output"; can be set.

        "with_stage": closed while the stage is off. "output": a spring closes it, and the current of the drive's output
        opens it, each after its time (`motor.brake_closes_in`, `motor.brake_opens_in`). Its torque is twice the motor's
        rated torque, as is usual for holding brakes of this size.
        """
        return np.array([_BRAKES[int(mode)] for mode in self._axis_field("brake_mode")])

    @brake.setter
    def brake(self, value: ArrayLike) -> None:
        inside = self.inside
        chosen = np.broadcast_to(np.asarray(value), (inside.num_axes,))
        known = _BRAKES if Role.BRAKE_RELEASE_CURRENT in inside.device.roles else _BRAKES[:-1]
        for state in chosen:
            if state not in known:
                raise ValueError(f"a brake of {inside.device.name} is {', '.join(known)}, not {str(state)!r}")
        set_lanes(inside.records, "brake_mode", np.array([_BRAKES.index(state) for state in chosen], float))

    @property
    def brake_output(self) -> Floats:
        """Current of each axis' brake output, as a share of the maximum, shape (num_axes,); 0 without an output."""
        return self._axis_field("brake_output")

    @property
    def joint_positions(self) -> Floats:
        """Positions of the load's joints, in the order of its MJCF [rad or m], shape (num_machines, joints)."""
        return np.concatenate([group.load.joint_positions() for group in self.inside.groups])

    def place(self, joint: int, angles: ArrayLike, where: Mask | None = None) -> None:
        """Move a joint that no drive turns to another position, at rest.

        Args:
            joint: Number of the joint, as in `joint_positions`.
            angles: From the load's zero [rad or m], shape (num_machines,).
            where: Machines.
        """
        mask, chosen = self._mask(where), self._per_machine(angles, "angles")
        for group in self.inside.groups:
            group.load.place(joint, chosen[group.machines], mask[group.machines])

    @property
    def supply(self) -> Floats:
        """Open-circuit supply voltage [V], shape (num_axes,); set one value or one per axis.

        Axes that share a DC link have one supply: ValueError for two values.
        """
        return self._axis_field("supply_voltage")

    @supply.setter
    def supply(self, value: ArrayLike) -> None:
        inside = self.inside
        volts = checked_supply(value, inside.num_axes)
        check_one_supply(volts, self.links)
        with self._faults.suspended():
            set_lanes(inside.records, "supply_voltage", volts)

    @property
    def links(self) -> Integers:
        """DC link of each axis, shape (num_axes,): the number of the first axis on it."""
        return self.inside.links

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
    def switches(self) -> Integers:
        """Inputs pressed by the load or held, bits of 60FDh, shape (num_axes,)."""
        return self._axis_field("inputs").astype(np.int64)

    def press(self, kind: str, held: ArrayLike) -> None:
        """Hold switches pressed regardless of the load; released ones follow the load again.

        Args:
            kind: "left", "right" or "home".
            held: One value or one per axis.

        Raises:
            ValueError: For a kind of switch that one of the held axes lacks.
        """
        inside = self.inside
        pressed = np.broadcast_to(np.asarray(held, bool), (inside.num_axes,))
        there = {switch.axis for switch in inside.load.switches if switch.kind == kind}
        missing = [int(axis) for axis in np.flatnonzero(pressed) if axis % inside.load.num_axes not in there]
        if missing:
            raise ValueError(
                f"axis {missing[0]} has no {kind} switch to press: load {inside.load.name!r} has "
                f"{', '.join(f'{one.kind} (axis {one.axis})' for one in inside.load.switches) or 'none'}"
            )
        inside.set_switches(kind, pressed)

    @property
    def enable_input(self) -> Mask:
        """Whether the enable input is closed, shape (num_axes,); can be set, to one value or one per axis."""
        return self._axis_field("enable_input") > 0

    @enable_input.setter
    def enable_input(self, value: ArrayLike) -> None:
        inside = self.inside
        closed = np.broadcast_to(np.asarray(value, bool), (inside.num_axes,))
        with self._faults.suspended():
            set_lanes(inside.records, "enable_input", closed.astype(np.int32))

    @property
    def outputs(self) -> Integers:
        """Digital outputs, bit 0 is GPO0: those that their mask enables, shape (num_axes,).

        A drive whose axes have separate registers for every second output also sets and clears them by these.
        """
        read, device = self.drives.read, self.inside.device
        pins = (1 << device.num_outputs) - 1
        set_ = (read(Role.OUTPUTS) & read(Role.OUTPUTS_MASK)) >> INPUTS_SHIFT & pins
        if Role.OUTPUTS_OWN not in device.roles:
            return set_
        own = read(Role.OUTPUTS_OWN) | read(Role.OUTPUTS_SET) | read(Role.NATIVE_CONTROL) >> NATIVE_OUTPUTS
        return (set_ | self._of_both(own)) & ~self._of_both(read(Role.OUTPUTS_CLEAR)) & pins

    def _of_both(self, own: Integers) -> Integers:
        """Combine the outputs of a module's axes: the first has outputs 0, 2, 4, the second 1, 3, 5."""
        count = self.inside.device.num_axes
        number = np.arange(len(own))
        spread = np.zeros(len(own), np.int64)
        for bit in range(AXIS_OUTPUTS):
            spread |= ((own >> bit & 1) << (AXES * bit)) << number % count
        found = np.zeros(len(own), np.int64)
        for axis in range(count):
            mate = number - number % count + axis
            found |= np.where(mate < len(own), spread[np.minimum(mate, len(own) - 1)], 0)
        return found

    @property
    def digital_inputs(self) -> Integers:
        """Levels of the inputs that belong to no axis, bit 0 is IN0, shape (num_axes,); can be set, 0 to 255.

        A node with several axes shows those of its first one.
        """
        return self.drives.read(Role.DIGITAL_INPUTS) >> INPUTS_SHIFT

    @digital_inputs.setter
    def digital_inputs(self, value: ArrayLike) -> None:
        values = np.broadcast_to(np.asarray(value), (self.inside.num_axes,))
        if values.dtype.kind not in "iu" or np.any((values < 0) | (values > 0xFF)):
            raise ValueError(f"digital inputs are whole numbers of 0 to 255, a bit for each, not {value!r}")
        inside = self.inside
        records = inside.objects.records
        if inside.device.firmware.layout.has(INPUTS_FIELD):  # the firmware adds its switches
            set_lanes(records, INPUTS_FIELD, values)
        else:
            inside.objects.impose(Role.DIGITAL_INPUTS, values.astype(np.int64) << INPUTS_SHIFT)

    @property
    def analog_inputs(self) -> Integers:
        """Readings of the analog inputs, 0...4095, shape (inputs, num_axes); can be set."""
        return np.stack([self.drives.read(key) for key in self._analog_inputs()])

    @analog_inputs.setter
    def analog_inputs(self, value: ArrayLike) -> None:
        keys = self._analog_inputs()
        values = np.broadcast_to(np.asarray(value), (len(keys), self.inside.num_axes))
        for key, raw in zip(keys, values, strict=True):
            self.inside.objects.impose(key, raw)

    def _analog_inputs(self) -> list[tuple[int, int]]:
        entries = self.inside.objects.entries
        first = entries.find(Role.ANALOG_INPUTS)
        return [(entry.index, entry.sub) for entry in entries if entry.index == first.index and entry.sub >= first.sub]

    @property
    def drive_mode(self) -> Integers:
        """The manufacturer's mode, shape (num_axes,), as set by the maker's service program (D-Mode of the TGZ, 2303h).

        Setting it acts like that program: without frames on the bus. ObjectAccessError for a value that the object does
        not allow, and for a drive without such a mode.
        """
        return self.drives.read(Role.MODE_GATE)

    @drive_mode.setter
    def drive_mode(self, value: ArrayLike) -> None:
        self.drives.write(Role.MODE_GATE, value)

    @property
    def error_bits(self) -> Integers:
        """Forced errors, independent of machine and drive, shape (num_axes,); bit k is error k of the table.

        Can be set; errors with a physical cause here occur by that, too. ValueError for a bit without an error, and for
        drives without such bits.
        """
        self._check_has_errors()
        return self._axis_field(ERRORS_FIELD).astype(np.int64)

    @error_bits.setter
    def error_bits(self, value: ArrayLike) -> None:
        self._check_has_errors()
        device = self.inside.device
        known = 0
        for cause in device.firmware.causes:
            known |= cause.status_flag
        values = np.broadcast_to(np.asarray(value), (self.inside.num_axes,))
        if values.dtype.kind not in "iu" or np.any(values & ~known):
            bits = ", ".join(str(bit) for bit in range(32) if known >> bit & 1)
            raise ValueError(f"error bits of {device.name} are whole numbers of bits {bits}, not {value!r}")
        set_lanes(self.inside.records, ERRORS_FIELD, values)

    def _check_has_errors(self) -> None:
        device = self.inside.device
        if not device.firmware.layout.has(ERRORS_FIELD):
            raise ValueError(
                f"{device.name} has no error bits to set; inject a fault that causes the error (machine.fault)"
            )

    @property
    def leds(self) -> tuple[NDArray[np.str_], NDArray[np.str_]]:
        """Patterns of the run LED and the error LED of each axis' node, by name, each of shape (num_axes,).

        "off", "on", "blinking", "single flash" or "double flash" (CiA 303-3; their times are in canopen/leds.py).
        Drives without a bus show the patterns after power-on: pre-operational, without an error.
        """
        shown = np.array([AFTER_POWER_ON] * self.inside.num_axes).T
        for axes, lamps in self._lamps:
            shown = shown.astype(object)
            shown[0, axes], shown[1, axes] = lamps()
        run, error = shown.astype(str)
        return run, error

    def connect_lamps(self, axes: slice, lamps: Callable[[], tuple[str, str]]) -> None:
        """Take the LEDs of axes from those of a node: patterns of run and error, by name."""
        self._lamps.append((axes, lamps))

    @property
    def temperatures(self) -> tuple[Floats, Floats]:
        """Winding and stage temperature [degC], each of shape (num_axes,)."""
        return self._axis_field("T_winding"), self._axis_field("T_stage")

    def set_temperatures(self, winding: ArrayLike, stage: ArrayLike) -> None:
        """Set winding and stage temperature [degC], as after previous work; ValueError for one that is not finite."""
        each = {"T_winding": np.asarray(winding, float), "T_stage": np.asarray(stage, float)}
        if bad := [value for values in each.values() for value in values[~np.isfinite(values)]]:
            raise ValueError(f"a temperature must be finite, not {bad[0]:g} degC; give a finite number")
        for name, values in each.items():
            set_lanes(self.inside.records, name, np.broadcast_to(values, (self.inside.num_axes,)))

    def set(self, name: str, value: ArrayLike, where: Mask | None = None) -> None:
        """Set a true parameter [SI] of the machines where the mask is true; bad input changes nothing.

        Raises:
            ValueError: If there is no such parameter, the value is not finite, or impossible for a machine.
        """
        inside = self.inside
        check_known(name, inside.parameters)
        mask = self._mask(where)
        check_parameter(name, self._per_machine(value, name)[mask])
        values = np.where(mask, self._per_machine(value, name), inside.parameters[name])
        with self._faults.suspended():
            inside.apply_parameter(name, values, mask)
        inside.parameters[name] = values

    def set_all(self, values: Mapping[str, ArrayLike], where: Mask | None = None) -> None:
        """Set several true parameters [SI] at once; bad input changes nothing.

        Only the resulting machine must be possible, not intermediate ones; and a machine's inertias, which take most of
        the time of `set`, are derived only once.

        Args:
            values: Parameter -> one value, or one per machine.
            where: Machines.

        Raises:
            ValueError: As in `set`.
        """
        inside = self.inside
        mask = self._mask(where)
        new: dict[str, Floats] = {}
        for name, value in values.items():
            check_known(name, inside.parameters)
            check_parameter(name, self._per_machine(value, name)[mask])
            new[name] = np.where(mask, self._per_machine(value, name), inside.parameters[name])
        before = {name: inside.parameters[name] for name in new}
        with self._faults.suspended():
            try:
                inside.apply_parameters(new, mask)
            except ValueError:
                inside.apply_parameters(before, mask)
                raise

    def fault(
        self,
        name: str,
        *,
        at: float = 0.0,
        when: str = "",
        duration: float | None = None,
        where: Mask | None = None,
        axis: int | None = None,
        **parameters: float,
    ) -> int:
        """Inject a fault into machines, by a schedule; docs/faults.md explains each fault.

        A fault changes the machine without changing `parameters`. It begins and ends at communication cycles, and is
        the same for the same machine and seed.

        Args:
            name: A row of the table, e.g. "encoder_stuck".
            at: Time from now, or from when the condition holds for the first time [s], whole communication cycles.
            when: Its condition: "" none, "enabled" an axis in operation enabled, or a comparison of the true rotor
                angle [rad] or speed [rad/s], e.g. "position > 3.1" or "speed > 100".
            duration: Whole communication cycles [s]; None: until it is cleared or the machine is reset.
            where: Machines.
            axis: Number of the axis of each machine; all of them by default. It has no effect on a load's fault that
                does not concern one axis.
            **parameters: Numbers of the fault, in the units of its row.

        Returns:
            Its number, for `clear_fault`.

        Raises:
            ValueError: For an unknown fault or parameter, an invalid time or condition, or a fault that is impossible
                for this load.
        """
        order = Order(name, at, when, duration, axis=axis, parameters=parameters)
        return self._faults.add(order, self._mask(where))

    def faults(self) -> list[InjectedFault]:
        """Return the faults that are scheduled or active; one that has ended on all machines is forgotten."""
        return self._faults.listing()

    @property
    def possible_faults(self) -> list[str]:
        """Names of the faults that are possible for these machines, in the order of the table."""
        found = []
        for name in FAULTS:
            try:
                self._faults.check(Order(name))
            except ValueError:
                continue
            found.append(name)
        return found

    def clear_fault(self, number: int | None = None, where: Mask | None = None) -> None:
        """End or cancel a fault; None: all of them. ValueError for an unknown number."""
        self._faults.clear(number, self._mask(where))

    def seed_noise(self, seeds: ArrayLike, where: Mask | None = None) -> None:
        """Set noise seeds of machines, from their next reset on: 1...2^32 - 1, (num_machines,), else ValueError."""
        mask = self._mask(where)
        chosen = np.asarray(seeds, float)
        if chosen.shape != mask.shape or np.any((chosen < 1.0) | (chosen >= 2.0**32)):
            raise ValueError(f"noise takes {len(mask)} seeds of 1...{2**32 - 1}, one per machine")
        axes = self.inside.num_axes // self.inside.num_machines
        # As when machines are drawn: every axis has its own noise.
        apart = np.repeat(chosen, axes) + np.tile(np.arange(axes), len(mask))
        every = np.repeat(mask, axes)
        self.inside.noise_seeds[every] = (np.mod(apart, 2.0**32 - 1.0) + 1.0)[every]

    def reset(self, where: Mask | None = None) -> None:
        """Put machines to rest at zero and restart their drives; diverged machines recover, faults end."""
        mask = self._mask(where)
        inside = self.inside
        if self._faults.some:
            self._faults.clear(None, mask)
        for group in inside.groups:
            group.load.reset(mask[group.machines])
        axes = np.repeat(mask, inside.num_axes // inside.num_machines)
        if self._rest is None:
            layout = inside.device.firmware.layout
            parts = [(field, part) for field in layout.state for part in range(field.depth)]
            initial = np.array([[field.initial] for field, _ in parts])
            self._rest = RecordSnapshot(layout, inside.records, [(field.name, part) for field, part in parts], initial)
        self._rest.restore(axes)
        inside.set_noise(axes)
        for live, nominal in (("R_s", "R_nominal"), ("psi_m", "psi_nominal")):
            set_lanes(inside.records, live, get_lanes(inside.records, nominal, inside.num_axes), axes)
        inside.reported[mask] = False
        inside.objects.restart(axes)

    def power_cycle(self, where: Mask | None = None) -> None:
        """Switch the supply of the drives off and on: stored values return, counters and positions start at zero."""
        inside = self.inside
        inside.objects.restart(np.repeat(self._mask(where), inside.num_axes // inside.num_machines))

    def _axis_field(self, name: str) -> Floats:
        return get_lanes(self.inside.records, name, self.inside.num_axes).astype(float)

    def _mask(self, where: Mask | None) -> Mask:
        return checked_mask(where, self.inside.num_machines)

    def _per_machine(self, value: ArrayLike, name: str) -> Floats:
        values = np.asarray(value, float)
        if values.shape not in ((), (self.inside.num_machines,)):
            raise ValueError(
                f"{name} takes one value or one for each of {self.inside.num_machines} machines, not shape "
                f"{values.shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite, not {values[~np.isfinite(values)][0]:g}; give a finite number")
        return np.broadcast_to(values, (self.inside.num_machines,)).copy()
