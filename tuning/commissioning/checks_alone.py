"""Two experiments of an identification, each alone: the wiring of encoder and halls, and the winding."""

from __future__ import annotations

import numpy as np

from mechanics.arrays import Mask
from tuning.identify.experiments import Experiments
from tuning.identify.identified_axis import Identification, Progress
from tuning.identify.working_state import Working
from tuning.target import Target


class WiringCheck(Experiments):
    """The field is turned slowly, and encoder and halls must follow it; no torque is commanded.

    Attributes:
        good: Of which axes torque may be commanded, (num_axes,).
    """

    thorough = False

    def check(self, working: Working) -> Mask:
        """Check the encoders."""
        self.good = super().check(working)
        return self.good

    def turn(self, working: Working) -> None:
        """Do nothing: this is all."""


class WindingCheck(Experiments):
    """The same, and then current pulses for resistance and inductance."""

    thorough = False

    def turn(self, working: Working) -> None:
        """Identify the windings."""
        self.pulse_currents(working)


def check_wiring(target: Target, progress: Progress) -> tuple[list[Identification], Mask]:
    """Check wirings; return the identification of each axis, and the axes of which torque may be commanded."""
    check = WiringCheck(target, np.ones(target.num_axes, bool), progress)
    return check.run(), check.good


def identify_windings(target: Target, progress: Progress) -> list[Identification]:
    """Identify resistance and inductance of each axis."""
    return WindingCheck(target, np.ones(target.num_axes, bool), progress).run()
