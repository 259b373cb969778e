"""The data that all steps of a commissioning share: the drives, the user's plan, and how far the rotors have turned."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.loops.dynamics import DEFAULT
from drive_env.trials.positioning import wrapped
from mechanics.arrays import Floats, Integers
from tuning.identify.wiring import write_wiring
from tuning.target import hold_to_travel

if TYPE_CHECKING:
    from drive_env.cia402 import Key
    from drive_env.loops.dynamics import Dynamics
    from tuning.auto.stages import Result
    from tuning.stepper.result import StepperResult
    from tuning.target import Target


WHOLE = 2**32 - 1  # span of 607Dh in a drive without position limits


@dataclass
class CommissioningPlan:
    """What the user asks of a commissioning.

    Attributes:
        dynamics: Requirements on the outer loops.
        method: Homing method; None keeps the one in 6098h.
        limits: Values as text by the name of the limit, e.g. "3 A".
        store: Whether drives on a bus store all parameters over a power cycle.
        seed: Seed of the emulated machine, for the certificate.
    """

    dynamics: str | Dynamics = DEFAULT
    method: int | None = None
    limits: Mapping[str, str] = field(default_factory=dict)
    store: bool = True
    seed: int = 0


class CommissioningBench:
    """The drives of one commissioning.

    Args:
        target: The drives; its travel counts from the present angles of the rotors.
        plan: The user's plan; it may change between steps.
        folder: Folder for the files.

    Attributes:
        result: Result of the tuning; None before it.
        is_kept: Whether the parameters stay for good: they are no longer rolled back.
        is_stored: Whether the drives store them over a power cycle.
    """

    def __init__(self, target: Target, plan: CommissioningPlan, folder: Path) -> None:
        self.target, self.plan, self.folder = target, plan, folder
        self.result: Result | StepperResult | None = None
        self.is_kept = self.is_stored = False
        self._origin = target.drives.read(cia402.POSITION_ACTUAL)
        self._at_begin: Floats = np.zeros(target.num_axes)

    def here(self) -> Target:
        """Return the target with the travel that remains from here, also within the drive's position limits."""
        target, gone, here = self.target, self._gone(), self._position()
        low, high = target.low - gone, target.high - gone
        if target.device.new_dictionary().has((cia402.POSITION_LIMITS, 1)):
            own = [target.drives.read((cia402.POSITION_LIMITS, sub)) for sub in (1, 2)]
            is_limited = (own[0] < own[1]) & (own[1] - own[0] < WHOLE)
            least, most = (((one - here) / target.increments()) for one in own)
            low = np.where(is_limited, np.maximum(low, least), low)
            high = np.where(is_limited, np.minimum(high, most), high)
        low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
        return replace(target, low=low, high=np.where(low < high, high, 1e-3))  # without travel left: a tiny one

    def note_way(self, way: Floats) -> None:
        """Account for a way [rad] of the rotors in the step, shape (num_axes,), and a new zero of positions."""
        self._origin = self._position() - self._counts(self._at_begin + way)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Limit the envelope to the remaining travel of the axes while a block runs."""
        envelope = self.target.drives.safety
        self._at_begin = self._gone()
        if envelope is None:
            yield
            return
        limits = envelope.limits
        hold_to_travel(self.here())
        try:
            yield
        finally:
            envelope.change(limits)

    @contextmanager
    def counting_anew(self) -> Iterator[None]:
        """Let a block write objects that reverse or scale the positions of axes that are switched off.

        An envelope with position limits would refuse these writes, so it has none during the block.
        """
        drives, gone, scale = self.target.drives, self._gone(), self.target.increments()
        envelope = drives.safety
        limits = None if envelope is None else envelope.limits
        if envelope is not None and limits is not None:
            envelope.change(replace(limits, position=None))
        try:
            yield
        finally:
            scaled = self.target.increments() != scale
            self._origin = np.where(scaled, self._position() - self._counts(gone), self._origin)
            if envelope is not None and limits is not None:
                envelope.change(limits) if limits.position is None else hold_to_travel(self.here())

    def wire(self, values: Sequence[Mapping[Key, int]]) -> None:
        """Write the wiring settings of every axis, and convert travel and origin to the positions that they give."""
        self.target, self._origin = write_wiring(self.target, self._origin, values)

    def _gone(self) -> Floats:
        return np.asarray(wrapped(self._position() - self._origin) / self.target.increments())

    def _position(self) -> Integers:
        return self.target.drives.read(cia402.POSITION_ACTUAL)

    def _counts(self, angle: Floats) -> Integers:
        return np.asarray(np.rint(angle * self.target.increments()), np.int64)
