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
from mechanics.load import Combination, Friction, Load
from mechanics.load_values import FRICTION_COLUMNS, LoadValues
from mechanics.modal import corrections
from mechanics.plant import Plant
from mechanics.template import Template

Floats = NDArray[np.float64]

# Above this phase per step [rad] the discrete resonance cannot be put at the true one any more with good accuracy.
MAX_PHASE_PER_STEP = 0.7
# Damping that couples resonances by more than this per step is off by more than 0.5 % of the peak speed.
MAX_COUPLING_PER_STEP = 0.1
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
        template: Of this load and as many copies, instead of one made anew.
        first_machine: Number of copy 0, for messages.
        weigh_every: Steps after which the inertias that friction sees are brought to the present position.

    Attributes:
        joints: Names of a copy's joints, in the order of its degrees of freedom.
        values: What each copy has of its own; `set`, `set_motor` and `set_all` change it and what is stepped.

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
        template: Template | None = None,
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
        self.template = Template(load, self.copies) if template is None else template
        self.model = copy.copy(self.template.model)
        self.num_dofs = self.template.num_dofs
        self.joints = self.template.joints
        self.constrained = self.template.constrained
        # Runge-Kutta looks at everything anew, too: it is the oracle.
        self._looking = not self.staggered or self.constrained or self.template.varying
        self._constant = not self._looking and self.template.constant
        # Rolls grow slowly and change nothing but their own inertia; where something else does, all is looked at.
        self._looking |= bool(load.rolls) and not self._constant
        self.varying = self._looking or bool(load.rolls)
        self.model.opt.integrator = _INTEGRATORS[integrator]
        self.model.opt.timestep = h
        self.model.opt.disableflags = int(_DISABLED | (0 if self.constrained else _DISABLED_UNCONSTRAINED))
        if load.rolls:
            # MuJoCo takes the inertia of simple joints from a constant; a roll's grows.
            self.model.dof_simplenum[:] = 0
        # The bearings' friction acts on the rotors' motions.
        turning = self.template.turning
        # Friction on a rotor's own motion is computed in one with its bearing's, unless it has bristles.
        self._merged = {} if self._model_of_friction.bristles else _proportional(turning, load.frictions)
        apart = [row.motion for k, row in enumerate(load.frictions) if k not in self._merged]
        self._motions = turning + apart + [row.motion for row in load.contacts]
        self.num_frictions = self.num_axes + len(apart)
        self._passive_armature = self._by_copy(self.model.dof_armature).copy()
        self.start = np.array(self.model.qpos0[: self.num_dofs])
        for joint, position in load.start.items():
            self.start[self.joints.index(joint)] = position
        self.values = LoadValues(load, self.model, self.joints, self.template.bodies, armature, motor_friction)
        springs = any(p.field == "jnt_stiffness" for p in load.parameters) or bool(np.any(self.values.stiffness))
        self._elastic = self.staggered and springs
        for name, values in parameters.items():
            self.values.store(name, np.asarray(values, float), slice(None))
        self.data = mujoco.MjData(self.model)
        self.plant = self._new_plant()
        self._jammed = self._jam_rows()
        self._apply()
        self.reset(np.ones(self.copies, bool))

    # --- parameters -----------------------------------------------------------------------------------------------
    def get(self, name: str) -> Floats:
        """Return a parameter of every copy, shape (copies,)."""
        return self.values.get(name)

    def set(self, name: str, values: Floats, where: NDArray[np.bool_]) -> None:
        """Set a parameter of the copies where the mask is true; ValueError leaves all as it was."""
        before = self.get(name)
        self.values.store(name, np.asarray(values, float)[where], where)
        try:
            self._apply(where)
        except ValueError:
            self.values.store(name, before, slice(None))
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
        before = self.values.armature.copy()
        self.values.armature[:] = armature
        try:
            self._apply()
        except ValueError:
            self.values.armature[:] = before
            self._apply()
            raise
        self.values.motor_friction[:] = friction
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
        motors = self.values.armature.copy(), self.values.motor_friction.copy()
        changed = where | np.any(armature != motors[0], axis=1) | np.any(friction != motors[1], axis=(1, 2))
        try:
            for name, values in parameters.items():
                self.values.store(name, np.asarray(values, float)[where], where)
            self.values.armature[:], self.values.motor_friction[:] = armature, friction
            self._apply(changed)
        except ValueError:
            for name, values in before.items():
                self.values.store(name, values, slice(None))
            self.values.armature[:], self.values.motor_friction[:] = motors
            self._apply(changed)
            raise

    def reset(self, where: NDArray[np.bool_]) -> None:
        """Put the copies where the mask is true to rest at their start; a frozen one lives again."""
        plant, data = self.plant, self.data
        self._by_copy(data.qpos)[where] = self.start
        for array in (data.qvel, data.qfrc_applied, data.qacc_warmstart, plant.qvel_before):
            self._by_copy(array)[where] = 0.0
        plant.holding[:, where] = 0.0
        for values in (plant.bristle, plant.carried, plant.diverged, plant.load_torque, plant.clock):
            values[where] = 0

    def jam(self, torque: Floats) -> None:
        """Hold the loads of axes by dry friction that withstands a torque seen from the rotor.

        It acts on the friction of the load that is farthest from the rotor, or on the rotor where the load has none.

        Args:
            torque: Of each axis [N*m], shape (copies, axes); 0 frees it.
        """
        plant = self.plant
        held = np.zeros_like(plant.brake)
        for axis, values in enumerate(torque.T):
            row, ratio = self._jammed[axis]
            held[row] = np.maximum(held[row], ratio * values)  # a part that two axes drive is held for both
        plant.jam[:] = held[: self.num_axes]
        plant.brake[self.num_axes :] = held[self.num_axes :]

    def mend(self, name: str, where: NDArray[np.bool_]) -> None:
        """Bring the parts that a stiffness joins together again, at rest to each other where the rotor is.

        Args:
            name: Parameter that is the stiffness of a joint or of a contact.
            where: Copies.
        """
        element = next(parameter.element for parameter in self.load.parameters if parameter.name == name)
        position, before = self._by_copy(self.data.qpos), self._by_copy(self.plant.qvel_before)
        speed = self._by_copy(self.data.qvel)
        if element in self.joints:
            dof = self.joints.index(element)
            position[where, dof] = self.plant.spring_zero[dof]
            speed[where, dof] = before[where, dof] = 0.0
            return
        motion = next(row.motion for row in self.load.contacts if row.name == element)
        joint = next(name for name in motion if name not in self.load.joints)
        for array in (position, speed, before):
            others = sum(c * array[where, self.joints.index(name)] for name, c in motion.items() if name != joint)
            array[where, self.joints.index(joint)] = -others / motion[joint]

    def mass_matrix(self) -> Floats:
        """Return each copy's inertia matrix with the rotors', shape (copies, D, D), at the present position."""
        mujoco.mj_forward(self.model, self.data)
        return self.template.inertia(self.data)

    @property
    def armature(self) -> Floats:
        """Rotor inertia of every axis [kg*m^2], shape (copies, axes)."""
        return self.values.armature

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
            axis_position=self._combinations(self.template.position),
            axis_start=self._combinations(self._motions[:axes]) @ self.start,
            axis_kick=np.zeros((axes, dofs, copies)),
            stiffness=np.zeros((dofs, dofs, copies)),
            held=np.zeros((dofs, dofs, copies)),
            held_moment=np.zeros((dofs, axes, copies)),
            damper=np.zeros((dofs, dofs, copies)),
            ends=np.zeros((axes, dofs, copies)),
            ends_of_speed=np.zeros((axes, dofs, copies)),
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
            contact=np.zeros((contacts, 7, copies)),
            carried=np.zeros((copies, contacts)),
            roll_dof=np.array([self.joints.index(row.joint) for row in self.load.rolls], np.int64),
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
            brake=np.zeros((frictions, copies)),
            jam=np.zeros((axes, copies)),
            diverged=np.zeros(copies, np.int64),
        )

    def _combinations(self, motions: Sequence[Combination]) -> Floats:
        """Return motions as coefficients of the joints, shape (motions, D)."""
        rows = np.zeros((len(motions), self.num_dofs))
        for row, motion in zip(rows, motions, strict=True):
            for joint, coefficient in motion.items():
                row[self.joints.index(joint)] += coefficient
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
        self._by_copy(self.data.qpos)[:], self.data.qvel[:] = self.start, 0.0
        inertia = self.mass_matrix()[copies]
        plant.bias[:, copies] = self._by_copy(self.data.qfrc_bias)[copies].T
        self.data.qpos[:], self.data.qvel[:] = moving
        plant.damping[:] = self.values.damping.T
        if self.staggered:
            stiffness, damping = self.values.stiffness[copies], self.values.damping[copies]
            found = corrections(inertia, stiffness, damping, plant.axis_motion, self.h)
            self._check_phase(found.phase, found.shapes, copies)
            self._check_coupling(found.coupling, found.shapes, copies)
            plant.stiffness[..., copies] = _copies_last(found.stiffness)
            plant.held[..., copies] = _copies_last(found.held)
            plant.held_moment[..., copies] = _copies_last(found.held_moment)
            plant.axis_kick[..., copies] = _copies_last(found.kick)
            plant.damper[..., copies] = _copies_last(found.damping)
            plant.ends[..., copies] = _copies_last(found.ends)
            plant.ends_of_speed[..., copies] = _copies_last(found.ends_of_speed)
        # The springs' force is the plant's, since the corrected one is no spring of a joint any more.
        self._by_copy(self.model.jnt_stiffness)[:] = 0.0 if self.staggered else self.values.stiffness
        self._by_copy(self.model.dof_damping)[:] = self.values.damping * (0.5 if self.staggered else 1.0)
        inverse = np.linalg.inv(inertia)
        share = np.einsum("cde,fe->fdc", inverse, plant.motion)
        mass = 1.0 / np.einsum("fd,fdc->fc", plant.motion, share)
        plant.mass[:, copies] = mass
        plant.share[..., copies] = share * mass[:, None]
        self._apply_frictions(copies)
        self._apply_contacts(copies)
        plant.roll[:] = self.values.roll
        dofs = plant.roll_dof
        wound = self._by_copy(self.model.dof_armature)[:, dofs] - plant.roll_armature
        plant.roll_inertia[copies] = inertia[:, dofs, dofs] - wound[copies]

    def _place_rotors(self) -> None:
        """Enter the rotors as armature of their joints or tendons, on the load's side of the gear."""
        armature = self._by_copy(self.model.dof_armature)
        armature[:] = self._passive_armature
        for axis, (name, gear) in enumerate(zip(self.load.joints, self.load.gears, strict=True)):
            values = self.values.armature[:, axis] * gear**2
            if name in self.joints:
                armature[:, self.joints.index(name)] = values
            else:
                self.model.tendon_armature[self.template.tendons[name]] = values
        for k, row in enumerate(self.load.rolls):
            dof = self.joints.index(row.joint)
            self.plant.roll_armature[:, k] = armature[:, dof]
            start, core, _, density = self.values.roll[:, k].T
            armature[:, dof] += 0.5 * np.pi * density * (np.maximum(start, core) ** 4 - core**4)

    def _jam_rows(self) -> list[tuple[int, float]]:
        """Return which friction of the plant holds the load of each axis, and its torque or force per rotor torque."""
        found = []
        apart = self._apart()
        for axis in range(self.num_axes):
            # What moves with the rotor: joints of its own motion, and those that a contact drives from them.
            per_rotor = {name: 1.0 / c for name, c in self._motions[axis].items()}
            for contact in self.load.contacts:
                if len(contact.motion) > 1 and any(name in per_rotor for name in contact.motion):
                    driver = next(name for name in contact.motion if name in per_rotor)
                    for name, c in contact.motion.items():
                        per_rotor.setdefault(name, -contact.motion[driver] * per_rotor[driver] / c)
            best = (axis, 1.0)
            for row, k in enumerate(apart):
                if k < self.num_axes:
                    continue
                shared = [name for name in self._motions[row] if name in per_rotor and self._motions[row][name] != 0.0]
                if shared:
                    best = (row, abs(1.0 / (self._motions[row][shared[0]] * per_rotor[shared[0]])))
            found.append(best)
        return found

    def _apart(self) -> list[int]:
        """Return which frictions the plant has a row for: the axes' bearings, and those that are not merged in one."""
        loads = range(len(self.load.frictions))
        return [*range(self.num_axes), *(self.num_axes + k for k in loads if k not in self._merged)]

    def _apply_frictions(self, copies: NDArray[np.intp]) -> None:
        chosen, plant = self._model_of_friction, self.plant
        own = self.values.friction[copies]
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
        plant, stiffness = self.plant, self.values.contact[copies, :, 2].T
        plant.contact[:, :4, copies] = _copies_last(self.values.contact[copies])
        phase = 0.5 * self.h * np.sqrt(stiffness / plant.mass[self.num_frictions :, copies])
        if self.staggered:
            # As in modal.py, for the mode that the spring has while it is pressed.
            plant.contact[:, 2, copies] *= np.sinc(phase / np.pi) ** 2
            plant.contact[:, 4, copies] = np.sinc(2.0 * phase / np.pi) - 1.0
            plant.contact[:, 5, copies] = 2.0 * phase / self.h * np.sin(phase)
            plant.contact[:, 6, copies] = np.sinc(phase / np.pi) / np.cos(phase) - 1.0
        if phase.size and 2.0 * phase.max() > MAX_PHASE_PER_STEP:
            k, worst = np.unravel_index(int(phase.argmax()), phase.shape)
            self._refuse(f"contact {self.load.contacts[int(k)].name!r}", int(copies[worst]), float(phase.max()))

    def _check_phase(self, phase: Floats, shapes: Floats, copies: NDArray[np.intp]) -> None:
        if 2.0 * phase.max() > MAX_PHASE_PER_STEP:
            worst, mode = np.unravel_index(int(phase.argmax()), phase.shape)
            # The joint whose spring takes most of that mode's energy.
            dof = int(np.argmax(self.values.stiffness[copies[worst]] * shapes[worst, :, mode] ** 2))
            self._refuse(f"joint {self.joints[dof]!r}", int(copies[worst]), float(phase.max()))

    def _check_coupling(self, coupling: Floats, shapes: Floats, copies: NDArray[np.intp]) -> None:
        limit = MAX_COUPLING_PER_STEP / self.h
        if np.abs(coupling).max() > limit:
            worst, *modes = (int(k) for k in np.unravel_index(int(np.abs(coupling).argmax()), coupling.shape))
            damping = self.values.damping[copies[worst]]
            # The joint whose damper couples those two modes most.
            dof = int(np.argmax(np.abs(damping * shapes[worst][:, modes].prod(axis=1))))
            raise ValueError(
                f"joint {self.joints[dof]!r} of machine {self._first_machine + int(copies[worst])} is damped by "
                f"{damping[dof]:g}, so strongly that its resonances brake each other at {np.abs(coupling).max():.0f} "
                f"1/s; the limit is {limit:.0f} 1/s at a physics step of {self.h * 1e6:.0f} us; lower its damping or "
                "take more physics steps per millisecond"
            )

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
