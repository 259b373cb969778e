"""The drive record: everything that a drive knows, eight drives side by side, SI units throughout.

A field is an array of 8 lanes, so that a stage is one loop over lanes that the compiler turns into vector
instructions. Parameters come from the object dictionary through `dictionary/units.py`, from the motor's row and from
the device's data; nothing in the firmware knows an object index.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

LANES = 8
EMERGENCY_QUEUE = 8
MAX_SUBSTEPS = 8


class Field(NamedTuple):
    """One field of the record: `kind` is "f8" or "i4"; `depth` above 1 gives (depth, 8) values.

    What a stage reads in a lane loop that should vectorise is "f8" even where it is a whole number: LLVM cannot tell
    stores of one width from loads of another in the same record, and then leaves the loop scalar.
    """

    name: str
    kind: str
    unit: str
    meaning: str
    initial: float = 0.0
    depth: int = 1


PARAMETERS = (
    Field("live", "i4", "", "1: this lane is an axis"),
    # --- parameters and commands that the dictionary writes -------------------------------------------------------
    Field("current_p", "f8", "1/A", "2041h:01: duty per A of current error"),
    Field("current_i", "f8", "1", "2041h:02: share of P * error that the integrator takes per sample"),
    Field("velocity_p", "f8", "A*s/rad", "2042h:01"),
    Field("velocity_i", "f8", "1", "2042h:02: share of P * error that the integrator takes per sample"),
    Field("position_p", "f8", "1/s", "2043h:01"),
    Field("i_max", "f8", "A", "2003h: limit of the current set-point"),
    Field("torque_limit", "f8", "1", "6072h: limit of the torque as a share of 2003h; 0: 2003h alone"),
    Field("motor_type", "f8", "", "2050h: 0 none, 1 DC, 3 BLDC"),
    Field("commutation_mode", "f8", "", "2055h: 0 disabled, 1 open loop, 2 digital hall, 3 ABN encoder"),
    Field("open_loop_current", "f8", "A", "2004h"),
    Field("chopper_enable", "f8", "", "2006h:01"),
    Field("chopper_voltage", "f8", "V", "2006h:02"),
    Field("chopper_hysteresis", "f8", "V", "2006h:03"),
    Field(
        "always_use_encoder",
        "f8",
        "",
        "2043h:03: 1 takes position and velocity from the encoder under hall commutation",
    ),
    Field("velocity_sensor", "f8", "", "2042h:05, 606Ah: 0 that of the commutation, 1 digital halls, 2 ABN encoder"),
    Field("pole_pairs", "f8", "", "2056h: the drive's belief, n_p is the motor's truth", 1.0),
    Field("shaft_direction", "f8", "", "2057h: 1 reverses position, velocity and torque"),
    Field("position_scaler", "f8", "inc/rev", "2058h", 65536.0),
    Field("adc_offset", "f8", "LSB", "2060h:03 and :04", 33500.0, depth=2),
    Field("encoder_direction", "f8", "", "2080h:01: 1 counts backwards"),
    Field("encoder_steps", "f8", "1/rev", "2080h:02: the drive's belief", 8192.0),
    Field("encoder_init_mode", "i4", "", "2080h:03: 0 estimate offset, 1 use offset, 2 use hall"),
    Field("hall_polarity", "f8", "", "2070h:01"),
    Field("hall_direction", "f8", "", "2070h:02"),
    Field("hall_interpolation", "f8", "", "2070h:03"),
    Field("hall_offset", "f8", "rad", "2070h:04, electrical angle"),
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
    Field("duty_limit", "f8", "1", "radius of the voltage circle as a share of the supply", 0.5773502691896258),
    Field("adc_step", "f8", "A", "one step of the current measurement"),
    Field("adc_step_lsb", "f8", "LSB", "one step of the current measurement in the ADC's register"),
    Field("undervoltage", "f8", "V", "limit below which the stage is cut"),
    Field("overvoltage", "f8", "V", "limit above which the stage is cut"),
    Field("overcurrent", "f8", "A", "phase current at which the stage is cut"),
    Field("warning_temperature", "f8", "K", "stage temperature above 0 degC at which a warning is sent"),
    Field("error_temperature", "f8", "K", "stage temperature above 0 degC at which the stage is cut"),
    Field("nominal_current", "f8", "A", "current that the stage carries for ever"),
    Field("overload_time", "f8", "s", "time for which it carries its largest current"),
    Field("on_resistance", "f8", "ohm", "of the stage, per phase"),
    Field("stage_thermal_resistance", "f8", "K/W", "stage to ambient", 1.0),
    Field("stage_thermal_time", "f8", "s", "", 100.0),
    Field("standstill", "f8", "rad/s", "speed below which the motor counts as standing still"),
    Field("velocity_filter_b", "f8", "1", "first numerator coefficient of the velocity filter; the others 2b, b"),
    Field("velocity_filter_a", "f8", "1", "denominator coefficients of the velocity filter", depth=2),
    Field("dead_time_duty", "f8", "1", "dead time per PWM period"),
    Field("dead_time_current", "f8", "A", "current below which the dead-time error fades"),
    Field("adc_offset_error", "f8", "A", "true offset of each phase's measurement", depth=2),
    Field("adc_gain", "f8", "1", "true gain of each phase's measurement", 1.0, depth=2),
    Field("adc_noise", "f8", "A", "rms noise of a current measurement before quantisation"),
    Field("supply_voltage", "f8", "V", "open-circuit voltage of the supply"),
    Field("dc_capacitance", "f8", "F", "of the DC link", 1e-3),
    Field("idle_current", "f8", "A", "that logic, gate drivers and bleeder take from the DC link"),
    Field("chopper_resistance", "f8", "ohm", "of the brake resistor", 5.0),
    Field("supply_sinks", "f8", "", "1: a supply that takes power back; 0: fed through a diode"),
    Field("supply_resistance", "f8", "ohm", "resistance of supply and cables"),
    # --- the motor as it is ---------------------------------------------------------------------------------------
    Field("is_dc", "f8", "", "1: a brushed DC motor on two legs; 0: three phases"),
    Field("phase_factor", "f8", "1", "3/2 of the amplitude-invariant dq frame, 1 of a DC motor", 1.5),
    Field("R_s", "f8", "ohm", "phase resistance at the present temperature", 1.0),
    Field("L_d", "f8", "H", "d inductance", 1e-3),
    Field("L_q", "f8", "H", "q inductance", 1e-3),
    Field("psi_m", "f8", "V*s", "magnet flux at the present temperature; of a DC motor its constant"),
    Field("R_nominal", "f8", "ohm", "phase resistance at 25 degC", 1.0),
    Field("psi_nominal", "f8", "V*s", "magnet flux at 25 degC"),
    Field("flux_temperature", "f8", "1/K", "relative change of the flux"),
    Field("thermal_resistance", "f8", "K/W", "winding to ambient", 1.0),
    Field("thermal_time", "f8", "s", "of winding and housing", 600.0),
    Field("ambient", "f8", "K", "ambient temperature above 0 degC", 25.0),
    Field("encoder_true_direction", "f8", "", "1: channels A and B are exchanged, the encoder counts backwards"),
    Field("hall_true_polarity", "f8", "", "1: the halls' levels are inverted"),
    Field("hall_true_direction", "f8", "", "1: the halls are wired in reverse order"),
    Field("hall_true_offset", "f8", "rad", "electrical angle of the rotor at the first edge"),
    Field("hall_broken", "f8", "", "1: the halls' cable is broken, all lines read high"),
    Field("encoder_broken", "f8", "", "1: the encoder's cable is broken, it does not count"),
    Field("n_p", "f8", "", "pole pairs", 1.0),
    Field("encoder_counts", "f8", "1/rev", "counts per turn, interpolation included", 4096.0),
    Field("encoder_interpolation", "f8", "1", "counts per encoder step: above 1 an interpolated analog encoder", 1.0),
    Field("encoder_line_error", "f8", "rad", "once-per-turn error of the encoder disc, mechanical angle"),
    Field("encoder_line_phase", "f8", "rad", "phase of that error"),
    Field("commutation_offset", "f8", "rad", "error of the electrical angle after alignment"),
    # Faults that come and go (drive_env/faults); a sound machine has the initial values.
    Field("encoder_gain", "f8", "1", "counts per true count: below 1 some are lost, 0 stuck", 1.0),
    Field("encoder_noise", "f8", "rad", "rms noise of the encoder's angle"),
    Field("wired", "i4", "", "inputs (bits of 60FDh) that a switch is connected to"),
    Field("enable_input", "i4", "", "1: the enable input is closed", 1),
    Field("switch_low", "f8", "rad or m", "where the left, right and home switch begin to be pressed", depth=3),
    Field("switch_high", "f8", "rad or m", "where they cease to be", depth=3),
    Field("open_a", "f8", "", "1: the cable of phase A is broken"),
    Field("open_b", "f8", "", "1: the cable of phase B is broken"),
    Field("open_c", "f8", "", "1: the cable of phase C is broken; a DC motor has none"),
    Field("short_conductance", "f8", "S", "short circuit across the DC link, in the stage"),
    Field("cogging_torque", "f8", "N*m", "amplitude"),
    Field("cogging_order", "f8", "1/rev", "periods per turn"),
    Field("cogging_phase", "f8", "rad", ""),
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
    Field("status_flags", "i4", "", "2101h"),
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
    Field("init_time", "f8", "s", "time in this state"),
    Field("init_angle", "f8", "rad", "rotor angle, as the encoder tells it, at the beginning of this state"),
    Field("overload", "f8", "1", "I2t: share of the overload budget that is used"),
    Field("T_winding", "f8", "K", "winding temperature above 0 degC", 25.0),
    Field("T_stage", "f8", "K", "stage temperature above 0 degC", 25.0),
    Field("open_load_time_a", "f8", "s", "time for which phase A carried no current although it should"),
    Field("open_load_time_b", "f8", "s", "the same of phase B"),
    Field("active", "i4", "", "bits of the causes whose condition held at the last look"),
    Field("present", "i4", "", "bits of the causes whose condition holds now, whatever the state"),
    Field("warning", "i4", "", "statusword bit 7"),
    Field("block_uses_halls", "i4", "", "lane 0: 1 if a lane of this block commutates by halls"),
    Field("block_has_open_phase", "i4", "", "lane 0: 1 if a lane of this block has a broken phase"),
    Field("block_has_noisy_encoder", "i4", "", "lane 0: 1 if a lane of this block has a noisy encoder"),
    Field("stage_on", "f8", "1", "1: the bridge switches"),
    Field("loop_level", "f8", "", "innermost loop that has a set-point: 0 current, 1 velocity, 2 position"),
    Field("profile_target", "f8", "rad", "where the profile ends"),
    Field("position_demand", "f8", "rad", "6062h"),
    Field("velocity_demand", "f8", "rad/s", "speed of the profile; set-point of the velocity loop at level 1"),
    Field("torque_demand", "f8", "A", "set-point of the current loop at level 0"),
    Field("omega_slow", "f8", "rad/s", "slowly filtered speed, for the motor activity bit"),
    Field("drive_function", "f8", "1", "1: the power stage drives the motor"),
    # --- state: sensors and loops ---------------------------------------------------------------------------------
    Field("count", "f8", "", "encoder count"),
    Field("count_zero", "f8", "", "encoder count at power-on"),
    Field("angle_zero", "f8", "rad", "electrical angle that alignment found at count_zero"),
    Field("encoder_error", "f8", "rad", "disc error at the present angle, and noise"),
    Field("encoder_shake", "f8", "rad", "noise of the encoder in this window"),
    Field("encoder_random", "f8", "", "state of that noise's generator, an unsigned 32-bit integer", 1.0),
    Field("theta_meas", "f8", "rad", "measured position, in the user's direction"),
    Field("omega_meas", "f8", "rad/s", "measured and filtered velocity, in the user's direction"),
    Field("velocity_filter_z", "f8", "rad/s", "state of the velocity filter", depth=2),
    Field("omega_ref", "f8", "rad/s", "set-point of the velocity loop"),
    Field("position_error", "f8", "rad", "2043h:02"),
    Field("velocity_error", "f8", "rad/s", "2042h:03"),
    Field("velocity_sum", "f8", "A", "2042h:04: integrator of the velocity loop"),
    Field("i_q_ref", "f8", "A", "set-point of the torque current, in the user's direction"),
    Field("current_share", "f8", "1", "share of 2003h that the torque limit leaves", 1.0),
    Field("torque_demand_share", "f8", "1", "6074h: i_q_ref as a share of 2003h"),
    Field("i_d_meas", "f8", "A", "measured flux current"),
    Field("i_q_meas", "f8", "A", "measured torque current, motor's direction"),
    Field("current_error_d", "f8", "A", "2041h:05"),
    Field("current_error_q", "f8", "A", "2041h:03"),
    Field("current_sum_d", "f8", "1", "2041h:06: integrator of the flux loop, duty"),
    Field("current_sum_q", "f8", "1", "2041h:04: integrator of the torque loop, duty"),
    Field("adc_raw", "f8", "LSB", "2060h:01 and :02", depth=2),
    Field("adc_current", "f8", "A", "2060h:05 to :07: phase currents after the offsets", depth=3),
    Field("angle_source", "f8", "", "0 none, 1 open loop, 2 halls, 3 encoder, 4 forced, 5 DC motor"),
    Field("angle_open_loop", "f8", "rad", "2102h"),
    Field("angle_encoder", "f8", "rad", "2103h"),
    Field("angle_hall", "f8", "rad", "2104h"),
    Field("angle_forced", "f8", "rad", "angle that alignment holds"),
    Field("hall_sector", "f8", "", "decoded sector, counted over turns"),
    Field("hall_time", "f8", "s", "since the last edge"),
    Field("hall_period", "f8", "s", "between the last two edges", 1.0),
    Field("hall_sense", "f8", "", "direction of the last edge"),
    Field("hall_zero", "f8", "", "sector at power-on"),
    Field("i_d_ref", "f8", "A", "set-point of the flux current"),
    Field("torque_share", "f8", "1", "0 while the current is held along d: open loop, alignment", 1.0),
    Field("angle_meas", "f8", "rad", "electrical angle that commutation uses"),
    Field("torque_meas", "f8", "A", "6077h: measured torque current, user's direction"),
    Field("random", "f8", "", "state of the noise generator, an unsigned 32-bit integer", 1.0),
    # --- state: power stage and motor -----------------------------------------------------------------------------
    Field("sin_e", "f8", "1", "sine of the true electrical angle at the tick's start"),
    Field("cos_e", "f8", "1", "", 1.0),
    Field("sin_meas", "f8", "1", "sine of the electrical angle that the encoder tells"),
    Field("cos_meas", "f8", "1", "", 1.0),
    Field("peak_a", "f8", "A", "largest measured current of phase A since protection looked last"),
    Field("peak_b", "f8", "A", "the same of phase B"),
    Field("i_alpha_meas", "f8", "A", "measured current, stator frame"),
    Field("i_beta_meas", "f8", "A", ""),
    Field("duty_next_alpha", "f8", "1", "duty computed in this period, held in the next"),
    Field("duty_next_beta", "f8", "1", ""),
    Field("duty_alpha", "f8", "1", "duty that the bridge holds during this period, stator frame"),
    Field("duty_beta", "f8", "1", ""),
    Field("turns_per_count", "f8", "rev", "1 / encoder_steps, signed by the encoder's direction"),
    Field("counts_per_rad", "f8", "1/rad", "encoder_counts / 2 pi"),
    Field("adc_steps_per_ampere", "f8", "1/A", "1 / adc_step"),
    Field("ampere_per_lsb", "f8", "A", "current per LSB of the ADC's register"),
    Field("dead_time_slope", "f8", "1/A", "1 / dead_time_current"),
    Field("chopper_conductance", "f8", "S", "1 / chopper_resistance"),
    Field("tick_mobility", "f8", "1/(kg*m^2*Hz)", "speed gained per torque in a tick"),
    Field("link_step", "f8", "V/A", "voltage lost per ampere in a tick"),
    Field("link_feed", "f8", "1", "charging constant of the supply in a tick"),
    Field("link_decay", "f8", "1", "what a short circuit leaves of the voltage after a tick"),
    Field("link_share", "f8", "1", "1 / (1 + link_feed), less with a short circuit"),
    Field("i_d_before", "f8", "A", "at the tick's start"),
    Field("i_q_before", "f8", "A", ""),
    Field("i_d_mean", "f8", "A", "over the tick"),
    Field("i_q_mean", "f8", "A", ""),
    Field("u_d", "f8", "V", "held by the bridge, rotor frame at the tick's start"),
    Field("u_q", "f8", "V", ""),
    Field("half_turn_sin", "f8", "1", "sine of half the electrical angle that the rotor turns in a tick"),
    Field("half_turn_cos", "f8", "1", "", 1.0),
    Field("bridge_power", "f8", "W", "power that the bridge takes from the DC link"),
    Field("chopper", "f8", "", "1: the brake chopper conducts"),
    Field("u_dc", "f8", "V", "supply voltage at the bridge"),
    Field("i_d", "f8", "A", ""),
    Field("i_q", "f8", "A", ""),
    Field("theta_m", "f8", "rad", "rotor angle"),
    Field("omega_m", "f8", "rad/s", "rotor speed"),
    Field("tau_m", "f8", "N*m", "motor torque, mean of the last tick"),
    Field("tau_window", "f8", "N*m", "mean motor torque of each physics step of the window", depth=MAX_SUBSTEPS),
    Field("moment_window", "f8", "N*m*s", "first moment in time of that torque", depth=MAX_SUBSTEPS),
    Field("tau_cogging", "f8", "N*m", "cogging torque during this window"),
    Field("tau_reaction", "f8", "N*m", "torque of the load on the rotor, mean of the last window"),
    Field("tau_reaction_before", "f8", "N*m", "the same of the window before"),
    # --- the exact electrical step, refreshed once per window -----------------------------------------------------
    Field("step_i", "f8", "1", "exp(A dt): dd, dq, qd, qq", depth=4),
    Field("step_u", "f8", "A/V", "effect of the held voltage: dd, dq, qd, qq", depth=4),
    Field("step_e", "f8", "A", "effect of the back-EMF: d, q", depth=2),
    Field("mean_i", "f8", "1", "mean current over the tick, from the current at its start", depth=4),
    Field("mean_u", "f8", "A/V", "the same, from the held voltage", depth=4),
    Field("mean_e", "f8", "A", "the same, from the back-EMF", depth=2),
)

FIELDS = PARAMETERS + STATE

# Doubles first and the whole padded to cache lines: a field of doubles is then one aligned 64-byte line.
_ORDERED = sorted(FIELDS, key=lambda field: field.kind != "f8")
_PACKED = np.dtype([(f.name, f.kind, (LANES,) if f.depth == 1 else (f.depth, LANES)) for f in _ORDERED])
CACHE_LINE = 64
_PADDING = -_PACKED.itemsize % CACHE_LINE
_PAD = [("padding", "u1", (_PADDING,))] if _PADDING else []
RECORD = np.dtype([*((name, _PACKED[name]) for name in _PACKED.names or ()), *_PAD])


def new_records(num_axes: int) -> NDArray[np.void]:
    """Return records for `num_axes` axes, shape (ceil(num_axes / 8),), every field at its initial value.

    Lanes past the last axis are dead: they are computed, since a vector instruction computes all eight, and ignored.
    """
    num_blocks = -(-num_axes // LANES)
    buffer = np.zeros(num_blocks * RECORD.itemsize + CACHE_LINE, np.uint8)
    start = -buffer.ctypes.data % CACHE_LINE
    memory = buffer[start : start + num_blocks * RECORD.itemsize]
    # One record is filled field by field, the others are its copies: many times faster for thousands.
    first = np.zeros(1, RECORD)
    for field in FIELDS:
        first[field.name] = field.initial
    memory.reshape(num_blocks, RECORD.itemsize)[:] = first.view(np.uint8)
    records = memory.view(RECORD)
    set_lanes(records, "live", np.ones(num_axes, np.int32))
    return records


def get_lanes(records: NDArray[np.void], name: str, num_axes: int, part: int = 0) -> NDArray[np.generic]:
    """Return a field of the first `num_axes` axes as a copy, shape (num_axes,); `part` chooses in a deep field."""
    field = records[name]
    block = field[:, part, :] if field.ndim == 3 else field
    return block.reshape(-1)[:num_axes].copy()


def set_lanes(
    records: NDArray[np.void], name: str, values: ArrayLike, where: NDArray[np.bool_] | None = None, part: int = 0
) -> None:
    """Set a field of the axes from 0 on that `values`, shape (n,), covers; only those where the mask is true."""
    chosen = np.asarray(values).reshape(-1)
    field = records[name]
    block = field[:, part, :] if field.ndim == 3 else field
    if where is None or np.all(where):
        whole, rest = divmod(len(chosen), LANES)
        block[:whole] = chosen[: whole * LANES].reshape(whole, LANES)
        if rest:
            block[whole, :rest] = chosen[whole * LANES :]
        return
    axes = np.flatnonzero(where)
    block[axes // LANES, axes % LANES] = chosen[axes]
