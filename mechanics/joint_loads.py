"""The load of a drive on each joint of a model: inertia, holding torque and friction, or why it cannot have a drive."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from mechanics.arrays import Floats
from mechanics.load import Load
from mechanics.model import actuators_of, held_joints, read_any_model
from mechanics.model_files import joints_without_travel
from mechanics.reading.near_names import did_you_mean

POSES = 512  # random poses before the search from the best of them
VALUES = 25  # of one joint, on each line of the search
ROUNDS = 2  # in which every joint is searched once
SLIDE_SPAN = 1.0  # m to each side, searched for a slide without a range
KINDS = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
}
_DRIVEN_KINDS = ("hinge", "slide")
_NOTHING = 1e-12  # kg*m^2 or kg; next to an armature, the share lost in rounding
_STILL = 1e-9  # share of a tendon's change of length with a joint


class Range(NamedTuple):
    """The least and the most of a value over the poses of a model."""

    low: float
    high: float


class JointLoad(NamedTuple):
    """The load of a drive on a joint while the other joints are held; unknown for a joint without a drive.

    Attributes:
        name: Name of the joint.
        kind: "hinge", "slide", "ball" or "free".
        travel: Travel of the joint [rad or m]; infinite without limits.
        inertia: Inertia at the joint, without its armature, which belongs to the rotor [kg*m^2 or kg].
        holding: Torque or force that keeps it at rest: against gravity and springs [N*m or N].
        friction: Dry friction [N*m or N].
        damping: Viscous friction [N*m*s/rad or N*s/m].
        refusal: Why it cannot have a drive, with the remedy; empty if it can.
    """

    name: str
    kind: str
    travel: Range
    inertia: Range = Range(np.nan, np.nan)
    holding: Range = Range(np.nan, np.nan)
    friction: float = np.nan
    damping: float = np.nan
    refusal: str = ""


class _Follower(NamedTuple):
    """A joint that an equality moves with its leader: q - q0 = the sum of c_k (leader - leader0)^k."""

    leader: int
    polynomial: tuple[float, ...]
    equality: str


def joint_loads(load: Load, joints: Collection[str] = ()) -> list[JointLoad]:
    """Return inertia, torques and friction for a drive on each joint of a model, in the order of the file.

    The extremes are searched over the ranges of all joints; over one turn for a hinge without a range.

    Args:
        load: Any model, even one with ball or free joints.
        joints: Joints to drive; by default those of the file's actuators, or all if it has no actuators.

    Raises:
        ValueError: As `read_any_model`, or for an unknown joint.
    """
    model = read_any_model(load)
    names = [str(model.joint(k).name) for k in range(model.njnt)]
    for name in joints:
        if name not in names:
            raise ValueError(
                f"load {load.name!r} has no joint {name!r}{did_you_mean(name, names)}; it has {', '.join(names)}"
            )
    asked = set(joints) or (set(actuators_of(model)) if model.nu else set(names))
    followers = _followers(model, asked)
    refusals = _refusals(load, model, asked, is_chosen=bool(joints), followers=followers)
    found = [JointLoad(name, KINDS[int(model.jnt_type[k])], _travel(model, k)) for k, name in enumerate(names)]
    driven = [k for k in range(model.njnt) if k not in refusals]
    extremes = _extremes(_statics(model, driven, followers), *_limits(model), len(driven))
    for k, (inertia, holding) in zip(driven, extremes, strict=True):
        if inertia.low <= _NOTHING * (1.0 + 1e3 * float(model.dof_armature[model.jnt_dofadr[k]])):
            refusals[k] = "what it turns has no inertia about it: give the bodies behind it mass and inertia"
            continue
        dof = int(model.jnt_dofadr[k])
        loss, damping = float(model.dof_frictionloss[dof]), float(model.dof_damping[dof])
        found[k] = found[k]._replace(inertia=inertia, holding=holding, friction=loss, damping=damping)
    return [row._replace(refusal=refusals.get(k, "")) for k, row in enumerate(found)]


# --- which joints -----------------------------------------------------------------------------------------------------
def _refusals(
    load: Load, model: mujoco.MjModel, asked: Collection[str], is_chosen: bool, followers: Mapping[int, _Follower]
) -> dict[int, str]:
    """Return why joints can have no drive, with the remedy, by the joint's number."""
    tendons, loops, held = _tendon_driven(model), _in_loops(model), held_joints(model)
    still = joints_without_travel(load.mjcf)
    found = {}
    for k in range(model.njnt):
        name, kind = str(model.joint(k).name), KINDS[int(model.jnt_type[k])]
        low, high = model.jnt_range[k]
        reasons = {
            "a free joint moves in six directions, and a drive turns one: take it out, so that its body stands still":
                kind == "free",
            "a ball joint turns about three axes, and a drive turns one: give the body three hinges in its place":
                kind == "ball",
            "it has no name: give it one in the file": not name,
            f"its range is {low:g} to {high:g}, where nothing turns: give it a range, or take the joint out":
                name in still or (not model.jnt_limited[k] and low == high != 0.0),
            f"{held.get(name)} holds it where it is: give that a term of another joint, or take it out": name in held,
            f"it follows {str(model.joint(followers[k].leader).name)!r} by {followers[k].equality}: a drive on "
            "that one moves both" if k in followers else "": k in followers,
            f"its body is in a loop that {loops.get(k)} closes, so that its inertia is not its own: name it in a Load "
            "of your own, with a gear": k in loops,
            f"{tendons.get(name)} pulls it, and how its joints share the motion is not known: name a fixed tendon in a "
            "Load of your own, with a gear, or name the joint (--joint)":
                name in tendons and not (is_chosen and name in asked),
            "no actuator of the file turns it: name it (--joint, or joints= of a Load) if it is to have a drive":
                name not in asked,
        }  # fmt: skip
        reason = next((text for text, is_so in reasons.items() if is_so), "")
        if reason:
            found[k] = reason
    return found


def _tendon_driven(model: mujoco.MjModel) -> dict[str, str]:
    """Return the joints that tendons with actuators move, each with a text about its tendon."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = {}
    for k in np.flatnonzero(model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)):
        tendon = int(model.actuator_trnid[k, 0])
        first, count = int(model.ten_J_rowadr[tendon]), int(model.ten_J_rownnz[tendon])
        moved = np.abs(data.ten_J[first : first + count]) > _STILL
        for dof in model.ten_J_colind[first : first + count][moved]:
            joint = str(model.joint(int(model.dof_jntid[dof])).name)
            found[joint] = f"the tendon {str(model.tendon(tendon).name)!r}"
    return found


def _in_loops(model: mujoco.MjModel) -> dict[int, str]:
    """Return the joints of bodies that an equality closes into a loop, each with a text about it."""
    kinds = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
    found = {}
    for k in np.flatnonzero(np.isin(model.eq_type, kinds) & (model.eq_active0 != 0)):
        ends = [int(model.eq_obj1id[k]), int(model.eq_obj2id[k])]
        if model.eq_objtype[k] == int(mujoco.mjtObj.mjOBJ_SITE):
            ends = [int(model.site_bodyid[end]) for end in ends]
        chains = []
        for body in ends:
            chain = set()
            while body > 0:
                chain.add(body)
                body = int(model.body_parentid[body])
            chains.append(chain)
        for joint in np.flatnonzero(np.isin(model.jnt_bodyid, list(chains[0] ^ chains[1]))):
            found[int(joint)] = f"the equality {str(model.equality(int(k)).name) or int(k)!r}"
    return found


def _followers(model: mujoco.MjModel, asked: Collection[str]) -> dict[int, _Follower]:
    """Return the joints that equalities move with others; of two, the requested one leads if possible."""
    found = {}
    for k in np.flatnonzero((model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & (model.eq_active0 != 0)):
        follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        c = tuple(float(term) for term in model.eq_data[k, :5])
        if leader < 0 or not any(c[1:]):
            continue
        is_asked = [str(model.joint(joint).name) in asked for joint in (follower, leader)]
        if is_asked == [True, False] and c[1] and not any(c[2:]):
            follower, leader, c = leader, follower, (-c[0] / c[1], 1.0 / c[1], 0.0, 0.0, 0.0)
        found[follower] = _Follower(leader, c, f"the equality {str(model.equality(int(k)).name) or int(k)!r}")
    return found


# --- inertia and torque -----------------------------------------------------------------------------------------------
def _travel(model: mujoco.MjModel, joint: int) -> Range:
    if not model.jnt_limited[joint] or KINDS[int(model.jnt_type[joint])] not in _DRIVEN_KINDS:
        return Range(-np.inf, np.inf)
    return Range(*map(float, model.jnt_range[joint]))


def _limits(model: mujoco.MjModel) -> tuple[Floats, Floats]:
    """Return the searched range of each joint's position; ball and free joints stay at their position."""
    at = model.qpos0[model.jnt_qposadr]
    turns = np.array([KINDS[int(kind)] for kind in model.jnt_type])
    span = np.select([turns == "hinge", turns == "slide"], [np.pi, SLIDE_SPAN], 0.0)
    limited = (model.jnt_limited != 0) & (span > 0.0)
    low, high = model.jnt_range.T
    return np.where(limited, low, at - span), np.where(limited, high, at + span)


def _statics(
    model: mujoco.MjModel, driven: list[int], followers: Mapping[int, _Follower]
) -> Callable[[Floats], Floats]:
    """Return the function from positions of the joints to inertias, then holding torques, of the driven ones."""
    # Only inertia and the forces at rest are needed.
    flags = mujoco.mjtDisableBit
    for flag in (flags.mjDSBL_CONTACT, flags.mjDSBL_EQUALITY, flags.mjDSBL_LIMIT, flags.mjDSBL_ACTUATION):
        model.opt.disableflags |= int(flag)
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    moved = np.array([KINDS[int(kind)] in _DRIVEN_KINDS for kind in model.jnt_type])
    dofs = model.jnt_dofadr
    rotors = model.dof_armature[dofs[driven]]

    def statics(position: Floats) -> Floats:
        data.qpos[:] = model.qpos0
        data.qpos[model.jnt_qposadr[moved]] = position[moved]
        along = np.zeros((model.nv, len(driven)))  # speed of every degree of freedom per speed of a driven joint
        along[dofs[driven], range(len(driven))] = 1.0
        for joint, (leader, c, _) in followers.items():
            x = position[leader] - model.qpos0[model.jnt_qposadr[leader]]
            data.qpos[model.jnt_qposadr[joint]] = model.qpos0[model.jnt_qposadr[joint]] + np.polyval(c[::-1], x)
            along[dofs[joint]] = np.polyval(np.polyder(np.array(c[::-1])), x) * along[dofs[leader]]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        inertia = np.einsum("da,de,ea->a", along, full, along) - rotors
        return np.concatenate([inertia, (data.qfrc_bias - data.qfrc_passive) @ along])

    return statics


def _extremes(statics: Callable[[Floats], Floats], low: Floats, high: Floats, axes: int) -> list[tuple[Range, Range]]:
    """Return the ranges of each axis's inertia and holding torque: drawn poses, then joint by joint from the best."""
    if not axes:
        return []
    poses = low + np.random.default_rng(0).random((POSES, len(low))) * (high - low)
    values = np.array([statics(pose) for pose in poses])
    ends = np.zeros((2, values.shape[1]))
    for row, sign in enumerate((-1.0, 1.0)):
        for k in range(values.shape[1]):
            best = int(np.argmax(sign * values[:, k]))
            pose, most = poses[best].copy(), sign * values[best, k]
            for joint in [*range(len(low))] * ROUNDS:
                for value in np.linspace(low[joint], high[joint], VALUES):
                    other = pose.copy()
                    other[joint] = value
                    if (found := sign * statics(other)[k]) > most:
                        pose, most = other, found
            ends[row, k] = sign * most
    ranges = [Range(float(least), float(most)) for least, most in ends.T]
    return list(zip(ranges[:axes], ranges[axes:], strict=True))
