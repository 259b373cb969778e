"""A driven load as data: its MJCF, driven joints, and parameters that can be set and drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

# A motion or torque as a combination of joints: joint name -> coefficient. In a chain of joints the absolute angle of
# a body is the sum of the joints before it.
Combination = Mapping[str, float]


class Parameter(NamedTuple):
    """A parameter of the load, set per machine.

    `field` is its array, `element` the element: a body's "body_mass", "body_inertia" or "body_ipos" (distance of its
    centre of mass from its frame), a joint's "jnt_stiffness" or "dof_damping", all in the MJCF, which then has the
    default; or a column of one of the load's frictions, contacts or rolls. Low and high are the range of randomisation,
    as multiples of the default.
    """

    name: str
    unit: str
    field: str
    element: str
    low: float
    high: float
    meaning: str


class Friction(NamedTuple):
    """Friction on one motion of the load; see friction.py for the equations.

    coulomb, breakaway [N*m or N], stribeck [rad/s or m/s], viscous [N*m*s/rad or N*s/m]. `drag` [N*m*s^2/rad^2 or
    N*s^2/m^2] grows with the square of speed: air and water. `bristle` [rad or m] is the deflection at break-away,
    which LuGre's law needs. `efficiency` of a screw or gear adds dry friction in proportion to the force that
    `carries`, a contact, transmits: 1/efficiency - 1 of it.
    """

    name: str
    motion: Combination
    coulomb: float = 0.0
    breakaway: float = 0.0
    stribeck: float = 1.0
    viscous: float = 0.0
    drag: float = 0.0
    bristle: float = 1e-3
    efficiency: float = 1.0
    carries: str = ""


class Switch(NamedTuple):
    """A switch of an axis: "left", "right" or "home", pressed while the axis's `position` lies in low...high."""

    kind: str
    axis: int
    low: float
    high: float


class Contact(NamedTuple):
    """A motion that is free from low to high [rad or m]; beyond, a spring and a damper push it back, but never pull.

    Rubber end stops, or teeth and threads with backlash: low to high is then the gap, and the contact `transmits` the
    drive's force to its load. stiffness [N*m/rad or N/m], damping [N*m*s/rad or N*s/m].
    """

    name: str
    motion: Combination
    low: float
    high: float
    stiffness: float
    damping: float
    transmits: bool = False


class Roll(NamedTuple):
    """A web that a joint winds up: its radius grows with every turn, and the disturbance [N] pulls at the web.

    start: Radius at the start [m]; core: radius of the empty core, whose inertia is in the MJCF [m]. thickness:
    Thickness of the web [m]. density: Mass per volume times width [kg/m^2].
    """

    name: str
    joint: str
    start: float
    core: float
    thickness: float
    density: float


@dataclass(frozen=True)
class Load:
    """A driven load: a row of the table in loads.py, or the user's own machine.

    Attributes:
        mjcf: The MuJoCo model: the load's masses, without rotors. Hinge and slide joints only.
        joints: The joints, or fixed tendons, that the drives turn, in the order of the axes. By default those of the
            model's actuators, or its only joint.
        gear: Rotor angle per unit of each axis's joint [1 or rad/m]: one for all or one each; by default the actuators'
            gears.
        name: Name for messages; by default the file's.
        disturbance: The motion on which the external load torque (force) acts; the first joint by default. For a load
            with a roll, the pull at its web.
        frictions, contacts, rolls: Forces on the load that MuJoCo does not compute.
        parameters: Parameters that may be set per machine.
        positions: The motion that presses each axis's switches, by default its joint.
        travel: Range of each axis's position, low and high [rad or m]; None if it may turn without limit.
        switches: The switches.
        start: Positions of joints at the start [rad or m], by default 0.
        meaning: Description in one line.
        disturbance_unit: Unit of the external load torque.
        packing_bound: Largest deviation of a packed copy from the load alone, as a share of the motion's range: 0
            without a constraint solver, since it is then equal bit by bit; 1e-9 within a second, filled in, if the
            model has limits, contacts or loops.
        energy_bound: Largest error of the energy balance at the default step, as a share of the work done.
    """

    mjcf: Path
    joints: tuple[str, ...] = ()
    gear: float | tuple[float, ...] = 1.0
    name: str = ""
    disturbance: Combination = field(default_factory=dict)
    frictions: tuple[Friction, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    meaning: str = ""
    positions: tuple[Combination, ...] = ()
    travel: tuple[tuple[float, float] | None, ...] = ()
    switches: tuple[Switch, ...] = ()
    contacts: tuple[Contact, ...] = ()
    rolls: tuple[Roll, ...] = ()
    start: Combination = field(default_factory=dict)
    disturbance_unit: str = "N*m"
    packing_bound: float = 0.0
    energy_bound: float = 0.01

    def __post_init__(self) -> None:
        """Accept simpler forms: one joint's name, a list, a path as text."""
        object.__setattr__(self, "mjcf", Path(self.mjcf))
        object.__setattr__(self, "joints", (self.joints,) if isinstance(self.joints, str) else tuple(self.joints))
        object.__setattr__(self, "name", self.name or self.mjcf.stem)
        if not isinstance(self.gear, int | float):
            object.__setattr__(self, "gear", tuple(float(gear) for gear in self.gear))

    @property
    def num_axes(self) -> int:
        """Number of drives of the load."""
        return len(self.joints)

    @property
    def gears(self) -> tuple[float, ...]:
        """Rotor angle per unit of each axis's joint."""
        return self.gear if isinstance(self.gear, tuple) else (float(self.gear),) * self.num_axes

    @property
    def has_switches(self) -> bool:
        """Whether limit switches are wired."""
        return any(switch.kind != "home" for switch in self.switches)
