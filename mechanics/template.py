"""The common part of all packed models of a load with the same number of copies, compiled and analysed once."""

from __future__ import annotations

import re
import threading
from collections import OrderedDict
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np

from mechanics.arrays import Floats, Integers
from mechanics.friction import FrictionModel
from mechanics.load import Combination, Friction, Load
from mechanics.load_values import body_numbers, check_places
from mechanics.model import compile_packed, is_constant, is_constrained, is_varying, motion_of, read_model
from mechanics.reading.untrusted import read_bytes

_INDICES = Integers
_MOST_TEMPLATES = 32  # one of 64 copies takes about 6 MB


class Rows(NamedTuple):
    """Frictions, contacts and forces on a load's motions, in the order of the plant's rows; D joints.

    merged: Friction of the load computed together with a bearing's -> axis, its motion per the rotor's. apart:
    Frictions with a row, in the numbering of `LoadValues`: the axes' bearings, and those that are not merged.
    num_frictions: Their number.
    motion: Motions of these frictions and of the contacts, from the joints, shape (num_frictions + contacts, D).
    position: Positions that press each axis's switches, shape (axes, D).
    disturbance: Shape (D,).
    carries: Contact whose force increases each friction, or -1, shape (num_frictions,).
    jammed: For each axis, the friction that holds its load, and its torque or force per rotor torque.
    """

    merged: dict[int, tuple[int, float]]
    apart: list[int]
    num_frictions: int
    motion: Floats
    position: Floats
    disturbance: Floats
    carries: _INDICES
    jammed: list[tuple[int, float]]


class Template:
    """A load's packed model before machines have their own values; thousands of machines use one template.

    Args:
        load: The row, resolved (model.py).
        copies: Copies of the load in the model.

    Attributes:
        model: MuJoCo's model, to be copied and never changed.
        scratch: Its data for computations in any pose, one per thread.
        joints: Names of a copy's joints, in the order of its degrees of freedom.
        turning: Rotor angle of each axis from joints.
        position: Position that presses each axis's switches, from joints.
        bodies: Element of a parameter -> the number of every copy's body of that name, shape (copies,).
        tendons: The same for the driven tendons. constrained, varying, constant: Properties found by model.py.

    Raises:
        ValueError: If a parameter of the row names an unknown element.
    """

    def __init__(self, load: Load, copies: int) -> None:
        self.copies = copies
        self._load = load
        self._rows: dict[bool, Rows] = {}
        self.model: mujoco.MjModel = compile_packed(load, copies)
        self._scratch = threading.local()
        single = read_model(load)
        self.constrained = is_constrained(self.model)
        self.varying = is_varying(single)
        self.constant = not self.constrained and not self.varying and is_constant(single)
        self.num_dofs: int = self.model.nv // copies
        self.joints = [
            str(self.model.joint(int(self.model.dof_jntid[d])).name).removeprefix("0/") for d in range(self.num_dofs)
        ]
        driven = [motion_of(self.model, joint, "0/") for joint in load.joints]
        self.turning: list[Combination] = [
            {name: gear * c for name, c in motion.items()} for motion, gear in zip(driven, load.gears, strict=True)
        ]
        self.position: list[Combination] = list(load.positions) or driven
        check_places(load, self.model, self.joints)
        self.bodies = body_numbers(load, self.model, copies)
        self.tendons: dict[str, _INDICES] = {
            name: np.array([self.model.tendon(f"{k}/{name}").id for k in range(copies)], np.int64)
            for name in load.joints
            if name not in self.joints
        }
        self._row, self._column, self._entry = self._places_of_inertia()

    @cached_property
    def model_arrays(self) -> tuple[str, ...]:
        """Arrays of a copy of the model that a load's parameters change, or that MuJoCo derives from these."""
        return tuple(
            name
            for name in dir(self.model)
            if name.startswith(("body_", "dof_", "jnt_", "tendon_", "efm0_"))
            and isinstance(array := getattr(self.model, name), np.ndarray)
            and array.dtype == float
            and array.size
        )

    @cached_property
    def data_arrays(self) -> tuple[str, ...]:
        """Arrays of a model's data that persist from step to step, without temporary ones."""
        data = mujoco.MjData(self.model)
        arrays = {name: getattr(data, name) for name in dir(data) if not name.startswith("_")}
        return tuple(name for name, array in arrays.items() if isinstance(array, np.ndarray) and array.size)

    @property
    def scratch(self) -> mujoco.MjData:
        """Data of the model, one per thread."""
        if not hasattr(self._scratch, "data"):
            self._scratch.data = mujoco.MjData(self.model)
        return self._scratch.data

    def inertia(self, data: mujoco.MjData) -> Floats:
        """Return each copy's inertia matrix, shape (copies, D, D), of data of a copy of the model."""
        entries = data.M.reshape(self.copies, -1)[:, self._entry]
        found = np.zeros((self.copies, self.num_dofs, self.num_dofs))
        found[:, self._row, self._column] = entries
        found[:, self._column, self._row] = entries
        return found

    def weigh(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Update quantities that a step without constraints derives from masses in a copy of the model, as MuJoCo does.

        `mujoco.mj_setConst` also derives quantities for its constraint solver, in a time that grows with the square of
        the copies: 0.7 ms for 64 shafts of two masses, where this takes 0.1.

        Args:
            model: A copy of this template's, whose bodies' masses or rotors have changed.
            data: Its data; it is left at the reference position.
        """
        bodies = (model.nbody - 1) // self.copies
        subtrees = model.body_subtreemass
        subtrees[:] = model.body_mass
        of_copies = subtrees[1:].reshape(self.copies, bodies)
        parents = model.body_parentid[1 : 1 + bodies]
        for body in reversed(np.flatnonzero(parents).tolist()):
            of_copies[:, parents[body] - 1] += of_copies[:, body]
        # In order from the last to the first: another order rounds differently.
        roots = of_copies[::-1, np.flatnonzero(parents == 0)[::-1]]
        subtrees[0] = np.cumsum(np.append(subtrees[0], roots))[-1]
        if np.any(model.dof_simplenum):
            # The inertias of simple joints are not computed but taken from dof_M0.
            simple = model.dof_simplenum.copy()
            model.dof_simplenum[:] = 0
            data.qpos[:] = model.qpos0
            mujoco.mj_fwdPosition(model, data)
            model.dof_M0[:] = data.M[model.M_rowadr + model.M_rownnz - 1]
            model.dof_simplenum[:] = simple

    def rows(self, friction: FrictionModel) -> Rows:
        """Return the plant's rows under a model of friction."""
        if friction.bristles not in self._rows:
            self._rows[friction.bristles] = self._rows_with(friction.bristles)
        return self._rows[friction.bristles]

    def _rows_with(self, bristles: bool) -> Rows:
        load, axes = self._load, len(self.turning)
        # The bearings' friction acts on the rotors' motions. Friction on a rotor's own motion is computed together with
        # its bearing's, unless it has bristles.
        merged = {} if bristles else _proportional(self.turning, load.frictions)
        apart = [*range(axes), *(axes + k for k in range(len(load.frictions)) if k not in merged)]
        motions = [*self.turning, *(row.motion for row in load.frictions)]
        motions = [motions[k] for k in apart] + [row.motion for row in load.contacts]
        names = [row.name for row in load.contacts]
        carries = np.full(axes + len(load.frictions), -1)
        for k, row in enumerate(load.frictions):
            if row.carries:
                carries[merged[k][0] if k in merged else axes + k] = names.index(row.carries)
        rows = Rows(
            merged=merged,
            apart=apart,
            num_frictions=len(apart),
            motion=self._combinations(motions),
            position=self._combinations(self.position),
            disturbance=self._combinations([load.disturbance])[0],
            carries=carries[apart].astype(np.int64),
            jammed=self._jammed(motions, apart),
        )
        for shared in (rows.motion, rows.position, rows.disturbance, rows.carries):
            shared.flags.writeable = False
        return rows

    def _combinations(self, motions: Sequence[Combination]) -> Floats:
        """Return motions as coefficients of the joints, shape (motions, D)."""
        rows = np.zeros((len(motions), self.num_dofs))
        for row, motion in zip(rows, motions, strict=True):
            for joint, coefficient in motion.items():
                row[self.joints.index(joint)] += coefficient
        return rows

    def _jammed(self, motions: Sequence[Combination], apart: Sequence[int]) -> list[tuple[int, float]]:
        found = []
        for axis in range(len(self.turning)):
            # Motions of the rotor: its own joints, and those that a contact drives from them.
            per_rotor = {name: 1.0 / c for name, c in motions[axis].items()}
            for contact in self._load.contacts:
                if len(contact.motion) > 1 and any(name in per_rotor for name in contact.motion):
                    driver = next(name for name in contact.motion if name in per_rotor)
                    for name, c in contact.motion.items():
                        per_rotor.setdefault(name, -contact.motion[driver] * per_rotor[driver] / c)
            best = (axis, 1.0)
            for row, k in enumerate(apart):
                if k < len(self.turning):
                    continue
                shared = [name for name in motions[row] if name in per_rotor and motions[row][name] != 0.0]
                if shared:
                    best = (row, abs(1.0 / (motions[row][shared[0]] * per_rotor[shared[0]])))
            found.append(best)
        return found

    def _places_of_inertia(self) -> tuple[_INDICES, _INDICES, _INDICES]:
        """Return row, column and place among a copy's numbers of each entry of its matrix's lower triangle."""
        starts, counts = self.model.M_rowadr[: self.num_dofs], self.model.M_rownnz[: self.num_dofs]
        places = [
            (row, int(self.model.M_colind[entry]), entry)
            for row in range(self.num_dofs)
            for entry in range(int(starts[row]), int(starts[row]) + int(counts[row]))
        ]
        row, column, entry = np.array(places, np.int64).T
        return row, column, entry


def template_of(load: Load, copies: int) -> Template:
    """Return a load's template, a cached one if the row and its file are unchanged.

    A model that includes other files is read anew each time.

    Raises:
        ValueError: As `Template`.
    """
    content = read_bytes(load.mjcf) if load.mjcf.is_file() else b""
    if not content or re.search(rb"<include|<replicate|file\s*=", content):
        return Template(load, copies)
    key = (repr(load), content, copies)
    with _lock:
        kept = _templates.pop(key, None)
    kept = Template(load, copies) if kept is None else kept
    with _lock:
        _templates[key] = kept
        while len(_templates) > _MOST_TEMPLATES:
            _templates.popitem(last=False)
    return kept


_templates: OrderedDict[tuple[str, bytes, int], Template] = OrderedDict()
_lock = threading.Lock()


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
