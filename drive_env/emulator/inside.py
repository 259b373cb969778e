"""Access to the inside of emulated drives for machines, faults, tools and tests, which read and change it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from drive_env.devices import Device
from drive_env.dictionary.entries import ObjectName
from drive_env.dictionary.roles import Role
from drive_env.drives.arguments import whole_cycles
from drive_env.emulator.group import Group, rates_of
from drive_env.emulator.live_dictionary import LiveDictionary
from drive_env.emulator.machine_kinds import MACHINE_KINDS
from drive_env.emulator.parameters import MachineParameter
from drive_env.firmware.record import LANES, get_lanes, set_lanes
from drive_env.motors import Motor
from drive_env.saved_state import Saved
from mechanics.arrays import Floats, Integers, Mask
from mechanics.load import Load
from mechanics.model import copies_per_model
from mechanics.packed import pack

SWITCHES = ("left", "right", "home")  # bits of 60FDh
LINK_FIELD = "link_shared"  # of firmware in which axes 2k and 2k + 1 may share a DC link
BRAKE_TORQUE = 2.0  # of the motor's rated torque, usual for holding brakes


class Inside(Saved):
    """The true state inside emulated drives, which no drive shows on a bus.

    Args:
        device: The drives' device.
        motor: The motor of each drive.
        load: The load of each machine.
        parameter_rows: Description of each parameter of a machine, by name.
        parameters: True parameters by name [SI], each of shape (num_machines,).
        noise_seeds: Seed of each axis' noise, shape (num_axes,).

    Attributes:
        records: The drives' records, each of eight lanes, shape (blocks,); `get_lanes` and `set_lanes` read and write
            one.
        groups: The machines, in groups with a packed load each.
        objects: The object dictionary of every axis.
        cycle: Communication cycles since the beginning.
        schedule: Scheduled changes of parameters: (cycle, name, values, machines), the next one first.
        reported: Which machines were reported to have diverged, shape (num_machines,).
    """

    STATE = ("objects", "parameters", "noise_seeds", "cycle", "schedule", "reported")

    objects: LiveDictionary  # for commissioned drives

    def __init__(
        self,
        device: Device,
        motor: Motor,
        load: Load,
        parameter_rows: Mapping[str, MachineParameter],
        parameters: dict[str, Floats],
        noise_seeds: Floats,
    ) -> None:
        self.device, self.motor, self.load = device, motor, load
        self.parameter_rows, self.parameters, self.noise_seeds = parameter_rows, parameters, noise_seeds
        self.num_axes = len(noise_seeds)
        self.num_machines = self.num_axes // load.num_axes
        self.records: NDArray[np.void] = device.firmware.layout.new_records(self.num_axes)
        self.groups: list[Group] = []
        self.cycle = 0
        self.schedule: list[tuple[int, str, Floats, Mask]] = []
        self.reported: Mask = np.zeros(self.num_machines, bool)
        self._kind = MACHINE_KINDS[device.firmware_name]

    # --- construction ---------------------------------------------------------------------------------------------
    def build_groups(self, physics_steps: int, integrator: str, friction: str) -> None:
        """Build the machines, packed in groups; arguments as for `EmulatedDrives`."""
        self._longest_step = 1.0 / (self.device.velocity_rate * physics_steps)
        rates = rates_of(self.device, physics_steps)
        per_group = copies_per_model(self.load, self.num_machines)
        loads = pack(
            self.load,
            self._armature(),
            self._bearings(),
            {p.name: self.parameters[f"load.{p.name}"] for p in self.load.parameters},
            rates.window / physics_steps,
            copies=per_group,
            integrator=integrator,
            friction=friction,
            # A joint does not move far in a millisecond, and sliding friction does not depend on inertia.
            weigh_every=rates.windows * physics_steps,
        )
        first = 0
        for load in loads:
            machines = slice(first, first + load.copies)
            block, blocks = first * self.load.num_axes // LANES, -(-load.copies * self.load.num_axes // LANES)
            self.groups.append(Group(machines, load, self.records[block : block + blocks], rates, self.device.firmware))
            first = machines.stop

    def change_rates(self, device: Device) -> None:
        """Continue at the rates of a device that differs only in these; scheduled changes keep their times."""
        longer = device.cycle / self.device.cycle
        self.device = device
        self.schedule = [
            (self.cycle + math.ceil((due - self.cycle) / longer - 1e-9), name, values, where)
            for due, name, values, where in self.schedule
        ]
        # A step that is not longer than before keeps every resonance stable.
        rates = rates_of(device, math.ceil(1.0 / (device.velocity_rate * self._longest_step) - 1e-9))
        for group in self.groups:
            group.machinery.rates.replace(**{row.name: getattr(rates, row.name) for row in dataclasses.fields(rates)})
            group.load.set_step(rates.window / rates.substeps, rates.windows * rates.substeps)
        self.refresh_inertia()
        axes, name = np.ones(self.num_axes, bool), "stage.velocity_filter"  # its coefficients depend on the rate
        self._apply_to_records(name, np.repeat(self.parameters[name], self.load.num_axes), axes)

    def _set_constants(self, supply: float) -> None:
        records, device = self.records, self.device
        records["undervoltage"] = device.undervoltage
        records["overvoltage"] = device.overvoltage
        records["standstill"] = device.standstill
        records["warning_temperature"] = device.warning_temperature
        records["error_temperature"] = device.error_temperature
        for kind in SWITCHES:
            self.set_switches(kind, np.zeros(self.num_axes, bool))
        records["supply_voltage"] = supply
        records["mode_delay"] = device.quirks.mode_display_delay
        records["mode_needs_halt"] = device.quirks.mode_change_needs_halt
        records["absent_status_bits"] = device.quirks.absent_status_bits
        records["set_point_buffer"] = device.quirks.set_point_buffer
        records["pv_slows_down_by_6084h"] = device.quirks.pv_slows_down_by_6084h
        records["pv_starts_and_stops"] = device.quirks.pv_starts_and_stops
        records["homing_here_sets_zero"] = device.quirks.homing_here_sets_zero
        self._kind.set_constants(records, device, self.motor)
        if self._kind.connect is not None:
            self._kind.connect(records, device, np.full(self.num_axes, self.load.num_axes % device.num_axes == 0))
        self.set_noise(np.ones(self.num_axes, bool))

    def apply_what_was_drawn(self, supply: float) -> None:
        """Write the properties of machines, motor and supply [V] into the records."""
        self._set_constants(supply)
        for name, values in self.parameters.items():
            everywhere = np.ones(self.num_axes, bool)
            per_axis = np.repeat(values, self.load.num_axes)
            self._apply_to_records(name, per_axis, everywhere)
        self.refresh_inertia()
        set_lanes(self.records, "brake_torque", np.full(self.num_axes, BRAKE_TORQUE * self.motor.rated_torque))

    def commission(self, numbers: Integers, *, is_commissioned: bool) -> None:
        """Give the drives their dictionaries, with the motor's preset if they are commissioned, and start them."""
        preset: dict[ObjectName, int] = {}
        if is_commissioned:
            if Role.LIMIT_SWITCHES in self.device.roles:
                preset[Role.LIMIT_SWITCHES] = 0 if self.load.has_switches else 3
            for name, raw in self.device.preset(self.motor).items():
                preset[name] = raw
        self.objects = LiveDictionary(self.device, self.records, self.num_axes, preset)
        serial = self.device.canopen.objects.get("serial_number")
        if serial is not None:
            self.objects.engrave(serial, np.repeat(numbers + 1, self.load.num_axes))
        self.objects.restart(np.ones(self.num_axes, bool))

    # --- what the machines are --------------------------------------------------------------------------------------
    @property
    def links(self) -> Integers:
        """DC link of each axis, shape (num_axes,): the number of the first axis on it."""
        axes = np.arange(self.num_axes)
        if not self.device.firmware.layout.has(LINK_FIELD):
            return axes
        shared = np.asarray(get_lanes(self.records, LINK_FIELD, self.num_axes), float)
        return np.where(shared > 0.5, axes - axes % 2, axes)

    def cycles(self, duration: float) -> int:
        """Return the number of communication cycles in a time [s].

        Raises:
            ValueError: If it is not a time, or not a whole number of cycles.
        """
        return whole_cycles(duration, self.device.cycle)

    def connect_axes(self, first: int, number: int) -> None:
        """Make machines of one axis each share what the axes of one drive share, e.g. a DC link.

        Args:
            first: The drive's first axis.
            number: Number of its axes with a machine.

        Raises:
            ValueError: If they share a DC link, and their machines have different supplies.
        """
        if self._kind.connect is not None and self.load.num_axes == 1:
            axes = np.arange(self.num_axes)
            self._kind.connect(self.records, self.device, (axes >= first) & (axes < first + number))

    def set_switches(self, kind: str, held: Mask) -> None:
        """Set the switches of a kind: pressed by the load as in its row; `held` ones are always pressed."""
        for switch in self.load.switches:
            if switch.kind == kind:
                axes = np.tile(np.arange(self.load.num_axes) == switch.axis, self.num_machines)
                number = SWITCHES.index(kind)
                set_lanes(self.records, "switch_low", np.where(held, -np.inf, switch.low), axes, number)
                set_lanes(self.records, "switch_high", np.where(held, np.inf, switch.high), axes, number)
                wired = get_lanes(self.records, "wired", self.num_axes).astype(np.int32)
                set_lanes(self.records, "wired", wired | (1 << number), axes)

    def set_noise(self, axes: Mask) -> None:
        """Restart the noise of axes, if their firmware has noise."""
        if self._kind.noise:
            set_lanes(self.records, self._kind.noise, self.noise_seeds, axes)

    def _apply_to_records(self, name: str, values: Floats, axes: Mask) -> bool:
        """Write a motor or stage parameter into the records; return False for one of the mechanics."""
        if (write := self._kind.writes.get(name)) is None:
            return False
        write(self.records, self.device, self.motor, values, axes)
        return True

    def _armature(self) -> Floats:
        return np.repeat(self.parameters["motor.inertia"][:, None], self.load.num_axes, 1)

    def _bearings(self) -> Floats:
        """Return the motors' friction; breakaway equals sliding friction, so Stribeck's speed does not matter."""
        coulomb, viscous = self.parameters["motor.coulomb"], self.parameters["motor.viscous"]
        one = np.stack([coulomb, coulomb, np.ones_like(coulomb), viscous], -1)
        return np.repeat(one[:, None, :], self.load.num_axes, 1)

    def apply_parameter(self, name: str, values: Floats, machines: Mask) -> None:
        """Write a true parameter into records and mechanics; a refused one changes nothing."""
        axes_per_machine = self.load.num_axes
        axes = np.repeat(machines, axes_per_machine)
        if self._apply_to_records(name, np.repeat(values, axes_per_machine), axes):
            return
        before, self.parameters[name] = self.parameters[name], values
        try:
            self._apply_to_loads(name, machines)
        except ValueError:
            self.parameters[name] = before
            self._apply_to_loads(name, machines)
            raise
        self.refresh_inertia()

    def apply_parameters(self, values: Mapping[str, Floats], machines: Mask) -> None:
        """Write several true parameters into records and mechanics, and store them; a refusal leaves some changed."""
        axes_per_machine = self.load.num_axes
        axes = np.repeat(machines, axes_per_machine)
        self.parameters |= values
        mechanical = [
            name
            for name, value in values.items()
            if not self._apply_to_records(name, np.repeat(value, axes_per_machine), axes)
        ]
        if not mechanical:
            return
        loads = [name.removeprefix("load.") for name in mechanical if name.startswith("load.")]
        armature, bearings = self._armature(), self._bearings()
        for group in self.groups:
            group.load.set_all(
                {name: self.parameters[f"load.{name}"][group.machines] for name in loads},
                machines[group.machines],
                armature[group.machines],
                bearings[group.machines],
            )
        self.refresh_inertia()

    def _apply_to_loads(self, name: str, machines: Mask) -> None:
        values, armature, bearings = self.parameters[name], self._armature(), self._bearings()
        for group in self.groups:
            if name.startswith("load."):
                group.load.set(name.removeprefix("load."), values[group.machines], machines[group.machines])
            else:
                group.load.set_motor(armature[group.machines], bearings[group.machines])

    def refresh_inertia(self) -> None:
        """Update the rotors' total inertia after a change of load."""
        axes = self.load.num_axes
        inertia = np.concatenate([group.load.plant.mass[:axes].T.reshape(-1) for group in self.groups])
        set_lanes(self.records, "J_rotor", inertia)
