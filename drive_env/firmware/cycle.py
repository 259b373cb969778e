"""A drive's cycle, composed of the stages that its firmware names, in the order in which the data flows.

Per supervision period: protection, automaton, mode and profile, statusword. Per window (the velocity loop's period):
sensors, position and velocity loops, then the current loop's ticks; then one step of the load's mechanics. A
communication cycle is one supervision period or several.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, make_dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from numba import from_dtype, types
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.firmware.common import brake, fields, fsa, inputs, modes, protection, start_up
from drive_env.firmware.common.modes import hm, pp
from drive_env.firmware.common.protection import Cause, protection_of, row_of
from drive_env.firmware.record import LANES, Field, RecordLayout
from mechanics import stepping
from mechanics.kernels.bundle import Bundle, Cube, Matrix, Numbers, reader
from mechanics.kernels.calls import call_hook, next_number
from mechanics.kernels.compiled import cached, inlined, stage
from mechanics.plant import PackedPlant

# Effects of a played or written value on a field.
REAL, INTEGER, CONTROLWORD, MODE, SET_POINT, WHOLE_SET_POINT = 0, 1, 2, 3, 4, 5

# Time constant of the speed that decides whether the motor rotates [s]: encoder noise must not set bit 14.
ACTIVITY_TIME = 0.02

Stage = Callable[..., Any]
Integers = Annotated[NDArray[np.int32], types.int32[:, ::1]]


@dataclass(eq=False)
class Rates(Bundle):
    """Periods [s] and their ratios; data of the device and of the physics."""

    tick: float  # current loop
    window: float  # velocity and position loop
    period: float  # supervision: profile, automaton, protection
    ticks: int  # per window
    windows: int  # per period
    periods: int  # per communication cycle
    substeps: int  # physics steps per window
    # Share of each tick's torque in the mean of each physics step, shape (substeps, ticks).
    weights: Matrix
    # The same, times the time from the step's middle to the tick's [s].
    moments: Matrix


@dataclass(eq=False)
class Call(Bundle):
    """Played and sampled values of a run, in SI.

    `before` and `after` are addresses of hooks or 0. They are called with `data`, a group's first axis and its number
    of axes, in the thread that runs the group; if `before` returns 0 the group is not run.
    """

    values: Cube  # (cycles, objects, all axes)
    kinds: Numbers  # REAL, INTEGER, CONTROLWORD, MODE, SET_POINT or WHOLE_SET_POINT, (objects,)
    offsets: Numbers  # index of lane 0 in `reals` or `integers`, (objects,)
    samples: Cube  # written, (rows, objects, all axes)
    sample_kinds: Numbers  # REAL or INTEGER
    sample_offsets: Numbers
    every: int = 1  # cycles per sample
    before: int = 0
    after: int = 0
    data: int = 0


@dataclass(eq=False)
class Fleet(Bundle):
    """All groups of a set of drives, and the number of the next one that a thread takes."""

    groups: Numbers  # addresses of Machinery
    turn: Numbers  # (1,)


call_at, fleet_at = reader(Call), reader(Fleet)


@dataclass(frozen=True)
class FirmwareStages:
    """The parts of a drive's firmware besides those that all drives share; a stage is a compiled function.

    Attributes:
        name: Unique name of the list. parameters, state: Fields of its stages in the record, in addition to those of
            `common/fields.py`.
        causes: Its causes, see `protection_of`.
        begin_period: Stages (drive, rates) at the beginning of a supervision period.
        measure: Stages (drive, lane, dt) before protection checks the causes.
        switch: Stages (drive, lane, dt) between automaton and mode: start-up, commutation, switching of the power
            stage.
        tell: Stages (drive, lane) after the mode: status objects of the device's own.
        end_period: Stages (drive, rates) at the end of a supervision period.
        window: Stages (drive, rates): sensors and outer loops, once per window.
        tick: Stages (drive, rates, k): current loop and power stage, in tick k of a window.
        power_on: Stages (drive, lane) that reset its own fields.
        halt: Stages (drive, lane) that reset its own fields of a diverged machine to finite numbers.
        remote: Stage (drive, lane) -> whether the axis takes commands; otherwise it ignores the controlword, and
            statusword bit 9 is 0. None: always.
        tells_all: Whether a drive in fault reports further errors, see `protection_of`.
        faults_when_off: Whether it also goes into fault before it is switched on, see `protection_of`.
    """

    name: str
    parameters: Sequence[Field]
    state: Sequence[Field]
    causes: Sequence[Cause]
    begin_period: Sequence[Stage]
    measure: Sequence[Stage]
    switch: Sequence[Stage]
    tell: Sequence[Stage]
    end_period: Sequence[Stage]
    window: Sequence[Stage]
    tick: Sequence[Stage]
    power_on: Sequence[Stage]
    halt: Sequence[Stage]
    remote: Stage | None = None
    tells_all: bool = False
    faults_when_off: bool = False


class Firmware(NamedTuple):
    """A drive's firmware, composed and ready to be compiled at its first use.

    Attributes:
        layout: Layout of its records.
        causes: Its causes; an emergency in a record's queue is its row plus 1.
        machinery: Makes the bundle of a group of machines for a run: records, reals and integers (the records' memory,
            shape (blocks, numbers per record)), plant, rates, motion (scratch, (7, 8 blocks)), first_axis (number of
            the group's first axis in a call's rows), num_axes.
        run: (fleet address, call address, start, cycles, first, last) -> whether a machine has diverged. Runs groups
            for whole communication cycles from `start` up to `cycles`, taking turns with other threads; `first` and
            `last` say whether the call's hooks are due.
        run_drives_alone: (records, rates, periods): runs the drives without mechanics, with rotors driven by their
            predicted torque balance: the benchmark's bound.
        write_events: (records, kind, values, where): processes writes of the controlword or the mode for the axes where
            the mask is true.
        power_on: (records, where): restarts the firmware on the axes where the mask is true: transitions 0 and 1,
            encoder at zero.
        trip: (records, first axis, number of axes, row) -> number of axes that went from operation into fault, with the
            reaction of an external cause. The caller reports the cause: no emergency is queued.
        communication_lost: The row of the cause for a lost network. supervise, start_window, tick, window: The parts of
            a cycle, for tests between them.
    """

    layout: RecordLayout
    causes: tuple[Cause, ...]
    machinery: Callable[..., Any]
    run: Any
    run_drives_alone: Any
    write_events: Any
    power_on: Any
    trip: Any
    communication_lost: int
    supervise: Any
    start_window: Any
    tick: Any
    window: Any


def _after(first: Stage, second: Stage) -> Stage:
    """Return the stage that runs one stage of two arguments and then another, with the same."""

    @inlined
    def both(drive, of):
        first(drive, of)
        second(drive, of)

    return both


def _after_of_three(first: Stage, second: Stage) -> Stage:
    """Return the stage that runs one stage of three arguments and then another, with the same."""

    @inlined
    def both(drive, of, more):
        first(drive, of, more)
        second(drive, of, more)

    return both


@stage
def _nothing(drive, of):
    pass


@stage
def _nothing_of_three(drive, of, more):
    pass


def in_turn(stages: Sequence[Stage], arguments: int) -> Stage:
    """Return one stage that runs several, each with the same two or three arguments."""
    found: Stage = _nothing if arguments == 2 else _nothing_of_three
    for k, one in enumerate(stages):
        found = one if k == 0 else (_after if arguments == 2 else _after_of_three)(found, one)
    return found


@stage
def sample_row(reals, integers, samples, kinds, offsets, row, first_axis, num_axes):
    """Copy the recorded fields of this group's axes into one row of samples."""
    for k in range(kinds.shape[0]):
        for axis in range(num_axes):
            block, lane = axis // LANES, axis % LANES
            if kinds[k] == REAL:
                samples[row, k, first_axis + axis] = reals[block, offsets[k] + lane]
            else:
                samples[row, k, first_axis + axis] = integers[block, offsets[k] + lane]


@inlined
def mechanics_window(records, plant, rates, motion):
    """Step the load through one window and update the rotors by it.

    `motion` is scratch, shape (7, lanes of all blocks): whole blocks are copied, which vectorises.
    """
    torque, moment, theta, omega = motion[0], motion[1], motion[2], motion[3]
    reaction, total, position = motion[4], motion[5], motion[6]
    h = rates.window / rates.substeps
    blocks = records.shape[0]
    for s in range(rates.substeps):
        for block in range(blocks):
            drive = records[block]
            for lane in range(LANES):
                torque[block * LANES + lane] = drive.tau_window[s, lane]
            for lane in range(LANES):
                moment[block * LANES + lane] = drive.moment_window[s, lane]
        stepping.step(plant, torque, moment, h, theta, omega, reaction, position)
        for axis in range(blocks * LANES):
            total[axis] = reaction[axis] if s == 0 else total[axis] + reaction[axis]
    for block in range(blocks):
        drive = records[block]
        first = block * LANES
        for lane in range(LANES):
            drive.theta_m[lane] = theta[first + lane]
        for lane in range(LANES):
            drive.omega_m[lane] = omega[first + lane]
        for lane in range(LANES):
            drive.load_position[lane] = position[first + lane]
        for lane in range(LANES):
            drive.tau_reaction_before[lane] = drive.tau_reaction[lane]
        for lane in range(LANES):
            drive.tau_reaction[lane] = total[first + lane] / rates.substeps


@stage
def update_brakes_and_inertia(records, plant):
    """Once per supervision period: move the brakes, and update the rotors' inertia where it varies."""
    axes, copies = plant.jam.shape
    held, jam, mass, varying = plant.brake, plant.jam, plant.mass, plant.varying
    for copy in range(copies):
        for axis in range(axes):
            drive = records[(copy * axes + axis) // LANES]
            lane = (copy * axes + axis) % LANES
            mode = drive.brake_mode[lane]
            closed = (
                mode == brake.CLOSED
                or (mode == brake.WITH_STAGE and drive.stage_on[lane] == 0.0)
                or (mode == brake.WITH_OUTPUT and drive.brake_opened[lane] == 0)
            )
            held[axis, copy] = jam[axis, copy] + (drive.brake_torque[lane] if closed else 0.0)
            if varying:
                drive.J_rotor[lane] = mass[axis, copy]


@stage
def reset_shared_state(drive, lane):
    """Reset the fields that all drives share; the encoder is at zero."""
    drive.fsa[lane] = fsa.NOT_READY
    drive.transition_pending[lane] = 0
    drive.holding[lane] = 0
    drive.brake_output[lane] = 0.0
    drive.fault[lane] = 0
    drive.error_register[lane] = 0
    drive.emergency_count[lane] = 0
    drive.internal_limit[lane] = 0
    drive.stopping[lane] = 0
    drive.set_point_valid[lane] = 0
    drive.set_point_acknowledged[lane] = 0
    drive.set_point_waiting[lane] = 0
    drive.mode_wait[lane] = 0.0
    drive.target_reached[lane] = 0
    drive.drive_function[lane] = 0.0
    drive.stage_on[lane] = 0.0
    drive.active[lane] = 0
    drive.present[lane] = 0
    drive.blocked[lane] = 0
    drive.warning[lane] = 0
    drive.init_state[lane] = start_up.NEEDED
    drive.home_shift[lane] = 0.0
    drive.home_count[lane] = 0.0
    drive.homing_state[lane] = hm.IDLE
    drive.homing_attained[lane] = 0
    drive.loop_level[lane] = 0
    drive.mode_display[lane] = drive.mode[lane]
    drive.tau_m[lane] = 0.0
    drive.velocity_sum[lane] = 0.0
    drive.omega_meas[lane] = 0.0
    drive.omega_slow[lane] = 0.0
    drive.u_dc[lane] = drive.supply_voltage[lane]
    drive.theta_meas[lane] = 0.0
    drive.position_demand[lane] = 0.0
    drive.velocity_demand[lane] = 0.0
    drive.torque_demand[lane] = 0.0
    drive.ramp_wait_left[lane] = 0.0
    drive.acceleration_demand[lane] = 0.0
    drive.acceleration_before[lane] = 0.0
    drive.cause_flags[lane] = 0


class _Events(NamedTuple):
    """Stages that process external events: see `compose`."""

    tell_state: Stage
    write_controlword: Stage
    write_mode: Stage


@inlined
def _always(drive, lane):
    return True


def _events(causes_gone: Stage, cause_bits: Stage, remote: Stage) -> _Events:
    @inlined
    def tell_state(drive, lane):
        """Write the statusword."""
        fsa.update_statusword(drive, lane, modes.mode_bits(drive, lane) | cause_bits(drive, lane))
        if not remote(drive, lane):
            drive.statusword[lane] &= ~cia402.REMOTE.value

    @stage
    def write_controlword(drive, lane, word):
        """Process a write of 6040h completely: fault reset edge, state commands, new set-point, statusword."""
        if not remote(drive, lane):
            tell_state(drive, lane)
            return
        before = drive.controlword[lane]
        drive.controlword[lane] = word
        if word & cia402.FAULT_RESET and not before & cia402.FAULT_RESET:
            fsa.reset_fault(drive, lane, causes_gone(drive, lane))
        fsa.command(drive, lane)
        if drive.mode_display[lane] == modes.PP:
            pp.new_set_point(drive, lane, before)
        elif drive.mode_display[lane] == modes.HM:
            hm.start_or_stop(drive, lane, before)
        tell_state(drive, lane)

    @stage
    def write_mode(drive, lane, mode):
        """Process a write of 6060h."""
        modes.request_mode(drive, lane, mode)
        tell_state(drive, lane)

    return _Events(tell_state, write_controlword, write_mode)


def _window(start_window: Stage, tick: Stage) -> Stage:
    @stage
    def window(drive, rates):
        """Run the drive through one window."""
        start_window(drive, rates)
        for k in range(rates.ticks):
            tick(drive, rates, k)

    return window


def _supervise(stages: FirmwareStages, protect: Stage, tell_state: Stage) -> Stage:
    begin_period, end_period = in_turn(stages.begin_period, 2), in_turn(stages.end_period, 2)
    measure, switch, tell = in_turn(stages.measure, 3), in_turn(stages.switch, 3), in_turn(stages.tell, 2)

    @stage
    def supervise(drive, rates):
        """Run the drive's work of one supervision period."""
        begin_period(drive, rates)
        for lane in range(LANES):
            if drive.live[lane] == 0 or drive.diverged[lane] == 1:
                continue
            drive.omega_slow[lane] += (drive.omega_meas[lane] - drive.omega_slow[lane]) * (rates.period / ACTIVITY_TIME)
            inputs.read_inputs(drive, lane)
            measure(drive, lane, rates.period)
            protect(drive, lane)
            fsa.automatic_transitions(drive, lane, rates.period)
            switch(drive, lane, rates.period)
            modes.generate_demand(drive, lane, rates.period)
            tell_state(drive, lane)
            tell(drive, lane)
        end_period(drive, rates)

    return supervise


def _play_row(events: _Events, target: int) -> Stage:
    write_controlword, write_mode = events.write_controlword, events.write_mode

    @stage
    def play_row(records, reals, integers, values, kinds, offsets, row, first_axis, num_axes):
        """Write one row of played values to the axes of this group."""
        for k in range(kinds.shape[0]):
            for axis in range(num_axes):
                block, lane = axis // LANES, axis % LANES
                value = values[row, k, first_axis + axis]
                if kinds[k] == REAL:
                    reals[block, offsets[k] + lane] = value
                elif kinds[k] == SET_POINT or kinds[k] == WHOLE_SET_POINT:
                    reals[block, offsets[k] + lane] = value
                    records[block].set_point_fresh[lane] = 1
                    if offsets[k] == target:
                        records[block].target_is_whole[lane] = 1 if kinds[k] == WHOLE_SET_POINT else 0
                elif kinds[k] == INTEGER:
                    integers[block, offsets[k] + lane] = int(value)
                elif kinds[k] == CONTROLWORD:
                    write_controlword(records[block], lane, int(value))
                else:
                    write_mode(records[block], lane, int(value))

    return play_row


def _leave_diverged(halt: Stage) -> Stage:
    @stage
    def halt_diverged(drive, lane):
        """Halt a lane whose machine has diverged: its numbers must not affect anything."""
        drive.diverged[lane] = 1
        # On the bus the axis is in fault and stands.
        drive.fsa[lane] = fsa.FAULTED
        drive.error_register[lane] |= protection.GENERIC_ERROR
        drive.drive_function[lane] = 0.0
        drive.stage_on[lane] = 0.0
        drive.omega_slow[lane] = 0.0
        drive.omega_meas[lane] = 0.0
        drive.velocity_sum[lane] = 0.0
        drive.velocity_demand[lane] = 0.0
        drive.position_demand[lane] = drive.theta_meas[lane]
        drive.tau_m[lane] = 0.0
        drive.u_dc[lane] = drive.supply_voltage[lane]
        drive.tau_reaction[lane] = 0.0
        drive.tau_reaction_before[lane] = 0.0
        halt(drive, lane)
        fsa.update_statusword(drive, lane, 0)

    @stage
    def leave_diverged(records, plant):
        """Halt the axes of diverged machines."""
        axes_per_copy = plant.axis_motion.shape[0]
        for copy in range(plant.diverged.shape[0]):
            if plant.diverged[copy] == 1:
                for axis in range(copy * axes_per_copy, (copy + 1) * axes_per_copy):
                    if records[axis // LANES].diverged[axis % LANES] == 0:
                        halt_diverged(records[axis // LANES], axis % LANES)

    return leave_diverged


def _run_group(play_row: Stage, supervise: Stage, window: Stage, leave_diverged: Stage) -> Stage:
    @inlined
    def run_group(group, call, start, cycles):
        """Run one group; cycle k: play row k, record row k (every `every` cycles), simulate one cycle."""
        records, reals, integers, plant, rates = group.records, group.reals, group.integers, group.plant, group.rates
        for cycle in range(start, cycles):
            play_row(
                records, reals, integers, call.values, call.kinds, call.offsets, cycle, group.first_axis, group.num_axes
            )
            if cycle % call.every == 0:
                sample_row(
                    reals, integers, call.samples, call.sample_kinds, call.sample_offsets, cycle // call.every,
                    group.first_axis, group.num_axes,
                )  # fmt: skip
            for _ in range(rates.periods):
                for block in range(records.shape[0]):
                    supervise(records[block], rates)
                update_brakes_and_inertia(records, plant)
                for _ in range(rates.windows):
                    for block in range(records.shape[0]):
                        window(records[block], rates)
                    mechanics_window(records, plant, rates, group.motion)
                    leave_diverged(records, plant)

    return run_group


def _run(source: str, machinery_at: Any, run_group: Stage) -> Any:
    @cached(allocates=False, source=source)
    def run(fleet_address, call_address, start, cycles, first, last):
        fleet, call = fleet_at(fleet_address), call_at(call_address)
        groups, turn = fleet.groups, fleet.turn
        some = False
        k = next_number(turn)
        while k < groups.shape[0]:
            group = machinery_at(groups[k])
            if (
                not first
                or call.before == 0
                or call_hook(call.before, call.data, group.first_axis, group.num_axes) != 0
            ):
                run_group(group, call, start, cycles)
                if last and call.after != 0:
                    call_hook(call.after, call.data, group.first_axis, group.num_axes)
            diverged = group.plant.diverged
            for copy in range(diverged.shape[0]):
                some |= diverged[copy] != 0
            k = next_number(turn)
        return some

    return run


def _run_drives_alone(source: str, supervise: Stage, window: Stage) -> Any:
    @cached(allocates=False, source=source)
    def run_drives_alone(records, rates, periods):
        for _ in range(periods):
            for block in range(records.shape[0]):
                supervise(records[block], rates)
            for _ in range(rates.windows):
                for block in range(records.shape[0]):
                    window(records[block], rates)

    return run_drives_alone


def _write_events(source: str, events: _Events) -> Any:
    write_controlword, write_mode = events.write_controlword, events.write_mode

    @cached(allocates=False, source=source)
    def write_events(records, kind, values, where):
        for axis in range(values.shape[0]):
            if where[axis]:
                drive = records[axis // LANES]
                if kind == CONTROLWORD:
                    write_controlword(drive, axis % LANES, values[axis])
                else:
                    write_mode(drive, axis % LANES, values[axis])

    return write_events


def _power_on(source: str, stages: FirmwareStages, tell_state: Stage) -> Any:
    begin_anew, tell = in_turn(stages.power_on, 2), in_turn(stages.tell, 2)

    @cached(allocates=False, source=source)
    def power_on(records, where):
        for axis in range(where.shape[0]):
            if not where[axis]:
                continue
            drive = records[axis // LANES]
            lane = axis % LANES
            reset_shared_state(drive, lane)
            begin_anew(drive, lane)
            inputs.read_inputs(drive, lane)
            fsa.automatic_transitions(drive, lane, 0.0)
            tell_state(drive, lane)
            tell(drive, lane)

    return power_on


def _trip(source: str, take_into_fault: Stage) -> Any:
    @cached(source=source)
    def trip(records, first_axis, num_axes, cause):
        taken = 0
        for axis in range(first_axis, first_axis + num_axes):
            drive = records[axis // LANES]
            lane = axis % LANES
            # An axis whose stage is on because it is about to be enabled also counts as in operation.
            if drive.fsa[lane] != fsa.ENABLED and drive.transition_pending[lane] != 4:
                continue
            take_into_fault(drive, lane, cause)
            taken += 1
        return taken

    return trip


def _machinery(name: str, layout: RecordLayout, source: str) -> Any:
    """Return the bundle's class; its name identifies its records in compiled code."""
    columns = [
        ("records", Annotated[NDArray[np.void], types.Array(from_dtype(layout.dtype), 1, "C")]),
        ("reals", Matrix),
        ("integers", Integers),
        ("plant", PackedPlant),
        ("rates", Rates),
        ("motion", Matrix),
        ("first_axis", int),
        ("num_axes", int),
    ]
    return make_dataclass(f"Machinery_{name}", columns, bases=(Bundle,), eq=False, namespace={"__module__": source})


def compose(stages: FirmwareStages, source: str) -> Firmware:
    """Return the firmware of a list of stages.

    Args:
        stages: The list.
        source: Name of its module: compiled kernels are stored by the module's sources and imports.
    """
    layout = RecordLayout((*fields.PARAMETERS, *stages.parameters), (*fields.STATE, *stages.state))
    machinery = _machinery(stages.name, layout, source)
    guard = protection_of(stages.causes, tells_all=stages.tells_all, faults_when_off=stages.faults_when_off)
    events = _events(guard.causes_gone, guard.statusword_bits, stages.remote or _always)
    supervise = _supervise(stages, guard.protect, events.tell_state)
    start_window, tick = in_turn(stages.window, 2), in_turn(stages.tick, 3)
    window = _window(start_window, tick)
    leave_diverged = _leave_diverged(in_turn(stages.halt, 2))
    return Firmware(
        layout=layout,
        causes=tuple(stages.causes),
        machinery=machinery,
        run=_run(
            source,
            reader(machinery),
            _run_group(_play_row(events, layout.place("target_position")[1]), supervise, window, leave_diverged),
        ),
        run_drives_alone=_run_drives_alone(source, supervise, window),
        write_events=_write_events(source, events),
        power_on=_power_on(source, stages, events.tell_state),
        trip=_trip(source, guard.trip),
        communication_lost=row_of(stages.causes, protection.COMMUNICATION),
        supervise=supervise,
        start_window=start_window,
        tick=tick,
        window=window,
    )
