"""The driven loads, as rows. Sized for a 50 W motor: about two rotor inertias at its shaft."""

from __future__ import annotations

from functools import cache
from math import pi
from pathlib import Path

from mechanics.load import Combination, Contact, Friction, Load, Parameter, Roll, Switch
from mechanics.model import MODELS, resolve
from mechanics.reading.near_names import did_you_mean


def _friction(element: str, unit: str = "rad", **bounds: tuple[float, float]) -> tuple[Parameter, ...]:
    """Return the parameters of a load's friction; `bounds` replaces the usual range."""
    force = "N*m" if unit == "rad" else "N"
    rows = (
        ("coulomb", force, (0.0, 3.0), "sliding friction"),
        ("breakaway", force, (1.0, 2.0), "friction at standstill"),
        ("viscous", f"{force}*s/{unit}", (0.0, 5.0), "friction that grows with speed"),
    )
    return tuple(Parameter(name, u, name, element, *bounds.get(name, usual), text) for name, u, usual, text in rows)


def _linear_switches(travel: float, axes: int = 1) -> tuple[Switch, ...]:
    """Return limit switches 20 mm before the end stops of an axis, and a home switch near its middle."""
    return tuple(
        switch
        for axis in range(axes)
        for switch in (
            Switch("left", axis, -1.0, 0.02 - travel),
            Switch("right", axis, travel - 0.02, 1.0),
            Switch("home", axis, -0.06, -0.02),
        )
    )


_SHAFT = {"motor": 1.0, "twist": 1.0}
_END_SHAFT = {"motor": 1.0, "first_twist": 1.0, "second_twist": 1.0}
_CARRIAGE = {"pulley": 1.0, "stretch": 1.0}
_PULLEY = 0.04 / (2.0 * pi)  # m, 40 mm of belt per turn
_TOOTH_BELT = 0.032 / (2.0 * pi)  # m, 32 mm of belt per turn
_COLUMN_LEAD = 0.01 / (2.0 * pi)  # m/rad
_LEAD = 0.005 / (2.0 * pi)  # m/rad
_NUT = {"table": 1.0, "screw": -_LEAD}
_TEETH = {"joint": 1.0, "motor": -1.0 / 50.0}
_LEFT, _RIGHT = {"travel": 1.0, "yaw": -0.2}, {"travel": 1.0, "yaw": 0.2}


def _bearing(name: str, motion: Combination) -> Friction:
    """Return the friction of a small ball bearing with its seal."""
    return Friction(name, motion, coulomb=2e-3, breakaway=3e-3, stribeck=2.0, viscous=2e-6)


def _guide(name: str, motion: Combination) -> Friction:
    """Return the friction of a linear guide."""
    return Friction(name, motion, coulomb=0.8, breakaway=1.2, stribeck=0.01, viscous=2.0, bristle=1e-5)


def _screw(name: str, mass_range: tuple[float, float], meaning: str) -> Load:
    """Return a ball-screw axis; horizontal and vertical ones differ only in their MJCF."""
    return Load(
        MODELS / f"{name}.xml",
        joints=("screw",),
        name=name,
        disturbance={"table": 1.0},
        frictions=(
            Friction("nut", {"screw": _LEAD}, 4.0, 5.0, 0.005, 20.0, bristle=1e-5, efficiency=0.9, carries="nut"),
            Friction("guide", {"table": 1.0}, 3.0, 5.0, 0.01, 20.0, bristle=1e-5),
        ),
        parameters=(
            Parameter("mass", "kg", "body_mass", "table", *mass_range, "of table and payload"),
            Parameter("stiffness", "N/m", "contact_stiffness", "nut", 0.5, 1.6, "of screw, nut and bearing, axial"),
            Parameter("damping", "N*s/m", "contact_damping", "nut", 0.5, 2.0, "of screw, nut and bearing, axial"),
            Parameter("backlash", "m", "gap", "nut", 0.0, 3.0, "of the nut"),
            Parameter("efficiency", "1", "efficiency", "nut", 0.9, 1.08, "of the screw: what it loses is dry friction"),
            *_friction("guide", "m"),
        ),
        meaning=meaning,
        energy_bound=1e-3,
        positions=({"table": 1.0},),
        travel=((-0.25, 0.25),),
        switches=_linear_switches(0.25),
        contacts=(
            Contact("nut", _NUT, -1e-5, 1e-5, 1e7, 1500.0, transmits=True),
            Contact("end stops", {"table": 1.0}, -0.25, 0.25, 4e5, 800.0),
        ),
        disturbance_unit="N",
    )


def _cart(name: str, meaning: str, start: Combination, heaviest: float) -> Load:
    """Return a cart with a pendulum that hangs or stands at 0, up to `heaviest` times as heavy as the row says."""
    return Load(
        MODELS / f"{name}.xml",
        joints=("cart",),
        gear=1.0 / _PULLEY,
        name=name,
        disturbance={"cart": 1.0},
        frictions=(_guide("guide", {"cart": 1.0}),),
        parameters=(
            Parameter("mass", "kg", "body_mass", "cart", 0.5, 3.0, "of the cart"),
            Parameter("payload", "kg", "body_mass", "bob", 0.3, heaviest, "of the pendulum"),
            Parameter("length", "m", "body_ipos", "bob", 0.5, 1.5, "from pivot to centre of mass"),
            *_friction("guide", "m"),
        ),
        meaning=meaning,
        energy_bound=1e-3,
        travel=((-0.41, 0.41),),
        switches=_linear_switches(0.41),
        contacts=(Contact("end stops", {"cart": 1.0}, -0.41, 0.41, 2e4, 60.0),),
        start=start,
        disturbance_unit="N",
    )


_ROBOT_JOINTS = ("base", "shoulder", "elbow", "roll", "pitch", "turn")
_ROBOT_TRAVEL = ((-2.8, 2.8), (-1.2, 1.6), (-1.4, 1.4), (-3.0, 3.0), (-1.6, 1.6), (-3.0, 3.0))

_ROWS = (
    Load(
        MODELS / "inertia.xml",
        joints=("shaft",),
        disturbance={"shaft": 1.0},
        frictions=(_bearing("load", {"shaft": 1.0}),),
        parameters=(
            Parameter("inertia", "kg*m^2", "body_inertia", "load", 0.2, 5.0, "inertia of the load"),
            *_friction("load"),
        ),
        meaning="a disc rigidly on the shaft",
        energy_bound=1e-4,
    ),
    Load(
        MODELS / "two_mass.xml",
        joints=("motor",),
        disturbance=_SHAFT,
        frictions=(_bearing("load", _SHAFT),),
        parameters=(
            Parameter("inertia", "kg*m^2", "body_inertia", "load", 0.3, 4.0, "inertia of the load"),
            Parameter("stiffness", "N*m/rad", "jnt_stiffness", "twist", 0.3, 4.0, "of shaft and coupling"),
            Parameter("damping", "N*m*s/rad", "dof_damping", "twist", 1.0, 4.0, "of shaft and coupling"),
            *_friction("load"),
        ),
        meaning="a disc on an elastic shaft: one resonance, one anti-resonance",
        energy_bound=1e-4,
    ),
    Load(
        MODELS / "three_mass.xml",
        joints=("motor",),
        disturbance=_END_SHAFT,
        frictions=(_bearing("load", _END_SHAFT),),
        parameters=(
            Parameter("inertia", "kg*m^2", "body_inertia", "load", 0.5, 3.0, "inertia of the load"),
            Parameter("middle_inertia", "kg*m^2", "body_inertia", "middle", 0.5, 2.0, "inertia of the wheel between"),
            Parameter("stiffness", "N*m/rad", "jnt_stiffness", "second_twist", 0.4, 2.5, "of the load's shaft"),
            Parameter("first_stiffness", "N*m/rad", "jnt_stiffness", "first_twist", 0.4, 2.5, "of the motor's shaft"),
            Parameter("damping", "N*m*s/rad", "dof_damping", "second_twist", 0.5, 3.0, "of the load's shaft"),
            Parameter("first_damping", "N*m*s/rad", "dof_damping", "first_twist", 0.5, 3.0, "of the motor's shaft"),
            *_friction("load"),
        ),
        meaning="a wheel and a disc on elastic shafts: two resonances",
        energy_bound=1e-4,
    ),
    Load(
        MODELS / "belt.xml",
        joints=("pulley",),
        gear=1.0 / _PULLEY,
        disturbance=_CARRIAGE,
        frictions=(_guide("carriage", _CARRIAGE),),
        parameters=(
            Parameter("mass", "kg", "body_mass", "carriage", 0.3, 4.0, "of carriage and payload"),
            Parameter("stiffness", "N/m", "jnt_stiffness", "stretch", 0.4, 2.5, "of the belt"),
            Parameter("damping", "N*s/m", "dof_damping", "stretch", 0.5, 3.0, "of the belt"),
            *_friction("carriage", "m"),
        ),
        meaning="a carriage on a toothed belt, 0.5 m of travel, limit switches, home switch, rubber end stops",
        energy_bound=1e-3,
        positions=(_CARRIAGE,),
        travel=((-0.25, 0.25),),
        switches=_linear_switches(0.25),
        contacts=(Contact("end stops", _CARRIAGE, -0.25, 0.25, 4e4, 60.0),),
        disturbance_unit="N",
    ),
    _screw("ball_screw", (0.3, 3.0), "a table of 8 kg on a ball screw: backlash, efficiency, end stops, switches"),
    _screw("vertical_screw", (0.5, 2.0), "the same upright with 4 kg: gravity pulls, and a cut stage lets it fall"),
    Load(
        MODELS / "geared_joint.xml",
        joints=("motor",),
        disturbance={"joint": 1.0},
        frictions=(
            Friction(
                "gear", {"motor": 1.0 / 50.0}, 0.06, 0.08, 0.05, 0.02, bristle=1e-4, efficiency=0.85, carries="teeth"
            ),
            Friction("joint", {"joint": 1.0}, 0.05, 0.08, 0.05, 0.01, bristle=1e-4),
        ),
        parameters=(
            Parameter("inertia", "kg*m^2", "body_inertia", "link", 0.3, 4.0, "of link and payload"),
            Parameter("stiffness", "N*m/rad", "contact_stiffness", "teeth", 0.4, 2.5, "of the gear, at its output"),
            Parameter("damping", "N*m*s/rad", "contact_damping", "teeth", 0.5, 2.0, "of the gear, at its output"),
            Parameter("backlash", "rad", "gap", "teeth", 0.0, 3.0, "of the gear, at its output"),
            Parameter("efficiency", "1", "efficiency", "gear", 0.85, 1.1, "of the gear: what it loses is dry friction"),
            *_friction("joint"),
        ),
        meaning="a joint behind a gear of 50:1 with backlash and compliance",
        energy_bound=1e-3,
        positions=({"joint": 1.0},),
        contacts=(Contact("teeth", _TEETH, -1e-3, 1e-3, 7000.0, 0.5, transmits=True),),
    ),
    Load(
        MODELS / "arm.xml",
        joints=("joint",),
        gear=30.0,
        disturbance={"joint": 1.0},
        frictions=(Friction("joint", {"joint": 1.0}, 0.03, 0.05, 0.05, 0.005, bristle=1e-4),),
        parameters=(
            Parameter("mass", "kg", "body_mass", "arm", 0.3, 2.5, "of the weight"),
            Parameter("length", "m", "body_ipos", "arm", 0.6, 1.3, "from axis to weight"),
            *_friction("joint"),
        ),
        meaning="an unbalanced arm under gravity behind a gear of 30:1; at 0 it hangs",
        energy_bound=1e-4,
    ),
    _cart("cart_pendulum", "a crane: a cart from which a load hangs and swings", {}, 3.0),
    _cart(
        "inverted_pendulum",
        "a cart with a pole that stands, a little askew, and falls unless balanced",
        {"swing": 0.02},
        2.0,  # a heavier pole shakes the cart off its place
    ),
    Load(
        MODELS / "fan.xml",
        joints=("shaft",),
        disturbance={"shaft": 1.0},
        frictions=(Friction("wheel", {"shaft": 1.0}, 1e-3, 1.5e-3, 2.0, 1e-6, drag=3.5e-7),),
        parameters=(
            Parameter("inertia", "kg*m^2", "body_inertia", "wheel", 0.3, 4.0, "of the wheel"),
            Parameter("drag", "N*m*s^2/rad^2", "drag", "wheel", 0.2, 2.0, "torque per square of speed"),
            *_friction("wheel"),
        ),
        meaning="a fan or pump: torque grows with the square of speed",
        energy_bound=1e-4,
    ),
    Load(
        MODELS / "winder.xml",
        joints=("shaft",),
        gear=2.5,
        disturbance={"shaft": 0.025},
        frictions=(Friction("bearing", {"shaft": 1.0}, 5e-3, 8e-3, 1.0, 1e-5),),
        parameters=(
            Parameter("inertia", "kg*m^2", "body_inertia", "core", 0.5, 2.0, "of the empty core"),
            Parameter("radius", "m", "start", "roll", 0.8, 1.8, "of the roll at the start"),
            Parameter("thickness", "m", "thickness", "roll", 0.2, 2.0, "of the web"),
            Parameter("density", "kg/m^2", "density", "roll", 0.5, 2.0, "of the web, times its width"),
            *_friction("bearing"),
        ),
        meaning="a winder: its roll grows with every turn, the load force pulls at the web",
        energy_bound=1e-4,
        rolls=(Roll("roll", "shaft", start=0.025, core=0.02, thickness=2e-4, density=24.0),),
        disturbance_unit="N",
    ),
    Load(
        MODELS / "gantry.xml",
        joints=("left", "right"),
        gear=1.0 / _PULLEY,
        disturbance={"travel": 1.0, "yaw": 0.06},
        frictions=(_guide("left", _LEFT), _guide("right", _RIGHT)),
        parameters=(
            Parameter("mass", "kg", "body_mass", "bridge", 0.5, 3.0, "of the bridge"),
            Parameter("payload", "kg", "body_mass", "tool", 0.3, 3.0, "of the tool, 60 mm off the middle"),
            Parameter("stiffness", "N*m/rad", "jnt_stiffness", "yaw", 0.4, 2.5, "of the guides against yaw"),
            Parameter("damping", "N*m*s/rad", "dof_damping", "yaw", 0.5, 3.0, "of the guides against yaw"),
            *_friction("left", "m"),
        ),
        meaning="a bridge that two drives pull, one at each end: coupled axes",
        energy_bound=2e-3,
        positions=(_LEFT, _RIGHT),
        travel=((-0.3, 0.3), (-0.3, 0.3)),
        switches=_linear_switches(0.3, axes=2),
        contacts=(
            Contact("left stops", _LEFT, -0.3, 0.3, 4e4, 60.0),
            Contact("right stops", _RIGHT, -0.3, 0.3, 4e4, 60.0),
        ),
        disturbance_unit="N",
    ),
    Load(
        MODELS / "portal.xml",
        joints=("x", "y", "z"),
        gear=(1.0 / _TOOTH_BELT, 1.0 / _TOOTH_BELT, 1.0 / _COLUMN_LEAD),
        disturbance={"x": 1.0, "sway_x": 0.12},
        frictions=(
            _guide("bridge", {"x": 1.0}),
            _guide("carriage", {"y": 1.0}),
            Friction("column", {"z": 1.0}, 3.0, 4.0, 0.01, 20.0, bristle=1e-5),
        ),
        parameters=(
            Parameter("mass", "kg", "body_mass", "bridge", 0.5, 2.0, "of the bridge"),
            Parameter("payload", "kg", "body_mass", "arm", 0.3, 2.0, "of the tool and its arm"),
            Parameter("stiffness", "N*m/rad", "jnt_stiffness", "sway_x", 0.5, 2.5, "of the arm along x"),
            Parameter("damping", "N*m*s/rad", "dof_damping", "sway_x", 0.5, 3.0, "of the arm along x"),
            *_friction("bridge", "m"),
        ),
        meaning="three axes at right angles under gravity: two belts, a screw, a tool that sways",
        energy_bound=1e-3,
        travel=((-0.25, 0.25),) * 3,
        switches=_linear_switches(0.25, axes=3),
        contacts=tuple(Contact(f"{joint} stops", {joint: 1.0}, -0.25, 0.25, 4e4, 60.0) for joint in ("x", "y", "z")),
        disturbance_unit="N",
    ),
    Load(
        MODELS / "robot.xml",
        joints=_ROBOT_JOINTS,
        gear=(80.0, 80.0, 50.0, 10.0, 15.0, 8.0),
        disturbance={"shoulder": 1.0},
        frictions=tuple(
            Friction(joint, {joint: 1.0}, 2e-3 * gear, 3e-3 * gear, 0.05, 1e-4 * gear, bristle=1e-4)
            for joint, gear in zip(_ROBOT_JOINTS, (80.0, 80.0, 50.0, 10.0, 15.0, 8.0), strict=True)
        ),
        parameters=(Parameter("payload", "kg", "body_mass", "tool", 0.2, 2.0, "of the tool"), *_friction("shoulder")),
        meaning="a table-top arm with six joints under gravity: six drives",
        energy_bound=1e-3,
        travel=_ROBOT_TRAVEL,
        contacts=tuple(
            Contact(f"{joint} stops", {joint: 1.0}, low, high, 500.0, 2.0)
            for joint, (low, high) in zip(_ROBOT_JOINTS, _ROBOT_TRAVEL, strict=True)
        ),
    ),
)

MODEL_ENDINGS = (".xml", ".mjcf", ".urdf")  # of the path of your own model
LOADS: dict[str, Load] = {row.name: row for row in _ROWS}
# No load: for mechanics outside this program, which gives the torque at the shaft.
BARE_SHAFT = Load(
    MODELS / "bare_shaft.xml",
    joints=("shaft",),
    name="none",
    disturbance={"shaft": 1.0},
    parameters=(Parameter("inertia", "kg*m^2", "body_inertia", "hub", 1.0, 1.0, "what is rigid on the shaft: a hub"),),
    meaning="a rotor alone",
    energy_bound=1e-4,
)


def find_load(load: str | Path | Load) -> Load:
    """Return a load: a row by its name, or the user's own by its MJCF or as a `Load`, with joints resolved.

    Raises:
        ValueError: For an unknown name, listing the known ones, or a model that does not fit.
    """
    if isinstance(load, Load):
        return resolve(load)
    if isinstance(load, str) and load in LOADS:
        return _resolved_row(load)
    if isinstance(load, Path) or str(load).endswith(MODEL_ENDINGS):
        return resolve(Load(Path(load)))
    raise ValueError(
        f"no load is named {load!r}; there are {', '.join(sorted(LOADS))}, or give the path of an MJCF (.xml) or URDF"
        f"{did_you_mean(load, LOADS)}"
    )


@cache
def _resolved_row(name: str) -> Load:
    return resolve(LOADS[name])
