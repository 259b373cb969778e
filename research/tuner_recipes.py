"""Recipes of trained tuners, one for each device: which gains, how far from the rule's, and on which machines."""

from __future__ import annotations

from typing import NamedTuple

from drive_env.devices import find_device
from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.loops.dynamics import DEFAULT, known_dynamics
from drive_env.randomisation.random_machines import Distributions, laws_of
from mechanics.loads import find_load

FORCES = ("kg", "N")  # what the units of masses and inertias, of forces and of all that is counted by them begin with


class TrainingMachines(NamedTuple):
    """Machines: load and motor, drawn from the load's shipped distributions.

    times: Of the load's inertia, stiffness, damping and friction, for a motor that is larger than the load's own; the
        frequencies stay.
    """

    load: str
    motor: str
    times: float = 1.0

    @property
    def name(self) -> str:
        """As a card has it."""
        size = "" if self.times == 1.0 else f" x {self.times:g}"
        return f"{self.load}{size} on {self.motor}"


class Recipe(NamedTuple):
    """How a device's tuner is trained; ln of gains over the rule's, one number for each gain.

    Attributes:
        device: Its name.
        gains: What is tuned.
        low, high: Of what is tried.
        reach: By which the network's inputs are divided.
        about, together, spread: Of random gains, where optima lie: the middle; what they have in common, and apart
            from that, as standard deviations.
        rows: The machines.
        dynamics: Names of those that a set's are drawn between and that figures are measured with; of loops without a
            linear model nothing depends on them.
        rule: Whose gains a trial begins with, for people.
        limits: For the card.
    """

    device: str
    gains: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    reach: tuple[float, ...]
    about: tuple[float, ...]
    together: tuple[float, ...]
    spread: tuple[float, ...]
    rows: tuple[TrainingMachines, ...]
    dynamics: tuple[str, ...]
    rule: str
    limits: tuple[str, ...]


# Of the TMCM-1636's range: the constrained oracles of the public suite (tuning/compare/oracles.csv) lie in -2.3...1.1,
# -3.7...1.6 and -2.5...1.3, nine tenths of them in -1.6...1.0, -1.3...1.3 and -2.2...1.2. Velocity P and position P
# go together.
_TMCM1636 = Recipe(
    device="tmcm1636",
    gains=("velocity_p", "velocity_i", "position_p"),
    low=(-2.6, -2.6, -3.0),
    high=(1.4, 1.7, 1.7),
    reach=(0.8, 1.0, 1.0),
    about=(0.0, 0.2, 0.0),
    together=(0.9, 0.3, 1.2),
    spread=(0.3, 0.7, 0.3),
    rows=(
        TrainingMachines("two_mass", "qbl4208"),
        TrainingMachines("belt", "qbl4208"),
        TrainingMachines("inertia", "ec_i_40"),
        TrainingMachines("ball_screw", "teknic_m2310p"),
        TrainingMachines("three_mass", "qbl4208"),
        TrainingMachines("geared_joint", "ec_45_flat"),
        TrainingMachines("vertical_screw", "re_40"),
        TrainingMachines("fan", "re_35"),
    ),
    dynamics=tuple(known_dynamics()),
    rule="the baseline rule",
    limits=(
        "velocity P and I and position P only",
        "too cautious on rigid axes: its answers cost more there than the baseline rule's",
        "drive-tune auto, which designs gains on models of the machine, is better, and so are searches by as many "
        "trials with the same constraints (--by cmaes, gp, tpe): this agent shows what learning reaches",
    ),
)

_NOT_COMPARED = "trained for a comparison: drive-tune auto tunes this drive"

# The loops are those of the TMCM-1636, and so is the rule; of an integration time ln counts what its inverse does.
# Loads are made for motors of 0.1 N m; these have 2.0 and 2.8 N m, and 17 times the rotor.
_TGZ = _TMCM1636._replace(
    device="tgz_d",
    rows=(
        TrainingMachines("two_mass", "am3041_e", 16.0),
        TrainingMachines("belt", "am3041_e", 16.0),
        TrainingMachines("inertia", "am3033_e", 16.0),
        TrainingMachines("ball_screw", "am3041_e", 16.0),
        TrainingMachines("three_mass", "am3041_e", 16.0),
        TrainingMachines("geared_joint", "am3033_e", 16.0),
        TrainingMachines("vertical_screw", "am3041_e", 8.0),
        TrainingMachines("fan", "am3033_e", 16.0),
    ),
    limits=("velocity P and I and position P only", _NOT_COMPARED),
)

# The values of table 3 of its manual are where trials begin. Of 12 random sets in -2.5...2.5 on 16 machines of each row
# the best lie, medians of the rows, in 0.0...0.5, 0.3...1.7, 0.1...0.3 and 1.1...1.4; what limits the corrections lower
# than commissioned is seldom good. The loads are made for motors of its size.
_TMCM3313 = Recipe(
    device="tmcm3313",
    gains=(
        "correction_position_p", "correction_velocity_p", "correction_velocity_i", "correction_velocity_limit",
    ),
    low=(-2.0, -2.0, -2.5, -1.5),
    high=(2.5, 2.5, 2.5, 2.5),
    reach=(1.0, 1.0, 1.0, 1.0),
    about=(0.3, 1.0, 0.2, 1.2),
    together=(0.0, 0.0, 0.0, 0.0),
    spread=(0.8, 0.8, 1.0, 0.7),
    rows=(
        TrainingMachines("inertia", "qsh4218_51"),
        TrainingMachines("two_mass", "qsh4218_51"),
        TrainingMachines("belt", "qsh5718_76", 4.0),
        TrainingMachines("fan", "qsh4218_47"),
        TrainingMachines("ball_screw", "qsh6018_86", 8.0),
    ),
    dynamics=(DEFAULT,),
    rule="the values it is commissioned with",
    limits=("the corrections of load angle control only", "drive-tune auto --by agent does not take it", _NOT_COMPARED),
)  # fmt: skip

RECIPES = {recipe.device: recipe for recipe in (_TMCM1636, _TGZ, _TGZ._replace(device="tgz_s"), _TMCM3313)}


def laws(recipe: Recipe, row: TrainingMachines) -> Distributions | None:
    """Return how machines of a row are distributed; None is as the load's shipped set has it."""
    if row.times == 1.0:
        return None
    with EmulatedDrives(recipe.device, row.load, row.motor, 1, num_threads=1) as drives:
        shipped = laws_of(row.load, find_device(recipe.device), drives.machine.parameters)
    found = dict(shipped.laws)
    for parameter in find_load(row.load).parameters:
        law = found.get(name := f"load.{parameter.name}")
        if law is not None and law.relative and parameter.unit.startswith(FORCES):
            found[name] = law._replace(low=law.low * row.times, high=law.high * row.times)
    return Distributions(found, shipped.curriculum, shipped.faults)
