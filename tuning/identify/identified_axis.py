"""The results of an identification of one axis."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tuning.estimate import Estimate

if TYPE_CHECKING:
    from tuning.identify.wiring import Settings
    from tuning.response.plant_fit import PlantFit

Progress = Callable[[str, float], None]  # the present step, and the share that is done, 0...1

# In the order of identification and display.
NAMES = (
    "resistance", "inductance", "pole_pairs", "encoder_direction", "inertia", "coulomb", "viscous", "offset",
    "anti_resonance", "resonance", "loop_delay", "velocity_filter",
)  # fmt: skip

TITLES = {  # for users
    "resistance": "phase resistance",
    "inductance": "phase inductance",
    "pole_pairs": "pole pairs",
    "encoder_direction": "encoder direction",
    "inertia": "total inertia",
    "inertia_ratio": "load inertia over the rotor's",
    "coulomb": "Coulomb friction",
    "viscous": "viscous friction",
    "offset": "constant load (gravity)",
    "anti_resonance": "anti-resonance",
    "resonance": "resonance",
    "damping": "damping ratio",
    "loop_delay": "velocity loop delay",
    "velocity_filter": "velocity filter corner",
}


@dataclass(frozen=True)
class Identification:
    """The identification of one axis.

    Attributes:
        estimates: By the names of `NAMES`: "resistance" [ohm per phase], "inductance" [H per phase, q axis],
            "pole_pairs", "encoder_direction" (1 correct, -1 reversed), "inertia" (J/K_t times the data sheet's K_t,
            everything that turns, at the rotor [kg*m^2]), "coulomb" [A], "viscous" [A*s/rad], "offset" [A, gravity or a
            constant load], "anti_resonance", "resonance" [Hz], "loop_delay" [s], "velocity_filter" [Hz].
        drive_time: Time that passed on the drive [s].
        told: Identified values only, if `estimates` also has assumed values for a tuner; None if it has none.
        wiring: For each wiring object, the value that encoder and halls need, and the drive's. With wrong ones the
            motor runs away or locks.
        fit: The linear model fitted to the frequency response; None if none was measured, or it is that of another
            axis.
        pushed: This axis' row of the mass matrix of its machine at the rotors, as "inertia" [kg*m^2]; () if not
            measured.
    """

    estimates: Mapping[str, Estimate]
    drive_time: float
    told: Mapping[str, Estimate] | None = None
    wiring: Settings = field(default_factory=dict)
    fit: PlantFit | None = None
    pushed: tuple[float, ...] = ()

    @property
    def together(self) -> float:
        """Total inertia that the axis moves if all axes of its machine accelerate equally; nan if not measured."""
        return sum(self.pushed) if self.pushed else math.nan

    def value(self, name: str) -> float:
        """Return a value; nan if it was not identified."""
        return self.estimates[name].value
