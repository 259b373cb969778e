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


class Switch(NamedTuple):
    """A switch of an axis: "left", "right" or "home", pressed while the axis's `position` lies in low...high."""

    kind: str
    axis: int
    low: float
    high: float


class EndStop(NamedTuple):
    """Rubber end stops of a motion: free from low to high [rad or m], then a spring [N/m] and a damper [N*s/m]."""

    motion: Combination
    low: float
    high: float
    stiffness: float
    damping: float


class Load(NamedTuple):
    """A row of the table of loads.

    `axes` are the joints that the drives turn, in the order of the axes; `disturbance` is the motion on which the
    external load torque (force) acts; `gears` are each axis's rotor angle per unit of its joint, 1 where not given;
    `positions` the motion that presses each axis's switches, its joint where not given.
    """

    name: str
    mjcf: Path
    axes: tuple[str, ...]
    disturbance: Combination
    frictions: tuple[Friction, ...]
    parameters: tuple[Parameter, ...]
    meaning: str
    gears: tuple[float, ...] = ()
    positions: tuple[Combination, ...] = ()
    switches: tuple[Switch, ...] = ()
    end_stops: tuple[EndStop, ...] = ()
    disturbance_unit: str = "N*m"

    @property
    def has_switches(self) -> bool:
        """Whether limit switches are wired."""
        return any(switch.kind != "home" for switch in self.switches)


_LOAD_FRICTION_PARAMETERS = (
    Parameter("coulomb", "N*m", "coulomb", "load", 0.0, 3.0, "sliding friction of the load's bearing"),
    Parameter("breakaway", "N*m", "breakaway", "load", 1.0, 2.0, "friction at standstill"),
    Parameter("viscous", "N*m*s/rad", "viscous", "load", 0.0, 5.0, "friction that grows with speed"),
)

_CARRIAGE = {"pulley": 1.0, "stretch": 1.0}

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
            meaning="a disc on an elastic shaft: one resonance, one anti-resonance",
        ),
        Load(
            "belt",
            MODELS / "belt.xml",
            axes=("pulley",),
            disturbance=_CARRIAGE,
            frictions=(Friction("carriage", _CARRIAGE, coulomb=0.8, breakaway=1.2, stribeck=0.01, viscous=2.0),),
            parameters=(
                Parameter("mass", "kg", "body_mass", "carriage", 0.3, 4.0, "of carriage and payload"),
                Parameter("stiffness", "N/m", "jnt_stiffness", "stretch", 0.4, 2.5, "of the belt"),
                Parameter("damping", "N*s/m", "dof_damping", "stretch", 0.5, 3.0, "of the belt"),
                Parameter("coulomb", "N", "coulomb", "carriage", 0.0, 3.0, "sliding friction of the guide"),
                Parameter("breakaway", "N", "breakaway", "carriage", 1.0, 2.0, "friction at standstill"),
                Parameter("viscous", "N*s/m", "viscous", "carriage", 0.0, 5.0, "friction that grows with speed"),
            ),
            meaning="a carriage on a toothed belt, 0.5 m of travel, limit switches, home switch, rubber end stops",
            gears=(1.0 / 0.006366,),  # pulley of 40 mm per turn
            positions=(_CARRIAGE,),
            switches=(
                Switch("left", 0, -1.0, -0.23),
                Switch("right", 0, 0.23, 1.0),
                Switch("home", 0, -0.06, -0.02),
            ),
            end_stops=(EndStop(_CARRIAGE, -0.25, 0.25, 4e4, 60.0),),
            disturbance_unit="N",
        ),
    )
}


def find_load(name: str) -> Load:
    """Return the row of a load; ValueError lists the names there are."""
    if name not in LOADS:
        raise ValueError(f"no load is named {name!r}; there are {', '.join(sorted(LOADS))}")
    return LOADS[name]
