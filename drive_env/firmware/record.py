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


FIELDS = (
    # --- parameters and commands that the dictionary writes -------------------------------------------------------
    Field("current_p", "f8", "1/A", "2041h:01: duty per A of current error"),
    Field("current_i", "f8", "1", "2041h:02: share of P * error that the integrator takes per sample"),
    Field("velocity_p", "f8", "A*s/rad", "2042h:01"),
    Field("velocity_i", "f8", "1", "2042h:02: share of P * error that the integrator takes per sample"),
    Field("position_p", "f8", "1/s", "2043h:01"),
    Field("i_max", "f8", "A", "2003h: limit of the current set-point"),
    Field("motor_type", "i4", "", "2050h: 0 none, 1 DC, 3 BLDC"),
    Field("commutation_mode", "i4", "", "2055h: 0 disabled, 1 open loop, 2 digital hall, 3 ABN encoder"),
    Field("pole_pairs", "f8", "", "2056h: the drive's belief, n_p is the motor's truth", 1.0),
    Field("shaft_direction", "f8", "", "2057h: 1 reverses position, velocity and torque"),
    Field("position_scaler", "f8", "inc/rev", "2058h", 65536.0),
    Field("adc_offset", "f8", "LSB", "2060h:03 and :04", 33500.0, depth=2),
    Field("encoder_direction", "f8", "", "2080h:01: 1 counts backwards"),
    Field("encoder_steps", "f8", "1/rev", "2080h:02: the drive's belief", 8192.0),
    Field("controlword", "i4", "", "6040h"),
    Field("mode", "i4", "", "6060h"),
    Field("quick_stop_option", "i4", "", "605Ah", 2),
    Field("positioning_option", "i4", "", "60F2h"),
    Field("target_position", "f8", "rad", "607Ah"),
    Field("target_velocity", "f8", "rad/s", "60FFh"),
    Field("target_torque", "f8", "A", "6071h, as peak i_q"),
    Field("max_velocity", "f8", "rad/s", "6081h: velocity of the profile"),
    Field("acceleration", "f8", "rad/s^2", "6083h"),
    Field("deceleration", "f8", "rad/s^2", "6084h"),
    Field("quick_stop_deceleration", "f8", "rad/s^2", "6085h"),
    Field("position_window", "f8", "rad", "6067h; inf: switched off"),
    Field("position_window_time", "f8", "s", "6068h"),
    Field("following_error_window", "f8", "rad", "6065h; 0: switched off"),
    Field("position_min", "f8", "rad", "607Dh:01"),
    Field("position_max", "f8", "rad", "607Dh:02"),
    # --- data of the device and of its power stage ----------------------------------------------------------------
    Field("current_scale", "f8", "A", "current of 32768 LSB", 100.0),
    Field("duty_limit", "f8", "1", "radius of the voltage circle as a share of the supply", 0.5773502691896258),
    Field("adc_step", "f8", "A", "one step of the current measurement"),
    Field("adc_step_lsb", "f8", "LSB", "one step of the current measurement in the ADC's register"),
    Field("undervoltage", "f8", "V", "limit below which the stage is cut"),
    Field("overvoltage", "f8", "V", "limit above which the stage is cut"),
    Field("overcurrent", "f8", "A", "phase current at which the stage is cut"),
    Field("standstill", "f8", "rad/s", "speed below which the motor counts as standing still"),
    Field("velocity_filter_b", "f8", "1", "first numerator coefficient of the velocity filter; the others 2b, b"),
    Field("velocity_filter_a", "f8", "1", "denominator coefficients of the velocity filter", depth=2),
    Field("dead_time_duty", "f8", "1", "dead time per PWM period"),
    Field("dead_time_current", "f8", "A", "current below which the dead-time error fades"),
    Field("adc_offset_error", "f8", "A", "true offset of each phase's measurement", depth=2),
    Field("adc_gain", "f8", "1", "true gain of each phase's measurement", 1.0, depth=2),
    Field("adc_noise", "f8", "A", "rms noise of a current measurement before quantisation"),
    Field("supply_voltage", "f8", "V", "open-circuit voltage of the supply"),
    Field("supply_resistance", "f8", "ohm", "resistance of supply and cables"),
    # --- the motor as it is ---------------------------------------------------------------------------------------
    Field("R_s", "f8", "ohm", "phase resistance", 1.0),
    Field("L_d", "f8", "H", "d inductance", 1e-3),
    Field("L_q", "f8", "H", "q inductance", 1e-3),
    Field("psi_m", "f8", "V*s", "magnet flux"),
    Field("n_p", "f8", "", "pole pairs", 1.0),
    Field("encoder_counts", "f8", "1/rev", "counts per turn, interpolation included", 4096.0),
    Field("encoder_interpolation", "f8", "1", "counts per encoder step: above 1 an interpolated analog encoder", 1.0),
    Field("encoder_line_error", "f8", "rad", "once-per-turn error of the encoder disc, mechanical angle"),
    Field("encoder_line_phase", "f8", "rad", "phase of that error"),
    Field("commutation_offset", "f8", "rad", "error of the electrical angle after alignment"),
    Field("cogging_torque", "f8", "N*m", "amplitude"),
    Field("cogging_order", "f8", "1/rev", "periods per turn"),
    Field("cogging_phase", "f8", "rad", ""),
    Field("J_rotor", "f8", "kg*m^2", "inertia that the rotor feels at once: its own and what is rigidly on it", 1.0),
    # --- state: finite state automaton, profile -------------------------------------------------------------------
    Field("live", "i4", "", "1: this lane is an axis"),
    Field("diverged", "i4", "", "1: the axis left the range of physics and is frozen"),
    Field("fsa", "i4", "", "state, see fsa.py"),
    Field("transition_pending", "i4", "", "transition that waits for standstill: 5, 12 or 14"),
    Field("statusword", "i4", "", "6041h"),
    Field("error_register", "i4", "", "1001h"),
    Field("status_flags", "i4", "", "2101h"),
    Field("fault", "i4", "", "row of the protection table that holds the drive in fault, plus 1"),
    Field("emergency", "i4", "", "queue of rows of the emergency table, plus 1", depth=EMERGENCY_QUEUE),
    Field("emergency_count", "i4", "", "emergencies that wait to be fetched"),
    Field("mode_display", "i4", "", "6061h"),
    Field("stopping", "i4", "", "1: a stop ramp runs or holds the axis at standstill"),
    Field("set_point_acknowledged", "i4", "", "statusword bit 12 in pp"),
    Field("set_point_valid", "i4", "", "a set-point of pp was accepted"),
    Field("internal_limit", "i4", "", "statusword bit 11"),
    Field("target_reached", "i4", "", "statusword bit 10"),
    Field("in_window_time", "f8", "s", "time spent within the position window"),
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
    Field("encoder_error", "f8", "rad", "disc error at the present angle"),
    Field("theta_meas", "f8", "rad", "measured position, in the user's direction"),
    Field("omega_meas", "f8", "rad/s", "measured and filtered velocity, in the user's direction"),
    Field("velocity_filter_z", "f8", "rad/s", "state of the velocity filter", depth=2),
    Field("omega_ref", "f8", "rad/s", "set-point of the velocity loop"),
    Field("position_error", "f8", "rad", "2043h:02"),
    Field("velocity_error", "f8", "rad/s", "2042h:03"),
    Field("velocity_sum", "f8", "A", "2042h:04: integrator of the velocity loop"),
    Field("i_q_ref", "f8", "A", "set-point of the torque current, in the user's direction"),
    Field("i_d_meas", "f8", "A", "measured flux current"),
    Field("i_q_meas", "f8", "A", "measured torque current, motor's direction"),
    Field("current_error_d", "f8", "A", "2041h:05"),
    Field("current_error_q", "f8", "A", "2041h:03"),
    Field("current_sum_d", "f8", "1", "2041h:06: integrator of the flux loop, duty"),
    Field("current_sum_q", "f8", "1", "2041h:04: integrator of the torque loop, duty"),
    Field("adc_raw", "f8", "LSB", "2060h:01 and :02", depth=2),
    Field("adc_current", "f8", "A", "2060h:05 to :07: phase currents after the offsets", depth=3),
    Field("angle_meas", "f8", "rad", "2103h: electrical angle that the encoder tells"),
    Field("torque_meas", "f8", "A", "6077h: measured torque current, user's direction"),
    Field("random", "f8", "", "state of the noise generator, an unsigned 32-bit integer", 1.0),
    # --- state: power stage and motor -----------------------------------------------------------------------------
    Field("sin_e", "f8", "1", "sine of the true electrical angle at the tick's start"),
    Field("cos_e", "f8", "1", "", 1.0),
    Field("sin_meas", "f8", "1", "sine of the electrical angle that the encoder tells"),
    Field("cos_meas", "f8", "1", "", 1.0),
    Field("i_alpha_meas", "f8", "A", "measured current, stator frame"),
    Field("i_beta_meas", "f8", "A", ""),
    Field("duty_next_alpha", "f8", "1", "duty computed in this period, held in the next"),
    Field("duty_next_beta", "f8", "1", ""),
    Field("duty_alpha", "f8", "1", "duty that the bridge holds during this period, stator frame"),
    Field("duty_beta", "f8", "1", ""),
    Field("u_dc", "f8", "V", "supply voltage at the bridge"),
    Field("i_d", "f8", "A", ""),
    Field("i_q", "f8", "A", ""),
    Field("theta_m", "f8", "rad", "rotor angle"),
    Field("omega_m", "f8", "rad/s", "rotor speed"),
    Field("tau_m", "f8", "N*m", "motor torque, mean of the last tick"),
    Field("tau_window", "f8", "N*m", "mean motor torque of each physics step of the window", depth=MAX_SUBSTEPS),
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

# Doubles first and the whole padded to cache lines: a field of doubles is then one aligned 64-byte line.
_ORDERED = sorted(FIELDS, key=lambda field: field.kind != "f8")
_PACKED = np.dtype([(f.name, f.kind, (LANES,) if f.depth == 1 else (f.depth, LANES)) for f in _ORDERED])
CACHE_LINE = 64
_PADDING = -_PACKED.itemsize % CACHE_LINE
RECORD = np.dtype([*((name, _PACKED[name]) for name in _PACKED.names or ()), ("padding", "u1", (max(_PADDING, 1),))])


def new_records(num_axes: int) -> NDArray[np.void]:
    """Return records for `num_axes` axes, shape (ceil(num_axes / 8),), every field at its initial value.

    Lanes past the last axis are dead: they are computed, since a vector instruction computes all eight, and ignored.
    """
    num_blocks = -(-num_axes // LANES)
    buffer = np.zeros(num_blocks * RECORD.itemsize + CACHE_LINE, np.uint8)
    start = -buffer.ctypes.data % CACHE_LINE
    records = buffer[start : start + num_blocks * RECORD.itemsize].view(RECORD)
    for field in FIELDS:
        records[field.name] = field.initial
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
    axes = np.arange(np.size(values)) if where is None else np.flatnonzero(where)
    chosen = np.asarray(values).reshape(-1)[axes]
    field = records[name]
    block = field[:, part, :] if field.ndim == 3 else field
    block[axes // LANES, axes % LANES] = chosen
