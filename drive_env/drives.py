"""The Drives interface, and emulated drives behind it.

Whatever acts on a drive uses this interface and nothing deeper, so that it runs on the emulator and on a bus alike.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drive_env.devices import Device, find_device
from drive_env.dictionary import units
from drive_env.dictionary.access import (
    CANNOT_BE_STORED,
    VALUE_RANGE,
    WRONG_STATE,
    ObjectAccessError,
    check_allowed,
    check_in_range,
    check_readable,
    check_writable,
    checked_values,
)
from drive_env.dictionary.bindings import Binding
from drive_env.dictionary.entries import Entry, ObjectDictionary, ObjectName
from drive_env.firmware import cycle
from drive_env.firmware.fsa import State
from drive_env.firmware.modes import MODES
from drive_env.firmware.protection import CAUSES
from drive_env.firmware.record import get_lanes, new_records, set_lanes
from drive_env.group import MACHINES_PER_GROUP, Channels, Group, channels, rates_of
from drive_env.machine import Machines, apply_to_records, check_parameter, draw_parameters, parameter_table
from drive_env.motors import find_motor
from mechanics.loads import find_load
from mechanics.packed import PackedLoad, compile_packed

Integers = NDArray[np.int64]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_EVENTS = {"": -1, "controlword": cycle.CONTROLWORD, "mode": cycle.MODE, "set_point": cycle.SET_POINT}
SWITCHES = ("left", "right", "home")  # bits of 60FDh
_NOTHING = Channels(np.empty(0, np.int64), np.empty(0, np.int64))


class EmergencyMessage(NamedTuple):
    """An emergency of an axis: code, error register and the five additional bytes, as on the bus."""

    axis: int
    code: int
    error_register: int
    extra: tuple[int, ...]
    name: str


class Trace:
    """A recorded move: sample times `t` [s], shape (n,), and each object's integers, shape (n, num_axes)."""

    def __init__(self, t: Floats, values: dict[tuple[int, int], Integers], dictionary: ObjectDictionary) -> None:
        self.t = t
        self._values = values
        self._dictionary = dictionary

    def __getitem__(self, name: ObjectName) -> Integers:
        entry = self._dictionary.find(name)
        if (entry.index, entry.sub) not in self._values:
            recorded = ", ".join(self._dictionary.find(key).label for key in self._values)
            raise KeyError(f"{entry.label} was not recorded; there are {recorded}")
        return self._values[entry.index, entry.sub]

    def __len__(self) -> int:
        return len(self.t)


class EmulatedDrives:
    """Emulated drives that turn emulated machines.

    The drives come up commissioned for their motor and in switch on disabled; with `motor=None` they have their
    factory values and the machine the device's default motor, and nothing moves until commissioned.

    Args:
        device: Name of the device.
        load: Name of the load.
        motor: Name of the motor, or None for factory values.
        num_machines: Machines, each with its drives.
        seed: Seed of everything random. Machine k of a seed is the same machine in every set.
        first_machine: Number of the first machine.
        identical: Make every machine the one numbered `first_machine`, its noise included: for comparing gains.
        randomise: Parameters to draw per machine: True for all, or names or groups ("load", "motor.R_s").
        ideal: Take a stage, encoder and bearings without faults.
        parameters: True machine parameters [SI] that replace defaults and draws: one value or one per machine.
        supply: Supply voltage [V]; the motor's by default.
        num_threads: Threads that run machines; the number of cores by default.
        physics_steps: Physics steps per velocity-loop period.
        integrator: "leapfrog", or "rk4", the slower oracle.

    Raises:
        ValueError: For an unknown name, or a machine that cannot be.
    """

    DEFAULT_MOTOR = "qbl4208"

    def __init__(
        self,
        device: str = "tmcm1636",
        load: str = "two_mass",
        motor: str | None = DEFAULT_MOTOR,
        num_machines: int = 1,
        seed: int = 0,
        *,
        first_machine: int = 0,
        identical: bool = False,
        randomise: bool | Collection[str] = False,
        ideal: bool = False,
        parameters: Mapping[str, ArrayLike] | None = None,
        supply: float | None = None,
        num_threads: int | None = None,
        physics_steps: int = 1,
        integrator: str = "leapfrog",
    ) -> None:
        if num_machines < 1:
            raise ValueError(f"num_machines must be 1 or more, not {num_machines}")
        self.device: Device = find_device(device)
        self.motor = find_motor(motor or self.DEFAULT_MOTOR)
        self.load = find_load(load)
        self.num_machines = num_machines
        self.num_axes = num_machines * len(self.load.axes)
        self._dictionary = self.device.new_dictionary()
        self._records = new_records(self.num_axes)
        self._threads = max(1, num_threads if num_threads is not None else os.cpu_count() or 1)
        self._executor: ThreadPoolExecutor | None = None
        self._reported = np.zeros(num_machines, bool)
        numbers = (
            [first_machine] * num_machines if identical else list(range(first_machine, first_machine + num_machines))
        )
        self._draw(seed, numbers, randomise, ideal, parameters or {})
        self._groups = self._build_groups(physics_steps, integrator)
        self._set_constants(self.motor.voltage if supply is None else supply)
        for name, values in self._parameters.items():
            apply_to_records(self, name, np.repeat(values, len(self.load.axes)), np.ones(self.num_axes, bool))
        self._refresh_inertia()
        self.machine = Machines(self)
        self._values: dict[tuple[int, int], Integers | str] = {}
        self._stored = self._commission(motor)
        self._restart(np.ones(self.num_axes, bool))

    # --- the interface --------------------------------------------------------------------------------------------
    def read(self, name: ObjectName) -> Integers:
        """Return an object as the wire carries it, int64 of shape (num_axes,); a text as an array of str.

        Raises:
            ObjectAccessError: If there is no such object or it cannot be read.
        """
        entry = self._dictionary.find(name)
        check_readable(entry)
        return self._read(entry)

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object of the axes where the mask is true: one integer, or one per axis.

        A write is checked for all axes before it changes any.

        Raises:
            ObjectAccessError: With the SDO abort code, if the object, the value or the state does not allow it.
        """
        entry = self._dictionary.find(name)
        check_writable(entry)
        raw = checked_values(entry, value, self.num_axes)
        mask = self._axis_mask(where)
        self._check(entry, raw, mask)
        self._write(entry, raw, mask)

    def advance(self, duration: float) -> None:
        """Let `duration` [s] pass, whole communication cycles of 1 ms."""
        cycles = self._cycles(duration)
        nothing = np.empty((cycles, 0, self.num_axes))
        self._run(cycles, nothing, _NOTHING, np.empty((cycles, 0, self.num_axes)), _NOTHING, 1)

    def record(
        self,
        objects: Sequence[ObjectName],
        duration: float,
        play: Mapping[ObjectName, ArrayLike] | None = None,
        period: float = 0.001,
    ) -> Trace:
        """Let `duration` [s] pass while objects are recorded and played.

        Cycle k: row k of `play` is written, then row k is recorded, then one communication cycle passes.

        Args:
            objects: What to record.
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
            raise ValueError(f"period must be at least {self._cycle:g} s, not {period:g} s")
        entries = [self._dictionary.find(name) for name in objects]
        for entry in entries:
            check_readable(entry)
        bound = {(e.index, e.sub): self.device.bindings[e.index, e.sub] for e in entries if self._is_bound(e)}
        sampled = channels([(b.field, b.part) for b in bound.values()])
        values, played = self._plan_play(play or {}, cycles)
        rows = -(-cycles // every)
        samples = np.empty((rows, len(bound), self.num_axes))
        self._run(cycles, values, played, samples, sampled, every)
        result: dict[tuple[int, int], Integers] = {}
        for k, key in enumerate(bound):
            result[key] = self._to_od(self._dictionary.find(key), bound[key], samples[:, k])
        for entry in entries:
            key = (entry.index, entry.sub)
            if key not in result:
                result[key] = np.broadcast_to(self._read(entry), (rows, self.num_axes))
        return Trace(np.arange(rows, dtype=np.float64) * (every * self._cycle), result, self._dictionary)

    def emergencies(self) -> list[EmergencyMessage]:
        """Return and forget the emergency messages since the last call, axis by axis in the order of each axis."""
        messages = []
        counts = get_lanes(self._records, "emergency_count", self.num_axes)
        for axis in np.flatnonzero(counts):
            for k in range(int(counts[axis])):
                queued = int(get_lanes(self._records, "emergency", self.num_axes, k)[axis])
                cause = CAUSES[(queued & 0xFF) - 1]
                emergency = self.device.emergencies[cause.name]
                messages.append(EmergencyMessage(int(axis), emergency.code, queued >> 8, emergency.extra, cause.name))
        set_lanes(self._records, "emergency_count", np.zeros(self.num_axes, np.int32))
        return messages

    def reset_node(self, where: Mask | None = None) -> None:
        """Reset the drives (NMT reset node): values return to the stored ones, the automaton starts anew."""
        self._restart(self._axis_mask(where))

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
    ) -> None:
        template = compile_packed(self.load, 1)
        axes = (1, len(self.load.axes))
        single = PackedLoad(self.load, np.ones(axes), np.zeros((*axes, 4)), {}, 1e-6, template=template)
        defaults = {p.name: float(single.get(p.name)[0]) for p in self.load.parameters}
        table = parameter_table(self.device, self.motor, self.load, defaults)
        self._parameters, noise = draw_parameters(table, seed, numbers, randomise, ideal)
        seeds = np.repeat(noise, len(self.load.axes)) + np.tile(np.arange(axes[1]), self.num_machines)
        self._noise_seeds = np.mod(seeds, 2.0**32 - 1.0) + 1.0  # xorshift stays at 0 for ever
        for name, value in given.items():
            if name not in table:
                raise ValueError(f"machines have no parameter {name!r}; they have {', '.join(table)}")
            self._parameters[name] = np.broadcast_to(np.asarray(value, float), (self.num_machines,)).copy()
            check_parameter(name, self._parameters[name])

    def _build_groups(self, physics_steps: int, integrator: str) -> list[Group]:
        rates = rates_of(self.device, physics_steps)
        templates: dict[int, Any] = {}
        groups = []
        axes_per_group = MACHINES_PER_GROUP * len(self.load.axes)
        for first in range(0, self.num_machines, MACHINES_PER_GROUP):
            machines = slice(first, min(first + MACHINES_PER_GROUP, self.num_machines))
            count = machines.stop - machines.start
            if count not in templates:
                templates[count] = compile_packed(self.load, count)
            load = PackedLoad(
                self.load,
                self._armature()[machines],
                self._bearings()[machines],
                {p.name: self._parameters[f"load.{p.name}"][machines] for p in self.load.parameters},
                rates.window / physics_steps,
                integrator=integrator,
                template=templates[count],
                first_machine=first,
            )
            block = first // MACHINES_PER_GROUP * (axes_per_group // 8)
            blocks = -(-count * len(self.load.axes) // 8)
            groups.append(Group(machines, load, self._records[block : block + blocks], rates))
        return groups

    def _set_constants(self, supply: float) -> None:
        records, device, motor = self._records, self.device, self.motor
        records["current_scale"] = device.current_full_scale
        records["duty_limit"] = device.duty_limit
        records["overcurrent"] = device.overcurrent
        records["undervoltage"] = device.undervoltage
        records["overvoltage"] = device.overvoltage
        records["standstill"] = device.standstill
        records["warning_temperature"] = device.warning_temperature
        records["error_temperature"] = device.error_temperature
        records["nominal_current"] = device.nominal_current
        records["overload_time"] = device.overload_time
        records["is_dc"] = motor.kind == "dc"
        records["phase_factor"] = 1.0 if motor.kind == "dc" else 1.5
        records["flux_temperature"] = motor.flux_temperature
        records["hall_true_polarity"] = motor.hall_polarity
        records["hall_true_direction"] = motor.hall_direction
        records["n_p"] = motor.n_p
        for switch in self.load.switches:
            kind = SWITCHES.index(switch.kind)
            axes = np.tile(np.arange(len(self.load.axes)) == switch.axis, self.num_machines)
            set_lanes(records, "switch_low", np.full(self.num_axes, switch.low), axes, kind)
            set_lanes(records, "switch_high", np.full(self.num_axes, switch.high), axes, kind)
            wired = get_lanes(records, "wired", self.num_axes).astype(np.int32)
            set_lanes(records, "wired", wired | (1 << kind), axes)
        records["cogging_order"] = motor.cogging_order
        records["supply_voltage"] = supply
        set_lanes(records, "random", self._noise_seeds)

    def _armature(self) -> Floats:
        return np.repeat(self._parameters["motor.inertia"][:, None], len(self.load.axes), 1)

    def _bearings(self) -> Floats:
        """Return the motors' friction; their breakaway is that of sliding, so Stribeck's speed does not matter."""
        coulomb, viscous = self._parameters["motor.coulomb"], self._parameters["motor.viscous"]
        one = np.stack([coulomb, coulomb, np.ones_like(coulomb), viscous], -1)
        return np.repeat(one[:, None, :], len(self.load.axes), 1)

    def _apply_parameter(self, name: str, values: Floats, machines: Mask) -> None:
        """Bring a true parameter into records and mechanics."""
        axes_per_machine = len(self.load.axes)
        axes = np.repeat(machines, axes_per_machine)
        if apply_to_records(self, name, np.repeat(values, axes_per_machine), axes):
            return
        before, self._parameters[name] = self._parameters[name], values
        try:
            self._apply_to_loads(name, machines)
        except ValueError:
            self._parameters[name] = before
            self._apply_to_loads(name, machines)
            raise
        self._refresh_inertia()

    def _apply_to_loads(self, name: str, machines: Mask) -> None:
        values = self._parameters[name]
        for group in self._groups:
            if name.startswith("load."):
                group.load.set(name.removeprefix("load."), values[group.machines], machines[group.machines])
            else:
                group.load.set_motor(self._armature()[group.machines], self._bearings()[group.machines])

    def _refresh_inertia(self) -> None:
        inertia = np.concatenate([group.load.plant.axis_inertia.reshape(-1) for group in self._groups])
        set_lanes(self._records, "J_rotor", inertia)

    def _commission(self, motor: str | None) -> dict[tuple[int, int], Integers]:
        """Write factory values, then the motor's preset; return the raw values that a reset restores."""
        everywhere = np.ones(self.num_axes, bool)
        stored: dict[tuple[int, int], Integers] = {}
        for entry in self._dictionary:
            if isinstance(entry.default, str):
                self._values[entry.index, entry.sub] = entry.default
            else:
                stored[entry.index, entry.sub] = np.full(self.num_axes, entry.default, np.int64)
        modes = sum(1 << mode.supported_bit for mode in MODES if mode.supported_bit is not None)
        stored[0x6502, 0] = np.full(self.num_axes, modes, np.int64)
        if motor is not None:
            preset = self.device.preset(motor)
            if not self.load.has_switches:
                preset = {"Limit switches": 3, **preset}
            for name, value in preset.items():
                entry = self._dictionary.find(name)
                raw = checked_values(entry, value, self.num_axes)
                self._check_value(entry, raw)
                stored[entry.index, entry.sub] = raw.copy()
        # The scaler first: the factors of positions follow it.
        for key in sorted(stored, key=lambda key: key != (0x2058, 0)):
            self._restore(self._dictionary.find(key), stored[key], everywhere)
        return stored

    def _restore(self, entry: Entry, raw: Integers, where: Mask) -> None:
        """Write a value without what a write sets off; a read-only field that the firmware computes stays."""
        if self._is_bound(entry):
            if entry.access not in ("ro", "const"):
                self._set_field(entry, raw, where)
        else:
            self._set_value(entry, raw, where)

    def _restart(self, axes: Mask) -> None:
        for key in sorted(self._stored, key=lambda key: key != (0x2058, 0)):
            self._restore(self._dictionary.find(key), self._stored[key], axes)
        cycle.power_on(self._records, axes)

    # --- access ---------------------------------------------------------------------------------------------------
    def _is_bound(self, entry: Entry) -> bool:
        return (entry.index, entry.sub) in self.device.bindings

    def _context(self) -> units.Context:
        device = self.device
        return units.Context(
            position_scaler=get_lanes(self._records, "position_scaler", self.num_axes).astype(float),
            encoder_steps=get_lanes(self._records, "encoder_steps", self.num_axes).astype(float),
            adc_step=get_lanes(self._records, "adc_step", self.num_axes).astype(float),
            current_lsb=device.current_full_scale / 32768.0,
            current_period=1.0 / device.current_rate,
            velocity_period=1.0 / device.velocity_rate,
        )

    def _read(self, entry: Entry) -> Integers:
        if self._is_bound(entry):
            binding = self.device.bindings[entry.index, entry.sub]
            value = get_lanes(self._records, binding.field, self.num_axes, binding.part)
            return self._to_od(entry, binding, value.astype(float))
        stored = self._values[entry.index, entry.sub]
        return np.full(self.num_axes, stored) if isinstance(stored, str) else stored.copy()

    def _to_od(self, entry: Entry, binding: Binding, value: Floats) -> Integers:
        if binding.unit == "position window":
            return units.window_to_od(value, self._context())
        low, high = entry.low, entry.high
        assert low is not None and high is not None, "only numbers are bound"
        return units.to_od(binding.unit, value, self._context(), low, high)

    def _from_od(self, binding: Binding, raw: NDArray[Any]) -> Floats:
        if binding.unit == "position window":
            return units.window_from_od(raw, self._context())
        return units.from_od(binding.unit, raw, self._context())

    def _check(self, entry: Entry, raw: Integers, where: Mask) -> None:
        self._check_value(entry, raw[where])
        key = (entry.index, entry.sub)
        if key in self.device.write_states:
            needed = State[self.device.write_states[key]]
            states = get_lanes(self._records, "fsa", self.num_axes)[where]
            wrong = states[states != needed]
            if wrong.size:
                raise ObjectAccessError(
                    WRONG_STATE,
                    f"{entry.label} can only be written in {_state_name(needed)}; the drive is in "
                    f"{_state_name(State(int(wrong[0])))}",
                )
        if key == (0x6060, 0) and self.device.refuses_same_mode:
            same = raw[where] == get_lanes(self._records, "mode", self.num_axes)[where]
            if np.any(same):
                raise ObjectAccessError(
                    WRONG_STATE,
                    f"{entry.label} is {raw[where][same][0]} already, and this drive refuses the same mode twice; "
                    "read 6061h first",
                )

    def _check_value(self, entry: Entry, raw: Integers) -> None:
        key = (entry.index, entry.sub)
        if key in self.device.unsupported:
            raise ObjectAccessError(CANNOT_BE_STORED, f"{entry.label} has no service behind it in this emulator")
        if key in self.device.allowed_values:
            check_allowed(entry, raw, self.device.allowed_values[key])
        if key == (0x6060, 0):
            check_allowed(entry, raw, tuple(mode.number for mode in MODES))

    def _write(self, entry: Entry, raw: Integers, where: Mask) -> None:
        key = (entry.index, entry.sub)
        if not self._is_bound(entry):
            self._set_value(entry, raw, where)
            return
        event = _EVENTS[self.device.bindings[key].event]
        if event == cycle.SET_POINT:
            self._set_field(entry, raw, where)
            set_lanes(self._records, "set_point_fresh", np.ones(self.num_axes, np.int32), where)
        elif event >= 0:
            cycle.write_events(self._records, event, raw, where)
        elif key == (0x2058, 0):
            self._rescale(entry, raw, where)
        else:
            self._set_field(entry, raw, where)

    def _rescale(self, entry: Entry, raw: Integers, where: Mask) -> None:
        """Change 2058h: what is stored in increments keeps its integers, and so changes its SI value."""
        if np.any(raw[where] == 0):
            raise ObjectAccessError(VALUE_RANGE, f"{entry.label} cannot be 0 increments per revolution")
        kept = [
            (other, self._read(other))
            for other in self._dictionary
            if self._is_bound(other)
            and other.access not in ("ro", "const")
            and self.device.bindings[other.index, other.sub].unit in {*units.SCALED_BY_POSITION, "position window"}
        ]
        self._set_field(entry, raw, where)
        for other, value in kept:
            self._set_field(other, value, where)

    def _set_field(self, entry: Entry, raw: Integers, where: Mask) -> None:
        binding = self.device.bindings[entry.index, entry.sub]
        set_lanes(self._records, binding.field, self._from_od(binding, raw), where, binding.part)

    def _set_value(self, entry: Entry, raw: Integers, where: Mask) -> None:
        key = (entry.index, entry.sub)
        before = self._values.get(key)
        self._values[key] = raw.copy() if before is None else np.where(where, raw, before)

    def _axis_mask(self, where: Mask | None) -> Mask:
        if where is None:
            return np.ones(self.num_axes, bool)
        mask = np.asarray(where)
        if mask.shape != (self.num_axes,) or mask.dtype != bool:
            raise ValueError(
                f"where must be a boolean array of shape ({self.num_axes},), not {mask.dtype} {mask.shape}"
            )
        return mask

    # --- time -----------------------------------------------------------------------------------------------------
    @property
    def _cycle(self) -> float:
        return 1.0 / self.device.profile_rate

    def _cycles(self, duration: float) -> int:
        cycles = round(duration / self._cycle)
        if not duration >= 0.0 or abs(cycles * self._cycle - duration) > 1e-9:
            raise ValueError(
                f"{duration:g} s is not a whole number of communication cycles of {self._cycle:g} s; "
                f"use {max(cycles, 0) * self._cycle:g} s"
            )
        return cycles

    def _plan_play(self, play: Mapping[ObjectName, ArrayLike], cycles: int) -> tuple[Floats, Channels]:
        values = np.empty((cycles, len(play), self.num_axes))
        fields: list[tuple[str, int]] = []
        kinds: list[int] = []
        for k, (name, given) in enumerate(play.items()):
            entry = self._dictionary.find(name)
            check_writable(entry)
            if not self._is_bound(entry) or (entry.index, entry.sub) == (0x2058, 0):
                raise ObjectAccessError(CANNOT_BE_STORED, f"{entry.label} cannot be played; write it before")
            raw = np.asarray(given)
            if raw.shape not in ((cycles,), (cycles, self.num_axes)):
                raise ValueError(
                    f"{entry.label}: play takes shape ({cycles},) or ({cycles}, {self.num_axes}), one row per cycle, "
                    f"not {raw.shape}"
                )
            check_in_range(entry, raw)
            self._check_value(entry, raw.astype(np.int64).reshape(-1))
            binding = self.device.bindings[entry.index, entry.sub]
            values[:, k] = self._from_od(binding, raw if raw.ndim == 2 else raw[:, None])
            fields.append((binding.field, binding.part))
            kinds.append(_EVENTS[binding.event])
        return values, channels(fields, kinds) if fields else _NOTHING

    def _run(self, cycles: int, play: Floats, played: Channels, samples: Floats, sampled: Channels, every: int) -> None:
        if cycles == 0:
            return
        if self._threads == 1 or len(self._groups) == 1:
            for group in self._groups:
                group.run(cycles, play, played, samples, sampled, every)
        else:
            if self._executor is None:
                self._executor = ThreadPoolExecutor(self._threads, thread_name_prefix="drives")
            jobs = [
                self._executor.submit(group.run, cycles, play, played, samples, sampled, every)
                for group in self._groups
            ]
            for job in jobs:
                job.result()
        self._report_divergence()

    def _report_divergence(self) -> None:
        diverged = self.machine.diverged
        new = np.flatnonzero(diverged & ~self._reported)
        self._reported = diverged
        if new.size:
            warnings.warn(
                f"machine {', '.join(map(str, new[:10]))}{' ...' if new.size > 10 else ''} left the range of physics "
                "and is frozen at rest until machine.reset(); the others go on",
                RuntimeWarning,
                stacklevel=4,
            )


def _state_name(state: State) -> str:
    return state.name.lower().replace("_", " ")
