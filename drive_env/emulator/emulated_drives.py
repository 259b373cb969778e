"""The Drives interface, and emulated drives behind it.

Whatever acts on a drive uses this interface and nothing deeper, so that it runs on the emulator and on a bus alike.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drive_env.cores import usable_cores
from drive_env.default_device import DEFAULT_DEVICE
from drive_env.devices import Device, find_device
from drive_env.dictionary.codec import Code
from drive_env.dictionary.entries import ObjectName
from drive_env.dictionary.roles import Role
from drive_env.drives.arguments import checked_mask, object_names, whole_cycles
from drive_env.drives.emergency import EmergencyMessage
from drive_env.drives.trace import Trace
from drive_env.emulator.group import Group, call_of, channels, rates_of
from drive_env.emulator.inertia_check import warn_of_misfits
from drive_env.emulator.inside import Inside
from drive_env.emulator.live_dictionary import NOTHING, LiveDictionary
from drive_env.emulator.machine import Machines, checked_supply
from drive_env.emulator.machine_kinds import MACHINE_KINDS
from drive_env.emulator.parameters import (
    check_known,
    check_parameter,
    draw_parameters,
    parameter_table,
)
from drive_env.emulator.prepared_record import PreparedRecord
from drive_env.faults.machine_faults import MachineFaults
from drive_env.firmware import cycle
from drive_env.firmware.cycle import Call
from drive_env.firmware.record import LANES, get_lanes, set_lanes
from drive_env.master.quantities import AxisScale, Scale, integers, is_quantity
from drive_env.motors import Motor, find_motor
from drive_env.saved_state import Saved, State, check_alike
from mechanics.arrays import Floats, Integers, Mask
from mechanics.load import Load
from mechanics.loads import find_load
from mechanics.model import copies_per_model
from mechanics.packed import PackedLoad, pack

SWITCHES = ("left", "right", "home")  # bits of 60FDh

MOST_PREPARED = 64  # calls of record that are kept prepared: more than any loop makes in turn

MOST_MACHINES = 65_536  # some 17 kB each: 1.1 GB
BRAKE_TORQUE = 2.0  # of the motor's rated torque, usual for holding brakes


def check_number_of_machines(number: int) -> None:
    """Raise ValueError for a number of machines that cannot be."""
    if number < 1:
        raise ValueError(f"num_machines must be 1 or more, not {number}")
    if number > MOST_MACHINES:
        raise ValueError(f"num_machines must be {MOST_MACHINES} at most, not {number}")


class EmulatedDrives(Saved):
    """Emulated drives that turn emulated machines.

    The drives come up commissioned for their motor and in switch on disabled; with `commissioned=False` they have their
    factory values, and nothing moves until they are commissioned.

    Args:
        device: Name of the device.
        load: A load's name, the path of your own MJCF, or a `mechanics.Load`.
        motor: Name of the motor, the path of your own motor's TOML, or a `Motor`; by default the device's usual one.
        num_machines: Machines, each with its drives.
        seed: Seed of everything random. Machine k of a seed is the same machine in every set.
        commissioned: Give the drives their motor's preset; otherwise they have their factory values.
        first_machine: Number of the first machine.
        identical: Make every machine the one numbered `first_machine`, its noise included: for comparing gains.
        randomise: Parameters to draw per machine: True for all, or names or groups ("load", "motor.R_s"). How a motor
            is wired is drawn with the rest where the drives have factory values; commissioned ones know it, and it is
            drawn where it is named ("motor.encoder_direction").
        ideal: Take a stage, encoder and bearings without faults.
        parameters: True machine parameters [SI] that replace defaults and draws: one value or one per machine.
        supply: Supply voltage [V]; by default the motor's, or the highest that the device is built for.
        num_threads: Threads that run machines; the cores that this process may use by default.
        physics_steps: Physics steps per velocity-loop period.
        integrator: "leapfrog", or "rk4", the slower oracle.
        friction: How the load's friction is modelled: "none", "coulomb_viscous", "stribeck" or "lugre".

    Raises:
        ValueError: For an unknown name, a motor that the device does not turn, or a machine that cannot be.
    """

    STATE = ("_objects", "_parameters", "_noise_seeds", "_now", "_schedule", "_reported", "_faults")

    # Of the Drives interface: what emulated drives do not have, and their time, which passes when it is asked to.
    bus = None
    safety = None
    observers = ()
    time_waits = True

    def __init__(
        self,
        device: str = DEFAULT_DEVICE,
        load: str | Path | Load = "two_mass",
        motor: str | Path | Motor | None = None,
        num_machines: int = 1,
        seed: int = 0,
        *,
        commissioned: bool = True,
        first_machine: int = 0,
        identical: bool = False,
        randomise: bool | Collection[str] = False,
        ideal: bool = False,
        parameters: Mapping[str, ArrayLike] | None = None,
        supply: float | None = None,
        num_threads: int | None = None,
        physics_steps: int = 1,
        integrator: str = "leapfrog",
        friction: str = "stribeck",
    ) -> None:
        check_number_of_machines(num_machines)
        self.device: Device = find_device(device)
        self.motor = find_motor(self.device.default_motor if motor is None else motor)
        self.device.check_motor(self.motor)
        self.load = find_load(load)
        self.num_machines = num_machines
        self.num_axes = num_machines * self.load.num_axes
        self.axis_numbers = range(self.num_axes)
        volts = checked_supply(self.device.supply_of(self.motor) if supply is None else supply, 1)
        self._firmware, self._kind = self.device.firmware, MACHINE_KINDS[self.device.firmware_name]
        self._records = self._firmware.layout.new_records(self.num_axes)
        self._threads = max(1, num_threads if num_threads is not None else usable_cores())
        self._executor: ThreadPoolExecutor | None = None
        numbers = (
            [first_machine] * num_machines if identical else list(range(first_machine, first_machine + num_machines))
        )
        self._draw(seed, numbers, randomise, ideal, parameters or {}, wired_as_known=commissioned)
        self._groups = self._build_groups(physics_steps, integrator, friction)
        self._turn = np.zeros(1, np.int64)
        self._fleet = cycle.Fleet(np.array([group.machinery.address for group in self._groups], np.int64), self._turn)
        self._apply_what_was_drawn(float(volts[0]))
        warn_of_misfits([group.load for group in self._groups], self.motor, self.device)
        self._begin()
        self.machine = Machines(self)
        self.inside = Inside(self)
        self._commission(np.array(numbers), is_commissioned=commissioned)

    def _apply_what_was_drawn(self, supply: float) -> None:
        """Give the records what machines, motor and supply [V] are."""
        self._set_constants(supply)
        for name, values in self._parameters.items():
            everywhere = np.ones(self.num_axes, bool)
            per_axis = np.repeat(values, self.load.num_axes)
            self._apply_to_records(name, per_axis, everywhere)
        self._refresh_inertia()
        set_lanes(self._records, "brake_torque", np.full(self.num_axes, BRAKE_TORQUE * self.motor.rated_torque))

    def _begin(self) -> None:
        """Begin time: nothing is scheduled, no fault is there."""
        self._now = 0  # cycles since the beginning
        self._schedule: list[tuple[int, str, Floats, Mask]] = []
        self._prepared: dict[tuple[ObjectName | None, ...], PreparedRecord] = {}  # of calls of record
        self._reported = np.zeros(self.num_machines, bool)
        nothing = np.empty((0, 0, self.num_axes))
        self._nothing = call_of(nothing, NOTHING, nothing, NOTHING, 1)
        self._faults = MachineFaults(self)

    def _commission(self, numbers: Integers, *, is_commissioned: bool) -> None:
        """Give the drives their dictionaries, with the motor's preset if they are commissioned, and start them."""
        preset: dict[ObjectName, int] = {}
        if is_commissioned:
            if Role.LIMIT_SWITCHES in self.device.roles:
                preset[Role.LIMIT_SWITCHES] = 0 if self.load.has_switches else 3
            for name, raw in self.device.preset(self.motor).items():
                preset[name] = raw
        self._objects = LiveDictionary(self.device, self._records, self.num_axes, preset)
        serial = self.device.canopen.objects.get("serial_number")
        if serial is not None:
            self._objects.engrave(serial, np.repeat(numbers + 1, self.load.num_axes))
        self._objects.restart(np.ones(self.num_axes, bool))
        self._scale: tuple[int, list[Scale]] = (-1, [])

    @property
    def codes(self) -> Mapping[tuple[int, int], Code]:
        """How the integers of bound objects are SI values, by index and sub-index."""
        return self._objects.codes

    # --- the interface --------------------------------------------------------------------------------------------
    def read(self, name: ObjectName) -> Integers:
        """Return an object as the wire carries it, int64 of shape (num_axes,); a text as an array of str.

        Raises:
            ObjectAccessError: If there is no such object or it cannot be read.
        """
        return self._objects.read(name)

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object of the axes where the mask is true: one integer, one per axis, or a quantity, "500 rpm".

        A write is checked for all axes before it changes any.

        Raises:
            ObjectAccessError: With the SDO abort code, if the object, the value or the state does not allow it.
            ValueError: For a quantity that the object is none of.
        """
        axes = checked_mask(where, self.num_axes)
        if is_quantity(value):
            entry = self._objects.entries.find(name)
            if entry.bits is not None:
                value = integers(str(value), entry, self._scales(), axes)
        self._objects.write(name, value, axes)

    def _scales(self) -> list[Scale]:
        """Return what the units of each axis follow, read again once it was written."""
        if self._scale[0] != self._objects.scale_changes:
            found = self._objects.context()
            every = (found.position_scaler, found.velocity_ratio, found.peak_current)
            rows = np.stack([np.broadcast_to(np.asarray(one, float), (self.num_axes,)) for one in every], axis=1)
            self._scale = self._objects.scale_changes, [AxisScale(*row) for row in rows.tolist()]
        return self._scale[1]

    def advance(self, duration: float) -> None:
        """Let `duration` [s] pass, whole communication cycles of 1 ms."""
        cycles = self._cycles(duration)
        self._run(cycles, self._nothing)

    def record(
        self,
        objects: ObjectName | Sequence[ObjectName],
        duration: float,
        play: Mapping[Any, ArrayLike] | None = None,
        period: float = 0.001,
    ) -> Trace:
        """Let `duration` [s] pass while objects are recorded and played.

        Cycle k: row k of `play` is written, then row k is recorded, then one communication cycle passes. In csp and
        csv every row is a set-point that arrives, also one that repeats the last.

        Args:
            objects: What to record: one object, or several.
            duration: Whole communication cycles [s].
            play: Object -> integers to write, shape (cycles,) or (cycles, num_axes).
            period: Time between samples [s], whole communication cycles.

        Raises:
            ObjectAccessError: For an object that cannot be recorded or played, or a value out of range.
            ValueError: For times that are no whole cycles, or rows that do not fit.
        """
        cycles = self._cycles(duration)
        every = self._cycles(period)
        if every < 1:
            raise ValueError(f"period must be at least {self.device.cycle:g} s, not {period:g} s")
        objects, play = object_names(objects), play or {}
        names = (*objects, None, *play)
        prepared = self._prepared.get(names)
        if prepared is not None and prepared.scale_changes == self._objects.scale_changes:
            values = np.empty((cycles, len(play), self.num_axes))
            if prepared.play(play, values):
                samples = np.empty((-(-cycles // every), len(prepared.keys), self.num_axes))
                self._run(cycles, call_of(values, prepared.played, samples, prepared.sampled, every))
                return self._trace(prepared.read(samples), len(samples), every)
        known = self._objects.entries
        entries = [known.find(name) for name in objects]
        codes = {(e.index, e.sub): self._objects.recordable(e) for e in entries}
        live = {key: code for key, code in codes.items() if code is not None}
        sampled = channels(self._firmware.layout, [(b.field, b.part) for b in live.values()]) if live else NOTHING
        values, played = self._objects.plan_play(play, cycles)
        rows = -(-cycles // every)
        samples = np.empty((rows, len(live), self.num_axes))
        self._run(cycles, call_of(values, played, samples, sampled, every))
        result: dict[tuple[int, int], Integers] = {}
        for k, (key, code) in enumerate(live.items()):
            result[key] = self._objects.recorded(known.find(key), code, samples[:, k])
        for key in codes:
            if key not in result:
                result[key] = np.broadcast_to(self._objects.read(key), (rows, self.num_axes))
        prepared = self._objects.prepared_record(objects, list(play))
        if prepared is not None and len(self._prepared) < MOST_PREPARED:
            self._prepared[names] = prepared
        return self._trace(result, rows, every)

    def _trace(self, values: dict[tuple[int, int], Integers], rows: int, every: int) -> Trace:
        t = np.arange(rows, dtype=np.float64) * (every * self.device.cycle)
        scale = self._scales()
        return Trace(t, values, self._objects.entries, lambda: scale)

    def emergencies(self) -> list[EmergencyMessage]:
        """Return and forget the emergency messages since the last call, axis by axis in the order of each axis."""
        messages = []
        counts = get_lanes(self._records, "emergency_count", self.num_axes)
        for axis in np.flatnonzero(counts):
            for k in range(int(counts[axis])):
                queued = int(get_lanes(self._records, "emergency", self.num_axes, k)[axis])
                cause = self._firmware.causes[(queued & 0xFF) - 1]
                emergency = self.device.emergencies[cause.name].of_axis(int(axis) % self.device.num_axes)
                messages.append(EmergencyMessage(int(axis), emergency.code, queued >> 8, emergency.extra, cause.name))
        set_lanes(self._records, "emergency_count", np.zeros(self.num_axes, np.int32))
        return messages

    def reset_node(self, where: Mask | None = None) -> None:
        """Reset the drives (NMT reset node): values return to the stored ones, the automaton starts anew."""
        self._objects.restart(checked_mask(where, self.num_axes))

    # --- states ---------------------------------------------------------------------------------------------------
    def save_state(self) -> State:
        """Return all that drives and machines go on from, bit by bit, as plain data that pickles."""
        return {
            "of": self._description(),
            "groups": [group.load.save_state() for group in self._groups],
        } | super().save_state()

    def restore_state(self, state: State) -> None:
        """Put drives and machines back to a state that such drives have saved, these or others that were made alike.

        Raises:
            ValueError: For a state of other drives, naming what differs.
        """
        check_alike("drives", state["of"], self._description())
        super().restore_state(state)
        for group, saved in zip(self._groups, state["groups"], strict=True):
            group.load.restore_state(saved)

    def _description(self) -> State:
        """Return what must be equal in two sets of drives so that one can restore the state of the other."""
        groups = [(group.load.copies, group.load.h, group.load.staggered) for group in self._groups]
        return {
            "device": self.device.name, "load": str(self.load.name), "motor": self.motor.name,
            "machines": self.num_machines, "parameters": sorted(self._parameters), "models": groups,
            "bytes of a record": self._records.dtype.itemsize,
        }  # fmt: skip

    def close(self) -> None:
        """Give the threads back; the drives cannot be used afterwards."""
        if self._executor is not None:
            self._executor.shutdown()
            self._executor = None

    def __enter__(self) -> EmulatedDrives:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- construction ---------------------------------------------------------------------------------------------
    def _draw(
        self,
        seed: int,
        numbers: list[int],
        randomise: bool | Collection[str],
        ideal: bool,
        given: Mapping[str, ArrayLike],
        wired_as_known: bool,
    ) -> None:
        axes = (1, self.load.num_axes)
        single = PackedLoad(self.load, np.ones(axes), np.zeros((*axes, 4)), {}, 1e-6)
        defaults = {p.name: float(single.get(p.name)[0]) for p in self.load.parameters}
        table = parameter_table(self._kind, self.device, self.motor, self.load, defaults)
        self._parameter_rows = table
        self._parameters, noise = draw_parameters(table, seed, numbers, randomise, ideal, wired_as_known=wired_as_known)
        seeds = np.repeat(noise, self.load.num_axes) + np.tile(np.arange(axes[1]), self.num_machines)
        self._noise_seeds = np.mod(seeds, 2.0**32 - 1.0) + 1.0  # xorshift stays at 0 for ever
        for name, value in given.items():
            check_known(name, table)
            self._parameters[name] = np.broadcast_to(np.asarray(value, float), (self.num_machines,)).copy()
            check_parameter(name, self._parameters[name])

    def _build_groups(self, physics_steps: int, integrator: str, friction: str) -> list[Group]:
        rates = rates_of(self.device, physics_steps)
        per_group = copies_per_model(self.load, self.num_machines)
        loads = pack(
            self.load,
            self._armature(),
            self._bearings(),
            {p.name: self._parameters[f"load.{p.name}"] for p in self.load.parameters},
            rates.window / physics_steps,
            copies=per_group,
            integrator=integrator,
            friction=friction,
            # A joint does not go far in a millisecond, and sliding friction does not depend on inertia.
            weigh_every=rates.windows * physics_steps,
        )
        groups, first = [], 0
        for load in loads:
            machines = slice(first, first + load.copies)
            block, blocks = first * self.load.num_axes // LANES, -(-load.copies * self.load.num_axes // LANES)
            groups.append(Group(machines, load, self._records[block : block + blocks], rates, self._firmware))
            first = machines.stop
        return groups

    def _set_constants(self, supply: float) -> None:
        records, device = self._records, self.device
        records["undervoltage"] = device.undervoltage
        records["overvoltage"] = device.overvoltage
        records["standstill"] = device.standstill
        records["warning_temperature"] = device.warning_temperature
        records["error_temperature"] = device.error_temperature
        for switch in self.load.switches:
            kind = SWITCHES.index(switch.kind)
            axes = np.tile(np.arange(self.load.num_axes) == switch.axis, self.num_machines)
            set_lanes(records, "switch_low", np.full(self.num_axes, switch.low), axes, kind)
            set_lanes(records, "switch_high", np.full(self.num_axes, switch.high), axes, kind)
            wired = get_lanes(records, "wired", self.num_axes).astype(np.int32)
            set_lanes(records, "wired", wired | (1 << kind), axes)
        records["supply_voltage"] = supply
        records["mode_delay"] = device.quirks.mode_display_delay
        records["mode_needs_halt"] = device.quirks.mode_change_needs_halt
        records["absent_status_bits"] = device.quirks.absent_status_bits
        records["set_point_buffer"] = device.quirks.set_point_buffer
        records["pv_slows_down_by_6084h"] = device.quirks.pv_slows_down_by_6084h
        records["pv_starts_and_stops"] = device.quirks.pv_starts_and_stops
        self._kind.set_constants(records, device, self.motor)
        if self._kind.connect is not None:
            self._kind.connect(records, device, np.full(self.num_axes, self.load.num_axes % device.num_axes == 0))
        self._set_noise(np.ones(self.num_axes, bool))

    def _set_noise(self, axes: Mask) -> None:
        """Let the noise of axes begin anew, where their firmware has any."""
        if self._kind.noise:
            set_lanes(self._records, self._kind.noise, self._noise_seeds, axes)

    def _apply_to_records(self, name: str, values: Floats, axes: Mask) -> bool:
        """Write a motor or stage parameter into the records; return False for one that is the mechanics'."""
        if (write := self._kind.writes.get(name)) is None:
            return False
        write(self._records, self.device, self.motor, values, axes)
        return True

    def _armature(self) -> Floats:
        return np.repeat(self._parameters["motor.inertia"][:, None], self.load.num_axes, 1)

    def _bearings(self) -> Floats:
        """Return the motors' friction; their breakaway is that of sliding, so Stribeck's speed does not matter."""
        coulomb, viscous = self._parameters["motor.coulomb"], self._parameters["motor.viscous"]
        one = np.stack([coulomb, coulomb, np.ones_like(coulomb), viscous], -1)
        return np.repeat(one[:, None, :], self.load.num_axes, 1)

    def _apply_parameter(self, name: str, values: Floats, machines: Mask) -> None:
        """Bring a true parameter into records and mechanics; a refused one changes nothing."""
        axes_per_machine = self.load.num_axes
        axes = np.repeat(machines, axes_per_machine)
        if self._apply_to_records(name, np.repeat(values, axes_per_machine), axes):
            return
        before, self._parameters[name] = self._parameters[name], values
        try:
            self._apply_to_loads(name, machines)
        except ValueError:
            self._parameters[name] = before
            self._apply_to_loads(name, machines)
            raise
        self._refresh_inertia()

    def _apply_parameters(self, values: Mapping[str, Floats], machines: Mask) -> None:
        """Bring several true parameters into records and mechanics, and remember them; a refusal leaves a mixture."""
        axes_per_machine = self.load.num_axes
        axes = np.repeat(machines, axes_per_machine)
        self._parameters |= values
        mechanical = [
            name
            for name, value in values.items()
            if not self._apply_to_records(name, np.repeat(value, axes_per_machine), axes)
        ]
        if not mechanical:
            return
        loads = [name.removeprefix("load.") for name in mechanical if name.startswith("load.")]
        armature, bearings = self._armature(), self._bearings()
        for group in self._groups:
            group.load.set_all(
                {name: self._parameters[f"load.{name}"][group.machines] for name in loads},
                machines[group.machines],
                armature[group.machines],
                bearings[group.machines],
            )
        self._refresh_inertia()

    def _apply_to_loads(self, name: str, machines: Mask) -> None:
        values, armature, bearings = self._parameters[name], self._armature(), self._bearings()
        for group in self._groups:
            if name.startswith("load."):
                group.load.set(name.removeprefix("load."), values[group.machines], machines[group.machines])
            else:
                group.load.set_motor(armature[group.machines], bearings[group.machines])

    def _refresh_inertia(self) -> None:
        axes = self.load.num_axes
        inertia = np.concatenate([group.load.plant.mass[:axes].T.reshape(-1) for group in self._groups])
        set_lanes(self._records, "J_rotor", inertia)

    # --- time -----------------------------------------------------------------------------------------------------
    def _cycles(self, duration: float) -> int:
        return whole_cycles(duration, self.device.cycle)

    def _run(self, cycles: int, call: Call) -> None:
        begin, done, diverged = self._now, 0, False
        while done < cycles:
            while self._schedule and self._schedule[0][0] <= begin + done:
                _, name, values, where = self._schedule.pop(0)
                self.machine.set(name, values, where)
            until = min([cycles, *(due - begin for due, *_ in self._schedule[:1])]) if self._schedule else cycles
            if self._faults.some:
                until = min(until, self._faults.act(begin + done) - begin)
            diverged |= self._run_groups(call, done, until, done == 0, until == cycles)
            done = until
            self._now = begin + done
        if diverged:
            self._report_divergence()

    def _run_groups(self, call: Call, start: int, end: int, first: bool, last: bool) -> bool:
        self._turn[0] = 0
        given = self._fleet.address, call.address, start, end, first, last
        helpers = min(self._threads, len(self._groups)) - 1
        if not helpers:
            return bool(self._firmware.run(*given))
        if self._executor is None:
            self._executor = ThreadPoolExecutor(self._threads - 1, thread_name_prefix="drives")
        jobs = [self._executor.submit(self._firmware.run, *given) for _ in range(helpers)]
        found = bool(self._firmware.run(*given))
        return sum(job.result() for job in jobs) > 0 or found

    def _report_divergence(self) -> None:
        diverged = self.machine.diverged
        new = np.flatnonzero(diverged & ~self._reported)
        self._reported = diverged
        if new.size:
            warnings.warn(
                f"machine {', '.join(map(str, new[:10]))}{' ...' if new.size > 10 else ''} left the range of physics "
                "and is frozen at rest until machine.reset(); the others continue",
                RuntimeWarning,
                stacklevel=4,
            )
