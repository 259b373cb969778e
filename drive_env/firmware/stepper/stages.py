"""The firmware of stepper drives: the order of its stages."""

from __future__ import annotations

from drive_env.firmware.common import phases, start_up
from drive_env.firmware.common.dc_link import derive_link
from drive_env.firmware.common.encoder import find_noise, forget_velocity, shake_encoders, start_counter
from drive_env.firmware.common.warming import warmed
from drive_env.firmware.cycle import FirmwareStages, Stage, compose
from drive_env.firmware.record import LANES
from drive_env.firmware.stepper import causes, fields
from drive_env.firmware.stepper.chopper import choose_drive, drain_shorts, find_ripple
from drive_env.firmware.stepper.cool_step import adapt_current, forget_reduction
from drive_env.firmware.stepper.current_scale import scale_current
from drive_env.firmware.stepper.dc_step import forget_waiting, release_steps, slow_ramp
from drive_env.firmware.stepper.sensors import derive_encoder, measure_motion
from drive_env.firmware.stepper.stall_guard import collect_voltage, forget_load, hold_stalled, read_load, stop_stalled
from drive_env.firmware.stepper.steps import count_steps, derive_steps, make_steps, plan_steps
from drive_env.firmware.stepper.winding import chop, move_rotor, power_stage, refresh_winding
from mechanics.kernels.compiled import inlined, stage

LARGEST_SQUARE = 1e12  # A^2


@inlined
def collect_torque(drive, s, weight, moment):
    """Add this tick's share to mean and first moment of the torque of physics step s of the window."""
    for lane in range(LANES):
        drive.tau_window[s, lane] += weight * (drive.tau_m[lane] + drive.tau_detent[lane])
    for lane in range(LANES):
        drive.moment_window[s, lane] += moment * (drive.tau_m[lane] + drive.tau_detent[lane])


def tick_with(step: Stage) -> Stage:
    """Return the stage that runs the current loop once, with a stage that steps the field for a tick."""

    @stage
    def run_tick(drive, rates, k):
        """Run the current loop once: steps, chopper, winding, torque for the load's next steps.

        One stage, since each call takes some nanoseconds, 25,000 times a second.
        """
        step(drive, rates.tick)
        chop(drive)
        power_stage(drive)
        collect_voltage(drive)
        move_rotor(drive, rates.tick, (k + 0.5) / rates.ticks + 0.5)
        collect_torque(drive, 0, rates.weights[0, k], rates.moments[0, k])
        for s in range(1, rates.substeps):
            collect_torque(drive, s, rates.weights[s, k], rates.moments[s, k])

    return run_tick


@stage
def read_motion(drive, rates):
    """Read step counter and encoder."""
    if drive.block_has_noisy_encoder[0]:
        shake_encoders(drive)
    measure_motion(drive, rates.window)


@stage
def watch_load(drive, rates):
    """Let steps wait for the rotor, read the load, stop a motor that has stalled, and adapt the current."""
    if drive.block_has_dc_step[0]:
        release_steps(drive, rates.window)
    read_load(drive, rates.tick, rates.ticks)
    stop_stalled(drive)
    count_steps(drive, rates.window)
    adapt_current(drive)


@stage
def prepare_chopper(drive, rates):
    """Choose the drive of the bridges in this window, and compute the winding's exact step for its ticks."""
    for s in range(rates.substeps):
        for lane in range(LANES):
            drive.tau_window[s, lane] = 0.0
            drive.moment_window[s, lane] = 0.0
    refresh_winding(drive, rates.tick, rates.window)
    choose_drive(drive)
    find_ripple(drive)
    drain_shorts(drive)


@stage
def warm(drive, rates):
    """Advance the temperatures: copper loss of currents and ripple."""
    for lane in range(LANES):
        square = drive.i_a[lane] * drive.i_a[lane] + drive.i_b[lane] * drive.i_b[lane]
        square += drive.ripple[lane] * drive.ripple[lane] * (1.0 / 6.0)
        square = square if square < LARGEST_SQUARE else 0.0  # a frozen lane's currents may be non-finite
        # The current of a short to ground warms only the stage, while its bridge is on.
        u_dc = drive.u_dc[lane]
        shorts = drive.short_a[lane] * drive.short_a[lane] * abs(drive.u_a[lane])
        shorts += drive.short_b[lane] * drive.short_b[lane] * abs(drive.u_b[lane])
        shorted = drive.stage_on[lane] * u_dc * shorts
        shorted = shorted if shorted < LARGEST_SQUARE else 0.0
        in_stage = drive.on_resistance[lane] * (square + shorted)
        warmed(drive, lane, drive.R_s[lane] * square, in_stage, rates.period)


@stage
def prepare_quotients(drive, rates):
    """Compute the quotients for windows and ticks."""
    derive_encoder(drive)
    derive_steps(drive)
    derive_link(drive, rates.tick)


@stage
def spread_steps(drive, rates):
    """Plan the steps of the coming period, without parts that no drive of a block needs."""
    if rates.period > 0.0:
        plan_steps(drive, rates.period)
    find_noise(drive)
    drive.block_has_dc_step[0] = 0
    for lane in range(LANES):
        if drive.dc_speed[lane] > 0.0:
            drive.block_has_dc_step[0] = 1


@stage
def tell_status(drive, lane):
    """Write 2102h: the driver's error flags of present causes."""
    drive.status_flags[lane] = drive.cause_flags[lane]


@stage
def halt(drive, lane):
    """Replace non-finite state by 0."""
    forget_velocity(drive, lane)
    drive.step_rate[lane] = 0.0
    drive.i_a[lane] = 0.0
    drive.i_b[lane] = 0.0
    drive.tau_detent[lane] = 0.0


@stage
def power_on(drive, lane):
    """Reset: steps and encoder at zero, the table at its first entry, for any angle of the rotor."""
    drive.init_state[lane] = start_up.DONE
    drive.step_position[lane] = 0.0
    drive.step_rate[lane] = 0.0
    drive.steps_done[lane] = 0.0
    drive.steps_low[lane] = 0.0
    drive.steps_high[lane] = 0.0
    drive.in_full_steps[lane] = 0.0
    drive.standstill_time[lane] = 0.0
    drive.velocity_before[lane] = 0.0
    drive.current_scale[lane] = 0.0
    drive.i_a[lane] = 0.0
    drive.i_b[lane] = 0.0
    drive.tau_detent[lane] = 0.0
    drive.true_edges[lane] = start_counter(drive, lane)
    drive.step_seen[lane] = 0.0
    drive.step_shift[lane] = 0.0
    drive.loop_closed[lane] = 0.0
    drive.encoder_shift[lane] = 0.0
    drive.index_seen[lane] = 0.0
    drive.latch_armed[lane] = 0.0
    drive.latch_steps[lane] = 0.0
    drive.latch_encoder[lane] = 0.0
    drive.theta_encoder[lane] = 0.0
    drive.omega_encoder[lane] = 0.0
    drive.position_actual[lane] = 0.0
    drive.deviation[lane] = 0.0


STAGES = FirmwareStages(
    name="stepper",
    parameters=fields.PARAMETERS,
    state=fields.STATE,
    causes=causes.CAUSES,
    begin_period=(warm, prepare_quotients),
    measure=(causes.watch_phases,),
    switch=(phases.forget_peaks, slow_ramp, hold_stalled, causes.switch_brake, scale_current),
    tell=(tell_status,),
    end_period=(spread_steps,),
    window=(watch_load, read_motion, prepare_chopper),
    tick=(tick_with(make_steps),),
    power_on=(power_on, forget_load, forget_reduction, forget_waiting),
    halt=(halt, forget_load, forget_reduction, forget_waiting),
)

FIRMWARE = compose(STAGES, __name__)
