"""The jobs of the page Machine for emulated machines: parameters, torque, supply, faults."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from drive_env.drives.interface import Drives, machine_of
from drive_env.studio import motion_jobs

if TYPE_CHECKING:
    from drive_env.emulator.machine import Machines


def set_parameters(values: Mapping[str, float]) -> Callable[[Drives], None]:
    """Return the job that sets several parameters of the machine at once."""
    return lambda drives: machine_of(drives).set_all(values)


def act(quantity: str, value: float) -> Callable[[Drives], None]:
    """Return the job that sets "load_torque" [N*m, or N for a linear load] or "supply" [V]."""
    return lambda drives: setattr(machine_of(drives), quantity, value)


def begin_fault(name: str, duration: float | None, when: str, given: Mapping[str, Any]) -> Callable[[Drives], int]:
    """Return the job that begins a fault and returns its number."""
    numbers: Any = dict(given)
    return lambda drives: _machines(drives).fault(name, duration=duration, when=when, **numbers)


def end_faults(name: str | None) -> Callable[[Drives], None]:
    """Return the job that ends the faults with a name, None for all; faults that have already ended are no error."""

    def job(drives: Drives) -> None:
        machines = _machines(drives)
        for fault in machines.faults():
            if name in (None, fault.order.name):
                machines.clear_fault(fault.number)

    return job


def take_step(step: str, name: str, axis: int) -> Callable[[Drives], None]:
    """Return the job for a step that ends a fault's effects (`STEPS`), for one axis if the step needs one."""
    if step == "end":
        return end_faults(name)
    if step == "reset_fault":
        return motion_jobs.reset_fault(axis)
    if step == "start_node":
        return motion_jobs.start_node(axis)
    return lambda drives: drives.reset_node(motion_jobs.only(drives, axis))


def _machines(drives: Drives) -> Machines:
    from drive_env.emulator.emulated_drives import emulated_of

    return emulated_of(drives).machine
