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

Progress = Callable[[str, float], None]  # the present step, and the share done, 0...1

# In the order in which they are identified and shown.
NAMES = (
    "resistance", "inductance", "pole_pairs", "encoder_direction", "inertia", "coulomb", "viscous", "offset",
    "anti_resonance", "resonance", "loop_delay", "velocity_filter",
)  # fmt: skip

TITLES = {  # as people read them
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
        estimates: By name, those of `NAMES`: "resistance" [ohm per phase], "inductance" [H per phase, of the q axis],
            "pole_pairs", "encoder_direction" (1 as it should be, -1 reversed), "inertia" (J/K_t times the data sheet's
            K_t, all that turns, at the rotor [kg*m^2]), "coulomb" [A], "viscous" [A*s/rad], "offset" [A, gravity or a
            constant load], "anti_resonance", "resonance" [Hz], "loop_delay" [s], "velocity_filter" [Hz].
        drive_time: Time that passed on the drive [s].
        told: The identified values without guesses, where `estimates` have guesses for a tuner; None where they have
            none.
        wiring: The settings that encoder and halls need, by object, and those of the drive. With wrong ones the motor
            runs away or locks.
        fit: The linear model fitted to the frequency response, None where none was measured or it is another axis's.
        pushed: What the axis pushes for each axis of its machine that accelerates, its row of their mass matrix at the
            rotors, as "inertia" [kg*m^2]; () where it was not measured.
    """

    estimates: Mapping[str, Estimate]
    drive_time: float
    told: Mapping[str, Estimate] | None = None
    wiring: Settings = field(default_factory=dict)
    fit: PlantFit | None = None
    pushed: tuple[float, ...] = ()

    @property
    def together(self) -> float:
        """Total inertia that the axis pushes while all axes of its machine accelerate alike; nan if not measured."""
        return sum(self.pushed) if self.pushed else math.nan

    def value(self, name: str) -> float:
        """Return a value, nan where it was not identified."""
        return self.estimates[name].value
