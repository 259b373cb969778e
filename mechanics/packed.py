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

from mechanics.loads import Combination, Load, Parameter
from mechanics.stepping import Plant

Floats = NDArray[np.float64]

# Above this phase per step [rad] the discrete resonance cannot be put at the true one any more with good accuracy.
MAX_PHASE_PER_STEP = 0.7
_FRICTION_COLUMNS = {"coulomb": 1, "breakaway": 2, "stribeck": 3, "viscous": 4}
_DISABLED = (
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    | mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_GRAVITY
    | mujoco.mjtDisableBit.mjDSBL_ACTUATION
    | mujoco.mjtDisableBit.mjDSBL_SENSOR
    | mujoco.mjtDisableBit.mjDSBL_WARMSTART
    | mujoco.mjtDisableBit.mjDSBL_ISLAND
    | mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    # MuJoCo resets a whole model when one copy diverges; stepping.py freezes that copy alone instead.
    | mujoco.mjtDisableBit.mjDSBL_AUTORESET
)
_MEMORY_PER_COPY = 2048  # bytes; 64 two-mass copies were seen to use 194 each
_MEMORY_FIXED = 65536


def compile_packed(load: Load, copies: int) -> mujoco.MjModel:
    """Return a model of `copies` copies of the load; elements of copy k are named with the prefix `k/`."""
    packed = mujoco.MjSpec()
    packed.memory = _MEMORY_FIXED + _MEMORY_PER_COPY * copies
    for k in range(copies):
        child = mujoco.MjSpec.from_file(str(load.mjcf))
        packed.attach(child, prefix=f"{k}/", frame=packed.worldbody.add_frame())
    model = packed.compile()
    if model.nq != model.nv:
        raise ValueError(
            f"load {load.name!r} has {model.nq // copies} coordinates for {model.nv // copies} degrees of freedom; "
            "use hinge and slide joints only"
        )
    return model


class PackedLoad:
    """Copies of a load with parameters of their own, ready to be stepped by compiled code.

    Args:
        load: The row.
        armature: Rotor inertia of each copy's axes [kg*m^2], shape (copies, axes).
        motor_friction: Of each copy's axes, shape (copies, axes, 4): coulomb, breakaway, stribeck, viscous.
        parameters: Parameter name -> values, shape (copies,); others keep the row's default.
        h: Physics step [s].
        integrator: "leapfrog" (implicitfast, staggered) or "rk4", the slower oracle.
        template: Compiled model to copy instead of compiling again.
        first_machine: Number of copy 0, for messages.

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
        template: mujoco.MjModel | None = None,
        first_machine: int = 0,
    ) -> None:
        self.load = load
        self.copies: int = armature.shape[0]
        self.num_axes: int = armature.shape[1]
        self.h = h
        self._first_machine = first_machine
        self.staggered = integrator == "leapfrog"
        self.model = compile_packed(load, self.copies) if template is None else _copy_model(template)
        self.num_dofs = self.model.nv // self.copies
        self._set_options(integrator)
        self._armature = np.array(armature)
        self._joints = [self._joint_name(d) for d in range(self.num_dofs)]
        self._axis_dof = np.array([self._joints.index(axis) for axis in load.axes])
        # A joint's speed times its gear is the rotor's: the bearings' friction acts there.
        self._gears = np.array(load.gears or (1.0,) * self.num_axes)
        turning = [{axis: gear} for axis, gear in zip(load.axes, self._gears, strict=True)]
        self._motions = turning + [f.motion for f in load.frictions]
        self._friction = np.zeros((self.copies, len(self._motions), 5))
        self._friction[:, : self.num_axes, 1:] = motor_friction
        for k, row in enumerate(load.frictions, self.num_axes):
            self._friction[:, k, 1:] = (row.coulomb, row.breakaway, row.stribeck, row.viscous)
        self._stiffness = self._by_copy(self.model.jnt_stiffness).copy()
        self._damping = self._by_copy(self.model.dof_damping).copy()
        for name, values in parameters.items():
            self._store(self._parameter(name), np.asarray(values, float), slice(None))
        self.data = mujoco.MjData(self.model)
        self.plant = self._new_plant()
        self._apply()

    # --- parameters -----------------------------------------------------------------------------------------------
    def get(self, name: str) -> Floats:
        """Return a parameter of every copy, shape (copies,)."""
        parameter = self._parameter(name)
        if parameter.field in _FRICTION_COLUMNS:
            return self._friction[:, self._friction_row(parameter), _FRICTION_COLUMNS[parameter.field]].copy()
        if parameter.field in ("body_inertia", "body_mass"):
            bodies = [self.model.body(f"{k}/{parameter.element}") for k in range(self.copies)]
            return np.array([b.mass[0] if parameter.field == "body_mass" else b.inertia[0] for b in bodies])
        array = self._stiffness if parameter.field == "jnt_stiffness" else self._damping
        return array[:, self._joints.index(parameter.element)].copy()

    def set(self, name: str, values: Floats, where: NDArray[np.bool_]) -> None:
        """Set a parameter of the copies where the mask is true; ValueError leaves all as it was."""
        before = self.get(name)
        parameter = self._parameter(name)
        self._store(parameter, np.asarray(values, float)[where], where)
        try:
            self._apply()
        except ValueError:
            self._store(parameter, before, slice(None))
            self._apply()
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
        self._friction[:, : self.num_axes, 1:] = friction
        self._apply()

    def reset(self, where: NDArray[np.bool_]) -> None:
        """Put the copies where the mask is true to rest at zero; a frozen one lives again."""
        for k in np.flatnonzero(where):
            dofs = slice(k * self.num_dofs, (k + 1) * self.num_dofs)
            self.data.qpos[dofs] = self.model.qpos0[dofs]
            self.data.qvel[dofs] = 0.0
            self.data.qfrc_applied[dofs] = 0.0
            self.plant.diverged[k] = 0
            self.plant.load_torque[k] = 0.0

    def mass_matrix(self) -> Floats:
        """Return each copy's inertia matrix with the rotors', shape (copies, D, D), at the present position."""
        mujoco.mj_forward(self.model, self.data)
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, full)
        blocks = full.reshape(self.copies, self.num_dofs, self.copies, self.num_dofs)
        index = np.arange(self.copies)
        return blocks[index, :, index, :]

    # --- inside ---------------------------------------------------------------------------------------------------
    def _set_options(self, integrator: str) -> None:
        integrators = {
            "leapfrog": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
            "rk4": mujoco.mjtIntegrator.mjINT_RK4,
        }
        if integrator not in integrators:
            raise ValueError(f"no integrator is named {integrator!r}; there are {', '.join(integrators)}")
        self.model.opt.integrator = integrators[integrator]
        self.model.opt.timestep = self.h
        self.model.opt.disableflags = int(_DISABLED)

    def _joint_name(self, dof: int) -> str:
        return str(self.model.joint(int(self.model.dof_jntid[dof])).name).removeprefix("0/")

    def _by_copy(self, array: Floats) -> Floats:
        return array.reshape(self.copies, self.num_dofs)

    def _parameter(self, name: str) -> Parameter:
        for parameter in self.load.parameters:
            if parameter.name == name:
                return parameter
        names = ", ".join(p.name for p in self.load.parameters)
        raise ValueError(f"load {self.load.name!r} has no parameter {name!r}; it has {names}")

    def _friction_row(self, parameter: Parameter) -> int:
        return self.num_axes + tuple(f.name for f in self.load.frictions).index(parameter.element)

    def _store(self, parameter: Parameter, values: Floats, where: slice | NDArray[np.bool_]) -> None:
        if np.any(values < 0.0) or not np.all(np.isfinite(values)):
            raise ValueError(
                f"{parameter.name} of load {self.load.name!r} must be finite and not negative [{parameter.unit}], "
                f"not {values.min():g}"
            )
        if parameter.field in _FRICTION_COLUMNS:
            self._friction[where, self._friction_row(parameter), _FRICTION_COLUMNS[parameter.field]] = values
        elif parameter.field in ("body_inertia", "body_mass"):
            if np.any(values <= 0.0):
                raise ValueError(f"{parameter.name} of load {self.load.name!r} must be above 0 {parameter.unit}")
            copies = np.arange(self.copies)[where]
            for k, value in zip(copies, np.broadcast_to(values, copies.shape), strict=True):
                body = self.model.body(f"{k}/{parameter.element}")
                (body.mass if parameter.field == "body_mass" else body.inertia)[:] = value
        else:
            array = self._stiffness if parameter.field == "jnt_stiffness" else self._damping
            array[where, self._joints.index(parameter.element)] = values

    def _new_plant(self) -> Plant:
        shape = (self.copies, self.num_dofs)
        return Plant(
            model_address=self.model._address,
            data_address=self.data._address,
            staggered=self.staggered,
            qpos=self.data.qpos,
            qvel=self.data.qvel,
            qfrc_applied=self.data.qfrc_applied,
            qvel_before=np.zeros(self.model.nv),
            axis_dof=self._axis_dof.astype(np.int64),
            axis_gear=self._gears,
            axis_inertia=np.zeros((self.copies, self.num_axes)),
            axis_position=self._combinations(self.load.positions or [{axis: 1.0} for axis in self.load.axes]),
            axis_kick=np.zeros((self.copies, self.num_axes, self.num_dofs)),
            stiffness=np.zeros(shape),
            compliance=np.zeros((self.copies, self.num_dofs, self.num_dofs)),
            compliance_moment=np.zeros((self.copies, self.num_dofs, self.num_axes)),
            stuck=np.zeros((self.copies, len(self._motions)), np.int64),
            spring_zero=np.array(self.model.qpos_spring[: self.num_dofs]),
            damping=np.zeros(shape),
            friction_motion=self._combinations(self._motions),
            friction_share=np.zeros((self.copies, len(self._motions), self.num_dofs)),
            friction=np.zeros((self.copies, len(self._motions), 5)),
            bumper_motion=self._combinations([stop.motion for stop in self.load.end_stops]),
            bumper=np.tile(
                np.array([stop[1:] for stop in self.load.end_stops], float).reshape(-1, 4), (self.copies, 1, 1)
            ),
            disturbance=self._combinations([self.load.disturbance])[0],
            load_torque=np.zeros(self.copies),
            diverged=np.zeros(self.copies, np.int64),
        )

    def _combinations(self, motions: Sequence[Combination]) -> Floats:
        """Return motions as coefficients of the joints, shape (motions, D)."""
        rows = np.zeros((len(motions), self.num_dofs))
        for row, motion in zip(rows, motions, strict=True):
            for joint, coefficient in motion.items():
                row[self._joints.index(joint)] = coefficient
        return rows

    def _apply(self) -> None:
        """Bring parameters into MuJoCo's model and the plant: stiffness corrected, damping halved, inertias derived."""
        self._by_copy(self.model.dof_armature)[:, self._axis_dof] = self._armature * self._gears**2
        moving = (self.data.qpos.copy(), self.data.qvel.copy())
        mujoco.mj_setConst(self.model, self.data)
        # At the reference position, so that setting one copy cannot change the rounding of another.
        self.data.qpos[:], self.data.qvel[:] = self.model.qpos0, 0.0
        inverse = np.asarray(np.linalg.inv(self.mass_matrix()), np.float64)
        self.data.qpos[:], self.data.qvel[:] = moving
        phase = np.asarray(0.5 * self.h * np.sqrt(self._stiffness * np.einsum("cdd->cd", inverse)), np.float64)
        if self.staggered and 2.0 * phase.max() > MAX_PHASE_PER_STEP:
            worst, dof = np.unravel_index(int(phase.argmax()), phase.shape)
            resonance = phase.max() / (np.pi * self.h)
            limit = MAX_PHASE_PER_STEP / (2.0 * np.pi * self.h)
            raise ValueError(
                f"joint {self._joints[int(dof)]!r} of machine {self._first_machine + int(worst)} resonates at "
                f"{resonance:.0f} Hz; the limit is {limit:.0f} Hz at a physics step of {self.h * 1e6:.0f} us; lower "
                "its stiffness, raise its inertia or take more physics steps per millisecond"
            )
        # sin(x)/x: the leapfrog puts a resonance too high by x/sin(x); numpy's sinc has pi in it.
        correction = np.sinc(phase / np.pi) ** 2 if self.staggered else np.ones_like(phase)
        self.plant.stiffness[:] = self._stiffness * correction
        self.plant.damping[:] = self._damping
        self._apply_held_torque(phase, inverse)
        self._by_copy(self.model.jnt_stiffness)[:] = self.plant.stiffness
        self._by_copy(self.model.dof_damping)[:] = self._damping * (0.5 if self.staggered else 1.0)
        motion = self.plant.friction_motion
        share = np.einsum("cde,fe->cfd", inverse, motion)
        inertia = 1.0 / np.einsum("fd,cfd->cf", motion, share)
        self.plant.friction_share[:] = share * inertia[:, :, None]
        self.plant.friction[:] = self._friction
        self.plant.friction[:, :, 0] = inertia
        self.plant.axis_inertia[:] = inertia[:, : self.num_axes]

    def _apply_held_torque(self, phase: Floats, inverse: Floats) -> None:
        """Derive what makes torque that is held over a step, or changes within it, act as it does in continuous time.

        The leapfrog takes a step's torque as an impulse in its middle, which excites a resonance by 1/cos(x). Torque
        held over the step excites it by sin(x)/x, and a first moment m of the torque in time moves the rotor by -m/J
        less until the next step and shakes the resonance by m w, x = w h / 2. Solved for force and displacement this
        gives the factors below.
        """
        turning = inverse[:, :, self._axis_dof] * self._gears
        if not self.staggered:
            return
        diagonal = np.einsum("cdd->cd", inverse)[:, :, None]
        self.plant.compliance[:] = (np.sinc(2.0 * phase / np.pi) - 1.0)[:, :, None] * inverse / diagonal
        self.plant.compliance_moment[:] = (2.0 * phase / self.h * np.sin(phase))[:, :, None] * turning / diagonal
        stretch = 1.0 / np.sinc(phase / np.pi) - 1.0
        kick = turning + np.einsum("cde,ce,cea->cda", inverse, stretch, turning / diagonal)
        self.plant.axis_kick[:] = np.swapaxes(kick, 1, 2)


def _copy_model(model: mujoco.MjModel) -> mujoco.MjModel:
    return copy.copy(model)
