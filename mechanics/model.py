"""From a load's MJCF to MuJoCo models: checks it, resolves its joints, and packs copies into one model.

MuJoCo compiles our own models here, and those of others in a process with limits (limited_child.py), which returns the
compiled model: a one-line file may ask for 10^9 bodies.
"""

from __future__ import annotations

import copy
import dataclasses
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from mechanics.arrays import Floats
from mechanics.load import Combination, Friction, Load
from mechanics.model_files import hash_of_model
from mechanics.reading.limited_child import call_limited

MODELS = Path(__file__).parent / "models"  # ours
# Copies in one model. mj_step per copy: 1154 ns alone, 318 in 8, 204 in 64, 199 in 128 (two-mass shaft); a multiple of
# 8, so that every group of machines but the last fills its drives' records.
COPIES_PER_MODEL = 64
# From this number of machines on each thread has enough larger models, and fewer are made: a model and its data take
# Python 1 ms and 600 kB, regardless of size. Number of machines, and number of copies.
COPIES_OF_MANY = ((65_536, 256), (16_384, 128))
# Copies that may have contacts are separated by MuJoCo's 32 contact bits.
CONTACT_BITS = 32
# MuJoCo's solver works on all copies at once and stops at a common tolerance: 4e-13 was measured in 0.6 s of motion.
CONSTRAINED_PACKING_BOUND = 1e-9
_MEMORY_PER_COPY = 2048  # bytes; 64 two-mass copies were measured at 194 each
_MEMORY_PER_CONSTRAINED_COPY = 400_000
_MEMORY_FIXED = 65536
MOST_GEAR = 1e9  # rotor's angle per unit of a joint; squared, it must be a number still
# Numbers of a model that MuJoCo takes although nothing can move by them, and which must not be below 0.
_FINITE = (
    "body_mass", "body_inertia", "dof_damping", "dof_frictionloss", "jnt_stiffness", "jnt_range", "qpos0",
    "qpos_spring", "tendon_damping", "tendon_stiffness", "tendon_frictionloss",
)  # fmt: skip
_NOT_BELOW_0 = ("dof_damping", "dof_frictionloss", "tendon_damping", "tendon_frictionloss")
_MOST_KEPT = 32  # models kept as compiled, each alone
JOINT_TRANSMISSIONS = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_REMEDIES = {  # remedies for MuJoCo's messages
    "mjMINVAL": "give it an <inertial>, or geoms with a mass",
    "package:/": "MuJoCo knows no packages: write where the file lies from the folder of the model",
}
_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)


def read_model(load: Load) -> mujoco.MjModel:
    """Return the load's model alone, as its file has it.

    Raises:
        ValueError: As `read_any_model`, or if it has other joints than hinges and slides.
    """
    return _with_driven_kinds(load, read_any_model(load))


def read_any_model(load: Load) -> mujoco.MjModel:
    """Return a model with any joints; one with other joints than a load's can only be inspected.

    Raises:
        ValueError: If there is no such file, it includes files from elsewhere, it exceeds a limit, or MuJoCo cannot
            read it.
    """
    ours = _is_ours(load.mjcf)
    key = load.name, _text_of(load.mjcf) if ours else _hash_of(load.mjcf)
    kept = _kept.pop(key, None)
    if kept is None:
        kept = _compiled(load, _spec(load)) if ours else _compiled_elsewhere(load, None)
        _check_numbers(load, kept)
    _kept[key] = kept
    while len(_kept) > _MOST_KEPT:
        _kept.popitem(last=False)
    return copy.copy(kept)  # the caller may change it


def resolve(load: Load) -> Load:
    """Return the load with its joints found and everything it names checked against its model.

    Raises:
        ValueError: With the existing joints and tendons.
    """
    model = read_model(load)
    joints = load.joints or tuple(actuators_of(model)) or (_joint_names(model) if model.njnt == 1 else ())
    there = (
        f"the model has the joints {', '.join(_joint_names(model)) or '(none)'} and the fixed tendons "
        f"{', '.join(_fixed_tendons(model)) or '(none)'}"
    )
    if not joints:
        raise ValueError(f"load {load.name!r} does not name the joints that its drives turn; {there}")
    for name in joints:
        if name not in _joint_names(model) and name not in _fixed_tendons(model):
            raise ValueError(f"load {load.name!r} has no joint or fixed tendon {name!r}; {there}")
    if len(set(joints)) < len(joints):
        raise ValueError(f"load {load.name!r} names a joint twice: {', '.join(joints)}; a joint takes one drive")
    gears = _gears(load, model, joints)
    for name in joints:
        _check_turnable(load, model, name)
    load = _without_zeros(load, model, there)
    contacts = [row.name for row in load.contacts]
    for row in load.frictions:
        if row.carries and row.carries not in contacts:
            raise ValueError(
                f"load {load.name!r}: its friction {row.name!r} carries the contact {row.carries!r}; the contacts are "
                f"{', '.join(contacts) or '(none)'}"
            )
    for field in ("positions", "travel"):
        rows = getattr(load, field)
        if rows and len(rows) != len(joints):
            raise ValueError(f"load {load.name!r} has {len(joints)} axes and {len(rows)} {field}; give one per axis")
    return dataclasses.replace(
        load,
        joints=joints,
        gear=gears,
        disturbance=load.disturbance or _motion(model, joints[0]),
        frictions=load.frictions + _joint_friction(model),
        start=load.start or _keyframe(model),
        packing_bound=load.packing_bound or (CONSTRAINED_PACKING_BOUND if is_constrained(model) else 0.0),
    )


def _check_numbers(load: Load, model: mujoco.MjModel) -> None:
    """Raise ValueError for a model with numbers with which its machine would be frozen or would run away by itself."""
    for name in _FINITE:
        values = np.ravel(getattr(model, name))
        if (wrong := values[~np.isfinite(values) | ((name in _NOT_BELOW_0) & (values < 0.0))]).size:
            least = ", 0 or more" if name in _NOT_BELOW_0 else ""
            raise ValueError(f"load {load.name!r}: its {name} of the MJCF has {wrong[0]:g}; give finite numbers{least}")


def _gears(load: Load, model: mujoco.MjModel, joints: tuple[str, ...]) -> tuple[float, ...]:
    """Return the gear of each axis; ValueError for one that turns nothing, with its place in the file."""
    if isinstance(load.gear, tuple) and len(load.gear) != len(joints):
        raise ValueError(
            f"load {load.name!r} has {len(joints)} driven joints and {len(load.gear)} gears; give one each"
        )
    gears = load.gear if isinstance(load.gear, tuple) else (float(load.gear),) * len(joints)
    of_actuators = not load.joints and load.gear == 1.0
    if of_actuators:
        # MuJoCo's gear of an actuator equals ours: the rotor's angle per unit of its joint.
        gears = tuple(actuators_of(model).get(name, 1.0) for name in joints)
    for name, gear in zip(joints, gears, strict=True):
        if not 1.0 / MOST_GEAR <= abs(gear) <= MOST_GEAR:
            where = "the gear of the actuator of" if of_actuators else "the gear of"
            why = "" if gear else ", and its rotor would turn nothing"
            raise ValueError(
                f"load {load.name!r}: {where} {name!r} is {gear:g}{why}; give the rotor's angle per unit of the joint, "
                f"of {1.0 / MOST_GEAR:g} to {MOST_GEAR:g} in size"
            )
    return gears


def _check_turnable(load: Load, model: mujoco.MjModel, name: str) -> None:
    """Raise ValueError for a driven joint or tendon that cannot follow its rotor."""
    motion = _motion(model, name)
    if not motion:
        raise ValueError(
            f"load {load.name!r}: every coef of the fixed tendon {name!r} is 0, and its rotor would turn nothing; give "
            "its joints a coef, or name a joint in its place"
        )
    held = held_joints(model)
    if all(joint in held for joint in motion):
        joint = next(iter(motion))
        raise ValueError(
            f"load {load.name!r}: {held[joint]} holds {joint!r} where it is, and no drive can turn it; give its "
            "polycoef a term of the other joint, as in 0 1 0 0 0, or take it out"
        )


def _without_zeros(load: Load, model: mujoco.MjModel, there: str) -> Load:
    """Return the load without zero coefficients in motions; ValueError for a motion without or of unknown joints."""

    def moving(what: str, motion: Combination) -> Combination:
        for name, coefficient in motion.items():
            if name not in _joint_names(model):
                raise ValueError(f"load {load.name!r}: its {what} names the joint {name!r}; {there}")
            if not np.isfinite(coefficient):
                raise ValueError(
                    f"load {load.name!r}: its {what} has {coefficient:g} of {name!r}; give a finite number"
                )
        found = {name: coefficient for name, coefficient in motion.items() if coefficient != 0.0}
        if motion and not found:
            raise ValueError(
                f"load {load.name!r}: its {what} has 0 of {', '.join(map(repr, motion))}, which is no motion; give a "
                "joint a coefficient that is not 0"
            )
        return found

    for name in load.start:
        moving("start", {name: 1.0})
    for roll in load.rolls:
        moving(f"roll {roll.name!r}", {roll.joint: 1.0})
    return dataclasses.replace(
        load,
        disturbance=moving("disturbance", load.disturbance),
        frictions=tuple(r._replace(motion=moving(f"friction {r.name!r}", r.motion)) for r in load.frictions),
        contacts=tuple(r._replace(motion=moving(f"contact {r.name!r}", r.motion)) for r in load.contacts),
        positions=tuple(moving("position", motion) for motion in load.positions),
    )


def held_joints(model: mujoco.MjModel) -> dict[str, str]:
    """Return the joints that an equality in force holds where they are, each with a text about it."""
    found = {}
    for k in np.flatnonzero((model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & (model.eq_active0 != 0)):
        terms = model.eq_data[k, :5]
        if model.eq_obj2id[k] < 0 or not np.any(terms[1:]):
            name = model.joint(int(model.eq_obj1id[k])).name
            polycoef = " ".join(f"{term:g}" for term in terms)
            found[name] = f"the equality {model.equality(int(k)).name or int(k)!r} with polycoef {polycoef}"
    return found


def copies_per_model(load: Load, machines: int = 1) -> int:
    """Return how many machines of a set one model holds; without constraints results do not depend on it."""
    model = read_model(load)
    if not is_constrained(model):
        return next((copies for many, copies in COPIES_OF_MANY if machines >= many), COPIES_PER_MODEL)
    if not _bits(model):
        return COPIES_PER_MODEL
    return max(CONTACT_BITS // _bits(model) // 8 * 8, 8)


def compile_packed(load: Load, copies: int) -> mujoco.MjModel:
    """Return a model of `copies` copies of the load; elements of copy k are named with the prefix `k/`."""
    if _is_ours(load.mjcf):
        return _packed(load, copies)
    _hash_of(load.mjcf)
    return _compiled_elsewhere(load, copies)


def with_motors(load: Load, gears: Mapping[str, float]) -> str:
    """Return the text of an MJCF of a load's model with drives and gears instead of its actuators.

    It refers to the model's other files by relative paths; included MJCF is in the text.

    Args:
        load: Any model.
        gears: Joint -> rotor angle per unit of it, in the order of the axes.

    Raises:
        ValueError: As `read_model`.
    """
    if _is_ours(load.mjcf):
        return _write_with_motors(load, gears).decode()
    _hash_of(load.mjcf)
    return call_limited(f"the model {load.mjcf}", _write_with_motors, load, dict(gears)).decode()


def check_model(mjcf: Path) -> None:
    """Raise ValueError unless a model may be compiled in this process: it is ours, or was within the limits elsewhere.

    Raises:
        ValueError: As `read_model`, for any joints.
    """
    if not _is_ours(mjcf):
        key = "", _hash_of(mjcf)
        if key not in _harmless:
            call_limited(f"the model {mjcf}", _compile_alone, mjcf)
            _harmless.add(key)


def _packed(load: Load, copies: int) -> mujoco.MjModel:
    alone = _spec(load)
    single = _with_driven_kinds(load, _compiled(load, alone))
    inertias = _inertias(alone, single) if _must_be_told(alone) else []
    packed = mujoco.MjSpec()
    constrained = is_constrained(single)
    packed.memory = _MEMORY_FIXED + (_MEMORY_PER_CONSTRAINED_COPY if constrained else _MEMORY_PER_COPY) * copies
    packed.option = _spec(load).option
    # Visual shapes would be copied with each model and moved at each step. A fluid, though, acts on shapes.
    packed.compiler.discardvisual = not (single.opt.density or single.opt.viscosity)
    bits = _bits(single)
    # Attaching takes as long as the number of elements. Ten by ten, with the names' last digit first, 256 copies take a
    # third to half of the time of one by one.
    for tens in range(-(-copies // 10)):
        ten = mujoco.MjSpec() if tens else packed
        ten.option, ten.compiler.discardvisual = packed.option, packed.compiler.discardvisual
        for k in range(10 * tens, min(10 * tens + 10, copies)):
            ten.attach(_copy(load, k * bits, inertias), prefix=f"{k % 10}/", frame=ten.worldbody.add_frame())
        if tens:
            packed.attach(ten, prefix=str(tens), frame=packed.worldbody.add_frame())
    return _compiled(load, packed)


def is_constrained(model: mujoco.MjModel) -> bool:
    """Return whether MuJoCo's constraint solver has something to do: loops, limits, friction losses, contacts."""
    touching = np.any((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    return bool(
        model.neq
        or np.any(model.jnt_limited)
        or np.any(model.tendon_limited)
        or np.any(model.tendon_frictionloss > 0.0)
        or model.npair
        or touching
    )


def is_varying(model: mujoco.MjModel) -> bool:
    """Return whether inertia or gravity change with the position; tested at random positions."""
    return _changes(model, 1e-4, 0.0)


def is_constant(model: mujoco.MjModel) -> bool:
    """Return whether only the forces of the joints' own springs and dampers change.

    Tested at random positions and speeds.
    """
    return not _changes(model, 1e-9, 1.0)


def actuators_of(model: mujoco.MjModel) -> dict[str, float]:
    """Return the joints and tendons that actuators turn, each with the actuator's gear."""
    tendon = int(mujoco.mjtTrn.mjTRN_TENDON)
    gears: dict[str, float] = {}
    for k in range(model.nu):
        target = int(model.actuator_trnid[k, 0])
        if model.actuator_trntype[k] in (*JOINT_TRANSMISSIONS, tendon):
            turned = model.tendon(target) if model.actuator_trntype[k] == tendon else model.joint(target)
            gears.setdefault(turned.name, float(model.actuator_gear[k, 0]))
    return gears


def motion_of(model: mujoco.MjModel, name: str, prefix: str = "") -> Combination:
    """Return a joint or fixed tendon as a combination of joints, their names without the prefix."""
    found = _motion(model, prefix + name)
    return {joint.removeprefix(prefix): coefficient for joint, coefficient in found.items()}


# --- inside -----------------------------------------------------------------------------------------------------------
def _changes(model: mujoco.MjModel, tolerance: float, speed: float) -> bool:
    """Return whether inertias and forces change by more than the tolerance; speeds of about `speed` [rad/s or m/s]."""
    data = mujoco.MjData(model)
    generator = np.random.default_rng(0)
    seen = []
    largest = np.zeros(model.nv)
    for k in range(5):
        span = np.where(model.jnt_type == _HINGE, np.pi, 1.0)
        low, high = model.jnt_range.T
        ranged = high > low
        share = generator.random(model.nq) if k else np.zeros(model.nq)
        spread = np.where(ranged, low + share * (high - low), (2.0 * share - 1.0) * span)
        data.qpos[:] = spread if k else model.qpos0
        data.qvel[:] = speed * (2.0 * share - 1.0)
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        simple = model.jnt_stiffness * (data.qpos - model.qpos_spring) + model.dof_damping * data.qvel
        others = data.qfrc_passive + simple if speed else np.zeros(model.nv)
        largest = np.maximum(largest, np.abs(data.qfrc_bias) + (np.abs(simple) if speed else 0.0))
        seen.append(np.concatenate([full.ravel(), data.qfrc_bias, others]))
    scale = np.concatenate([np.sqrt(np.outer(np.diag(full), np.diag(full))).ravel(), largest, largest])
    return bool(np.any(np.ptp(np.array(seen), axis=0) > tolerance * scale + 1e-12))


def _inertias(alone: mujoco.MjSpec, single: mujoco.MjModel) -> list[_Inertia]:
    """Return the inertia of each body of a specification in its compiled model; the world is the first."""
    arrays = single.body_mass, single.body_inertia, single.body_ipos, single.body_iquat
    return [_Inertia(*(array[body.id].copy() for array in arrays)) for body in alone.bodies]


def _must_be_told(alone: mujoco.MjSpec) -> bool:
    """Return whether inertias must be written into copies instead of being computed from shapes.

    Visual shapes are left out of copies; MuJoCo keeps their inertia, except if a file demands inertia from shapes in
    any case. A total mass that a file may demand is not that of a copy.
    """
    is_of_shapes = alone.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    return bool(is_of_shapes or alone.compiler.settotalmass > 0.0)


def _tell(spec: mujoco.MjSpec, inertias: list[_Inertia]) -> None:
    """Write inertias into a specification, so that they are not computed from its shapes."""
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    spec.compiler.settotalmass = -1.0
    for body, known in list(zip(spec.bodies, inertias, strict=True))[1:]:
        body.explicitinertial, body.fullinertia = True, np.full(6, np.nan)
        body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        body.mass, body.inertia, body.ipos, body.iquat = known


def _copy(load: Load, shift: int, inertias: list[_Inertia]) -> mujoco.MjSpec:
    """Return the specification of one copy, contact bits shifted; without `inertias` its shapes determine them."""
    child = _spec(load)
    if inertias:
        _tell(child, inertias)
    for actuator in list(child.actuators):
        child.delete(actuator)
    for key in list(child.keys):
        child.delete(key)
    for name in load.joints:
        # The rotor is added later, instead of an armature in the file.
        for joint in child.joints:
            if joint.name == name:
                joint.armature = 0.0
        for tendon in child.tendons:
            if tendon.name == name:
                tendon.armature = 0.0
    for joint in child.joints:
        joint.frictionloss = 0.0  # replaced by friction.py's, see _joint_friction
    for geom in child.geoms:
        geom.contype = _signed(geom.contype << shift)
        geom.conaffinity = _signed(geom.conaffinity << shift)
    return child


class _Inertia(NamedTuple):
    """A compiled body's mass [kg], principal inertias [kg*m^2], position [m] and orientation of its inertial frame."""

    mass: float
    inertia: Floats
    ipos: Floats
    iquat: Floats


_kept: OrderedDict[tuple[str, str], mujoco.MjModel] = OrderedDict()
_harmless: set[tuple[str, str]] = set()


def _is_ours(mjcf: Path) -> bool:
    return mjcf.parent == MODELS


def _text_of(mjcf: Path) -> str:
    return mjcf.read_text(encoding="utf-8") if mjcf.is_file() else ""


def _hash_of(mjcf: Path) -> str:
    """Return the hash of a model's files; ValueError as `hash_of_model`, and if there is no file."""
    if not mjcf.exists():
        raise ValueError(f"there is no model file {str(mjcf)!r}")
    try:
        return hash_of_model(mjcf)
    except OSError as error:
        raise ValueError(f"the model file {str(mjcf)!r} cannot be read: {error.strerror}") from None


def _compiled_elsewhere(load: Load, copies: int | None) -> mujoco.MjModel:
    """Return the model of a load alone, or packed, which another process has compiled."""
    content = call_limited(f"the model {load.mjcf}", _compile_to_bytes, load, copies)
    return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": content})


def _compile_to_bytes(load: Load, copies: int | None) -> bytes:
    model = _compiled(load, _spec(load)) if copies is None else _packed(load, copies)
    mujoco.MjData(model)  # a file may demand memory here, too
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return content.tobytes()


def _write_with_motors(load: Load, gears: Mapping[str, float]) -> bytes:
    spec = _spec(load)
    single = _with_driven_kinds(load, _compiled(load, spec))
    # A file's demand for inertia from shapes is not written, nor that a shape does not count.
    _tell(spec, _inertias(spec, single))
    for body in spec.bodies[1:]:
        for geom in body.geoms if not body.mass else ():
            geom.mass = 0.0
    for sensor in list(spec.sensors):
        if sensor.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR:
            spec.delete(sensor)
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for key in spec.keys:
        key.ctrl = []  # of actuators that no longer exist
    for joint, gear in gears.items():
        motor = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.gear = [gear, 0.0, 0.0, 0.0, 0.0, 0.0]
    _compiled(load, spec)
    return str(spec.to_xml()).encode()


def _compile_alone(mjcf: Path) -> bytes:
    try:
        mujoco.MjData(mujoco.MjModel.from_xml_path(str(mjcf)))
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read {str(mjcf)!r}: {' '.join(str(error).split())}") from None
    return b""


def _spec(load: Load) -> mujoco.MjSpec:
    if not Path(load.mjcf).is_file():
        raise ValueError(f"there is no model file {str(load.mjcf)!r}")
    try:
        spec = mujoco.MjSpec.from_file(str(load.mjcf))
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read {str(load.mjcf)!r}: {' '.join(str(error).split())}") from error
    spec.compiler.fusestatic = False  # of URDF: a copy would not be fused
    return spec


def _compiled(load: Load, spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        told = " ".join(str(error).split())
        remedy = next((f"; {text}" for words, text in _REMEDIES.items() if words in told), "")
        raise ValueError(f"MuJoCo cannot compile load {load.name!r}: {told}{remedy}") from error


def _with_driven_kinds(load: Load, model: mujoco.MjModel) -> mujoco.MjModel:
    """Return the model; ValueError if it has joints of other kinds than a load's, or no joints."""
    wrong = ~np.isin(model.jnt_type, (_SLIDE, _HINGE))
    if np.any(wrong):
        joints = [model.joint(int(k)) for k in np.flatnonzero(wrong)]
        names = ", ".join(
            repr(one.name) if one.name else f"one of body {model.body(int(one.bodyid[0])).name!r}" for one in joints
        )
        raise ValueError(
            f"load {load.name!r} has free or ball joints ({names}); drives turn hinge and slide joints, and a copy's "
            "coordinates must be its degrees of freedom: take a free joint out, so that its body stands still, and "
            "give a ball joint's body three hinges"
        )
    if model.nv == 0:
        raise ValueError(f"load {load.name!r} has no joint, so there is nothing that a drive could turn")
    return model


def _joint_names(model: mujoco.MjModel) -> tuple[str, ...]:
    return tuple(model.joint(k).name for k in range(model.njnt))


def _fixed_tendons(model: mujoco.MjModel) -> tuple[str, ...]:
    names = []
    for k in range(model.ntendon):
        first = model.tendon_adr[k]
        kinds = model.wrap_type[first : first + model.tendon_num[k]]
        if np.all(kinds == int(mujoco.mjtWrap.mjWRAP_JOINT)):
            names.append(model.tendon(k).name)
    return tuple(names)


def _motion(model: mujoco.MjModel, name: str) -> Combination:
    if name in _joint_names(model):
        return {name: 1.0}
    tendon = model.tendon(name).id
    first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
    wrapped = [
        (model.joint(int(model.wrap_objid[k])).name, float(model.wrap_prm[k])) for k in range(first, first + count)
    ]
    return {joint: coefficient for joint, coefficient in wrapped if coefficient != 0.0}


def _joint_friction(model: mujoco.MjModel) -> tuple[Friction, ...]:
    """Return the joints' friction losses as rows: dry friction is computed by friction.py, never also by the solver."""
    rows = []
    for k in range(model.njnt):
        loss = float(model.dof_frictionloss[model.jnt_dofadr[k]])
        if loss > 0.0:
            name = model.joint(k).name
            rows.append(Friction(name, {name: 1.0}, coulomb=loss, breakaway=loss))
    return tuple(rows)


def _keyframe(model: mujoco.MjModel) -> Combination:
    if model.nkey == 0:
        return {}
    return {model.joint(k).name: float(model.key_qpos[0, k]) for k in range(model.njnt)}


def _signed(bits: int) -> int:
    """Return 32 bits as the signed integer that MuJoCo takes."""
    return bits - (1 << CONTACT_BITS) if bits >> (CONTACT_BITS - 1) else bits


def _bits(model: mujoco.MjModel) -> int:
    """Return the number of contact bits that the model uses."""
    used = int(np.bitwise_or.reduce(model.geom_contype | model.geom_conaffinity)) if model.ngeom else 0
    bits = used.bit_length()
    if bits > CONTACT_BITS // 8:
        raise ValueError(
            f"the model uses contact bit {bits - 1}; contact bits distinguish copies of it, so that it may use "
            f"bits 0 to {CONTACT_BITS // 8 - 1} of contype and conaffinity only"
        )
    return bits
