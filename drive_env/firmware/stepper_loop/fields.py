"""Fields of stepper drives with a closed loop in the record, in addition to those of all stepper drives.

Object numbers are those of the TMCM-3313 manual. Settings of the motion controller without a unit are register values.
"""

from __future__ import annotations

from drive_env.firmware.record import Field
from drive_env.firmware.stepper import fields

PARAMETERS = (
    *fields.PARAMETERS,
    Field("loop_mode", "f8", "", "2020h: 0 open loop, 1 load angle control, 2 PID on the ramp's velocity, 3 PID alone"),
    Field("position_correction_p", "f8", "1/65536", "2021h: load angle per deviation; in PID modes the D part"),
    Field("correction_tolerance", "f8", "rad", "2022h: deviation within which 2021h is 1, and a PID corrects nothing"),
    Field(
        "load_angle_limit", "f8", "1/1024 turn", "2027h: by how much the field may lead the rotor, electrical", 255.0
    ),
    Field("current_scale_min", "f8", "1/255", "2029h: share of the run current without a load angle", 255.0),
    Field("current_scale_max", "f8", "1/255", "202Ah: the same at a load angle of 2027h and above", 255.0),
    Field("correction_velocity_p", "f8", "1/256 1/s", "202Bh: velocity of catching up per deviation; P of the PID"),
    Field("correction_velocity_i", "f8", "1/65536", "202Ch: its integral part, and the PID's"),
    Field("correction_sum_limit", "f8", "65536", "202Dh: clips the sum of the deviations"),
    Field("derivative_divider", "f8", "128 clocks", "202Eh: period in which the PID's D part looks at the deviation"),
    Field("correction_velocity_limit", "f8", "rad/s", "202Fh: what a correction adds to the velocity at most", 1e9),
    Field("upscale_delay", "f8", "clocks", "2030h: time of a step up of the current's scale; 0: at once"),
    Field("downscale_delay", "f8", "clocks", "2031h: the same down"),
    Field("weakening_velocity", "f8", "rad/s", "2034h: speed above which the load angle may grow"),
    Field("weakening_width", "f8", "rad/s", "2035h: how far above it the angle is the greatest"),
    Field("weakening_angle", "f8", "1/1024 turn", "2036h: what is added to 2027h at most", 0.0),
    # --- data of the device ---------------------------------------------------------------------------------------
    Field("motion_clock", "f8", "Hz", "of the motion controller", 16e6),
)

STATE = (
    *fields.STATE,
    # --- what is told ---------------------------------------------------------------------------------------------
    Field("loop_offset", "f8", "rad", "2028h: from the encoder's position to the steps', found by the initialisation"),
    Field("loop_scale", "f8", "", "2033h: scale of the current now, 0...255", 255.0),
    Field("loop_initialised", "i4", "", "2120h: 1 once load angle control works"),
    Field("torque_current", "f8", "A", "6077h: current that makes torque"),
    Field("omega_shown", "f8", "rad/s", "606Ch: speed by the encoder where there is one (606Ah), else of the steps"),
    # --- how the loop stands --------------------------------------------------------------------------------------
    Field("corrects", "f8", "", "1: a PID may move the field"),
    Field("settle_time", "f8", "s", "for which the initialisation has held the rotor"),
    Field("loop_deviation", "f8", "rad", "of the encoder from the steps"),
    # --- the field ------------------------------------------------------------------------------------------------
    Field("field_position", "f8", "rad", "where the current vector points, in the rotor's angle"),
    Field("field_rate", "f8", "rad/s", "its speed where no encoder commutates"),
    Field("tracks_rotor", "f8", "", "1: the encoder commutates"),
    Field("field_shift", "f8", "rad", "from the steps' position to the field's, where the rotor is at rest in it"),
    Field("lead_limit", "f8", "rad", "angle by which the field may lead the rotor, or lag behind it"),
    Field("angle_gain", "f8", "1", "angle of the field per deviation"),
    Field("rate_low", "f8", "rad/s", "least speed of the field", -1e300),
    Field("rate_high", "f8", "rad/s", "greatest speed of the field", 1e300),
    Field("asked_lead", "f8", "rad", "angle that a torque mode asks for"),
    Field("asks_torque", "f8", "", "1: a torque mode asks for the angle, not the deviation"),
    Field("asked_amplitude", "f8", "A", "amplitude that a torque mode asks for"),
    # --- current and corrections ----------------------------------------------------------------------------------
    Field("run_amplitude", "f8", "A", "amplitude that the run current gives"),
    Field("correction_sum", "f8", "rad*s", "of the deviations"),
    Field("derivative_time", "f8", "s", "since the D part looked at the deviation"),
    Field("deviation_before", "f8", "rad", "what it saw"),
    Field("derivative_part", "f8", "rad/s", "what it gives"),
)
