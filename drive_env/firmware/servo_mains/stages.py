"""The firmware of two-axis servo amplifiers on mains: the order of its stages."""

from __future__ import annotations

from drive_env.firmware.common.dc_link import turn_rotor
from drive_env.firmware.common.phases import forget_peaks
from drive_env.firmware.cycle import FirmwareStages, compose
from drive_env.firmware.record import LANES
from drive_env.firmware.servo import alignment
from drive_env.firmware.servo import causes as servo_causes
from drive_env.firmware.servo.derived import derive_sensors
from drive_env.firmware.servo.power_stage import find_torque
from drive_env.firmware.servo.sensors import tell_counts
from drive_env.firmware.servo.stages import (
    find_what_is_needed,
    halt,
    power_on,
    prepare_winding,
    read_motion,
    tell_sensor,
    tick_with,
    warm,
)
from drive_env.firmware.servo_mains import causes, d_mode, fields, own_commands
from drive_env.firmware.servo_mains.inputs import find_switches, read_module_inputs
from drive_env.firmware.servo_mains.loops import (
    compensate_cogging,
    feed_forward_current,
    find_integral_shares,
    motion_loops,
    share_current,
)
from drive_env.firmware.servo_mains.mains_link import (
    derive_link,
    find_rectifier_voltage,
    forget_link,
    move_link,
    share_rectifier,
    watch_link,
)
from drive_env.firmware.servo_mains.registers import (
    energise,
    find_readings,
    forget_readings,
    read_settings,
    tell_status,
)
from mechanics.kernels.compiled import inlined, stage


@inlined
def convert_energy(drive, dt, progress):
    """Compute torque and power from the tick's mean currents, and advance link and rotors; see the servo's stage."""
    for lane in range(LANES):
        find_torque(drive, lane)
    move_link(drive, dt)
    for lane in range(LANES):
        turn_rotor(drive, lane, drive.tau_m[lane] + drive.tau_cogging[lane], dt, progress)


@stage
def regulate_motion(drive, rates):
    """Run position and velocity loop, compensate cogging, and add the demanded current to its mean over the period."""
    motion_loops(drive)
    if drive.block_compensates_cogging[0]:
        compensate_cogging(drive)
    share = rates.window / rates.period
    for lane in range(LANES):
        drive.asked_mean[lane] += share * drive.i_q_ref[lane]


@stage
def read_mains(drive, rates):
    """Compute the rectifier's voltage for this window."""
    find_rectifier_voltage(drive, rates.window)
    share_rectifier(drive)


@stage
def prepare_link(drive, rates):
    """Read the settings, compute the ticks' quotients, and monitor the link."""
    read_settings(drive, rates.period)
    find_readings(drive, rates.period)
    derive_sensors(drive)
    find_integral_shares(drive, rates.tick, rates.window)
    share_current(drive)
    watch_link(drive, rates.period)
    derive_link(drive, rates.tick)


@stage
def connect(drive, lane):
    """Reset: connected to the master if the D-Mode matches, with all measured times at 0."""
    drive.disconnected[lane] = 0 if d_mode.fits(drive, lane) else 1
    drive.following_time[lane] = 0.0
    drive.reverse_time[lane] = 0.0
    drive.asked_mean[lane] = 0.0
    drive.stuck_time[lane] = 0.0
    drive.switch_time[lane] = 0.0
    drive.off_time[lane] = 0.0
    drive.omega_before[lane] = 0.0
    drive.torque_feed_forward[lane] = 0.0


STAGES = FirmwareStages(
    name="servo_mains",
    parameters=fields.PARAMETERS,
    state=fields.STATE,
    causes=causes.CAUSES,
    begin_period=(warm, prepare_link, read_module_inputs),
    measure=(find_switches, servo_causes.watch_phases, causes.watch_motion),
    switch=(
        forget_peaks,
        d_mode.look_at_gate,
        own_commands.obey_native_control,
        own_commands.obey_service,
        alignment.commutate,
        energise,
        tell_sensor,
    ),
    tell=(feed_forward_current, own_commands.give_back, tell_status),
    end_period=(find_what_is_needed,),
    window=(read_motion, regulate_motion, read_mains, prepare_winding),
    tick=(tick_with(convert_energy),),
    power_on=(power_on, tell_counts, connect, own_commands.forget_commands, forget_readings, forget_link),
    halt=(halt, forget_link),
    remote=d_mode.is_remote,
    tells_all=True,  # TGZ manual, 1003h: each error bit generates one entry
    faults_when_off=True,  # TGZ manual, 1001h: bit 0 is "any active bit", whatever the state
)

FIRMWARE = compose(STAGES, __name__)
