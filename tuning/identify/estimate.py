"""What is said of an axis that was identified: each value with its 95 % interval, or with why there is none."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from tuning.identify.wiring import Settings

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
