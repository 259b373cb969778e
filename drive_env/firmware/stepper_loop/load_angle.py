"""Load angle control: the field follows the rotor when the load angle would exceed 2027h.

The field leads the rotor by the deviation times 2021h / 65536 (times 1 within 2022h), at most by the load angle's
limit: until then it is at the steps, as in open loop; from then on the torque is the motor's maximum and no step is
lost. Above 2034h the limit grows by up to 2036h, so that the field weakens the rotor's flux (TMCM-3313 manual, sections
1.5.2 and 1.5.4). The motion controller reads the encoder every few microseconds; here once at the end of each tick of
the current loop.
"""

from __future__ import annotations

import numpy as np

from drive_env.firmware.common.arithmetic import TWO_PI, clip
from drive_env.firmware.common.encoder import count_at
from drive_env.firmware.record import LANES
from drive_env.firmware.stepper.steps import table_values
from mechanics.kernels.compiled import inlined

FULL_ANGLE = 1024.0  # of an electrical turn, which is four full steps
GREATEST = 511.0  # the register's, just below half a turn
UNITY = 65536.0


@inlined
def limit_lead(drive):
    """Compute the field's largest lead over the rotor in this window: writes lead_limit and angle_gain."""
    for lane in range(LANES):
        above = abs(drive.omega_encoder[lane]) - drive.weakening_velocity[lane]
        width = drive.weakening_width[lane]
        share = above / width if width > 0.0 else 1.0
        share = share if share < 1.0 else 1.0
        share = share if above > 0.0 else 0.0
        angle = drive.load_angle_limit[lane] + drive.weakening_angle[lane] * share
        angle = angle if angle < GREATEST else GREATEST
        steps = drive.full_steps[lane] if drive.full_steps[lane] > 0.0 else 1.0
        drive.lead_limit[lane] = angle * (TWO_PI * 4.0 / FULL_ANGLE) / steps
        drive.angle_gain[lane] = drive.position_correction_p[lane] / UNITY


@inlined
def move_field(drive, dt):
    """Step for one tick of dt [s]: writes step_position, field_position, and the table's values there."""
    for lane in range(LANES):
        position = drive.step_position[lane] + drive.step_rate[lane] * dt
        theta = drive.theta_m[lane] + drive.omega_m[lane] * dt + drive.encoder_error[lane]
        count = count_at(drive, lane, theta)
        rotor = (count - drive.count_zero[lane]) * TWO_PI * drive.turns_per_count[lane] + drive.loop_offset[lane]
        e = position - rotor
        lead = e if abs(e) <= drive.correction_tolerance[lane] else e * drive.angle_gain[lane]
        lead = drive.asked_lead[lane] if drive.asks_torque[lane] > 0.5 else lead
        lead = clip(lead, drive.lead_limit[lane])
        before = drive.field_position[lane]
        origin = rotor + drive.field_shift[lane]
        way = origin + lead - before
        low = drive.rate_low[lane] * dt
        high = drive.rate_high[lane] * dt
        way = low if way < low else way
        way = high if way > high else way
        # However slowly it may catch up, the field never leaves the rotor behind.
        led = origin + clip(before + way - origin, drive.lead_limit[lane])
        moved = before + drive.field_rate[lane] * dt
        field = led if drive.tracks_rotor[lane] > 0.5 else moved
        drive.step_position[lane] = position
        drive.field_position[lane] = field
        s, c = table_values(drive, lane, field)
        drive.sin_ref[lane] = s
        drive.cos_ref[lane] = c


@inlined
def electrical_angle(drive, lane, position):
    """Return the electrical angle at which a field at a position [rad] holds the rotor; entries are half a step on."""
    return (position * drive.steps_per_rad[lane] + 0.5) * drive.rad_per_entry[lane]


@inlined
def lead_of_field(drive, lane):
    """Return the field's lead over the rotor [rad], as measured by the loop."""
    rotor = drive.step_position[lane] - drive.loop_deviation[lane]
    return np.abs(drive.field_position[lane] - drive.field_shift[lane] - rotor)
