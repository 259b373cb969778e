"""Fields of two-axis servo amplifiers on mains in the record, in addition to those of all servo drives.

Names that a device binds or a test reads:

- peak_current: M-Ipeak [A]: the current of 32767 in torque objects, which are currents in the record
- i_low, i_high: current limits [A] by C-LimN, C-LimP, M-Ipeak and the image; i_max is the greater one
- target_torque: 6071h [A]: set-point of cst and pt, feed-forward in csp and ip, with torque_offset (loops.py)
- image_limit: current limit of the process images, raw: 0 no limit, 32767 no current
- d_mode: 2303h, 2403h;  d_mode_needed: by mode of operation, 0 any (d_mode.py)
- profile_shape: 6086h, -3 to 1 (common/shaped.py)
- following_error_time: 6066h [s]
- overspeed: over-speed, and the limit of cyclic set-points [rad/s]
- inputs_set: inputs that the machine sets, bits 0 to 7; switch_input: the input that each switch is wired to
- digital_inputs: 4000h, bits 0 to 7;  input_word 60FDh, the same in bits 16 to 23
- negative_, positive_, home_switch_mask: Homing_NegLimSwitchMask, ...: masks over bits 0 to 7
- error_bits: errors that the machine sets, by their number in the device's error register
- status_flags: the device's present error register: bit k is error k
- u_dc, chopper, mains_energy, mains_loss, brake_energy, idle_energy, brake_heat: of the link, equal for both axes
"""

from __future__ import annotations

from drive_env.firmware.record import Field
from drive_env.firmware.servo import fields as servo
from drive_env.firmware.servo_mains import d_mode, mains_link

# Of a servo drive on a supply without mains.
_NOT_HERE = ("idle_current", "supply_sinks")

PARAMETERS = (
    *(field for field in servo.PARAMETERS if field.name not in _NOT_HERE),
    *mains_link.PARAMETERS,
    # --- parameters and commands that the dictionary writes -------------------------------------------------------
    Field("peak_current", "f8", "A", "M-Ipeak of the motor"),
    Field("nominal_motor_current", "f8", "A", "M-Inull of the motor, RMS", 1e9),
    Field("motor_thermal_time", "f8", "s", "M-ThermTimeConst; 0: its I2t is not watched"),
    Field("commutation_shift", "f8", "rad", "M-CommutOffset, mechanical angle"),
    Field("sensor_lowest", "f8", "ohm", "M-MinResTerm: resistance of the motor's sensor below which it is an error"),
    Field("sensor_highest", "f8", "ohm", "M-MaxResTerm: the same above which", 1e9),
    Field("static_brake", "i4", "", "M-StaticBrake: 1: a brake at the output"),
    Field("hardware_delay", "f8", "s", "D-DelayEnable_Hwen: from the enable input's edge until an axis is enabled"),
    Field("unbrake_delay", "f8", "s", "D-DelayUnbrake_Enable: from current in the motor to the brake's release"),
    Field("feedback_type", "i4", "", "F-Type"),
    Field("feedback_resolution", "f8", "1/rev", "F-Resolution"),
    Field("feedback_pulses", "f8", "1/rev", "F-IncrEnc"),
    Field("external_pulses", "f8", "1/rev", "F-ExtIncrEnc; 0: there is no external encoder"),
    Field("current_integration", "f8", "s", "C-Ti: integration time of the current regulators; 0: no integrator"),
    Field("cogging_compensation", "f8", "1", "C-CogCompFac: share of the motor's cogging that is compensated"),
    Field("velocity_integration", "f8", "s", "V-Ti: integration time of the velocity regulator; 0: no integrator"),
    Field("limit_negative", "f8", "1", "C-LimN: limit of negative currents, as amplitudes in units of M-Inull"),
    Field("limit_positive", "f8", "1", "C-LimP: the same of positive ones"),
    Field("speed_low", "f8", "rad/s", "V-LimN: limit of negative speeds that the position loop asks for", 1e9),
    Field("speed_high", "f8", "rad/s", "V-LimP: the same of positive ones", 1e9),
    Field("error_angle", "f8", "rad", "P-MaxAngleError"),
    Field("error_turns", "f8", "rad", "P-MaxRevolError"),
    Field("set_cycle", "f8", "s", "C-SetCycleTime", 1e-3),
    Field("native_control", "f8", "", "control of the native image, own_commands.py"),
    Field("service_command", "i4", "", "K-Command"),
    Field("service_current", "f8", "A", "K-I"),
    Field("service_velocity", "f8", "rad/s", "K-V"),
    Field("service_position", "f8", "rad", "K-P_Angle and K-P_Revol"),
    Field("profile_position", "f8", "rad", "DPosAngle and DPosRevol"),
    Field("profile_mode", "i4", "", "Mode of the profile generator: 0 speed, 1 position", 1),
    Field("profile_ready", "i4", "", "Rdy: 1 from the arrival at the destination until a move begins, or 0 is written"),
    Field("image_limit", "f8", "1/32767", "share of M-Ipeak that is taken away: 0 none, 32767 all"),
    Field("profile_bits", "f8", "", "BitsPerRevol: only units read it", 16.0),
    Field("d_mode", "i4", "", "2303h, 2403h"),
    Field("following_error_time", "f8", "s", "6066h: for which the error may be outside of 6065h"),
    Field("negative_switch_mask", "i4", "", "inputs that are the negative limit switch; 0: there is none"),
    Field("positive_switch_mask", "i4", "", "the same of the positive one"),
    Field("home_switch_mask", "i4", "", "the same of the home switch"),
    # --- data of the device and of its motor ----------------------------------------------------------------------
    Field("module_axis", "i4", "", "which axis of its module it is"),
    Field("d_mode_needed", "i4", "", "D-Mode that each mode of operation needs; 0: any", depth=d_mode.MOST_MODES),
    Field("overspeed", "f8", "rad/s", "speed that is an error", 1e9),
    Field("offset_limit", "f8", "A", "current that may be measured while the stage is off", 1e9),
    Field("current_range", "f8", "A", "of the current measurement", 1e9),
    Field("motor_temperature", "f8", "K", "of the winding above 0 degC, as its sensor tells it, that is an error", 1e9),
    Field("ambient_limit", "f8", "K", "ambient temperature above 0 degC that is an error", 1e9),
    # --- the machine as it is -------------------------------------------------------------------------------------
    Field("inputs_set", "i4", "", "digital inputs that are set from outside, bits 0 to 7"),
    Field("switch_input", "f8", "", "input that the left, right and home switch are wired to", depth=3),
    Field("error_bits", "i4", "", "errors that are there, whatever the machine does: bit k is error k"),
    Field("emergency_stop", "f8", "", "1: the emergency stop button is pressed"),
    Field("brake_supply", "f8", "V", "that the output of the holding brake is supplied with", 24.0),
    Field("brake_switch", "f8", "", "1: the holding brake has a switch that shows whether it is closed"),
)

STATE = (
    *servo.STATE,
    *mains_link.STATE,
    Field("block_compensates_cogging", "i4", "", "lane 0: 1 if a lane of this block compensates cogging"),
    Field("cogging_current", "f8", "A", "amplitude of the current that compensates the cogging"),
    Field("i_low", "f8", "A", "least current that may be asked for"),
    Field("i_high", "f8", "A", "greatest current that may be asked for"),
    Field("cycle_seen", "f8", "s", "C-SetCycleTime that 60C2h has been set by", 1e-3),
    Field("gate_fits", "i4", "", "1: the D-Mode fits the mode of operation"),
    Field("native_before", "i4", "", "the native image's control in the period before"),
    Field("native_wants", "i4", "", "1: it enables the axis, step by step"),
    Field("native_fsa", "i4", "", "state of the axis at the end of the period before"),
    Field("service", "i4", "", "K-Command: 0 off, 1 it enables or leads the axis, 2 the axis stops"),
    Field("service_before", "i4", "", "K-Command in the period before"),
    Field("service_mode", "i4", "", "mode of operation that it leads the axis in"),
    Field("service_leads", "i4", "", "1: it has led the axis since it was enabled"),
    Field("leads", "i4", "", "1: its mode and set-points stand in place of the master's, in this period"),
    Field("masters_mode", "i4", "", "6060h meanwhile"),
    Field("masters_torque", "f8", "A", "6071h meanwhile"),
    Field("masters_velocity", "f8", "rad/s", "60FFh meanwhile"),
    Field("masters_position", "f8", "rad", "607Ah meanwhile"),
    Field("masters_is_whole", "i4", "", "target_is_whole meanwhile"),
    Field("reached_before", "i4", "", "target_reached in the period before"),
    Field("profile_taken", "f8", "rad", "destination that the profile was planned to"),
    Field("torque_feed_forward", "f8", "A", "what csp and ip add to the set-point of the current"),
    Field("disconnected", "i4", "", "1: the D-Mode does not fit, the master is ignored"),
    Field("following_time", "f8", "s", "for which the following error has been outside of its window"),
    Field("reverse_time", "f8", "s", "for which the motor has run away from its current; below 0: from one below 0"),
    Field("asked_mean", "f8", "A", "mean of i_q_ref over a period, as far as it is over"),
    Field("omega_before", "f8", "rad/s", "omega_meas a period ago"),
    Field("off_time", "f8", "s", "for which the stage has been off"),
    Field("stuck_time", "f8", "s", "for which the brake has held the motor although it was to move"),
    Field("switch_time", "f8", "s", "for which the brake's switch has not shown what the output commands"),
    Field("digital_inputs", "i4", "", "4000h: levels of the module's inputs, bits 0 to 7"),
    Field("input_word", "i4", "", "60FDh: the same in bits 16 to 23"),
    Field("axis_inputs", "i4", "", "Digital_Inputs: every second of them, from the axis' own on"),
    Field("angle_shifted", "f8", "rad", "what angle_zero has of commutation_shift, electrical angle"),
    Field("hardware_time", "f8", "s", "for which the enable input has been closed"),
    Field("phase_square", "f8", "A^2", "mean square of each phase's current", depth=3),
    Field("phase_rms", "f8", "A", "Ia_rms to Ic_rms", depth=3),
    Field("motor_square", "f8", "A^2", "mean square of the motor's current by its thermal time constant"),
    Field("mean_motor_current", "f8", "A", "aI2t: the root of it"),
    Field("sensor_resistance", "f8", "ohm", "Motor_temperature: of the motor's sensor; 0: it has none"),
    Field("feedback_link", "f8", "", "DSL_status: 1: a feedback by Hiperface DSL answers"),
    Field("external_zero", "f8", "rad", "theta_m at power-on, where the external encoder counts from"),
    Field("external_count", "f8", "", "333Eh: four counts a pulse, 32 bits with a sign"),
    Field("period_count", "f8", "", "Monitor-Counter: periods since power-on"),
    Field("drive_status", "f8", "", "aDriveStatus"),
)
