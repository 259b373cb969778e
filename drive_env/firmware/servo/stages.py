"""The firmware of servo drives: the order of its stages."""

from __future__ import annotations

import numpy as np

from drive_env.firmware.common import phases
from drive_env.firmware.common.arithmetic import TWO_PI, sine_cosine
from drive_env.firmware.common.encoder import find_noise, forget_velocity, shake_encoders, start_counter
from drive_env.firmware.cycle import FirmwareStages, Stage, compose
from drive_env.firmware.record import LANES
from drive_env.firmware.servo import alignment, causes, fields, thermal
from drive_env.firmware.servo.derived import derive
from drive_env.firmware.servo.index import find_whether_index_is_needed, watch_index
from drive_env.firmware.servo.loops import current_loop, motion_loops
from drive_env.firmware.servo.power_stage import convert_energy, open_phases, power_stage, refresh_winding
from drive_env.firmware.servo.sensors import measure_angle, measure_currents, measure_halls, measure_motion, tell_counts
from drive_env.firmware.servo.status_flags import tell_status
from mechanics.kernels.compiled import inlined, stage


@inlined
def collect_torque(drive, s, weight, moment):
    """Add this tick's share to mean and first moment of the torque of physics step s of the window."""
    for lane in range(LANES):
        drive.tau_window[s, lane] += weight * drive.tau_m[lane]
    for lane in range(LANES):
        drive.moment_window[s, lane] += moment * drive.tau_m[lane]


def tick_with(convert: Stage) -> Stage:
    """Return the stage that runs the current loop once, with `convert` for a tick's energy and motion."""

    @stage
    def run_tick(drive, rates, k):
        """Run the current loop once: sensors, regulation, bridge and winding, torque for the load's next steps.

        One stage, since each call takes some nanoseconds, 25,000 times a second.
        """
        if drive.block_uses_halls[0]:
            measure_halls(drive, rates.tick)
        measure_angle(drive, rates.tick)
        measure_currents(drive)
        current_loop(drive)
        power_stage(drive)
        if drive.block_has_open_phase[0]:
            open_phases(drive)
        convert(drive, rates.tick, (k + 0.5) / rates.ticks + 0.5)
        collect_torque(drive, 0, rates.weights[0, k], rates.moments[0, k])
        for s in range(1, rates.substeps):
            collect_torque(drive, s, rates.weights[s, k], rates.moments[s, k])

    return run_tick


@stage
def read_motion(drive, rates):
    """Read the encoder, and the halls if once per window suffices."""
    if not drive.block_uses_halls[0]:
        measure_halls(drive, rates.window)
    if drive.block_has_noisy_encoder[0]:
        shake_encoders(drive)
    measure_motion(drive, rates.window)
    if drive.block_looks_for_index[0]:
        watch_index(drive)


@stage
def regulate_motion(drive, rates):
    """Run position and velocity loop."""
    motion_loops(drive)


@stage
def prepare_winding(drive, rates):
    """Compute this window's cogging torque, and the winding's matrices for its ticks."""
    for lane in range(LANES):
        s, _ = sine_cosine(drive.cogging_order[lane] * drive.theta_m[lane] + drive.cogging_phase[lane])
        drive.tau_cogging[lane] = drive.cogging_torque[lane] * s
    for s in range(rates.substeps):
        for lane in range(LANES):
            drive.tau_window[s, lane] = drive.tau_cogging[lane]
            drive.moment_window[s, lane] = 0.0
    refresh_winding(drive, rates.tick, rates.window)


@stage
def warm(drive, rates):
    """Advance the temperatures."""
    thermal.warm(drive, rates.period)


@stage
def prepare_quotients(drive, rates):
    """Compute the quotients for the ticks."""
    derive(drive, rates.tick)


@stage
def find_what_is_needed(drive, rates):
    """Find rarely used parts of the ticks that no drive of a block needs."""
    find_whether_index_is_needed(drive)
    drive.block_uses_halls[0] = 0
    drive.block_has_open_phase[0] = 0
    find_noise(drive)
    for lane in range(LANES):
        if drive.angle_source[lane] == alignment.HALL or drive.velocity_sensor[lane] == alignment.VELOCITY_BY_HALL:
            drive.block_uses_halls[0] = 1
        if drive.open_a[lane] > 0.0 or drive.open_b[lane] > 0.0 or drive.open_c[lane] > 0.0:
            drive.block_has_open_phase[0] = 1


@stage
def tell_sensor(drive, lane, dt):
    """Write the counts of the sensor in use."""
    tell_counts(drive, lane)


@stage
def halt(drive, lane):
    """Replace non-finite state by 0."""
    forget_velocity(drive, lane)
    drive.current_sum_d[lane] = 0.0
    drive.current_sum_q[lane] = 0.0
    drive.i_d[lane] = 0.0
    drive.i_q[lane] = 0.0


@stage
def power_on(drive, lane):
    """Reset loops and sensors: the rotor's angle is known up to the commutation offset."""
    drive.overload[lane] = 0.0
    drive.i_d[lane] = 0.0
    drive.i_q[lane] = 0.0
    drive.duty_alpha[lane] = 0.0
    drive.duty_beta[lane] = 0.0
    drive.duty_next_alpha[lane] = 0.0
    drive.duty_next_beta[lane] = 0.0
    drive.current_sum_d[lane] = 0.0
    drive.current_sum_q[lane] = 0.0
    drive.i_q_ref[lane] = 0.0
    count = np.floor(start_counter(drive, lane))
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


STAGES = FirmwareStages(
    name="servo",
    parameters=fields.PARAMETERS,
    state=fields.STATE,
    causes=causes.CAUSES,
    begin_period=(warm, prepare_quotients),
    measure=(causes.watch_phases,),
    switch=(phases.forget_peaks, alignment.commutate, tell_sensor),
    tell=(tell_status,),
    end_period=(find_what_is_needed,),
    window=(read_motion, regulate_motion, prepare_winding),
    tick=(tick_with(convert_energy),),
    power_on=(power_on, tell_counts),
    halt=(halt,),
)

FIRMWARE = compose(STAGES, __name__)
