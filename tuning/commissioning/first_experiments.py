"""The first experiments of an identification alone: the wiring check, and optionally the current pulses."""

from __future__ import annotations

import numpy as np

from mechanics.arrays import Mask
from tuning.identify.experiments import Experiments
from tuning.identify.identified_axis import Progress
from tuning.identify.working_state import Working
from tuning.target import Target


class FirstExperiments(Experiments):
    """The first experiments, with all axes.

    Args:
        target, progress: As in `identify`.
        pulses: Also identify resistance and inductance; otherwise no torque is commanded.

    Attributes:
        good: Axes whose wiring is correct, so that torque may be commanded, shape (num_axes,).
    """

    thorough = False

    def __init__(self, target: Target, progress: Progress, *, pulses: bool) -> None:
        self.modes = ("csp", "csv", "cst") if pulses else ("csv",)
        super().__init__(target, np.ones(target.num_axes, bool), progress)
        self.good: Mask = np.zeros(target.num_axes, bool)
        self._pulses = pulses

    def check(self, working: Working) -> Mask:
        """Check the encoders; return which axes' are good."""
        self.good = super().check(working)
        return self.good

    def turn(self, working: Working) -> None:
        """Identify the windings if pulses are wanted."""
        if self._pulses:
            self.pulse_currents(working)
