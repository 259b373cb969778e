"""The firmware of stepper drives with a closed loop: those of stepper drives, with a field of its own and corrections.

The steps are the ramp's position. Where an encoder commutates, or a PID corrects, the field is somewhere else.
"""

from __future__ import annotations

from dataclasses import replace

from drive_env.firmware.cycle import compose
from drive_env.firmware.stepper import stages as stepper
from drive_env.firmware.stepper.stall_guard import collect_voltage
from drive_env.firmware.stepper.winding import chop, move_rotor, power_stage
from drive_env.firmware.stepper_loop import fields, initialise
from drive_env.firmware.stepper_loop.corrections import correct
from drive_env.firmware.stepper_loop.current_level import scale_by_load, tell_torque
from drive_env.firmware.stepper_loop.encoder import see_axis, seed_steps
from drive_env.firmware.stepper_loop.load_angle import limit_lead, move_field
from drive_env.firmware.stepper_loop.torque import ask_torque, tell_torque_mode
from mechanics.compiled import stage


@stage
def run_tick(drive, rates, k):
    """Run the current loop once: the field, chopper, winding, torque for the load's next steps."""
    move_field(drive, rates.tick)
    chop(drive)
    power_stage(drive)
    collect_voltage(drive)
    move_rotor(drive, rates.tick, (k + 0.5) / rates.ticks + 0.5)
    stepper.collect_torque(drive, 0, rates.weights[0, k], rates.moments[0, k])
    for s in range(1, rates.substeps):
        stepper.collect_torque(drive, s, rates.weights[s, k], rates.moments[s, k])


@stage
def regulate(drive, rates):
    """Close the loop once per window: the axis by its encoder, load angle, corrections, current."""
    see_axis(drive)
    limit_lead(drive)
    correct(drive, rates.window)
    scale_by_load(drive, rates.window)
    tell_torque(drive)


@stage
def take_over(drive, rates):
    """Let the steps be where a demand was taken from the encoder; a period without length has taken none."""
    if rates.period > 0.0:
        seed_steps(drive, rates.period)


# Right after the encoder is read, whatever else looks at the motion in a window.
_READ = stepper.STAGES.window.index(stepper.read_motion) + 1

STAGES = replace(
    stepper.STAGES,
    name="stepper_loop",
    parameters=fields.PARAMETERS,
    state=fields.STATE,
    switch=(*stepper.STAGES.switch, initialise.choose_loop),
    tell=(*stepper.STAGES.tell, ask_torque, tell_torque_mode),
    end_period=(take_over, *stepper.STAGES.end_period),
    window=(*stepper.STAGES.window[:_READ], regulate, *stepper.STAGES.window[_READ:]),
    tick=(run_tick,),
    power_on=(*stepper.STAGES.power_on, initialise.power_on),
    halt=(*stepper.STAGES.halt, initialise.halt),
)

FIRMWARE = compose(STAGES, __name__)
