"""Many independent copies of one load in one MuJoCo model.

`mj_step` has a fixed cost of about a microsecond for any model; 64 copies in one model share it. Copies never touch,
and without a constraint solver a copy's result is bit by bit that of the load alone.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import mujoco
import numpy as np
from numpy.typing import NDArray

from mechanics.arrays import Floats, Mask
from mechanics.friction import BRISTLE_DAMPING, FrictionModel, find_friction
from mechanics.load import Load
from mechanics.load_values import FRICTION_COLUMNS, VALUE_ARRAYS, LoadValues
from mechanics.modal import Corrections, corrections
from mechanics.plant import PackedPlant
from mechanics.template import Template, template_of

# Above this phase per step [rad] the corrected resonance is not accurate.
MAX_PHASE_PER_STEP = 0.7
# Damping that couples resonances by more than this per step causes errors above 0.5 % of the peak speed.
MAX_COUPLING_PER_STEP = 0.1
# Machines that are derived together: their matrices stay in the processor's cache.
COPIES_AT_ONCE = 2048
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
        motor_friction: Friction of each copy's axes, shape (copies, axes, 4): coulomb, breakaway, stribeck, viscous.
        parameters: Parameter name -> values, shape (copies,); others keep the row's default.
        h: Physics step [s].
        integrator: "leapfrog" (implicitfast, staggered) or "rk4", the slower oracle.
        friction: Model of the load's friction, a row of friction.py.
        template: Template of this load and number of copies; None: made anew.
        first_machine: Number of copy 0, for messages.
        weigh_every: Steps after which the inertias for friction are updated to the present position.
        ready: Whether to check the parameters and derive the stepped quantities; `pack` does it for many models at
            once.

    Attributes:
        joints: Names of a copy's joints, in the order of its degrees of freedom.
        values: Values of each copy; `set`, `set_motor` and `set_all` change them and the stepped quantities.

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
        ready: bool = True,
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
        self.template = template_of(load, self.copies) if template is None else template
        self.model = copy.copy(self.template.model)
        self.num_dofs = self.template.num_dofs
        self.joints = self.template.joints
        self.constrained = self.template.constrained
        # Runge-Kutta also recomputes everything: it is the oracle.
        self._looking = not self.staggered or self.constrained or self.template.varying
        self._constant = not self._looking and self.template.constant
        # Rolls grow slowly and change only their own inertia; if anything else changes, all is recomputed.
        self._looking |= bool(load.rolls) and not self._constant
        self.varying = self._looking or bool(load.rolls)
        self.model.opt.integrator = _INTEGRATORS[integrator]
        self.model.opt.timestep = h
        self.model.opt.disableflags = int(_DISABLED | (0 if self.constrained else _DISABLED_UNCONSTRAINED))
        if load.rolls:
            # MuJoCo takes the inertia of simple joints from a constant, but a roll's grows.
            self.model.dof_simplenum[:] = 0
        self._rows = self.template.rows(self._model_of_friction)
        self.num_frictions = self._rows.num_frictions
        self._passive_armature = self._by_copy(self.model.dof_armature).copy()
        self.start = np.array(self.model.qpos0[: self.num_dofs])
        for joint, position in load.start.items():
            self.start[self.joints.index(joint)] = position
        self.values = LoadValues(load, self.model, self.joints, self.template.bodies, armature, motor_friction)
        springs = any(p.field == "jnt_stiffness" for p in load.parameters) or bool(np.any(self.values.stiffness))
        self._elastic = self.staggered and springs
        store = self.values.store if ready else self.values.store_checked
        for name, values in parameters.items():
            store(name, np.asarray(values, float), slice(None))
        self.data = mujoco.MjData(self.model)
        self.plant = self._new_plant()
        self._begin = np.zeros((self.copies, self.num_dofs, self.num_dofs))
        if ready:
            self._apply()
            self.reset(np.ones(self.copies, bool))

    # --- parameters -----------------------------------------------------------------------------------------------
    def get(self, name: str) -> Floats:
        """Return a parameter of every copy, shape (copies,)."""
        return self.values.get(name)

    def set(self, name: str, values: Floats, where: Mask) -> None:
        """Set a parameter of the copies where the mask is true; ValueError changes nothing."""
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

        ValueError changes nothing.
        """
        _check_motors(armature, friction)
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

    def set_all(self, parameters: Mapping[str, Floats], where: Mask, armature: Floats, friction: Floats) -> None:
        """Set parameters of the copies where the mask is true, and all motors as `set_motor` does, at once.

        ValueError changes nothing.
        """
        _check_motors(armature, friction)
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

    def reset(self, where: Mask) -> None:
        """Put the copies where the mask is true to rest at their start; a frozen one is released."""
        plant, data = self.plant, self.data
        self._by_copy(data.qpos)[where] = self.start
        if self._elastic:
            self._stagger(where)
        for array in (data.qvel, data.qfrc_applied, data.qacc_warmstart, plant.qvel_before):
            self._by_copy(array)[where] = 0.0
        plant.holding[:, where] = 0.0
        for values in (plant.bristle, plant.carried, plant.diverged, plant.load_torque, plant.clock):
            values[where] = 0

    def set_step(self, h: float, weigh_every: int) -> None:
        """Set the length of physics steps to `h` [s]; arguments as for `__init__`. Motion continues."""
        if self.staggered:  # positions are those in the middle of a step
            self.data.qpos[:] -= 0.5 * (h - self.h) * self.data.qvel
        self.h = self.model.opt.timestep = h
        self.plant.replace(weigh_every=weigh_every)
        self._apply()

    def place(self, joint: int, position: Floats, where: Mask) -> None:
        """Put a joint of the copies where the mask is true to a position [rad or m], shape (copies,), at rest."""
        if self._elastic:
            self._stagger(where, back=True)
        self._by_copy(self.data.qpos)[where, joint] = position[where]
        if self._elastic:
            self._stagger(where)
        for array in (self.data.qvel, self.plant.qvel_before):
            self._by_copy(array)[where, joint] = 0.0

    def jam(self, torque: Floats) -> None:
        """Hold the loads of axes by dry friction that withstands a torque seen from the rotor.

        It acts on the friction of the load that is farthest from the rotor, or on the rotor where the load has none.

        Args:
            torque: Torque for each axis [N*m], shape (copies, axes); 0 releases it.
        """
        plant = self.plant
        held = np.zeros_like(plant.brake)
        for axis, values in enumerate(torque.T):
            row, ratio = self._rows.jammed[axis]
            held[row] = np.maximum(held[row], ratio * values)  # a part driven by two axes is held for both
        plant.jam[:] = held[: self.num_axes]
        plant.brake[self.num_axes :] = held[self.num_axes :]

    def mend(self, name: str, where: Mask) -> None:
        """Rejoin the parts that a stiffness connects, at rest relative to each other, at the rotor's position.

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
            torque: Torque on the load's disturbance [N*m or N].
            of_position: Whether `at` is a position.
            period: Period after which the table repeats; 0: the last value holds.
        """
        self.plant.clock[:] = 0.0
        self.plant.profile_now[:] = 0.0
        self.plant.replace(
            profile_at=np.ascontiguousarray(at, float),
            profile=np.ascontiguousarray(torque, float),
            profile_of_position=of_position,
            profile_period=float(period),
        )

    def save_state(self) -> dict[str, Any]:
        """Return the complete state of the copies: position, speed and parameters, as dicts of arrays."""
        return {
            "model": {name: getattr(self.model, name).copy() for name in self.template.model_arrays},
            "mean_inertia": float(self.model.stat.meaninertia),
            "data": {name: getattr(self.data, name).copy() for name in self.template.data_arrays},
            "values": {name: getattr(self.values, name).copy() for name in VALUE_ARRAYS},
            "plant": self.plant.save_state(),
            "begin": self._begin.copy(),
        }

    def restore_state(self, state: Mapping[str, Any]) -> None:
        """Restore copies of the same load to a result of `save_state`."""
        for own, saved in ((self.model, state["model"]), (self.data, state["data"]), (self.values, state["values"])):
            for name, values in saved.items():
                getattr(own, name)[...] = values
        self.model.stat.meaninertia = state["mean_inertia"]
        self.plant.restore_state(state["plant"])
        self._begin[...] = state["begin"]

    def joint_positions(self) -> Floats:
        """Return the joints' positions [rad or m], shape (copies, D), half a step ago if staggered."""
        return self._by_copy(self.data.qpos).copy()

    # --- inside ---------------------------------------------------------------------------------------------------
    def _by_copy(self, array: Floats) -> Floats:
        return array.reshape(self.copies, self.num_dofs)

    def _stagger(self, where: Mask, *, back: bool = False) -> None:
        """Convert positions at rest of the copies where the mask is true to those of the leapfrog, or back.

        Its spring displacements are half a step later: without this, a spring that starts tense swings too far.
        """
        position, zero = self._by_copy(self.data.qpos), self.plant.spring_zero
        begin = self._begin[where]
        tense = (position[where] - zero)[:, :, None]
        position[where] = zero + (np.linalg.solve(begin, tense) if back else begin @ tense)[:, :, 0]

    def _new_plant(self) -> PackedPlant:
        copies, dofs, axes = self.copies, self.num_dofs, self.num_axes
        rows, frictions, contacts = self._rows, self.num_frictions, len(self.load.contacts)
        elements = len(rows.motion)
        return PackedPlant(
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
            axis_motion=rows.motion[:axes],
            axis_position=rows.position,
            axis_start=rows.motion[:axes] @ self.start,
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
            motion=rows.motion,
            share=np.zeros((elements, dofs, copies)),
            mass=np.ones((elements, copies)),
            friction=np.zeros((frictions, 8, copies)),
            carries=rows.carries,
            bristle=np.zeros((copies, frictions)),
            stuck=np.zeros((frictions, copies), np.int64),
            holding=np.zeros((frictions, copies)),
            contact=np.zeros((contacts, 7, copies)),
            carried=np.zeros((copies, contacts)),
            roll_dof=np.array([self.joints.index(row.joint) for row in self.load.rolls], np.int64),
            roll=np.zeros((copies, len(self.load.rolls), 4)),
            roll_armature=np.zeros((copies, len(self.load.rolls))),
            roll_inertia=np.zeros((copies, len(self.load.rolls))),
            disturbance=np.repeat(rows.disturbance[:, None], copies, axis=1),
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

    def _apply(self, changed: Mask | None = None) -> None:
        """Write the parameters of the changed copies into MuJoCo's model and the plant; None: all copies."""
        if changed is None or np.any(changed):
            _derive([self], None if changed is None else np.flatnonzero(changed))

    def _weigh(self) -> Floats:
        """Write masses and rotors into MuJoCo's model; return each copy's inertia at the start, shape (copies, D, D).

        It is that at the start, so that setting one copy cannot change the rounding of another.
        """
        self._place_rotors()
        data = self.data
        moving = (data.qpos.copy(), data.qvel.copy())
        if self.constrained or self.model.opt.enableflags:
            mujoco.mj_setConst(self.model, data)
        else:
            self.template.weigh(self.model, data)
        self._by_copy(data.qpos)[:], data.qvel[:] = self.start, 0.0
        inertia = self.mass_matrix()
        data.qpos[:], data.qvel[:] = moving
        return inertia

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


def _check_motors(armature: Floats, friction: Floats) -> None:
    if np.any(armature <= 0.0) or np.any(friction < 0.0):
        raise ValueError(
            f"rotor inertia must be above 0 and friction not negative; the least are {armature.min():g} kg*m^2 "
            f"and {friction.min():g}"
        )


def _copies_last(array: Floats) -> Floats:
    return array.transpose(*range(1, array.ndim), 0)


def default_values(load: Load) -> dict[str, float]:
    """Return the value of each of a load's parameters as its row and its model have it; ValueError as `PackedLoad`."""
    one, axes = template_of(load, 1), (1, load.num_axes)
    values = LoadValues(load, one.model, one.joints, one.bodies, np.ones(axes), np.zeros((*axes, 4)))
    return {parameter.name: float(values.get(parameter.name)[0]) for parameter in load.parameters}


def pack(
    load: Load,
    armature: Floats,
    motor_friction: Floats,
    parameters: Mapping[str, Floats],
    h: float,
    *,
    copies: int,
    integrator: str = "leapfrog",
    friction: str = "stribeck",
    weigh_every: int = 1,
) -> list[PackedLoad]:
    """Return machines in packed models of `copies` each, the last one with the rest.

    The result equals single calls of `PackedLoad`, in a third of the time.

    Args:
        load: The row, resolved (model.py).
        armature: Rotor inertia of each machine's axes [kg*m^2], shape (machines, axes).
        motor_friction: Friction of each machine's axes, shape (machines, axes, 4), as in `PackedLoad`.
        parameters: Parameter name -> values, shape (machines,).
        h: Physics step [s].
        copies: Machines in a model.
        integrator: As of `PackedLoad`.
        friction: As of `PackedLoad`.
        weigh_every: As of `PackedLoad`.

    Raises:
        ValueError: As `PackedLoad`.
    """
    templates: dict[int, Template] = {}
    packed: list[PackedLoad] = []
    for first in range(0, len(armature), copies):
        machines = slice(first, first + copies)
        count = len(armature[machines])
        if count not in templates:
            templates[count] = template_of(load, count)
        packed.append(
            PackedLoad(
                load, armature[machines], motor_friction[machines],
                {name: values[machines] for name, values in parameters.items()}, h, integrator=integrator,
                friction=friction, template=templates[count], first_machine=first, weigh_every=weigh_every, ready=False,
            )
        )  # fmt: skip
    for name, values in parameters.items():
        packed[0].values.check(name, values)
    at_once = max(1, COPIES_AT_ONCE // copies)
    for k in range(0, len(packed), at_once):
        _derive(packed[k : k + at_once])
    for one in packed:
        one.reset(np.ones(one.copies, bool))
    return packed


def _derive(loads: Sequence[PackedLoad], changed: NDArray[np.intp] | None = None) -> None:
    """Write parameters into MuJoCo's models and the plants: stiffness corrected, damping halved, inertias derived.

    Args:
        loads: Loads of the same row with the same options.
        changed: Copies of a single load for which the quantities outside MuJoCo are derived; None: all.

    Raises:
        ValueError: For a machine that cannot be stepped.
    """
    first = loads[0]
    copies: slice | NDArray[np.intp] = slice(None) if changed is None else changed
    inertia = np.concatenate([load._weigh()[copies] for load in loads])
    ends = np.cumsum([len(np.arange(load.copies)[copies]) for load in loads])
    parts = [slice(end - count, end) for end, count in zip(ends, np.diff(ends, prepend=0), strict=True)]
    machines = np.concatenate([load._first_machine + np.arange(load.copies)[copies] for load in loads])

    def gathered(name: str) -> Floats:
        return np.concatenate([getattr(load.values, name)[copies] for load in loads])

    for load in loads:
        plant, values = load.plant, load.values
        plant.bias[:, copies] = load._by_copy(load.data.qfrc_bias)[copies].T
        plant.damping[:] = values.damping.T
    motion = first.plant.motion
    stiffness, damping = gathered("stiffness"), gathered("damping")
    # Of each plant's array the copies' part, copies last.
    derived: dict[str, Floats] = {}
    if first.staggered:
        found = corrections(inertia, stiffness, damping, first.plant.axis_motion, first.h)
        _check_phase(first, found, stiffness, machines)
        _check_coupling(first, found, damping, machines)
        derived |= {
            "stiffness": _copies_last(found.stiffness),
            "held": _copies_last(found.held),
            "held_moment": _copies_last(found.held_moment),
            "axis_kick": _copies_last(found.kick),
            "damper": _copies_last(found.damping),
            "ends": _copies_last(found.ends),
            "ends_of_speed": _copies_last(found.ends_of_speed),
        }
    inverse = np.linalg.inv(inertia)
    share = np.einsum("cde,fe->fdc", inverse, motion)
    mass = 1.0 / np.einsum("fd,fdc->fc", motion, share)
    derived |= {"mass": mass, "share": share * mass[:, None]}
    derived["friction"] = _frictions(first, gathered("friction"), mass[: first.num_frictions])
    derived["contact"] = _contacts(first, gathered("contact"), mass[first.num_frictions :], machines)
    for load, part in zip(loads, parts, strict=True):
        plant, values = load.plant, load.values
        if first.staggered:
            load._begin[copies] = found.begin[part]
        # The springs' force is in the plant, since the corrected one is not a spring of a joint.
        load._by_copy(load.model.jnt_stiffness)[:] = 0.0 if load.staggered else values.stiffness
        load._by_copy(load.model.dof_damping)[:] = values.damping * (0.5 if load.staggered else 1.0)
        for name, array in derived.items():
            getattr(plant, name)[..., copies] = array[..., part]
        plant.roll[:] = values.roll
        dofs = plant.roll_dof
        wound = load._by_copy(load.model.dof_armature)[:, dofs] - plant.roll_armature
        plant.roll_inertia[copies] = inertia[part][:, dofs, dofs] - wound[copies]


def _frictions(load: PackedLoad, own: Floats, mass: Floats) -> Floats:
    """Return the plant's rows of friction, shape (F, 8, n), of copies whose frictions are `own` on inertias `mass`."""
    chosen, rows_of = load._model_of_friction, load._rows
    column = {name: own[:, :, k] for k, name in enumerate(FRICTION_COLUMNS)}
    # The motors' bearings are not changed: they may be without friction.
    loads = np.arange(own.shape[1]) >= load.num_axes
    coulomb = np.where(loads & (not chosen.dry), 0.0, column["coulomb"])
    risen = np.where(loads & (not chosen.stribeck), column["coulomb"], column["breakaway"])
    breakaway = np.where(loads & (not chosen.dry), 0.0, np.maximum(risen, coulomb))
    viscous = np.where(loads & (not chosen.viscous), 0.0, column["viscous"])
    losses = 1.0 / column["efficiency"] - 1.0
    rows = np.stack([coulomb, breakaway, column["stribeck"], viscous, column["drag"], losses], axis=-1)
    for k, (axis, scale) in rows_of.merged.items():
        # A force F(v) on a motion of `scale` times the rotor's is a torque of scale F(scale v) there.
        row, turning = rows[:, load.num_axes + k], rows[:, axis]
        powers = np.array([1.0, 1.0, 0.0, 2.0, 3.0, 1.0])
        turning += row * scale**powers * np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])
        turning[:, 2] = row[:, 2] / scale
    rows = rows[:, rows_of.apart]
    bristle = column["bristle"][:, rows_of.apart]
    bristled = loads[rows_of.apart] & chosen.bristles & (bristle > 0.0)
    stiffness = np.where(bristled, rows[:, :, 1] / np.where(bristled, bristle, 1.0), 0.0)
    found = np.empty((rows.shape[1], 8, len(rows)))
    found[:, :5] = _copies_last(rows[:, :, :5])
    found[:, 5] = stiffness.T
    found[:, 6] = 2.0 * BRISTLE_DAMPING * np.sqrt(stiffness.T * mass)
    found[:, 7] = rows[:, :, 5].T
    return found


def _contacts(load: PackedLoad, own: Floats, mass: Floats, machines: NDArray[np.intp]) -> Floats:
    """Return the plant's rows of contacts, shape (B, 7, n), of copies whose contacts are `own` between `mass`."""
    stiffness = own[:, :, 2].T
    found = np.zeros((own.shape[1], 7, len(own)))
    found[:, :4] = _copies_last(own)
    phase = 0.5 * load.h * np.sqrt(stiffness / mass)
    if load.staggered:
        # As in modal.py, for the mode that the spring has while it is pressed.
        found[:, 2] *= np.sinc(phase / np.pi) ** 2
        found[:, 4] = np.sinc(2.0 * phase / np.pi) - 1.0
        found[:, 5] = 2.0 * phase / load.h * np.sin(phase)
        found[:, 6] = np.sinc(phase / np.pi) / np.cos(phase) - 1.0
    if phase.size and 2.0 * phase.max() > MAX_PHASE_PER_STEP:
        k, worst = np.unravel_index(int(phase.argmax()), phase.shape)
        _refuse(load, f"contact {load.load.contacts[int(k)].name!r}", int(machines[worst]), float(phase.max()))
    return found


def _check_phase(load: PackedLoad, found: Corrections, stiffness: Floats, machines: NDArray[np.intp]) -> None:
    if 2.0 * found.phase.max() > MAX_PHASE_PER_STEP:
        worst, mode = np.unravel_index(int(found.phase.argmax()), found.phase.shape)
        # The joint whose spring has most of that mode's energy.
        dof = int(np.argmax(stiffness[worst] * found.shapes[worst, :, mode] ** 2))
        _refuse(load, f"joint {load.joints[dof]!r}", int(machines[worst]), float(found.phase.max()))


def _check_coupling(load: PackedLoad, found: Corrections, damping: Floats, machines: NDArray[np.intp]) -> None:
    limit, coupling = MAX_COUPLING_PER_STEP / load.h, found.coupling
    if np.abs(coupling).max() > limit:
        worst, *modes = (int(k) for k in np.unravel_index(int(np.abs(coupling).argmax()), coupling.shape))
        # The joint whose damper couples those two modes most.
        dof = int(np.argmax(np.abs(damping[worst] * found.shapes[worst][:, modes].prod(axis=1))))
        raise ValueError(
            f"joint {load.joints[dof]!r} of machine {int(machines[worst])} is damped by {damping[worst, dof]:g}, so "
            f"strongly that its resonances brake each other at {np.abs(coupling).max():.0f} 1/s; the limit is "
            f"{limit:.0f} 1/s at a physics step of {load.h * 1e6:.0f} us; lower its damping or take more physics "
            "steps per millisecond"
        )


def _refuse(load: PackedLoad, what: str, machine: int, phase: float) -> NoReturn:
    raise ValueError(
        f"{what} of machine {machine} resonates at {phase / (np.pi * load.h):.0f} Hz; the limit is "
        f"{MAX_PHASE_PER_STEP / (2.0 * np.pi * load.h):.0f} Hz at a physics step of {load.h * 1e6:.0f} us; lower its "
        "stiffness, raise its inertia or take more physics steps per millisecond"
    )
