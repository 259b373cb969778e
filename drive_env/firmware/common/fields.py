"""What every drive's record has: what the automaton, modes, inputs and protection read and write.

A device's own stages share some of these: they write theta_meas, omega_meas, counts_per_turn, T_stage, u_dc, stage_on
and init_state, and tau_window with moment_window, what each physics step of a window has of the motor; they read the
demands, loop_level, drive_function, theta_m, omega_m and tau_reaction.
"""

from __future__ import annotations

from drive_env.firmware.record import EMERGENCY_QUEUE, MAX_SUBSTEPS, Field

PARAMETERS = (
    Field("live", "i4", "", "1: this lane is an axis"),
    # --- parameters and commands that the dictionary writes -------------------------------------------------------
    Field("position_p", "f8", "1/s", "position loop: speed per following error; 0: the demand is followed without lag"),
    Field("position_scaler", "f8", "inc/rev", "2058h", 65536.0),
    Field("limit_switches", "i4", "", "2005h"),
    Field("home_offset", "f8", "rad", "607Ch"),
    Field("homing_method", "i4", "", "6098h"),
    Field("homing_fast", "f8", "rad/s", "6099h:01"),
    Field("homing_slow", "f8", "rad/s", "6099h:02"),
    Field("homing_acceleration", "f8", "rad/s^2", "609Ah"),
    Field("controlword", "i4", "", "6040h"),
    Field("mode", "i4", "", "6060h"),
    Field("quick_stop_option", "i4", "", "605Ah", 2),
    Field("positioning_option", "i4", "", "60F2h"),
    Field("target_position", "f8", "rad", "607Ah"),
    Field("target_velocity", "f8", "rad/s", "60FFh"),
    Field("target_torque", "f8", "A", "6071h, as peak i_q"),
    Field("position_offset", "f8", "rad", "60B0h"),
    Field("velocity_offset", "f8", "rad/s", "60B1h"),
    Field("torque_offset", "f8", "A", "60B2h, as peak i_q"),
    Field("interpolation_value", "f8", "", "60C2h:01", 1.0),
    Field("interpolation_index", "f8", "", "60C2h:02", -3.0),
    Field("max_velocity", "f8", "rad/s", "6081h: velocity of the profile"),
    Field("velocity_limit", "f8", "rad/s", "607Fh: highest speed of pp and pv; 0: none"),
    Field("acceleration", "f8", "rad/s^2", "6083h"),
    Field("deceleration", "f8", "rad/s^2", "6084h"),
    Field("quick_stop_deceleration", "f8", "rad/s^2", "6085h"),
    Field("position_window", "f8", "rad", "6067h; inf: switched off"),
    Field("position_window_time", "f8", "s", "6068h"),
    Field("following_error_window", "f8", "rad", "6065h; 0: switched off"),
    Field("position_min", "f8", "rad", "607Dh:01"),
    Field("position_max", "f8", "rad", "607Dh:02"),
    # --- data of the device and of its power stage ----------------------------------------------------------------
    Field("undervoltage", "f8", "V", "limit below which the stage is cut"),
    Field("overvoltage", "f8", "V", "limit above which the stage is cut"),
    Field("warning_temperature", "f8", "K", "stage temperature above 0 degC at which a warning is sent"),
    Field("error_temperature", "f8", "K", "stage temperature above 0 degC at which the stage is cut"),
    Field("standstill", "f8", "rad/s", "speed below which the motor counts as standing still"),
    Field("supply_voltage", "f8", "V", "open-circuit voltage of the supply"),
    # --- the motor as it is ---------------------------------------------------------------------------------------
    # Faults that come and go (drive_env/faults); a sound machine has the initial values.
    Field("wired", "i4", "", "inputs (bits of 60FDh) that a switch is connected to"),
    Field("enable_input", "i4", "", "1: the enable input is closed", 1),
    Field("switch_low", "f8", "rad or m", "where the left, right and home switch begin to be pressed", depth=3),
    Field("switch_high", "f8", "rad or m", "where they cease to be", depth=3),
    Field("J_rotor", "f8", "kg*m^2", "inertia that the rotor feels at once: its own and what is rigidly on it", 1.0),
    Field("brake_torque", "f8", "N*m", "of the holding brake on the shaft", 0.0),
    Field("brake_mode", "f8", "", "0 open, 1 closed, 2 closed while the stage is off", 0.0),
)

# What changes while the drive runs; a machine that is reset starts from the initial values.
STATE = (
    # --- state: finite state automaton, profile -------------------------------------------------------------------
    Field("diverged", "i4", "", "1: the axis left the range of physics and is frozen"),
    Field("inputs", "i4", "", "60FDh, 2702h: bit 0 left limit, 1 right limit, 2 home, 3 enable"),
    Field("load_position", "f8", "rad or m", "position of the part of the load that presses switches"),
    Field("fsa", "i4", "", "state, see fsa.py"),
    Field("transition_pending", "i4", "", "transition that waits for standstill: 5, 12 or 14"),
    Field("statusword", "i4", "", "6041h"),
    Field("error_register", "i4", "", "1001h"),
    Field("fault", "i4", "", "row of the protection table that holds the drive in fault, plus 1"),
    Field(
        "emergency",
        "i4",
        "",
        "queue: row of the emergency table plus 1, error register shifted by 8",
        depth=EMERGENCY_QUEUE,
    ),
    Field("emergency_count", "i4", "", "emergencies that wait to be fetched"),
    Field("mode_display", "i4", "", "6061h"),
    Field("stopping", "i4", "", "1: a stop ramp runs or holds the axis at standstill"),
    Field("braking", "i4", "", "1: a stop ramp has begun"),
    Field("stop_time", "f8", "s", "since the stop ramp's end"),
    Field("set_point_acknowledged", "i4", "", "statusword bit 12 in pp"),
    Field("set_point_valid", "i4", "", "a set-point of pp was accepted"),
    Field("internal_limit", "i4", "", "statusword bit 11"),
    Field("target_reached", "i4", "", "statusword bit 10"),
    Field("in_window_time", "f8", "s", "time spent within the position window"),
    Field("set_point_fresh", "i4", "", "1: a cyclic set-point has arrived since the last look"),
    Field("set_point_steps", "i4", "", "periods left until the demand is at the cyclic set-point; -1: none came yet"),
    Field("blocked", "i4", "", "directions that limits forbid: bit 0 negative, bit 1 positive"),
    Field("homing_state", "i4", "", "see modes/hm.py"),
    Field("homing_direction", "f8", "", "direction in which the switch was found"),
    Field("homing_attained", "i4", "", "statusword bit 12 in hm"),
    Field("homing_edge", "f8", "rad", "where the switch changed"),
    Field("home_shift", "f8", "rad", "what is taken from the position since the last homing"),
    Field("home_count", "f8", "", "2140h: home as the position sensor counted it from power-on, 607Ch left out"),
    Field("init_state", "i4", "", "encoder initialisation, see alignment.py"),
    Field("velocity_sum", "f8", "A", "integrator of the velocity loop; 0 where there is none"),
    Field("T_stage", "f8", "K", "stage temperature above 0 degC", 25.0),
    Field("active", "i4", "", "bits of the causes whose condition held at the last look"),
    Field("present", "i4", "", "bits of the causes whose condition holds now, whatever the state"),
    Field("warning", "i4", "", "statusword bit 7"),
    Field("stage_on", "f8", "1", "1: the bridge switches"),
    Field("loop_level", "f8", "", "innermost loop that has a set-point: 0 current, 1 velocity, 2 position"),
    Field("profile_target", "f8", "rad", "where the profile ends"),
    Field("position_demand", "f8", "rad", "6062h"),
    Field("velocity_demand", "f8", "rad/s", "speed of the profile; set-point of the velocity loop at level 1"),
    Field("torque_demand", "f8", "A", "set-point of the current loop at level 0"),
    Field("omega_slow", "f8", "rad/s", "slowly filtered speed, for the motor activity bit"),
    Field("drive_function", "f8", "1", "1: the power stage drives the motor"),
    # --- state: sensors and loops ---------------------------------------------------------------------------------
    Field("theta_meas", "f8", "rad", "measured position, in the user's direction"),
    Field("omega_meas", "f8", "rad/s", "measured and filtered velocity, in the user's direction"),
    # --- state: power stage and motor -----------------------------------------------------------------------------
    Field("u_dc", "f8", "V", "supply voltage at the bridge"),
    Field("theta_m", "f8", "rad", "rotor angle"),
    Field("omega_m", "f8", "rad/s", "rotor speed"),
    Field("tau_m", "f8", "N*m", "motor torque, mean of the last tick"),
    Field("tau_window", "f8", "N*m", "mean motor torque of each physics step of the window", depth=MAX_SUBSTEPS),
    Field("moment_window", "f8", "N*m*s", "first moment in time of that torque", depth=MAX_SUBSTEPS),
    Field("tau_reaction", "f8", "N*m", "torque of the load on the rotor, mean of the last window"),
    Field("tau_reaction_before", "f8", "N*m", "the same of the window before"),
    Field(
        "cause_flags",
        "i4",
        "",
        "status flags of the causes that hold now, and of those the driver shows until the reset",
    ),
    Field("counts_per_turn", "f8", "1/rev", "counts of a turn of the sensor that tells the position"),
)
