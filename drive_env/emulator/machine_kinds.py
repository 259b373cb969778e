"""Kind of machine for each firmware."""

from __future__ import annotations

from drive_env.emulator.parameters import MachineKind
from drive_env.emulator.servo_machine import SERVO
from drive_env.emulator.servo_mains_machine import SERVO_MAINS
from drive_env.emulator.stepper_machine import STEPPER

# By the name of the firmware's folder.
MACHINE_KINDS: dict[str, MachineKind] = {
    "servo": SERVO,
    "servo_mains": SERVO_MAINS,
    "stepper": STEPPER,
    "stepper_loop": STEPPER,
}
