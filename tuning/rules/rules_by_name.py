"""The rules by name: each computes raw integers of the drive's gains from an identified axis.

A rule only proposes gains; it writes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from drive_env.devices.gains import check_linear_model
from tuning.rules.cascade import cascade_rule
from tuning.rules.internal_model import imc_rule, simc_rule
from tuning.rules.margin_targets import TARGETS, margin_rule
from tuning.rules.optima import modulus_rule, symmetrical_rule
from tuning.rules.pole_placement import pole_rule
from tuning.rules.proposal import Proposal as Proposal
from tuning.rules.proposal import Rule as Rule
from tuning.rules.relay import relay_rule

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.loops.linear_model import Plant
    from drive_env.motors import Motor

RULES: Mapping[str, Rule] = {
    "modulus_optimum": modulus_rule,
    "symmetrical_optimum": symmetrical_rule,
    "imc": imc_rule,
    "simc": simc_rule,
    "pole_placement": pole_rule,
    "relay": relay_rule,
    **{name: margin_rule(*target) for name, target in TARGETS.items()},
    "cascade": cascade_rule,
}

MEANINGS: Mapping[str, str] = {
    "modulus_optimum": "Kessler 1955: cancel the large lag, damping 0.707",
    "symmetrical_optimum": "Kessler 1958: crossover in the middle, 36.9 degrees of phase margin",
    "imc": "internal model, closed loops clear of what the model leaves out",
    "simc": "Skogestad 2003: dead time counted, shorter integration for load disturbances",
    "pole_placement": "two well damped poles in each PI loop",
    "relay": "Astrom and Hagglund 1984: ultimate point, Tyreus and Luyben's gains",
    **{
        name: f"greatest integers with {phase:g} degrees and {gain:g} dB in every loop"
        for name, (phase, gain) in TARGETS.items()
    },
    "cascade": "loop by loop from inside; lags, anti-resonance or encoder counts limit the velocity loop",
}


def propose(name: str, device: Device, motor: Motor, plant: Plant) -> Proposal:
    """Compute the proposal of a rule.

    Raises:
        ValueError: For an unknown rule (the message lists the known ones), or a drive without a linear model of its
            loops.
    """
    check_linear_model(device)
    check_rule(name)
    return RULES[name](device, motor, plant)


def check_rule(name: str) -> None:
    """Raise ValueError for an unknown rule; the message lists the known ones."""
    if name not in RULES:
        raise ValueError(f"no rule is named {name!r}; there are {', '.join(RULES)}")
