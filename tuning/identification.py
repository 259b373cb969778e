"""What a drive's own signals say of its motor and machine, each value with a 95 % interval, or with the reason why not.

`identify` runs the experiments in the order in which each needs what came before, for all axes side by side, and
leaves every drive as it was found: off, with its own parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from tuning.target import Target
    from tuning.wiring import Settings

Mask = NDArray[np.bool_]
Progress = Callable[[str, float], None]  # what is under way, and how much of it all is done, 0...1

# In the order in which they are found; what a report shows.
NAMES = (
    "resistance", "inductance", "pole_pairs", "encoder_direction", "inertia", "coulomb", "viscous", "offset",
    "anti_resonance", "resonance", "loop_delay", "velocity_filter",
)  # fmt: skip


class Estimate(NamedTuple):
    """A value with its 95 % confidence interval; one that was refused is nan and says why in `reason`."""

    value: float
    low: float
    high: float
    unit: str
    reason: str = ""

    @property
    def is_known(self) -> bool:
        """Whether there is a value."""
        return math.isfinite(self.value)


def refused(unit: str, reason: str) -> Estimate:
    """Return the estimate of what could not be identified."""
    return Estimate(math.nan, math.nan, math.nan, unit, reason)


@dataclass(frozen=True)
class Identification:
    """What was identified of one axis.

    Attributes:
        estimates: By name, those of `NAMES`: "resistance" [ohm per phase], "inductance" [H per phase, of the q axis],
            "pole_pairs", "encoder_direction" (1 as it should be, -1 reversed), "inertia" (J/K_t times the data sheet's
            K_t, all that turns, at the rotor [kg*m^2]), "coulomb" [A], "viscous" [A*s/rad], "offset" [A, gravity or a
            constant load], "anti_resonance", "resonance" [Hz], "loop_delay" [s], "velocity_filter" [Hz].
        drive_time: Time that passed on the drive [s].
        told: What is identified, by the same names, where `estimates` have guesses that only a tuner should work with;
            None where they have none.
        wiring: What is known of the cable: the settings that encoder and halls need, by object, and what the drive has.
            With others than it needs, its motor runs away or is locked.
    """

    estimates: Mapping[str, Estimate]
    drive_time: float
    told: Mapping[str, Estimate] | None = None
    wiring: Settings = field(default_factory=dict)

    def value(self, name: str) -> float:
        """Return a value, nan where it was refused."""
        return self.estimates[name].value


def identify(target: Target, where: Mask | None = None, *, progress: Progress | None = None) -> list[Identification]:
    """Identify axes, and leave the drives off and with the parameters that they had, also after an error.

    Args:
        target: The axes, with what is known of them. They must be off, and at rest.
        where: Which of them; all by default. The others' estimates are refused.
        progress: Told what is under way and the share done.

    Returns:
        One per axis; what could not be identified is refused with its reason.

    Raises:
        RuntimeError: If an axis is enabled, or does not come up; ValueError if no axis is chosen.
    """
    from tuning.experiments import Experiments

    axes = np.ones(target.num_axes, bool) if where is None else np.asarray(where, bool)
    if axes.shape != (target.num_axes,) or not axes.any():
        raise ValueError(f"where must choose at least one of {target.num_axes} axes, not shape {axes.shape}")
    return Experiments(target, axes, progress or (lambda what, share: None)).run()
