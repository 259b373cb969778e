"""The drive's cycle: one call per stage, in the order in which the data flows.

Per millisecond: protection, automaton, mode and profile, statusword. Per window (the velocity loop's period): encoder,
position and velocity loops, winding matrices; then the current ticks; then one step of the load's mechanics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numba import from_dtype, types
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.firmware import alignment, fsa, inputs, modes, protection, thermal
from drive_env.firmware.arithmetic import TWO_PI, sine_cosine
from drive_env.firmware.derived import derive
from drive_env.firmware.loops import current_loop, motion_loops
from drive_env.firmware.modes import hm, pp
from drive_env.firmware.power_stage import (
    convert_energy,
    open_phases,
    power_stage,
    refresh_winding,
)
from drive_env.firmware.record import LANES, RECORD
from drive_env.firmware.sensors import (
    encoder_count,
    measure_angle,
    measure_currents,
    measure_halls,
    measure_motion,
    shake_encoders,
)
from mechanics import stepping
from mechanics.bundle import Bundle, Cube, Matrix, Numbers, reader
from mechanics.calls import call_hook, next_number
from mechanics.compiled import cached, inlined, stage
from mechanics.plant import PackedPlant

# How a played or written value acts on a field.
REAL, INTEGER, CONTROLWORD, MODE, SET_POINT = 0, 1, 2, 3, 4

# Modes of a holding brake.
BRAKE_OPEN, BRAKE_CLOSED, BRAKE_WITH_STAGE = 0, 1, 2

# Time constant of the speed that decides whether the motor rotates [s]: encoder noise must not light bit 14.
ACTIVITY_TIME = 0.02


@dataclass(eq=False)
class Rates(Bundle):
    """Periods [s] and their ratios; data of the device and of the physics."""

    tick: float  # current loop
    window: float  # velocity and position loop
    period: float  # profile, automaton, protection: the communication cycle
    ticks: int  # per window
    windows: int  # per period
    substeps: int  # physics steps per window
    # Share of each tick's torque in the mean of each physics step, shape (substeps, ticks).
    weights: Matrix
    # The same times the time from the step's middle to the tick's [s].
    moments: Matrix


Records = Annotated[NDArray[np.void], types.Array(from_dtype(RECORD), 1, "C")]
Integers = Annotated[NDArray[np.int32], types.int32[:, ::1]]


@dataclass(eq=False)
class Machinery(Bundle):
    """What a run knows of a group of machines.

    `reals` and `integers` are the records' memory, shape (blocks, numbers per record).
    """

    records: Records  # (blocks,)
    reals: Matrix
    integers: Integers
    plant: PackedPlant
    rates: Rates
    motion: Matrix  # scratch, (7, 8 blocks)
    first_axis: int  # number of the group's first axis in a call's rows
    num_axes: int


@dataclass(eq=False)
class Call(Bundle):
    """What a run plays and samples; values are SI.

    `before` and `after` are addresses of hooks or 0. They are called with `data`, a group's first axis and its number
    of axes, in the thread that runs the group; where `before` returns 0 the group stays as it is.
    """

    values: Cube  # (cycles, objects, all axes)
    kinds: Numbers  # REAL, INTEGER, CONTROLWORD, MODE or SET_POINT, (objects,)
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


machinery_at, call_at, fleet_at = reader(Machinery), reader(Call), reader(Fleet)


@inlined
def collect_torque(drive, s, weight, moment):
    """Add this tick's share to mean and first moment of the torque of physics step s of the window."""
    for lane in range(LANES):
        drive.tau_window[s, lane] += weight * drive.tau_m[lane]
    for lane in range(LANES):
        drive.moment_window[s, lane] += moment * drive.tau_m[lane]


@stage
def tick(drive, rates, k):
    """Run one period of the current loop, tick k of its window."""
    if drive.block_uses_halls[0]:
        measure_halls(drive, rates.tick)
    measure_angle(drive, rates.tick)
    measure_currents(drive)
    current_loop(drive)
    power_stage(drive)
    if drive.block_has_open_phase[0]:
        open_phases(drive)
    convert_energy(drive, rates.tick, (k + 0.5) / rates.ticks + 0.5)
    collect_torque(drive, 0, rates.weights[0, k], rates.moments[0, k])
    for s in range(1, rates.substeps):
        collect_torque(drive, s, rates.weights[s, k], rates.moments[s, k])


@stage
def start_window(drive, rates):
    """Read the encoder, close position and velocity loop, and prepare the winding for the ticks of this window."""
    if not drive.block_uses_halls[0]:
        measure_halls(drive, rates.window)
    if drive.block_has_noisy_encoder[0]:
        shake_encoders(drive)
    measure_motion(drive, rates.window)
    motion_loops(drive)
    for lane in range(LANES):
        s, _ = sine_cosine(drive.cogging_order[lane] * drive.theta_m[lane] + drive.cogging_phase[lane])
        drive.tau_cogging[lane] = drive.cogging_torque[lane] * s
    for s in range(rates.substeps):
        for lane in range(LANES):
            drive.tau_window[s, lane] = drive.tau_cogging[lane]
            drive.moment_window[s, lane] = 0.0
    refresh_winding(drive, rates.tick, rates.window)


@stage
def window(drive, rates):
    """Run the drive through one window."""
    start_window(drive, rates)
    for k in range(rates.ticks):
        tick(drive, rates, k)


@stage
def supervise(drive, rates):
    """Run what the drive does once per millisecond."""
    thermal.warm(drive, rates.period)
    derive(drive, rates.tick)
    for lane in range(LANES):
        if drive.live[lane] == 0 or drive.diverged[lane] == 1:
            continue
        drive.omega_slow[lane] += (drive.omega_meas[lane] - drive.omega_slow[lane]) * (rates.period / ACTIVITY_TIME)
        inputs.read_inputs(drive, lane)
        protection.protect(drive, lane, rates.period)
        fsa.automatic_transitions(drive, lane, rates.period)
        alignment.commutate(drive, lane, rates.period)
        modes.generate_demand(drive, lane, rates.period)
        fsa.update_statusword(drive, lane, modes.mode_bits(drive, lane))
        drive.status_flags[lane] = modes.status_flags(drive, lane) | protection.fault_flags(drive, lane)
    # What few drives need is left out of the ticks of a block where none does.
    drive.block_uses_halls[0] = 0
    drive.block_has_open_phase[0] = 0
    drive.block_has_noisy_encoder[0] = 0
    for lane in range(LANES):
        if drive.angle_source[lane] == alignment.HALL or drive.velocity_sensor[lane] == alignment.VELOCITY_BY_HALL:
            drive.block_uses_halls[0] = 1
        if drive.open_a[lane] > 0.0 or drive.open_b[lane] > 0.0 or drive.open_c[lane] > 0.0:
            drive.block_has_open_phase[0] = 1
        # Once more after the noise has ended, so that none of it is left in the angle.
        if drive.encoder_noise[lane] > 0.0 or drive.encoder_shake[lane] != 0.0:
            drive.block_has_noisy_encoder[0] = 1


@stage
def write_controlword(drive, lane, word):
    """Process a write of 6040h completely: fault reset edge, state commands, new set-point, statusword."""
    before = drive.controlword[lane]
    drive.controlword[lane] = word
    if word & cia402.FAULT_RESET and not before & cia402.FAULT_RESET:
        fsa.reset_fault(drive, lane, protection.causes_gone(drive, lane))
    fsa.command(drive, lane)
    if drive.mode_display[lane] == modes.PP:
        pp.new_set_point(drive, lane, before)
    elif drive.mode_display[lane] == modes.HM:
        hm.start_or_stop(drive, lane, before)
    fsa.update_statusword(drive, lane, modes.mode_bits(drive, lane))


@stage
def write_mode(drive, lane, mode):
    """Process a write of 6060h: the mode changes at once."""
    drive.mode[lane] = mode
    if mode != drive.mode_display[lane]:
        modes.change_mode(drive, lane)
    fsa.update_statusword(drive, lane, modes.mode_bits(drive, lane))


@stage
def play_row(records, reals, integers, values, kinds, offsets, row, first_axis, num_axes):
    """Write one row of played values to the axes of this group."""
    for k in range(kinds.shape[0]):
        for axis in range(num_axes):
            block, lane = axis // LANES, axis % LANES
            value = values[row, k, first_axis + axis]
            if kinds[k] == REAL:
                reals[block, offsets[k] + lane] = value
            elif kinds[k] == SET_POINT:
                reals[block, offsets[k] + lane] = value
                records[block].set_point_fresh[lane] = 1
            elif kinds[k] == INTEGER:
                integers[block, offsets[k] + lane] = int(value)
            elif kinds[k] == CONTROLWORD:
                write_controlword(records[block], lane, int(value))
            else:
                write_mode(records[block], lane, int(value))


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
    """Step the load through one window and bring the rotors to where it has them.

    `motion` is scratch, shape (7, lanes of all blocks): whole blocks are copied, since that vectorises.
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
    axes_per_copy = plant.axis_motion.shape[0]
    for copy in range(plant.diverged.shape[0]):
        if plant.diverged[copy] == 1:
            for axis in range(copy * axes_per_copy, (copy + 1) * axes_per_copy):
                if records[axis // LANES].diverged[axis % LANES] == 0:
                    halt_diverged(records[axis // LANES], axis % LANES)


@stage
def meet(records, plant):
    """Once per millisecond: brakes close and open, and the rotors learn what they turn, where that changes."""
    axes, copies = plant.jam.shape
    brake, jam, mass, varying = plant.brake, plant.jam, plant.mass, plant.varying
    for copy in range(copies):
        for axis in range(axes):
            drive = records[(copy * axes + axis) // LANES]
            lane = (copy * axes + axis) % LANES
            mode = drive.brake_mode[lane]
            closed = mode == BRAKE_CLOSED or (mode == BRAKE_WITH_STAGE and drive.stage_on[lane] == 0.0)
            brake[axis, copy] = jam[axis, copy] + (drive.brake_torque[lane] if closed else 0.0)
            if varying:
                drive.J_rotor[lane] = mass[axis, copy]


@stage
def halt_diverged(drive, lane):
    """Take a lane out of the world: its machine left physics; its numbers must not reach anything."""
    drive.diverged[lane] = 1
    # Seen from the bus the axis is in fault and stands.
    drive.fsa[lane] = fsa.FAULTED
    drive.error_register[lane] |= protection.GENERIC_ERROR
    drive.drive_function[lane] = 0.0
    drive.stage_on[lane] = 0.0
    drive.omega_slow[lane] = 0.0
    drive.omega_meas[lane] = 0.0
    drive.velocity_filter_z[0, lane] = 0.0
    drive.velocity_filter_z[1, lane] = 0.0
    drive.velocity_sum[lane] = 0.0
    drive.current_sum_d[lane] = 0.0
    drive.current_sum_q[lane] = 0.0
    drive.velocity_demand[lane] = 0.0
    drive.position_demand[lane] = drive.theta_meas[lane]
    drive.i_d[lane] = 0.0
    drive.i_q[lane] = 0.0
    drive.tau_m[lane] = 0.0
    drive.u_dc[lane] = drive.supply_voltage[lane]
    drive.tau_reaction[lane] = 0.0
    drive.tau_reaction_before[lane] = 0.0
    fsa.update_statusword(drive, lane, 0)


@inlined
def run_group(group, call, start, cycles):
    """Run one group; cycle k: play row k, record row k (every `every` cycles), simulate one period."""
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
        for block in range(records.shape[0]):
            supervise(records[block], rates)
        meet(records, plant)
        for _ in range(rates.windows):
            for block in range(records.shape[0]):
                window(records[block], rates)
            mechanics_window(records, plant, rates, group.motion)


@cached(allocates=False)
def run(fleet_address, call_address, start, cycles, first, last):
    """Run groups for whole communication cycles from `start` up to `cycles`, taking turns with other threads.

    `first` and `last` say whether the call's hooks are due. Returns whether a machine has left physics.
    """
    fleet, call = fleet_at(fleet_address), call_at(call_address)
    groups, turn = fleet.groups, fleet.turn
    some = False
    k = next_number(turn)
    while k < groups.shape[0]:
        group = machinery_at(groups[k])
        if not first or call.before == 0 or call_hook(call.before, call.data, group.first_axis, group.num_axes) != 0:
            run_group(group, call, start, cycles)
            if last and call.after != 0:
                call_hook(call.after, call.data, group.first_axis, group.num_axes)
        diverged = group.plant.diverged
        for copy in range(diverged.shape[0]):
            some |= diverged[copy] != 0
        k = next_number(turn)
    return some


@cached(allocates=False)
def run_drives_alone(records, rates, cycles):
    """Run the drives without mechanics, rotors driven by their predicted torque balance; the benchmark's bound."""
    for _ in range(cycles):
        for block in range(records.shape[0]):
            supervise(records[block], rates)
        for _ in range(rates.windows):
            for block in range(records.shape[0]):
                window(records[block], rates)


@cached(allocates=False)
def write_events(records, kind, values, where):
    """Process writes of the controlword or the mode for the axes where the mask is true."""
    for axis in range(values.shape[0]):
        if where[axis]:
            drive = records[axis // LANES]
            if kind == CONTROLWORD:
                write_controlword(drive, axis % LANES, values[axis])
            else:
                write_mode(drive, axis % LANES, values[axis])


@cached(allocates=False)
def power_on(records, where):
    """Start the drive's firmware anew on the axes where the mask is true: transitions 0 and 1, encoder at zero.

    The commutation is aligned: the angle at which the rotor stands is known up to the commutation offset.
    """
    for axis in range(where.shape[0]):
        if not where[axis]:
            continue
        drive = records[axis // LANES]
        lane = axis % LANES
        drive.fsa[lane] = fsa.NOT_READY
        drive.transition_pending[lane] = 0
        drive.fault[lane] = 0
        drive.error_register[lane] = 0
        drive.emergency_count[lane] = 0
        drive.internal_limit[lane] = 0
        drive.stopping[lane] = 0
        drive.set_point_valid[lane] = 0
        drive.set_point_acknowledged[lane] = 0
        drive.target_reached[lane] = 0
        drive.drive_function[lane] = 0.0
        drive.stage_on[lane] = 0.0
        drive.active[lane] = 0
        drive.present[lane] = 0
        drive.blocked[lane] = 0
        drive.warning[lane] = 0
        drive.overload[lane] = 0.0
        drive.init_state[lane] = alignment.NEEDED
        drive.home_shift[lane] = 0.0
        drive.home_count[lane] = 0.0
        drive.homing_state[lane] = hm.IDLE
        drive.homing_attained[lane] = 0
        drive.loop_level[lane] = 0
        drive.mode_display[lane] = drive.mode[lane]
        drive.i_d[lane] = 0.0
        drive.i_q[lane] = 0.0
        drive.tau_m[lane] = 0.0
        drive.duty_alpha[lane] = 0.0
        drive.duty_beta[lane] = 0.0
        drive.duty_next_alpha[lane] = 0.0
        drive.duty_next_beta[lane] = 0.0
        drive.current_sum_d[lane] = 0.0
        drive.current_sum_q[lane] = 0.0
        drive.velocity_sum[lane] = 0.0
        drive.i_q_ref[lane] = 0.0
        drive.omega_meas[lane] = 0.0
        drive.omega_slow[lane] = 0.0
        drive.velocity_filter_z[0, lane] = 0.0
        drive.velocity_filter_z[1, lane] = 0.0
        drive.u_dc[lane] = drive.supply_voltage[lane]
        s, _ = sine_cosine(drive.theta_m[lane] + drive.encoder_line_phase[lane])
        drive.encoder_error[lane] = drive.encoder_line_error[lane] * s
        count = np.floor((drive.theta_m[lane] + drive.encoder_error[lane]) * drive.encoder_counts[lane] / TWO_PI)
        gain = drive.encoder_gain[lane]
        told = (drive.theta_m[lane] + drive.encoder_error[lane]) * drive.encoder_counts[lane] / TWO_PI * gain
        drive.count[lane] = encoder_count(told, drive.encoder_true_direction[lane])
        drive.count_zero[lane] = drive.count[lane]
        drive.angle_zero[lane] = (
            drive.n_p[lane] * (count + 0.5) * TWO_PI / drive.encoder_counts[lane] + drive.commutation_offset[lane]
        )
        sector = np.floor((drive.n_p[lane] * drive.theta_m[lane] + drive.hall_true_offset[lane]) * (6.0 / TWO_PI))
        reverse = abs(drive.hall_true_direction[lane] - drive.hall_direction[lane])
        sector += reverse * (-1.0 - 2.0 * sector)
        sector += 3.0 * abs(drive.hall_true_polarity[lane] - drive.hall_polarity[lane])
        drive.hall_sector[lane] = sector
        drive.hall_zero[lane] = sector
        drive.hall_time[lane] = 1.0
        drive.hall_period[lane] = 1.0
        drive.angle_hall[lane] = (sector + 0.5) * (TWO_PI / 6.0) - drive.hall_offset[lane]
        drive.theta_meas[lane] = 0.0
        drive.position_demand[lane] = 0.0
        drive.velocity_demand[lane] = 0.0
        drive.torque_demand[lane] = 0.0
        inputs.read_inputs(drive, lane)
        fsa.automatic_transitions(drive, lane, 0.0)
        fsa.update_statusword(drive, lane, modes.mode_bits(drive, lane))
        drive.status_flags[lane] = modes.status_flags(drive, lane)
