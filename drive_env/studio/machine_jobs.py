"""What the page Machine asks of emulated machines, each a job: parameters, torque, supply, faults."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from drive_env.drives.interface import Drives, machine_of


def set_parameter(name: str, value: float) -> Callable[[Drives], None]:
    """Return the job that gives the machine a true parameter [SI]."""
    return lambda drives: machine_of(drives).set(name, value)


def set_parameters(values: Mapping[str, float]) -> Callable[[Drives], None]:
    """Return the job that gives the machine several parameters at once."""
    return lambda drives: machine_of(drives).set_all(values)


def set_load_torque(value: float) -> Callable[[Drives], None]:
    """Return the job that lets a torque act on the load [N*m, or N where it moves in a line]."""

    def job(drives: Drives) -> None:
        machine_of(drives).load_torque = value

    return job


def set_supply(value: float) -> Callable[[Drives], None]:
    """Return the job that sets the open-circuit voltage of the supply [V]."""

    def job(drives: Drives) -> None:
        machine_of(drives).supply = value

    return job


def begin_fault(name: str, duration: float | None, when: str, given: Mapping[str, Any]) -> Callable[[Drives], int]:
    """Return the job that lets something fail, and returns the fault's number."""

    def job(drives: Drives) -> int:
        from drive_env.emulator.emulated_drives import emulated_of

        numbers: Any = dict(given)
        return emulated_of(drives).machine.fault(name, duration=duration, when=when, **numbers)

    return job


def end_fault(number: int | None) -> Callable[[Drives], None]:
    """Return the job that ends a fault, None all of them; one that is over already is no error."""

    def job(drives: Drives) -> None:
        from drive_env.emulator.emulated_drives import emulated_of

        machine = emulated_of(drives).machine
        if number is None or any(fault.number == number for fault in machine.faults()):
            machine.clear_fault(number)

    return job
