"""The same few cycles repeated: set-points out, samples in, with an agent's compiled code running beside them.

The outer controller of each machine is computed in the thread that runs the machine, so that it also gains from
threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drive_env.dictionary.entries import ObjectName
from drive_env.drives.interface import Drives
from drive_env.emulator.group import call_of
from drive_env.emulator.prepared_record import PreparedRecord, from_od_rows, to_od_rows
from mechanics.arrays import Integers
from mechanics.kernels.bundle import Bundle, Cube, Matrix, NumberCube, Numbers, reader
from mechanics.kernels.calls import address_of_hook, call_hook
from mechanics.kernels.compiled import cached

if TYPE_CHECKING:
    from drive_env.emulator.emulated_drives import EmulatedDrives


class Hooks(NamedTuple):
    """Compiled code that runs before and after the cycles, for the axes `first` up to `first + count` at a time.

    Both are `cached` functions of (address of the bundle, first, count) that return an integer; several threads may
    call them at once, each for the axes of different machines.
    """

    before: Any
    after: Any
    bundle: Bundle


class CyclicControl:
    """A repeated call of `record` on any Drives, with reused arrays.

    Attributes:
        play: The played objects.
        played: Integers to play, shape (objects, cycles, num_axes); filled in by the caller, or by `before`.
        sampled: Sampled integers of each cycle, shape (objects, cycles, num_axes).
    """

    def __init__(
        self, drives: Drives, objects: Sequence[ObjectName], play: Sequence[ObjectName], cycles: int, period: float
    ) -> None:
        self.hooks: Hooks | None = None
        self.played: Integers = np.zeros((len(play), cycles, drives.num_axes), np.int64)
        self.sampled: Integers = np.zeros((len(objects), cycles, drives.num_axes), np.int64)
        self._drives, self._objects, self.play = drives, tuple(objects), tuple(play)
        self._duration = cycles * period

    def run(self) -> None:
        """Let the cycles pass.

        Raises:
            ObjectAccessError: For an object that cannot be recorded or played, or a value out of range.
        """
        drives, hooks = self._drives, self.hooks
        if hooks is not None:
            hooks.before(hooks.bundle.address, 0, drives.num_axes)
        trace = drives.record(self._objects, self._duration, play=dict(zip(self.play, self.played, strict=True)))
        for rows, name in zip(self.sampled, self._objects, strict=True):
            rows[:] = trace[name]
        if hooks is not None:
            hooks.after(hooks.bundle.address, 0, drives.num_axes)


@dataclass(eq=False)
class Conversion(Bundle):
    """Integers that are played and sampled, their factors [SI per drive unit], and the hooks."""

    played: NumberCube  # (objects, cycles, axes)
    factors: Matrix  # (objects, axes)
    codes: Matrix  # rows of codec.compiled_rows
    values: Cube  # SI, (cycles, objects, axes)
    sampled: NumberCube
    sample_factors: Matrix
    sample_codes: Matrix
    samples: Cube  # SI
    refused: Numbers  # (1,) not 0: an integer was out of range, and its group was not run
    before: int = 0
    after: int = 0
    data: int = 0


conversion_at = reader(Conversion)


@cached(allocates=False)
def convert_in(address: Any, first: Any, count: Any) -> Any:
    """Run the hook before, and convert the integers to play into SI; return 0 if one is out of range."""
    own = conversion_at(address)
    if own.before != 0:
        call_hook(own.before, own.data, first, count)
    played, factors, codes, values = own.played, own.factors, own.codes, own.values
    for k in range(played.shape[0]):
        if not from_od_rows(played[k], factors[k], codes[k], values, k, first, first + count):
            own.refused[0] = 1
            return 0
    return 1


@cached(allocates=False)
def convert_out(address: Any, first: Any, count: Any) -> Any:
    """Convert samples to drive units, and run the hook after."""
    own = conversion_at(address)
    to_od_rows(own.samples, own.sample_factors, own.sample_codes, own.sampled, first, first + count)
    if own.after != 0:
        call_hook(own.after, own.data, first, count)
    return 1


class EmulatedCyclicControl(CyclicControl):
    """The same on emulated drives, without the interpreter once it has started."""

    def __init__(
        self, drives: EmulatedDrives, objects: Sequence[ObjectName], play: Sequence[ObjectName], cycles: int
    ) -> None:
        super().__init__(drives, objects, play, cycles, drives.device.cycle)
        self._emulated = drives
        self._cycles = cycles
        self._scale_changes = -1

    def run(self) -> None:
        """Let the cycles pass; a group with integers out of range does not run."""
        if self._scale_changes != self._emulated.inside.objects.scale_changes:
            self._prepare()
        if self._prepared is None:
            super().run()
            return
        self._refused[0] = 0
        self._emulated._run(self._cycles, self._call)
        if self._refused[0]:
            self._emulated.inside.objects.plan_play(dict(zip(self.play, self.played, strict=True)), self._cycles)

    def _prepare(self) -> None:
        drives, hooks = self._emulated, self.hooks
        # An object that can never be recorded or played is refused here.
        for name in self._objects:
            drives.inside.objects.recordable(drives.inside.objects.entries.find(name))
        drives.inside.objects.plan_play(dict(zip(self.play, self.played, strict=True)), self._cycles)
        self._scale_changes = drives.inside.objects.scale_changes
        self._prepared: PreparedRecord | None = drives.inside.objects.prepared_record(self._objects, self.play)
        if self._prepared is None:
            return
        prepared, axes = self._prepared, drives.num_axes
        values = np.zeros((self._cycles, len(self.play), axes))
        samples = np.zeros((self._cycles, len(self._objects), axes))
        self._refused = np.zeros(1, np.int64)
        rows = prepared.inputs
        self._conversion = Conversion(
            played=self.played,
            factors=np.array([row.factor for row in rows], float).reshape(len(rows), axes),
            codes=prepared.input_codes,
            values=values,
            sampled=self.sampled,
            sample_factors=prepared.factors,
            sample_codes=prepared.codes,
            samples=samples,
            refused=self._refused,
            before=0 if hooks is None else address_of_hook(hooks.before),
            after=0 if hooks is None else address_of_hook(hooks.after),
            data=0 if hooks is None else hooks.bundle.address,
        )
        self._call = call_of(values, prepared.played, samples, prepared.sampled, 1)
        self._call.replace(
            before=address_of_hook(convert_in), after=address_of_hook(convert_out), data=self._conversion.address
        )


def cyclic_control(
    drives: Drives, objects: Sequence[ObjectName], play: Sequence[ObjectName], cycles: int, period: float
) -> CyclicControl:
    """Return the control of some cycles of `period` [s], in the fastest way for these drives."""
    from drive_env.emulator.emulated_drives import EmulatedDrives

    if isinstance(drives, EmulatedDrives):
        return EmulatedCyclicControl(drives, objects, play, cycles)
    return CyclicControl(drives, objects, play, cycles, period)
