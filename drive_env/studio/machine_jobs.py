"""The jobs of the page Machine on emulated machines: parameters, torque, supply, faults."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from drive_env.drives import motion
from drive_env.drives.interface import Drives, machine_of
from drive_env.studio.motion_jobs import only

if TYPE_CHECKING:
    from drive_env.emulator.machine import Machines


def set_parameters(values: Mapping[str, float]) -> Callable[[Drives], None]:
    """Return the job that gives the machine several parameters at once."""
    return lambda drives: machine_of(drives).set_all(values)


def act(quantity: str, value: float) -> Callable[[Drives], None]:
    """Return the job that sets "load_torque" [N*m, or N of a load that moves in a line] or "supply" [V]."""
    return lambda drives: setattr(machine_of(drives), quantity, value)


def begin_fault(name: str, duration: float | None, when: str, given: Mapping[str, Any]) -> Callable[[Drives], int]:
    """Return the job that lets something fail, and returns the fault's number."""
    numbers: Any = dict(given)
    return lambda drives: _machines(drives).fault(name, duration=duration, when=when, **numbers)


def end_fault(number: int | None) -> Callable[[Drives], None]:
    """Return the job that ends a fault, None all of them; one that is over already is no error."""
    return lambda drives: _end(drives, lambda fault: number in (None, fault.number))


def take_step(step: str, name: str, axis: int) -> Callable[[Drives], None]:
    """Return the job that takes a step of the way back from a fault (`STEPS`), of an axis where it is of one."""

    def job(drives: Drives) -> None:
        where = only(drives, axis)
        if step == "end":
            _end(drives, lambda fault: fault.order.name == name)
        elif step == "reset_fault":
            motion.reset_fault(drives, where=where)
        else:
            (drives.start_node if step == "start_node" else drives.reset_node)(where)

    return job


def _end(drives: Drives, which: Callable[[Any], bool]) -> None:
    for fault in filter(which, _machines(drives).faults()):
        _machines(drives).clear_fault(fault.number)


def _machines(drives: Drives) -> Machines:
    from drive_env.emulator.emulated_drives import emulated_of

    return emulated_of(drives).machine
