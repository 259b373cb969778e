"""The values of each copy of a load: its parameters by name, and their places in arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from mechanics.arrays import Floats, Integers, Mask
from mechanics.load import Load, Parameter

# Columns of the frictions, contacts and rolls in the order of the rows.
FRICTION_COLUMNS = ("coulomb", "breakaway", "stribeck", "viscous", "drag", "bristle", "efficiency")
CONTACT_COLUMNS = ("low", "high", "contact_stiffness", "contact_damping")
ROLL_COLUMNS = ("start", "core", "thickness", "density")
VALUE_ARRAYS = ("armature", "friction", "contact", "roll", "stiffness", "damping")  # of LoadValues
_BODY_FIELDS = ("body_mass", "body_inertia", "body_ipos")


class LoadValues:
    """The values of copies of a load and of their rotors, initially those of the row and its MJCF.

    A body's are in the packed model itself, all others in arrays here. Storing one has no effect on motion:
    `PackedLoad` derives the stepped quantities from them.

    Args:
        load: The row, resolved (model.py).
        model: Its packed model, not stepped yet.
        joints: Names of a copy's joints.
        bodies: Element of a parameter -> the number of every copy's body of that name (template.py).
        armature: Rotor inertia of each copy's axes [kg*m^2], shape (copies, axes).
        motor_friction: Friction of each copy's axes, shape (copies, axes, 4): coulomb, breakaway, stribeck, viscous.

    Attributes:
        armature: A copy of the argument.
        friction: Friction of the axes' bearings, then of the load's rows, shape (copies, axes + rows,
            FRICTION_COLUMNS).
        contact: Shape (copies, contacts, CONTACT_COLUMNS).
        roll: Shape (copies, rolls, ROLL_COLUMNS).
        stiffness: Stiffness of the joints' springs, shape (copies, D).
        damping: Damping of the joints, shape (copies, D).
    """

    def __init__(
        self,
        load: Load,
        model: mujoco.MjModel,
        joints: Sequence[str],
        bodies: Mapping[str, Integers],
        armature: Floats,
        motor_friction: Floats,
    ) -> None:
        self._load = load
        self._model = model
        self._joints = joints
        self._copies, self._axes = armature.shape
        self._bodies = bodies
        self.armature: Floats = np.array(armature)
        self.friction = np.zeros((self._copies, self._axes + len(load.frictions), len(FRICTION_COLUMNS)))
        self.friction[:, :, FRICTION_COLUMNS.index("efficiency")] = 1.0
        self.motor_friction[:] = motor_friction
        for k, row in enumerate(load.frictions, self._axes):
            self.friction[:, k] = [getattr(row, column) for column in FRICTION_COLUMNS]
        rows = [(row.low, row.high, row.stiffness, row.damping) for row in load.contacts]
        self.contact = np.tile(np.array(rows, float).reshape(-1, 4), (self._copies, 1, 1))
        rolls = [[getattr(row, column) for column in ROLL_COLUMNS] for row in load.rolls]
        self.roll = np.tile(np.array(rolls, float).reshape(-1, 4), (self._copies, 1, 1))
        self.stiffness: Floats = model.jnt_stiffness.reshape(self._copies, len(joints)).copy()
        self.damping: Floats = model.dof_damping.reshape(self._copies, len(joints)).copy()

    @property
    def motor_friction(self) -> Floats:
        """The bearings' columns of `friction`, a view in the shape of the constructor's argument."""
        return self.friction[:, : self._axes, :4]

    def get(self, name: str) -> Floats:
        """Return a parameter of every copy, shape (copies,)."""
        parameter = self._parameter(name)
        if parameter.field in _BODY_FIELDS:
            bodies = self._bodies[parameter.element]
            if parameter.field == "body_ipos":
                return self._distances(bodies)
            return np.array(self._model.body_mass[bodies] if parameter.field == "body_mass"
                            else self._model.body_inertia[bodies, 0])  # fmt: skip
        if parameter.field == "gap":
            low, high = (self._column(parameter, field) for field in ("low", "high"))
            return np.asarray(high - low)
        return self._column(parameter, parameter.field).copy()

    def store(self, name: str, values: Floats, where: slice | Mask) -> None:
        """Store a parameter of the chosen copies, one value each; ValueError changes nothing."""
        self.check(name, values)
        self.store_checked(name, values, where)

    def store_checked(self, name: str, values: Floats, where: slice | Mask) -> None:
        """Store values already checked by `check`."""
        parameter = self._parameter(name)
        if parameter.field in _BODY_FIELDS:
            bodies = self._bodies[parameter.element][where]
            chosen = np.broadcast_to(values, bodies.shape)
            if parameter.field == "body_ipos":
                self._model.body_ipos[bodies] *= (chosen / self._distances(bodies))[:, None]
            elif parameter.field == "body_mass":
                self._model.body_mass[bodies] = chosen
            else:
                self._model.body_inertia[bodies] = chosen[:, None]
        elif parameter.field == "gap":
            middle = 0.5 * (self._column(parameter, "low") + self._column(parameter, "high"))[where]
            self._column(parameter, "low")[where] = middle - 0.5 * values
            self._column(parameter, "high")[where] = middle + 0.5 * values
        else:
            self._column(parameter, parameter.field)[where] = values

    def check(self, name: str, values: Floats) -> None:
        """Raise ValueError unless every value is possible for the parameter."""
        parameter = self._parameter(name)
        label = f"{parameter.name} of load {self._load.name!r}"
        if np.any(values < 0.0) or not np.all(np.isfinite(values)):
            raise ValueError(f"{label} must be finite and not negative [{parameter.unit}], not {values.min():g}")
        if parameter.field == "efficiency" and np.any((values <= 0.0) | (values > 1.0)):
            raise ValueError(f"{label} must lie above 0 and up to 1, not {values.min():g}...{values.max():g}")
        if parameter.field in _BODY_FIELDS and np.any(values <= 0.0):
            raise ValueError(f"{label} must be above 0 {parameter.unit}")

    # --- inside ---------------------------------------------------------------------------------------------------
    def _parameter(self, name: str) -> Parameter:
        for parameter in self._load.parameters:
            if parameter.name == name:
                return parameter
        names = ", ".join(p.name for p in self._load.parameters)
        raise ValueError(f"load {self._load.name!r} has no parameter {name!r}; it has {names}")

    def _distances(self, bodies: Integers) -> Floats:
        """Return the distances of bodies' centres of mass from their frames [m]."""
        return np.sqrt([place @ place for place in self._model.body_ipos[bodies]])

    def _column(self, parameter: Parameter, field: str) -> Floats:
        """Return the view, shape (copies,), of a parameter that is not a body's."""
        element = parameter.element
        if field in FRICTION_COLUMNS:
            row = self._axes + [f.name for f in self._load.frictions].index(element)
            return self.friction[:, row, FRICTION_COLUMNS.index(field)]
        if field in CONTACT_COLUMNS:
            return self.contact[:, [c.name for c in self._load.contacts].index(element), CONTACT_COLUMNS.index(field)]
        if field in ROLL_COLUMNS:
            return self.roll[:, [r.name for r in self._load.rolls].index(element), ROLL_COLUMNS.index(field)]
        array = {"jnt_stiffness": self.stiffness, "dof_damping": self.damping}[field]
        return array[:, self._joints.index(element)]


def check_places(load: Load, model: mujoco.MjModel, joints: Sequence[str]) -> None:
    """Raise ValueError, listing the known elements, if a parameter of a load names an unknown one.

    Args:
        load: The row, resolved.
        model: Its packed model.
        joints: Names of a copy's joints.
    """
    bodies = [str(model.body(k).name) for k in range(1, model.nbody)]
    places = {
        _BODY_FIELDS: [name.removeprefix("0/") for name in bodies if name.startswith("0/")],
        ("jnt_stiffness", "dof_damping"): joints,
        FRICTION_COLUMNS: [row.name for row in load.frictions],
        (*CONTACT_COLUMNS, "gap"): [row.name for row in load.contacts],
        ROLL_COLUMNS: [row.name for row in load.rolls],
    }
    for parameter in load.parameters:
        found = [names for fields, names in places.items() if parameter.field in fields]
        if not found:
            known = ", ".join(name for fields in places for name in fields)
            raise ValueError(
                f"load {load.name!r}: its parameter {parameter.name!r} is not a {parameter.field!r}; there are {known}"
            )
        if not any(parameter.element in names for names in found):
            raise ValueError(
                f"load {load.name!r}: its parameter {parameter.name!r}, a {parameter.field}, names "
                f"{parameter.element!r}; there are {', '.join(found[0]) or '(none)'}"
            )


def body_numbers(load: Load, model: mujoco.MjModel, copies: int) -> dict[str, Integers]:
    """Return the numbers of every copy's bodies that parameters of a load name: element -> shape (copies,)."""
    elements = {parameter.element for parameter in load.parameters if parameter.field in _BODY_FIELDS}
    return {
        element: np.array([model.body(f"{k}/{element}").id for k in range(copies)], np.int64) for element in elements
    }
