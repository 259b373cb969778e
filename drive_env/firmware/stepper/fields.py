"""What the stages of stepper drives have in the record beside what every drive has.

Settings of the driver's chip are its register's numbers; the stages know what they mean. Object numbers are those of
the TMCM-6212 and TMCM-3313 manuals.
"""

from __future__ import annotations

from drive_env.firmware.common import dc_link, encoder, warming
from drive_env.firmware.record import Field

PARAMETERS = (
    *encoder.PARAMETERS,
    *dc_link.PARAMETERS,
    *warming.PARAMETERS,
    # --- parameters that the dictionary writes --------------------------------------------------------------------
    Field("microstep_resolution", "f8", "", "2000h: 0...8; 2^this microsteps per full step", 8.0),
    Field("full_steps", "f8", "1/rev", "2001h: full steps a turn, the drive's belief", 200.0),
    Field("run_current", "f8", "", "2003h: 0...255 of the largest current, in 32 steps", 128.0),
    Field("standby_current", "f8", "", "2004h: the same, at standstill", 8.0),
    Field("boost_current", "f8", "", "204Eh: the same, while the speed changes; 0: the run current"),
    Field("standby_delay", "f8", "s", "2089h: standstill before the standby current", 2.0),
    Field("power_down_ramp", "f8", "", "20B9h: 0...15; units of 2^18 clocks for each 1/32 on the way down; 0: at once"),
    Field("vsense", "f8", "", "20A3h: 1 halves the largest current"),
    Field("chopper_blank", "f8", "", "2092h: 0...3; 16, 24, 36 or 54 clocks", 2.0),
    Field("chopper_mode", "f8", "", "2093h: 0 spread cycle, 1 constant off time"),
    Field("hysteresis_decrement", "f8", "", "2094h: 0...3; 16, 32, 48 or 64 clocks for each unit of hysteresis"),
    Field("hysteresis_end", "f8", "", "2095h: -3...12 units; in mode 1 the offset of the sine"),
    Field(
        "hysteresis_start", "f8", "", "2096h: 0...8 units above the end; in mode 1 times 32 clocks of fast decay", 3.0
    ),
    Field("off_time", "f8", "", "2097h: 0 bridges off, else slow decay of 12 + 32 n clocks", 5.0),
    Field("short_protection_off", "f8", "", "20A1h: 1: short circuits cut nothing"),
    Field("pwm_threshold", "f8", "rad/s", "20B0h: speed below which voltage PWM drives; 0: never"),
    Field("pwm_gradient", "f8", "", "20B1h: 0...255; PWM amplitude by speed; 0: no voltage PWM"),
    Field("pwm_amplitude", "f8", "", "20B2h: 0...255; PWM amplitude at standstill"),
    Field("fullstep_threshold", "f8", "rad/s", "20B6h: speed above which the high speed modes act; 0: never"),
    Field("high_speed_chopper", "f8", "", "20B7h: 1: constant off time without fast decay above that speed"),
    Field("high_speed_fullstep", "f8", "", "20B8h: 1: full steps above that speed"),
    Field("load_filter", "f8", "", "209Dh: 1: a load reading is the mean of four full steps"),
    Field("stall_threshold", "f8", "", "209Eh: -64...63; shifts the load reading, higher is less sensitive"),
    Field("stall_speed", "f8", "rad/s", "20A4h: speed above which a load reading of 0 stops the motor; 0: never"),
    Field("position_sensor", "f8", "", "606Ah: 0 the encoder tells the position, -1 the step counter", -1.0),
    # --- data of the device ---------------------------------------------------------------------------------------
    Field("full_scale_current", "f8", "A", "largest amplitude of a phase, vsense 0", 1.0),
    Field("chopper_clock", "f8", "Hz", "of the driver", 16e6),
    Field("duty_limit", "f8", "1", "largest voltage of a phase as a share of the supply", 1.0),
    Field("overcurrent", "f8", "A", "phase current at which the stage is cut", 1e3),
    # --- the motor as it is ---------------------------------------------------------------------------------------
    Field("L_s", "f8", "H", "inductance of a phase", 1e-3),
    Field("n_p", "f8", "", "pole pairs: a quarter of the full steps", 50.0),
    Field("saturation", "f8", "1/A^2", "of the torque: psi = psi_m / sqrt(1 + saturation i^2)"),
    Field("detent_torque", "f8", "N*m", "amplitude, four periods in each electrical one"),
    Field("open_a", "f8", "", "1: the cable of phase A is broken"),
    Field("open_b", "f8", "", "1: the cable of phase B is broken"),
)

STATE = (
    *encoder.STATE,
    *dc_link.STATE,
    *warming.STATE,
    # --- steps ----------------------------------------------------------------------------------------------------
    Field("step_position", "f8", "rad", "what the steps have moved since power-on"),
    Field("step_rate", "f8", "rad/s", "speed of the steps in this period"),
    Field("steps_done", "f8", "", "210Bh: microsteps made so far, whatever their direction"),
    Field("steps_per_rad", "f8", "1/rad", "microsteps per rad of the drive's belief"),
    Field("table_length", "f8", "", "microsteps of an electrical period", 1024.0),
    Field("rad_per_entry", "f8", "rad", "electrical angle of a microstep"),
    Field("in_full_steps", "f8", "1", "1: the high speed mode makes full steps"),
    Field("sin_ref", "f8", "1", "the table's values at the present microstep"),
    Field("cos_ref", "f8", "1", "", 1.0),
    # --- current --------------------------------------------------------------------------------------------------
    Field("standstill_time", "f8", "s", "since the last step"),
    Field("velocity_before", "f8", "rad/s", "velocity demand of the period before"),
    Field("current_scale", "f8", "", "step of the current in use, 0...31, and what is left of the ramp to it"),
    Field("amplitude", "f8", "A", "of the phase currents' set-points", 1.0),
    Field("in_pwm", "f8", "1", "1: voltage PWM drives"),
    Field("pwm_scale", "f8", "", "2121h: amplitude of the PWM, 0...255"),
    Field("lowest_share", "f8", "1", "lowest mean voltage along a phase's set-point, as a share of the largest", -1.0),
    Field("current_shift", "f8", "A", "by how much the mean current lies off the comparator's"),
    Field("current_gain", "f8", "1", "by which factor the mean current differs from the set-point", 1.0),
    Field("ripple", "f8", "A", "of the phase currents, peak to peak"),
    Field("chopper_frequency", "f8", "Hz", ""),
    Field("in_spread_cycle", "f8", "1", "1: the chopper, if it works, makes spread cycles"),
    # --- load by StallGuard2 --------------------------------------------------------------------------------------
    Field("load_value", "f8", "", "2101h: 0...1023, lower with load"),
    Field("load_is_fresh", "f8", "1", "1: the reading was taken in this window"),
    Field("load_direction", "f8", "1", "sign of the speed at which the measurement under way began; 0: none is"),
    Field("load_start", "f8", "rad", "where the steps were when it began"),
    Field("load_windows", "f8", "", "windows that it has lasted"),
    Field("u_along", "f8", "V", "voltage along the field, summed over its ticks"),
    Field("u_across", "f8", "V", "voltage a quarter of a period ahead of the field, summed likewise"),
    Field("stalled", "f8", "1", "1: a stall has stopped the steps"),
    # --- power stage and winding ----------------------------------------------------------------------------------
    Field("psi", "f8", "V*s", "flux that acts at the present current"),
    Field("sin_e", "f8", "1", "sine of the rotor's electrical angle at the tick's start"),
    Field("cos_e", "f8", "1", "", 1.0),
    Field("u_a", "f8", "V", "mean voltage of phase A in the tick"),
    Field("u_b", "f8", "V", ""),
    Field("emf_a", "f8", "A", "current of phase A that the back-EMF makes in the tick"),
    Field("emf_b", "f8", "A", ""),
    Field("i_a", "f8", "A", ""),
    Field("i_b", "f8", "A", ""),
    Field("i_a_mean", "f8", "A", "over the tick"),
    Field("i_b_mean", "f8", "A", ""),
    Field("tau_detent", "f8", "N*m", "mean of the last tick"),
    Field("peak_a", "f8", "A", "largest current of phase A since protection looked last"),
    Field("peak_b", "f8", "A", "the same of phase B"),
    Field("open_load_time_a", "f8", "s", "time for which phase A carried no current although it should"),
    Field("open_load_time_b", "f8", "s", "the same of phase B"),
    # The exact step of a phase, refreshed once per window.
    Field("step_i", "f8", "1", "what a tick leaves of a current"),
    Field("step_u", "f8", "A/V", "current that a held voltage makes in a tick"),
    Field("step_u_inverse", "f8", "V/A", "its reciprocal"),
    Field("step_e", "f8", "A", "effect of the back-EMF: along the sine of the angle, along its cosine", depth=2),
    Field("mean_i", "f8", "1", "mean current over the tick, from the current at its start"),
    Field("mean_u", "f8", "A/V", "the same, from the held voltage"),
    Field("mean_e", "f8", "A", "the same, from the back-EMF", depth=2),
    Field("half_turn_sin", "f8", "1", "sine of half the electrical angle that the rotor turns in a tick"),
    Field("half_turn_cos", "f8", "1", "", 1.0),
    Field("turn_sinc", "f8", "1", "sin x / x of that half angle", 1.0),
    Field("turn_sixth", "f8", "rad", "a sixth of that half angle"),
    # --- what is told ---------------------------------------------------------------------------------------------
    Field("theta_encoder", "f8", "rad", "position by the encoder"),
    Field("omega_encoder", "f8", "rad/s", "2122h: speed by the encoder, filtered"),
    Field("position_actual", "f8", "rad", "6064h: by the sensor that 606Ah names"),
    Field("deviation", "f8", "rad", "by which that lies behind the steps, wherever home is"),
    Field("status_flags", "i4", "", "2102h: errors of the driver"),
)
