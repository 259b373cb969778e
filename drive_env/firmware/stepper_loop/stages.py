"""The firmware of stepper drives with a closed loop: stepper stages, with a separate field and corrections.

The steps are the ramp's position. If an encoder commutates or a PID corrects, the field has another position.
"""

from __future__ import annotations

from dataclasses import replace

from drive_env.firmware.cycle import compose
from drive_env.firmware.stepper import stages as stepper
from drive_env.firmware.stepper_loop import fields, initialise
from drive_env.firmware.stepper_loop.corrections import correct
from drive_env.firmware.stepper_loop.current_level import scale_by_load, tell_torque
from drive_env.firmware.stepper_loop.encoder import see_axis, seed_steps
from drive_env.firmware.stepper_loop.load_angle import limit_lead, move_field
from drive_env.firmware.stepper_loop.torque import ask_torque, tell_torque_mode
from mechanics.kernels.compiled import stage


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
    """Set the steps to a demand that was set from the encoder; not in a period without length."""
    if rates.period > 0.0:
        seed_steps(drive, rates.period)


# Right after the encoder is read, before other stages use the motion of a window.
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
    tick=(stepper.tick_with(move_field),),
    power_on=(*stepper.STAGES.power_on, initialise.power_on),
    halt=(*stepper.STAGES.halt, initialise.halt),
)

FIRMWARE = compose(STAGES, __name__)
