"""Emulated drives behind the Drives interface.

Code that acts on drives uses only this interface, so that it runs on the emulator and on a bus alike.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from drive_env.cores import usable_cores
from drive_env.default_device import DEFAULT_DEVICE
from drive_env.devices import find_device
from drive_env.dictionary.codec import Code
from drive_env.dictionary.entries import ObjectName, ObjectNames, Rows
from drive_env.dictionary.quantities import AxisScale, Scale, integers, is_quantity
from drive_env.drives.arguments import checked_mask, object_names
from drive_env.drives.emergency import EmergencyMessage
from drive_env.drives.enabled_check import EnabledCheck
from drive_env.drives.interface import CYCLE, Drives, machine_of
from drive_env.drives.trace import Trace
from drive_env.emulator.group import call_of, channels, with_cycle
from drive_env.emulator.inertia_check import warn_of_misfits
from drive_env.emulator.inside import Inside
from drive_env.emulator.live_dictionary import NOTHING
from drive_env.emulator.machine import Machines, checked_supply
from drive_env.emulator.machine_faults import MachineFaults
from drive_env.emulator.machine_kinds import MACHINE_KINDS
from drive_env.emulator.parameters import (
    MachineParameter,
    check_known,
    check_parameter,
    draw_parameters,
    parameter_table,
)
from drive_env.emulator.prepared_record import PreparedRecord
from drive_env.firmware import cycle
from drive_env.firmware.cycle import Call
from drive_env.firmware.record import get_lanes, set_lanes
from drive_env.motors import Motor, find_motor
from drive_env.saved_state import Saved, State, check_alike
from mechanics.arrays import Floats, Integers, Mask
from mechanics.load import Load
from mechanics.loads import find_load
from mechanics.packed import default_values

MOST_PREPARED = 64  # prepared calls of record that are kept: more than any loop alternates between

MOST_MACHINES = 65_536  # some 17 kB each: 1.1 GB


def check_number_of_machines(number: int) -> None:
    """Raise ValueError for an impossible number of machines."""
    if number < 1:
        raise ValueError(f"num_machines must be 1 or more, not {number}")
    if number > MOST_MACHINES:
        raise ValueError(f"num_machines must be {MOST_MACHINES} at most, not {number}")


class EmulatedDrives(Saved):
    """Emulated drives with emulated machines.

    The drives start commissioned for their motor, in switch on disabled; with `commissioned=False` they have their
    factory values, and cannot move until they are commissioned.

    Args:
        device: Name of the device.
        load: A load's name, the path of your own MJCF, or a `mechanics.Load`.
        motor: Name of the motor, the path of your own motor's TOML, or a `Motor`; by default the device's usual one.
        num_machines: Machines, each with its drives.
        seed: Seed of everything random. Machine k of a seed is the same machine in every set of drives.
        commissioned: Whether the drives have their motor's preset instead of their factory values.
        first_machine: Number of the first machine.
        distinct: After this number the machines repeat, including their noise: for comparing gains. None: never.
        randomise: Parameters to draw per machine: True for all, or names or groups ("load", "motor.R_s"). The wiring of
            a motor is included only if the drives have factory values: commissioned ones know it, so it is drawn only
            if it is named ("motor.encoder_direction").
        ideal: Whether power stage, encoder and bearings have no imperfections.
        parameters: True machine parameters [SI] that replace defaults and draws: one value or one per machine.
        supply: Supply voltage [V]; by default the motor's, or the highest that the device is built for.
        num_threads: Threads that run machines; the cores that this process may use by default.
        physics_steps: Physics steps per velocity-loop period.
        integrator: "leapfrog", or "rk4", the slower oracle.
        friction: Model of the load's friction: "none", "coulomb_viscous", "stribeck" or "lugre".

    Raises:
        ValueError: For an unknown name, a motor that the device cannot turn, or an impossible machine.
    """

    STATE = ("inside", "faults")

    # Of the Drives interface: attributes that emulated drives lack, and their time, which passes only on request.
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
        distinct: int | None = None,
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
        self._rated = self.device = find_device(device)  # with its original rates
        self.image_period = self.device.cycle
        self.motor = find_motor(self.device.default_motor if motor is None else motor)
        self.device.check_motor(self.motor)
        self.load = find_load(load)
        self.num_machines = num_machines
        self.num_axes = num_machines * self.load.num_axes
        self.axis_numbers = range(self.num_axes)
        volts = checked_supply(self.device.supply_of(self.motor) if supply is None else supply, 1)
        self._firmware = self.device.firmware
        self._threads = max(1, num_threads if num_threads is not None else usable_cores())
        self._executor: ThreadPoolExecutor | None = None
        if distinct is not None and distinct < 1:
            raise ValueError(f"distinct must be 1 or more, not {distinct}; None for machines that are all their own")
        numbers = [first_machine + k % (distinct or num_machines) for k in range(num_machines)]
        drawn = self._drawn(seed, numbers, randomise, ideal, parameters or {}, wired_as_known=commissioned)
        self.inside = Inside(self.device, self.motor, self.load, *drawn)
        self.inside.build_groups(physics_steps, integrator, friction)
        groups = self.inside.groups
        self._turn = np.zeros(1, np.int64)
        self._fleet = cycle.Fleet(np.array([group.machinery.address for group in groups], np.int64), self._turn)
        self.inside.apply_what_was_drawn(float(volts[0]))
        warn_of_misfits([group.load for group in groups], self.motor, self.device)
        self._prepared: dict[tuple[ObjectName | None, ...], PreparedRecord] = {}  # of calls of record
        self._check_enabled = EnabledCheck()
        nothing = np.empty((0, 0, self.num_axes))
        self._nothing = call_of(nothing, NOTHING, nothing, NOTHING, 1)
        self.faults = MachineFaults(self.inside)
        self.machine: Machines = Machines(self, self.inside, self.faults)
        self.inside.commission(np.array(numbers), is_commissioned=commissioned)
        self._scale: tuple[int, list[Scale]] = (-1, [])

    @property
    def codes(self) -> Mapping[tuple[int, int], Code]:
        """Conversions of bound objects, by index and sub-index."""
        return self.inside.objects.codes

    # --- the interface --------------------------------------------------------------------------------------------
    def read(self, name: ObjectName) -> Integers:
        """Return an object as integers on the bus, int64 of shape (num_axes,); a text as an array of str.

        Raises:
            ObjectAccessError: If there is no such object or it cannot be read.
        """
        return self.inside.objects.read(name)

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object of the axes where the mask is true: one integer, one per axis, or a quantity, "500 rpm".

        A write is checked for all axes before it changes any.

        Raises:
            ObjectAccessError: With the SDO abort code, if the object, the value or the state does not allow it.
            ValueError: For a quantity of another kind than the object's.
        """
        axes = checked_mask(where, self.num_axes)
        if is_quantity(value):
            entry = self.inside.objects.entries.find(name)
            if entry.bits is not None:
                value = integers(str(value), entry, self._scales(), axes)
        self.inside.objects.write(name, value, axes)

    def _scales(self) -> list[Scale]:
        """Return the scale of each axis' units, read again after a change."""
        if self._scale[0] != self.inside.objects.scale_changes:
            found = self.inside.objects.context()
            every = (
                found.position_scaler, found.velocity_ratio, found.peak_current, found.nominal_motor_current,
                found.set_point_ratio,
            )  # fmt: skip
            rows = np.stack([np.broadcast_to(np.asarray(one, float), (self.num_axes,)) for one in every], axis=1)
            self._scale = self.inside.objects.scale_changes, [AxisScale(*row) for row in rows.tolist()]
        return self._scale[1]

    def advance(self, duration: float) -> None:
        """Let `duration` [s] pass, whole communication cycles of 1 ms."""
        cycles = self.inside.cycles(duration)
        self._run(cycles, self._nothing)

    def set_cycle(self, cycle: float) -> None:
        """Set the time between process images to `cycle` [s], and the communication cycle, at most to the device's.

        Time continues. A physics step does not become longer; the velocity loop gets the nearest lower rate that fits.
        """
        device = with_cycle(self._rated, cycle)
        self.image_period = max(cycle, device.cycle)
        if device.cycle != self.device.cycle:
            longer = device.cycle / self.device.cycle
            self.device = device
            self.inside.change_rates(device)
            self.faults.change_cycle(longer)

    def record(self, objects: ObjectNames, duration: float, play: Rows = None, period: float = CYCLE) -> Trace:
        """Let `duration` [s] pass while objects are recorded and played.

        Cycle k: row k of `play` is written, then row k is recorded, then one communication cycle passes. In csp and csv
        every row counts as a new set-point, even if it repeats the last one.

        Args:
            objects: The objects to record: one, or several.
            duration: Whole communication cycles [s].
            play: Object -> integers to write, shape (cycles,) or (cycles, num_axes).
            period: Time between samples [s], whole communication cycles.

        Raises:
            ObjectAccessError: For an object that cannot be recorded or played, or a value out of range.
            ValueError: For times that are not whole cycles, or rows of a wrong shape.
        """
        cycles = self.inside.cycles(duration)
        every = self.inside.cycles(period)
        if every < 1:
            raise ValueError(f"period must be at least {self.device.cycle:g} s, not {period:g} s")
        objects, play = object_names(objects), play or {}
        self._check_enabled(self, self.inside.objects.entries, play, cycles)
        names = (*objects, None, *play)
        prepared = self._prepared.get(names)
        if prepared is not None and prepared.scale_changes == self.inside.objects.scale_changes:
            values = np.empty((cycles, len(play), self.num_axes))
            if prepared.play(play, values):
                samples = np.empty((-(-cycles // every), len(prepared.keys), self.num_axes))
                self._run(cycles, call_of(values, prepared.played, samples, prepared.sampled, every))
                return self._trace(prepared.read(samples), len(samples), every)
        known = self.inside.objects.entries
        entries = [known.find(name) for name in objects]
        codes = {(e.index, e.sub): self.inside.objects.recordable(e) for e in entries}
        live = {key: code for key, code in codes.items() if code is not None}
        sampled = channels(self._firmware.layout, [(b.field, b.part) for b in live.values()]) if live else NOTHING
        values, played = self.inside.objects.plan_play(play, cycles)
        rows = -(-cycles // every)
        samples = np.empty((rows, len(live), self.num_axes))
        self._run(cycles, call_of(values, played, samples, sampled, every))
        result: dict[tuple[int, int], Integers] = {}
        for k, (key, code) in enumerate(live.items()):
            result[key] = self.inside.objects.recorded(known.find(key), code, samples[:, k])
        for key in codes:
            if key not in result:
                result[key] = np.broadcast_to(self.inside.objects.read(key), (rows, self.num_axes))
        prepared = self.inside.objects.prepared_record(objects, list(play))
        if prepared is not None and len(self._prepared) < MOST_PREPARED:
            self._prepared[names] = prepared
        return self._trace(result, rows, every)

    def _trace(self, values: dict[tuple[int, int], Integers], rows: int, every: int) -> Trace:
        t = np.arange(rows, dtype=np.float64) * (every * self.device.cycle)
        scale = self._scales()
        return Trace(t, values, self.inside.objects.entries, lambda: scale)

    def emergencies(self) -> list[EmergencyMessage]:
        """Return and forget the emergency messages since the last call, axis by axis in the order of each axis."""
        messages = []
        counts = get_lanes(self.inside.records, "emergency_count", self.num_axes)
        for axis in np.flatnonzero(counts):
            for k in range(int(counts[axis])):
                queued = int(get_lanes(self.inside.records, "emergency", self.num_axes, k)[axis])
                cause = self._firmware.causes[(queued & 0xFF) - 1]
                emergency = self.device.emergencies[cause.name].of_axis(int(axis) % self.device.num_axes)
                messages.append(EmergencyMessage(int(axis), emergency.code, queued >> 8, emergency.extra, cause.name))
        set_lanes(self.inside.records, "emergency_count", np.zeros(self.num_axes, np.int32))
        return messages

    def reset_node(self, where: Mask | None = None) -> None:
        """Reset the drives (NMT reset node): values return to the stored ones, the automaton starts anew."""
        self.inside.objects.restart(checked_mask(where, self.num_axes))

    def start_node(self, where: Mask | None = None) -> None:
        """Do nothing: drives in this process have no communication that has stopped."""
        checked_mask(where, self.num_axes)

    # --- states ---------------------------------------------------------------------------------------------------
    def save_state(self) -> State:
        """Return the complete state of drives and machines, bit by bit, as plain data that can be pickled."""
        return {
            "of": self._description(),
            "groups": [group.load.save_state() for group in self.inside.groups],
        } | super().save_state()

    def restore_state(self, state: State) -> None:
        """Restore drives and machines to a state saved by these drives or by others created alike.

        Raises:
            ValueError: For a state of other drives, naming what differs.
        """
        check_alike("drives", state["of"], self._description())
        super().restore_state(state)
        for group, saved in zip(self.inside.groups, state["groups"], strict=True):
            group.load.restore_state(saved)

    def _description(self) -> State:
        """Return the properties that two sets of drives must share for one to restore the other's state."""
        groups = [(group.load.copies, group.load.h, group.load.staggered) for group in self.inside.groups]
        return {
            "device": self.device.name, "load": str(self.load.name), "motor": self.motor.name,
            "machines": self.num_machines, "parameters": sorted(self.inside.parameters), "models": groups,
            "bytes of a record": self.inside.records.dtype.itemsize,
        }  # fmt: skip

    def close(self) -> None:
        """Release the threads; the drives cannot be used afterwards."""
        if self._executor is not None:
            self._executor.shutdown()
            self._executor = None

    def __enter__(self) -> EmulatedDrives:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- construction ---------------------------------------------------------------------------------------------
    def _drawn(
        self,
        seed: int,
        numbers: list[int],
        randomise: bool | Collection[str],
        ideal: bool,
        given: Mapping[str, ArrayLike],
        wired_as_known: bool,
    ) -> tuple[dict[str, MachineParameter], dict[str, Floats], Floats]:
        """Return the rows of the machines' parameters, their values, and the seed of each axis' noise."""
        kind = MACHINE_KINDS[self.device.firmware_name]
        table = parameter_table(kind, self.device, self.motor, self.load, default_values(self.load))
        values, noise = draw_parameters(table, seed, numbers, randomise, ideal, wired_as_known=wired_as_known)
        seeds = np.repeat(noise, self.load.num_axes) + np.tile(np.arange(self.load.num_axes), self.num_machines)
        for name, value in given.items():
            check_known(name, table)
            values[name] = np.broadcast_to(np.asarray(value, float), (self.num_machines,)).copy()
            check_parameter(name, values[name])
        return table, values, np.mod(seeds, 2.0**32 - 1.0) + 1.0  # xorshift would stay at 0 for ever

    # --- time -----------------------------------------------------------------------------------------------------
    def _run(self, cycles: int, call: Call) -> None:
        begin, done, diverged = self.inside.cycle, 0, False
        while done < cycles:
            while self.inside.schedule and self.inside.schedule[0][0] <= begin + done:
                _, name, values, where = self.inside.schedule.pop(0)
                self.machine.set(name, values, where)
            until = min([cycles, *(due - begin for due, *_ in self.inside.schedule[:1])])
            if self.faults.some:
                until = min(until, self.faults.act(begin + done) - begin)
            diverged |= self._run_groups(call, done, until, done == 0, until == cycles)
            done = until
            self.inside.cycle = begin + done
        if diverged:
            self._report_divergence()

    def _run_groups(self, call: Call, start: int, end: int, first: bool, last: bool) -> bool:
        self._turn[0] = 0
        given = self._fleet.address, call.address, start, end, first, last
        helpers = min(self._threads, len(self.inside.groups)) - 1
        if not helpers:
            return bool(self._firmware.run(*given))
        if self._executor is None:
            self._executor = ThreadPoolExecutor(self._threads - 1, thread_name_prefix="drives")
        jobs = [self._executor.submit(self._firmware.run, *given) for _ in range(helpers)]
        found = bool(self._firmware.run(*given))
        return sum(job.result() for job in jobs) > 0 or found

    def _report_divergence(self) -> None:
        diverged = self.machine.diverged
        new = np.flatnonzero(diverged & ~self.inside.reported)
        self.inside.reported = diverged
        if new.size:
            warnings.warn(
                f"machine {', '.join(map(str, new[:10]))}{' ...' if new.size > 10 else ''} left the range of physics "
                "and is frozen at rest until machine.reset(); the others continue",
                RuntimeWarning,
                stacklevel=4,
            )


def emulated_of(drives: Drives) -> EmulatedDrives:
    """Return the emulated drives behind drives, without observers; ValueError for drives on a bus."""
    found = machine_of(drives).drives
    assert isinstance(found, EmulatedDrives), "nothing else has a machine"
    return found
