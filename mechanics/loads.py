"""The driven loads, as rows: which MJCF, which joints the drives turn, which numbers can be set and drawn."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

MODELS = Path(__file__).parent / "models"

# A motion or torque as a combination of joints: joint name -> coefficient. In a chain of joints the absolute angle of
# a body is the sum of the joints before it.
Combination = Mapping[str, float]


class Parameter(NamedTuple):
    """A number of the load that may be set per machine.

    `field` is where it lives: "body_inertia", "jnt_stiffness" or "dof_damping" of the named element of the MJCF, which
    then holds the default, or a column of the load's friction. Low and high are the range of randomisation, as
    multiples of the default.
    """

    name: str
    unit: str
    field: str
    element: str
    low: float
    high: float
    meaning: str


class Friction(NamedTuple):
    """Dry and viscous friction on one motion of the load; see friction.py for the law.

    coulomb, breakaway [N*m or N], stribeck [rad/s or m/s], viscous [N*m*s/rad or N*s/m].
    """

    name: str
    motion: Combination
    coulomb: float = 0.0
    breakaway: float = 0.0
    stribeck: float = 1.0
    viscous: float = 0.0


class Load(NamedTuple):
    """A row of the table of loads.

    `axes` are the joints that the drives turn, in the order of the axes; `disturbance` is the motion on which the
    external load torque acts; `has_switches` tells whether limit switches are wired.
    """

    name: str
    mjcf: Path
    axes: tuple[str, ...]
    disturbance: Combination
    frictions: tuple[Friction, ...]
    parameters: tuple[Parameter, ...]
    has_switches: bool
    meaning: str


_LOAD_FRICTION_PARAMETERS = (
    Parameter("coulomb", "N*m", "coulomb", "load", 0.0, 3.0, "sliding friction of the load's bearing"),
    Parameter("breakaway", "N*m", "breakaway", "load", 1.0, 2.0, "friction at standstill"),
    Parameter("viscous", "N*m*s/rad", "viscous", "load", 0.0, 5.0, "friction that grows with speed"),
)

LOADS: dict[str, Load] = {
    row.name: row
    for row in (
        Load(
            "inertia",
            MODELS / "inertia.xml",
            axes=("shaft",),
            disturbance={"shaft": 1.0},
            frictions=(Friction("load", {"shaft": 1.0}, coulomb=2e-3, breakaway=3e-3, stribeck=2.0, viscous=2e-6),),
            parameters=(
                Parameter("inertia", "kg*m^2", "body_inertia", "load", 0.2, 5.0, "inertia of the load"),
                *_LOAD_FRICTION_PARAMETERS,
            ),
            has_switches=False,
            meaning="a disc rigidly on the shaft",
        ),
        Load(
            "two_mass",
            MODELS / "two_mass.xml",
            axes=("motor",),
            disturbance={"motor": 1.0, "twist": 1.0},
            frictions=(
                Friction(
                    "load", {"motor": 1.0, "twist": 1.0}, coulomb=2e-3, breakaway=3e-3, stribeck=2.0, viscous=2e-6
                ),
            ),
            parameters=(
                Parameter("inertia", "kg*m^2", "body_inertia", "load", 0.3, 4.0, "inertia of the load"),
                Parameter("stiffness", "N*m/rad", "jnt_stiffness", "twist", 0.3, 4.0, "of shaft and coupling"),
                Parameter("damping", "N*m*s/rad", "dof_damping", "twist", 0.5, 3.0, "of shaft and coupling"),
                *_LOAD_FRICTION_PARAMETERS,
            ),
            has_switches=False,
            meaning="a disc on an elastic shaft: one resonance, one anti-resonance",
        ),
    )
}


def find_load(name: str) -> Load:
    """Return the row of a load; ValueError lists the names there are."""
    if name not in LOADS:
        raise ValueError(f"no load is named {name!r}; there are {', '.join(sorted(LOADS))}")
    return LOADS[name]
