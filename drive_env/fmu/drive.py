"""The drive inside an FMU: emulated drives whose variables and time an importer controls."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import drive_env
from drive_env.devices import find_device
from drive_env.dictionary.access import check_in_range
from drive_env.drives.arguments import whole_cycles
from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.fmu.variables import (
    BOOLEAN,
    EMERGENCIES,
    INPUT,
    INTEGER,
    LARGE,
    MACHINE,
    OUTPUT,
    PARAMETER,
    SWITCHES,
    WRITTEN,
    FmuVariable,
    VariableRow,
    variables_of,
)  # fmt: skip
from drive_env.saved_state import Saved
from mechanics.arrays import Floats, Integers
from mechanics.load import Load, Switch
from mechanics.loads import BARE_SHAFT, find_load
from mechanics.reading.untrusted import read_json

SETTINGS = "drive.json"  # among an FMU's resources
NO_LOAD = "none"


def read_settings(resources: Path) -> dict[str, str | None]:
    """Return the drive of an FMU: device, load and motor, each a name or the path of a file among its resources.

    Raises:
        ValueError: For an FMU of another version of drive-env, whose variables may have other references.
    """
    settings = read_json(resources / SETTINGS)
    made_by = settings.pop("drive_env")
    if made_by != drive_env.__version__:
        raise ValueError(
            f"the FMU was made by drive-env {made_by} and this is drive-env {drive_env.__version__}; install that "
            "version, or export the FMU anew"
        )
    return {
        name: str(resources / given) if given is not None and (resources / given).exists() else given
        for name, given in settings.items()
    }


def with_switches(load: Load) -> Load:
    """Return a load whose every axis has limit and home switches; it never presses those that it lacked."""
    there = {(switch.kind, switch.axis) for switch in load.switches}
    others = (
        Switch(kind, axis, math.inf, -math.inf)
        for axis in range(load.num_axes)
        for kind in SWITCHES
        if (kind, axis) not in there
    )
    return replace(load, switches=(*load.switches, *others))


class FmuDrive(Saved):
    """A drive with its motor and its load, one of the table or a model, or `none`.

    Every axis of the device has a load; a load with more axes than the device needs several devices.

    Attributes:
        drives: The emulated drives.
        variables: The variables, in the order of their value references.
    """

    STATE = ("drives", "_given", "_applied", "_emergencies")

    def __init__(self, device: str, load: str, motor: str | None = None) -> None:
        known, is_bare = find_device(device), load == NO_LOAD
        row = with_switches(find_load(BARE_SHAFT if is_bare else load))
        machines = max(1, known.num_axes // row.num_axes)
        self.drives = EmulatedDrives(device, row, motor, num_machines=machines, num_threads=1)
        if known.num_axes <= self.drives.num_axes:
            self.drives.inside.connect_axes(0, known.num_axes)
        self.variables = variables_of(self.drives, is_bare=is_bare)
        self._emergencies = {name: np.zeros(self.drives.num_axes, np.int64) for name in EMERGENCIES}
        self._given = {one.name: self._present(one) for one in self.variables if one.row.causality != OUTPUT}
        self._applied = dict(self._given)

    def get(self, variable: FmuVariable) -> Any:
        """Return the set value of an input or a parameter, or the present value of an output."""
        return self._given[variable.name] if variable.name in self._given else self._present(variable)

    def set(self, variable: FmuVariable, value: float) -> None:
        """Set an input or a parameter; it is checked when it takes effect: in the next step, or at the start."""
        whole = variable.row.kind in (INTEGER, LARGE) and float(value).is_integer()
        self._given[variable.name] = int(value) if whole else bool(value) if variable.row.kind == BOOLEAN else value

    def begin(self) -> None:
        """Write the parameters that were set, in the dictionary's order.

        Raises:
            ObjectAccessError: For an object that refuses its value.
            ValueError: For a number that is impossible for the load.
        """
        for one in self._changed(PARAMETER):
            value, where = self._given[one.name], np.isin(np.arange(self.drives.num_axes), one.axes)
            if isinstance(one.row.source, str):
                self.drives.machine.set(one.row.source, value, where[:: self.drives.load.num_axes])
            else:
                self.drives.write(one.row.source, value, where)
            self._applied[one.name] = value

    def step(self, size: float) -> None:
        """Apply the inputs and let whole communication cycles pass [s]; a refused step changes nothing.

        Inputs are a master's process data: they arrive once, at the beginning of the step.

        Raises:
            ValueError: For another step size, or an input that is impossible for the machine.
            ObjectAccessError: For an input that the drive's object refuses.
        """
        drives, cycle = self.drives, self.drives.device.cycle
        if not size > 0.999 * cycle:
            raise ValueError(
                f"a step of {size:g} s is shorter than a communication cycle; use {cycle:g} s or a multiple"
            )
        cycles = whole_cycles(size, cycle)
        drives.record((), cycle, play=self._process_data())
        if cycles > 1:
            drives.advance((cycles - 1) * cycle)
        for message in drives.emergencies():
            self._emergencies["code"][message.axis] = message.code
            self._emergencies["count"][message.axis] += 1

    # --- inside ---------------------------------------------------------------------------------------------------
    def _present(self, one: FmuVariable) -> Any:
        row, machine, axis = one.row, self.drives.machine, one.axes[0]
        number = axis // self.drives.load.num_axes
        if not isinstance(row.source, str):
            return int(self.drives.read(row.source)[axis])
        if row.source in SWITCHES:
            return False
        if row.source in EMERGENCIES:
            return int(self._emergencies[row.source][axis])
        if row.causality == PARAMETER:
            return float(machine.parameters[row.source][number])
        value = getattr(machine, row.source)[number if row.of == MACHINE else axis]
        return bool(value) if row.kind == BOOLEAN else float(value)

    def _changed(self, causality: str) -> list[FmuVariable]:
        return [
            one
            for one in self.variables
            if one.row.causality == causality and self._given[one.name] != self._applied[one.name]
        ]

    def _process_data(self) -> dict[Any, Integers]:
        """Apply the inputs that are not set-points, and return the set-points: object -> a row of integers.

        No input is applied if one of them is refused.
        """
        known = self.drives.inside.objects.entries
        rows = {one.row.name: one.row for one in self.variables if one.row.causality == INPUT}
        values, before = self._inputs(self._given), self._inputs(self._applied)
        played = {
            name: np.asarray(values[name], np.int64) for name, row in rows.items() if not isinstance(row.source, str)
        }
        for name, integers in played.items():
            check_in_range(known.find(rows[name].source), integers)
        changed = [row for name, row in rows.items() if np.any(values[name] != before[name])]
        with ExitStack() as undoing:
            # Objects last: a mode that is written and taken back leaves traces in the drive.
            for row in sorted(changed, key=lambda row: row.name in WRITTEN):
                self._apply(row, values[row.name], before[row.name])
                undoing.callback(self._apply, row, before[row.name], values[row.name])
            undoing.pop_all()
        self._applied |= {one.name: self._given[one.name] for one in self._changed(INPUT)}
        return {rows[name].source: integers[None] for name, integers in played.items() if name not in WRITTEN}

    def _inputs(self, values: Mapping[str, Any]) -> dict[str, Floats]:
        """Return the inputs among values by variable, as those by row, shape (num_axes,)."""
        found = dict[str, Floats]()
        for one in self.variables:
            if one.row.causality == INPUT:
                found.setdefault(one.row.name, np.zeros(self.drives.num_axes))[list(one.axes)] = values[one.name]
        return found

    def _apply(self, row: VariableRow, values: Floats, before: Floats) -> None:
        """Apply an input, shape (num_axes,); one that is a set-point is only played."""
        machine = self.drives.machine
        if row.name in WRITTEN:
            self.drives.write(row.source, values.astype(np.int64), values != before)
        elif row.source in SWITCHES:
            machine.press(row.source, values > 0.0)
        elif row.source == "load_torque":
            machine.load_torque = values[:: self.drives.load.num_axes]
        elif isinstance(row.source, str):
            setattr(machine, row.source, values)
