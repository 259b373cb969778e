"""What all packed models of a load with equally many copies have in common: compiled, looked at and looked up once."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from mechanics.load import Combination, Load
from mechanics.load_values import body_numbers, check_places
from mechanics.model import compile_packed, is_constant, is_constrained, is_varying, motion_of, read_model

Floats = NDArray[np.float64]
_INDICES = NDArray[np.int64]


class Template:
    """A load's packed model before any machine has numbers of its own; thousands of them are made of one template.

    Args:
        load: The row, resolved (model.py).
        copies: Copies of the load in the model.

    Attributes:
        model: MuJoCo's, to be copied and never changed.
        scratch: Data of it, at rest, in which poses of any copy of the model are looked at.
        joints: Names of a copy's joints, in the order of its degrees of freedom.
        turning: Rotor angle of each axis from joints.
        position: What presses each axis's switches, from joints.
        bodies: Element of a parameter -> the number of every copy's body of that name, shape (copies,).
        tendons: The same of the tendons that drives turn.
        constrained, varying, constant: What model.py finds of the load.

    Raises:
        ValueError: If a parameter of the row lives nowhere.
    """

    def __init__(self, load: Load, copies: int) -> None:
        self.copies = copies
        self.model: mujoco.MjModel = compile_packed(load, copies)
        self.scratch = mujoco.MjData(self.model)
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

    def inertia(self, data: mujoco.MjData) -> Floats:
        """Return each copy's inertia matrix, shape (copies, D, D), of data of a copy of the model."""
        entries = data.M.reshape(self.copies, -1)[:, self._entry]
        found = np.zeros((self.copies, self.num_dofs, self.num_dofs))
        found[:, self._row, self._column] = entries
        found[:, self._column, self._row] = entries
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
