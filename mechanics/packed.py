"""Many independent copies of one load in one MuJoCo model.

`mj_step` has a fixed price of about a microsecond, whatever the model; 64 copies in one model share it. Copies never
touch, and without a constraint solver the result of a copy is bit for bit what it would be alone.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from mechanics.friction import BRISTLE_DAMPING, FrictionModel, find_friction
from mechanics.load import Combination, Friction, Load, Parameter
from mechanics.modal import corrections
from mechanics.model import compile_packed, is_constant, is_constrained, is_varying, motion_of, read_model
from mechanics.plant import Plant

Floats = NDArray[np.float64]

# Above this phase per step [rad] the discrete resonance cannot be put at the true one any more with good accuracy.
MAX_PHASE_PER_STEP = 0.7
# Columns of the frictions, contacts and rolls as the rows give them.
FRICTION_COLUMNS = ("coulomb", "breakaway", "stribeck", "viscous", "drag", "bristle", "efficiency")
CONTACT_COLUMNS = ("low", "high", "contact_stiffness", "contact_damping")
ROLL_COLUMNS = ("start", "core", "thickness", "density")
_BODY_FIELDS = ("body_mass", "body_inertia", "body_ipos")
_DISABLED = (
    mujoco.mjtDisableBit.mjDSBL_ACTUATION
    | mujoco.mjtDisableBit.mjDSBL_SENSOR
    | mujoco.mjtDisableBit.mjDSBL_WARMSTART
    | mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    # MuJoCo resets a whole model when one copy diverges; stepping.py freezes that copy alone instead.
    | mujoco.mjtDisableBit.mjDSBL_AUTORESET
)
_DISABLED_UNCONSTRAINED = (
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_ISLAND
)
_INTEGRATORS = {"leapfrog": mujoco.mjtIntegrator.mjINT_IMPLICITFAST, "rk4": mujoco.mjtIntegrator.mjINT_RK4}


class PackedLoad:
    """Copies of a load with parameters of their own, ready to be stepped by compiled code.

    Args:
        load: The row, resolved (model.py).
        armature: Rotor inertia of each copy's axes [kg*m^2], shape (copies, axes).
        motor_friction: Of each copy's axes, shape (copies, axes, 4): coulomb, breakaway, stribeck, viscous.
        parameters: Parameter name -> values, shape (copies,); others keep the row's default.
        h: Physics step [s].
        integrator: "leapfrog" (implicitfast, staggered) or "rk4", the slower oracle.
        friction: Model of the load's friction, a row of friction.py.
        template: Compiled model to copy instead of compiling again.
        first_machine: Number of copy 0, for messages.
        weigh_every: Steps after which the inertias that friction sees are brought to the present position.

    Raises:
        ValueError: If a resonance is too fast for the step, or a parameter is unknown.
    """

    def __init__(
        self,
        load: Load,
        armature: Floats,
        motor_friction: Floats,
        parameters: Mapping[str, Floats],
        h: float,
        *,
        integrator: str = "leapfrog",
        friction: str = "stribeck",
        template: mujoco.MjModel | None = None,
        first_machine: int = 0,
        weigh_every: int = 1,
    ) -> None:
        self.load = load
        self.copies: int = armature.shape[0]
        self.num_axes: int = armature.shape[1]
        self.h = h
        self._first_machine = first_machine
        self._weigh_every = weigh_every
        if integrator not in _INTEGRATORS:
            raise ValueError(f"no integrator is named {integrator!r}; there are {', '.join(_INTEGRATORS)}")
        self.staggered = integrator == "leapfrog"
        self._model_of_friction: FrictionModel = find_friction(friction)
        self.model = compile_packed(load, self.copies) if template is None else copy.copy(template)
        self.num_dofs = self.model.nv // self.copies
        self.constrained = is_constrained(self.model)
        single = read_model(load)
        # Runge-Kutta looks at everything anew, too: it is the oracle.
        self._looking = not self.staggered or self.constrained or is_varying(single)
        self._constant = not self._looking and is_constant(single)
        # Rolls grow slowly and change nothing but their own inertia; where something else does, all is looked at.
        self._looking |= bool(load.rolls) and not self._constant
        self.varying = self._looking or bool(load.rolls)
        self.model.opt.integrator = _INTEGRATORS[integrator]
        self.model.opt.timestep = h
        self.model.opt.disableflags = int(_DISABLED | (0 if self.constrained else _DISABLED_UNCONSTRAINED))
        if load.rolls:
            # MuJoCo takes the inertia of simple joints from a constant; a roll's grows.
            self.model.dof_simplenum[:] = 0
        self._body_numbers: dict[str, NDArray[np.int64]] = {}
        self._joints = [
            str(self.model.joint(int(self.model.dof_jntid[d])).name).removeprefix("0/") for d in range(self.num_dofs)
        ]
        # Rotor angle from joints: the bearings' friction acts on this motion.
        turning = [
            {name: gear * c for name, c in motion_of(self.model, joint, "0/").items()}
            for joint, gear in zip(load.joints, load.gears, strict=True)
        ]
        # Friction on a rotor's own motion is computed in one with its bearing's, unless it has bristles.
        self._merged = {} if self._model_of_friction.bristles else _proportional(turning, load.frictions)
        apart = [row.motion for k, row in enumerate(load.frictions) if k not in self._merged]
        self._motions = turning + apart + [row.motion for row in load.contacts]
        self.num_frictions = self.num_axes + len(apart)
        self._friction = np.zeros((self.copies, self.num_axes + len(load.frictions), len(FRICTION_COLUMNS)))
        self._friction[:, :, FRICTION_COLUMNS.index("efficiency")] = 1.0
        self._friction[:, : self.num_axes, :4] = motor_friction
        for k, row in enumerate(load.frictions, self.num_axes):
            self._friction[:, k] = [getattr(row, column) for column in FRICTION_COLUMNS]
        rows = [(row.low, row.high, row.stiffness, row.damping) for row in load.contacts]
        self._contact = np.tile(np.array(rows, float).reshape(-1, 4), (self.copies, 1, 1))
        rolls = [[getattr(row, column) for column in ROLL_COLUMNS] for row in load.rolls]
        self._roll = np.tile(np.array(rolls, float).reshape(-1, 4), (self.copies, 1, 1))
        self._armature = np.array(armature)
        self._stiffness = self._by_copy(self.model.jnt_stiffness).copy()
        self._damping = self._by_copy(self.model.dof_damping).copy()
        springs = any(p.field == "jnt_stiffness" for p in load.parameters) or bool(np.any(self._stiffness))
        self._elastic = self.staggered and springs
        self._passive_armature = self._by_copy(self.model.dof_armature).copy()
        self.start = np.array(self.model.qpos0[: self.num_dofs])
        for joint, position in load.start.items():
            self.start[self._joints.index(joint)] = position
        for parameter in load.parameters:
            self._check_parameter(parameter)
        for name, values in parameters.items():
            self._store(self._parameter(name), np.asarray(values, float), slice(None))
        self.data = mujoco.MjData(self.model)
        self.plant = self._new_plant()
        self._apply()
        self.reset(np.ones(self.copies, bool))

    # --- parameters -----------------------------------------------------------------------------------------------
    def get(self, name: str) -> Floats:
        """Return a parameter of every copy, shape (copies,)."""
        parameter = self._parameter(name)
        if parameter.field in _BODY_FIELDS:
            bodies = self._bodies(parameter.element)
            if parameter.field == "body_ipos":
                return np.array([np.linalg.norm(place) for place in self.model.body_ipos[bodies]])
            return np.array(self.model.body_mass[bodies] if parameter.field == "body_mass"
                            else self.model.body_inertia[bodies, 0])  # fmt: skip
        if parameter.field == "gap":
            low, high = (self._column(parameter, field) for field in ("low", "high"))
            return np.asarray(high - low)
        return self._column(parameter, parameter.field).copy()

    def set(self, name: str, values: Floats, where: NDArray[np.bool_]) -> None:
        """Set a parameter of the copies where the mask is true; ValueError leaves all as it was."""
        before = self.get(name)
        parameter = self._parameter(name)
        self._store(parameter, np.asarray(values, float)[where], where)
        try:
            self._apply(where)
        except ValueError:
            self._store(parameter, before, slice(None))
            self._apply(where)
            raise

    def set_motor(self, armature: Floats, friction: Floats) -> None:
        """Set the rotors' inertia [kg*m^2] and bearing friction, in the shapes of the constructor.

        ValueError leaves all as it was.
        """
        if np.any(armature <= 0.0) or np.any(friction < 0.0):
            raise ValueError(
                f"rotor inertia must be above 0 and friction not negative; the least are {armature.min():g} kg*m^2 "
                f"and {friction.min():g}"
            )
        before = self._armature.copy()
        self._armature[:] = armature
        try:
            self._apply()
        except ValueError:
            self._armature[:] = before
            self._apply()
            raise
        self._friction[:, : self.num_axes, :4] = friction
        self._apply()

    def set_all(
        self, parameters: Mapping[str, Floats], where: NDArray[np.bool_], armature: Floats, friction: Floats
    ) -> None:
        """Set parameters of the copies where the mask is true, and all motors as `set_motor` does, at once.

        ValueError leaves all as it was.
        """
        if np.any(armature <= 0.0) or np.any(friction < 0.0):
            raise ValueError(
                f"rotor inertia must be above 0 and friction not negative; the least are {armature.min():g} kg*m^2 "
                f"and {friction.min():g}"
            )
        before = {name: self.get(name) for name in parameters}
        motors = self._armature.copy(), self._friction[:, : self.num_axes, :4].copy()
        changed = where | np.any(armature != motors[0], axis=1) | np.any(friction != motors[1], axis=(1, 2))
        try:
            for name, values in parameters.items():
                self._store(self._parameter(name), np.asarray(values, float)[where], where)
            self._armature[:], self._friction[:, : self.num_axes, :4] = armature, friction
            self._apply(changed)
        except ValueError:
            for name, values in before.items():
                self._store(self._parameter(name), values, slice(None))
            self._armature[:], self._friction[:, : self.num_axes, :4] = motors
            self._apply(changed)
            raise

    def reset(self, where: NDArray[np.bool_]) -> None:
        """Put the copies where the mask is true to rest at their start; a frozen one lives again."""
        for k in np.flatnonzero(where):
            dofs = slice(k * self.num_dofs, (k + 1) * self.num_dofs)
            self.data.qpos[dofs] = self.start
            self.data.qvel[dofs] = 0.0
            self.data.qfrc_applied[dofs] = 0.0
            self.data.qacc_warmstart[dofs] = 0.0
            self.plant.qvel_before[dofs] = 0.0
            self.plant.bristle[k] = 0.0
            self.plant.holding[:, k] = 0.0
            self.plant.carried[k] = 0.0
            self.plant.diverged[k] = 0
            self.plant.load_torque[k] = 0.0
            self.plant.clock[k] = 0.0

    def mass_matrix(self) -> Floats:
        """Return each copy's inertia matrix with the rotors', shape (copies, D, D), at the present position."""
        mujoco.mj_forward(self.model, self.data)
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, full)
        blocks = full.reshape(self.copies, self.num_dofs, self.copies, self.num_dofs)
        index = np.arange(self.copies)
        return blocks[index, :, index, :]

    @property
    def armature(self) -> Floats:
        """Rotor inertia of every axis [kg*m^2], shape (copies, axes)."""
        return self._armature

    def set_profile(self, at: Floats, torque: Floats, *, of_position: bool, period: float) -> None:
        """Add a torque from a table to the load torque: `torque`, shape (copies, n), over `at`, shape (n,).

        Args:
            at: Time since now [s], or position of the first axis [rad or m]; increasing.
            torque: On the load's disturbance [N*m or N].
            of_position: Whether `at` is a position.
            period: After which the table begins anew; 0 holds the last value.
        """
        self.plant.clock[:] = 0.0
        self.plant.profile_now[:] = 0.0
        self.plant.replace(
            profile_at=np.ascontiguousarray(at, float),
            profile=np.ascontiguousarray(torque, float),
            profile_of_position=of_position,
            profile_period=float(period),
        )

    def joint_positions(self) -> Floats:
        """Return the joints' positions [rad or m], shape (copies, D), half a step ago if staggered."""
        return self._by_copy(self.data.qpos).copy()

    # --- inside ---------------------------------------------------------------------------------------------------
    def _by_copy(self, array: Floats) -> Floats:
        return array.reshape(self.copies, self.num_dofs)

    def _bodies(self, element: str) -> NDArray[np.int64]:
        """Return the numbers of every copy's body of a name."""
        if element not in self._body_numbers:
            numbers = [self.model.body(f"{k}/{element}").id for k in range(self.copies)]
            self._body_numbers[element] = np.array(numbers, np.int64)
        return self._body_numbers[element]

    def _parameter(self, name: str) -> Parameter:
        for parameter in self.load.parameters:
            if parameter.name == name:
                return parameter
        names = ", ".join(p.name for p in self.load.parameters)
        raise ValueError(f"load {self.load.name!r} has no parameter {name!r}; it has {names}")

    def _check_parameter(self, parameter: Parameter) -> None:
        """Refuse a parameter that lives nowhere, with the places that there are."""
        load, field = self.load, parameter.field
        bodies = [str(self.model.body(k).name) for k in range(1, self.model.nbody)]
        places = {
            _BODY_FIELDS: [name.removeprefix("0/") for name in bodies if name.startswith("0/")],
            ("jnt_stiffness", "dof_damping"): self._joints,
            FRICTION_COLUMNS: [row.name for row in load.frictions],
            (*CONTACT_COLUMNS, "gap"): [row.name for row in load.contacts],
            ROLL_COLUMNS: [row.name for row in load.rolls],
        }
        for fields, names in places.items():
            if field in fields and parameter.element in names:
                return
            if field in fields:
                raise ValueError(
                    f"load {load.name!r}: its parameter {parameter.name!r}, a {field}, names {parameter.element!r}; "
                    f"there are {', '.join(names) or '(none)'}"
                )
        known = ", ".join(name for fields in places for name in fields)
        raise ValueError(f"load {load.name!r}: its parameter {parameter.name!r} is no {field!r}; there are {known}")

    def _column(self, parameter: Parameter, field: str) -> Floats:
        """Return the view, shape (copies,), in which a parameter lives that is not a body's."""
        element = parameter.element
        if field in FRICTION_COLUMNS:
            row = self.num_axes + [f.name for f in self.load.frictions].index(element)
            return self._friction[:, row, FRICTION_COLUMNS.index(field)]
        if field in CONTACT_COLUMNS:
            return self._contact[:, [c.name for c in self.load.contacts].index(element), CONTACT_COLUMNS.index(field)]
        if field in ROLL_COLUMNS:
            return self._roll[:, [r.name for r in self.load.rolls].index(element), ROLL_COLUMNS.index(field)]
        array = {"jnt_stiffness": self._stiffness, "dof_damping": self._damping}[field]
        return array[:, self._joints.index(element)]

    def check(self, name: str, values: Floats) -> None:
        """Raise ValueError unless every value is one that the parameter can have."""
        parameter = self._parameter(name)
        label = f"{parameter.name} of load {self.load.name!r}"
        if np.any(values < 0.0) or not np.all(np.isfinite(values)):
            raise ValueError(f"{label} must be finite and not negative [{parameter.unit}], not {values.min():g}")
        if parameter.field == "efficiency" and np.any((values <= 0.0) | (values > 1.0)):
            raise ValueError(f"{label} must lie above 0 and up to 1, not {values.min():g}...{values.max():g}")
        if parameter.field in _BODY_FIELDS and np.any(values <= 0.0):
            raise ValueError(f"{label} must be above 0 {parameter.unit}")

    def _store(self, parameter: Parameter, values: Floats, where: slice | NDArray[np.bool_]) -> None:
        self.check(parameter.name, values)
        if parameter.field in _BODY_FIELDS:
            bodies = self._bodies(parameter.element)[where]
            chosen = np.broadcast_to(values, bodies.shape)
            if parameter.field == "body_ipos":
                for body, value in zip(bodies, chosen, strict=True):
                    place = self.model.body_ipos[body]
                    self.model.body_ipos[body] = place * (value / np.linalg.norm(place))
            elif parameter.field == "body_mass":
                self.model.body_mass[bodies] = chosen
            else:
                self.model.body_inertia[bodies] = chosen[:, None]
        elif parameter.field == "gap":
            middle = 0.5 * (self._column(parameter, "low") + self._column(parameter, "high"))[where]
            self._column(parameter, "low")[where] = middle - 0.5 * values
            self._column(parameter, "high")[where] = middle + 0.5 * values
        else:
            self._column(parameter, parameter.field)[where] = values

    def _new_plant(self) -> Plant:
        copies, dofs, axes = self.copies, self.num_dofs, self.num_axes
        frictions, contacts, elements = self.num_frictions, len(self.load.contacts), len(self._motions)
        names = [row.name for row in self.load.contacts]
        carries = np.full(axes + len(self.load.frictions), -1)
        for k, row in enumerate(self.load.frictions):
            if row.carries:
                into = self._merged[k][0] if k in self._merged else axes + k
                carries[into] = names.index(row.carries)
        disturbance = self._combinations([self.load.disturbance])[0]
        return Plant(
            model_address=self.model._address,
            data_address=self.data._address,
            staggered=self.staggered,
            varying=self.varying,
            looking=self._looking,
            constant=self._constant,
            elastic=self._elastic,
            qpos=self.data.qpos,
            qvel=self.data.qvel,
            qfrc_applied=self.data.qfrc_applied,
            qfrc_bias=self.data.qfrc_bias,
            qfrc_passive=self.data.qfrc_passive,
            qfrc_constraint=self.data.qfrc_constraint,
            inertia=self.data.M,
            inertia_start=self.model.M_rowadr.astype(np.int64),
            inertia_count=self.model.M_rownnz.astype(np.int64),
            inertia_column=self.model.M_colind.astype(np.int64),
            dof_armature=self.model.dof_armature,
            qvel_before=np.zeros(self.model.nv),
            ahead=np.zeros(self.model.nv),
            weigh_every=self._weigh_every,
            steps=np.zeros(1, np.int64),
            triangle=np.zeros((dofs, dofs, copies)),
            lane=np.zeros((8, copies)),
            position=np.zeros((dofs, copies)),
            speed=np.zeros((dofs, copies)),
            reached=np.zeros((dofs, copies)),
            applied=np.zeros((dofs, copies)),
            total=np.zeros((dofs, copies)),
            axis_motion=self._combinations(self._motions[:axes]),
            axis_position=self._combinations(
                list(self.load.positions) or [motion_of(self.model, joint, "0/") for joint in self.load.joints]
            ),
            axis_start=self._combinations(self._motions[:axes]) @ self.start,
            axis_kick=np.zeros((axes, dofs, copies)),
            stiffness=np.zeros((dofs, dofs, copies)),
            held=np.zeros((dofs, dofs, copies)),
            held_moment=np.zeros((dofs, axes, copies)),
            spring_zero=np.array(self.model.qpos_spring[:dofs]),
            damping=np.zeros((dofs, copies)),
            bias=np.zeros((dofs, copies)),
            motion=self._combinations(self._motions),
            share=np.zeros((elements, dofs, copies)),
            mass=np.ones((elements, copies)),
            friction=np.zeros((frictions, 8, copies)),
            carries=carries[self._apart()].astype(np.int64),
            bristle=np.zeros((copies, frictions)),
            stuck=np.zeros((frictions, copies), np.int64),
            holding=np.zeros((frictions, copies)),
            contact=np.zeros((contacts, 6, copies)),
            carried=np.zeros((copies, contacts)),
            roll_dof=np.array([self._joints.index(row.joint) for row in self.load.rolls], np.int64),
            roll=np.zeros((copies, len(self.load.rolls), 4)),
            roll_armature=np.zeros((copies, len(self.load.rolls))),
            roll_inertia=np.zeros((copies, len(self.load.rolls))),
            disturbance=np.repeat(disturbance[:, None], copies, axis=1),
            load_torque=np.zeros(copies),
            profile_at=np.zeros(0),
            profile=np.zeros((copies, 0)),
            profile_of_position=False,
            profile_period=0.0,
            profile_now=np.zeros(copies),
            clock=np.zeros(copies),
            brake=np.zeros((axes, copies)),
            diverged=np.zeros(copies, np.int64),
        )

    def _combinations(self, motions: Sequence[Combination]) -> Floats:
        """Return motions as coefficients of the joints, shape (motions, D)."""
        rows = np.zeros((len(motions), self.num_dofs))
        for row, motion in zip(rows, motions, strict=True):
            for joint, coefficient in motion.items():
                row[self._joints.index(joint)] += coefficient
        return rows

    def _apply(self, changed: NDArray[np.bool_] | None = None) -> None:
        """Bring parameters into MuJoCo's model and the plant: stiffness corrected, damping halved, inertias derived.

        What is derived outside MuJoCo is so for the changed copies alone; None is all.
        """
        plant, copies = self.plant, np.arange(self.copies) if changed is None else np.flatnonzero(changed)
        if not len(copies):
            return
        self._place_rotors()
        moving = (self.data.qpos.copy(), self.data.qvel.copy())
        mujoco.mj_setConst(self.model, self.data)
        # At the reference position, so that setting one copy cannot change the rounding of another.
        self.data.qpos[:], self.data.qvel[:] = np.tile(self.start, self.copies), 0.0
        inertia = self.mass_matrix()[copies]
        plant.bias[:, copies] = self._by_copy(self.data.qfrc_bias)[copies].T
        self.data.qpos[:], self.data.qvel[:] = moving
        plant.damping[:] = self._damping.T
        if self.staggered:
            found = corrections(inertia, self._stiffness[copies], plant.axis_motion, self.h)
            self._check_phase(found.phase, found.shapes, copies)
            plant.stiffness[..., copies] = _copies_last(found.stiffness)
            plant.held[..., copies] = _copies_last(found.held)
            plant.held_moment[..., copies] = _copies_last(found.held_moment)
            plant.axis_kick[..., copies] = _copies_last(found.kick)
        # The springs' force is the plant's, since the corrected one is no spring of a joint any more.
        self._by_copy(self.model.jnt_stiffness)[:] = 0.0 if self.staggered else self._stiffness
        self._by_copy(self.model.dof_damping)[:] = self._damping * (0.5 if self.staggered else 1.0)
        inverse = np.linalg.inv(inertia)
        share = np.einsum("cde,fe->fdc", inverse, plant.motion)
        mass = 1.0 / np.einsum("fd,fdc->fc", plant.motion, share)
        plant.mass[:, copies] = mass
        plant.share[..., copies] = share * mass[:, None]
        self._apply_frictions(copies)
        self._apply_contacts(copies)
        plant.roll[:] = self._roll
        dofs = plant.roll_dof
        wound = self._by_copy(self.model.dof_armature)[:, dofs] - plant.roll_armature
        plant.roll_inertia[copies] = inertia[:, dofs, dofs] - wound[copies]

    def _place_rotors(self) -> None:
        """Enter the rotors as armature of their joints or tendons, on the load's side of the gear."""
        armature = self._by_copy(self.model.dof_armature)
        armature[:] = self._passive_armature
        for axis, (name, gear) in enumerate(zip(self.load.joints, self.load.gears, strict=True)):
            values = self._armature[:, axis] * gear**2
            if name in self._joints:
                armature[:, self._joints.index(name)] = values
            else:
                for k, value in enumerate(values):
                    self.model.tendon_armature[self.model.tendon(f"{k}/{name}").id] = value
        for k, row in enumerate(self.load.rolls):
            dof = self._joints.index(row.joint)
            self.plant.roll_armature[:, k] = armature[:, dof]
            start, core, _, density = self._roll[:, k].T
            armature[:, dof] += 0.5 * np.pi * density * (np.maximum(start, core) ** 4 - core**4)

    def _apart(self) -> list[int]:
        """Return which frictions the plant has a row for: the axes' bearings, and those that are not merged in one."""
        loads = range(len(self.load.frictions))
        return [*range(self.num_axes), *(self.num_axes + k for k in loads if k not in self._merged)]

    def _apply_frictions(self, copies: NDArray[np.intp]) -> None:
        chosen, plant = self._model_of_friction, self.plant
        own = self._friction[copies]
        column = {name: own[:, :, k] for k, name in enumerate(FRICTION_COLUMNS)}
        # The motors' bearings keep theirs: it is theirs to be without friction.
        loads = np.arange(own.shape[1]) >= self.num_axes
        coulomb = np.where(loads & (not chosen.dry), 0.0, column["coulomb"])
        risen = np.where(loads & (not chosen.stribeck), column["coulomb"], column["breakaway"])
        breakaway = np.where(loads & (not chosen.dry), 0.0, np.maximum(risen, coulomb))
        viscous = np.where(loads & (not chosen.viscous), 0.0, column["viscous"])
        losses = 1.0 / column["efficiency"] - 1.0
        rows = np.stack([coulomb, breakaway, column["stribeck"], viscous, column["drag"], losses], axis=-1)
        for k, (axis, scale) in self._merged.items():
            # A force F(v) on a motion that is `scale` of the rotor's is a torque of scale F(scale v) there.
            row, turning = rows[:, self.num_axes + k], rows[:, axis]
            powers = np.array([1.0, 1.0, 0.0, 2.0, 3.0, 1.0])
            turning += row * scale**powers * np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])
            turning[:, 2] = row[:, 2] / scale
        rows = rows[:, self._apart()]
        plant.friction[:, :5, copies] = _copies_last(rows[:, :, :5])
        plant.friction[:, 7, copies] = rows[:, :, 5].T
        bristle = column["bristle"][:, self._apart()]
        bristled = loads[self._apart()] & chosen.bristles & (bristle > 0.0)
        stiffness = np.where(bristled, rows[:, :, 1] / np.where(bristled, bristle, 1.0), 0.0)
        plant.friction[:, 5, copies] = stiffness.T
        mass = plant.mass[: self.num_frictions, copies]
        plant.friction[:, 6, copies] = 2.0 * BRISTLE_DAMPING * np.sqrt(stiffness.T * mass)

    def _apply_contacts(self, copies: NDArray[np.intp]) -> None:
        plant, stiffness = self.plant, self._contact[copies, :, 2].T
        plant.contact[:, :4, copies] = _copies_last(self._contact[copies])
        phase = 0.5 * self.h * np.sqrt(stiffness / plant.mass[self.num_frictions :, copies])
        if self.staggered:
            # As in modal.py, for the mode that the spring has while it is pressed.
            plant.contact[:, 2, copies] *= np.sinc(phase / np.pi) ** 2
            plant.contact[:, 4, copies] = np.sinc(2.0 * phase / np.pi) - 1.0
            plant.contact[:, 5, copies] = 2.0 * phase / self.h * np.sin(phase)
        if phase.size and 2.0 * phase.max() > MAX_PHASE_PER_STEP:
            k, worst = np.unravel_index(int(phase.argmax()), phase.shape)
            self._refuse(f"contact {self.load.contacts[int(k)].name!r}", int(copies[worst]), float(phase.max()))

    def _check_phase(self, phase: Floats, shapes: Floats, copies: NDArray[np.intp]) -> None:
        if 2.0 * phase.max() > MAX_PHASE_PER_STEP:
            worst, mode = np.unravel_index(int(phase.argmax()), phase.shape)
            # The joint whose spring takes most of that mode's energy.
            dof = int(np.argmax(self._stiffness[copies[worst]] * shapes[worst, :, mode] ** 2))
            self._refuse(f"joint {self._joints[dof]!r}", int(copies[worst]), float(phase.max()))

    def _refuse(self, what: str, copy_: int, phase: float) -> None:
        raise ValueError(
            f"{what} of machine {self._first_machine + copy_} resonates at {phase / (np.pi * self.h):.0f} Hz; the "
            f"limit is {MAX_PHASE_PER_STEP / (2.0 * np.pi * self.h):.0f} Hz at a physics step of {self.h * 1e6:.0f} "
            "us; lower its stiffness, raise its inertia or take more physics steps per millisecond"
        )


def _copies_last(array: Floats) -> Floats:
    return np.moveaxis(array, 0, -1)


def _proportional(turning: Sequence[Combination], frictions: Sequence[Friction]) -> dict[int, tuple[int, float]]:
    """Return the frictions that act on an axis's own motion, at most one each: index -> axis, motion per rotor's."""
    found: dict[int, tuple[int, float]] = {}
    for k, row in enumerate(frictions):
        for axis, motion in enumerate(turning):
            if set(motion) != set(row.motion) or any(axis == taken for taken, _ in found.values()):
                continue
            scales = [row.motion[joint] / motion[joint] for joint in motion]
            if max(scales) - min(scales) <= 1e-12 * abs(scales[0]):
                found[k] = (axis, abs(scales[0]))
    return found
