"""The recording of a run for a film: the machine's positions and its drives' signals in every communication cycle.

A `Recorder` is used like the drives: `motion` and scripts work with it unchanged.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.dictionary import units
from drive_env.dictionary.codec import decode, encode
from drive_env.dictionary.entries import ObjectName
from drive_env.dictionary.roles import Role
from drive_env.drives.arguments import whole_cycles
from drive_env.drives.interface import CYCLE
from drive_env.trials.positioning import wrapped
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from drive_env.emulator.emulated_drives import EmulatedDrives
    from mechanics.load import Load


POSITION_DEMAND, POSITION, VELOCITY, CURRENT = (
    (cia402.POSITION_DEMAND, 0),
    (cia402.POSITION_ACTUAL, 0),
    (cia402.VELOCITY_ACTUAL, 0),
    (cia402.TORQUE_ACTUAL, 0),
)
TARGET_VELOCITY, TARGET_CURRENT, MODE = (cia402.TARGET_VELOCITY, 0), (cia402.TARGET_TORQUE, 0), (cia402.MODE_DISPLAY, 0)
_RECORDED = (POSITION_DEMAND, POSITION, VELOCITY, CURRENT, TARGET_VELOCITY, TARGET_CURRENT, MODE)
_OF_TORQUE = (CURRENT, TARGET_CURRENT)  # which drives in open loop have not
_PROFILED_MODES = (1, 3, 8)  # pp, pv, csp: 6062h goes on in them, and its slope is the velocity demand
_CSV, _CST = 9, 10


class Recording(NamedTuple):
    """A run of one machine: n samples of D joints and A axes. Motor side, SI; nan for missing values."""

    load: Load
    title: str
    gears: Floats  # (A,) rotor angle per unit of each axis's position [1 or rad/m]
    linear: Mask  # (A,) whether that position is in m, not an angle in rad
    t: Floats  # (n,) [s]
    joints: Floats  # (n, D) [rad or m], in the order of the MJCF
    position_demand: Floats  # (n, A) [rad]
    position: Floats  # (n, A) [rad]
    velocity_demand: Floats  # (n, A) [rad/s]
    velocity: Floats  # (n, A) [rad/s]
    current_demand: Floats  # (n, A) [A], peak i_q
    current: Floats  # (n, A) [A], peak i_q
    load_torque: Floats  # (n,) [N*m, or the load's unit]
    events: tuple[tuple[float, str], ...]  # what happens from when on [s]
    # (n, A) how far a stepper's rotor is behind its steps [full steps]: of one in open loop that is its torque
    lag: Floats | None = None


class Recorder:
    """Emulated drives that record while time advances.

    Args:
        drives: The drives.
        machine: Number of the machine to film.
        period: Time between two calls of `look` [s].

    Raises:
        ValueError: If there is no such machine.
    """

    def __init__(self, drives: EmulatedDrives, machine: int = 0, period: float = CYCLE) -> None:
        if not 0 <= machine < drives.num_machines:
            raise ValueError(f"there is no machine {machine}; there are 0...{drives.num_machines - 1}")
        self.drives = drives
        self.num_axes = drives.num_axes
        self._machine = machine
        self._period = period
        count = drives.num_axes // drives.num_machines
        self._axes = slice(machine * count, (machine + 1) * count)
        known = drives.inside.objects.entries
        self._names = [name for name in _RECORDED if name not in _OF_TORQUE or known.has(name)]
        self._rows: list[Floats] = []
        self._joints: list[Floats] = []
        self._load_torque: list[float] = []
        self._wanted: list[Floats] = []  # position and velocity that a master follows, (2, A), nan where it has none
        self._events: list[tuple[float, str]] = []

    @property
    def now(self) -> float:
        """Recorded time [s]."""
        return len(self._rows) * self._period

    def read(self, name: ObjectName) -> Integers:
        """Return an object of every axis, as the drives do."""
        return self.drives.read(name)

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object, as the drives do."""
        self.drives.write(name, value, where)

    def advance(self, duration: float) -> None:
        """Let time pass [s] and record each communication cycle of 1 ms; ValueError for a part of a cycle."""
        for _ in range(whole_cycles(duration, CYCLE)):
            self._joints.append(self.drives.machine.joint_positions[self._machine])
            self._load_torque.append(float(self.drives.machine.load_torque[self._machine]))
            trace = self.drives.record(self._names, CYCLE)
            self._rows.append(np.array([trace[name][0, self._axes] for name in self._names], np.float64))
            self._wanted.append(np.full((2, self._axes.stop - self._axes.start), np.nan))

    def look(self, wanted: tuple[Floats, Floats] | None = None) -> None:
        """Record the present state; to be called once per period by the code that lets time pass.

        Args:
            wanted: Set-points of a controller in the master, which sends the drives other values: position [inc] and
                velocity [60FFh], (num_axes,) each. None: without such a controller.
        """
        none = np.full(self.num_axes, np.nan)
        self._wanted.append(np.stack([part[self._axes] for part in (wanted or (none, none))]))
        self._joints.append(self.drives.machine.joint_positions[self._machine])
        self._load_torque.append(float(self.drives.machine.load_torque[self._machine]))
        self._rows.append(np.array([self.drives.read(name)[self._axes] for name in self._names], np.float64))

    def mark(self, text: str) -> None:
        """Add a remark from this time on; it is shown beside the machine."""
        self._events.append((self.now, text))

    def recording(self, title: str = "") -> Recording:
        """Return the recording so far.

        Raises:
            ValueError: If no time has passed.
        """
        if not self._rows:
            raise ValueError("nothing was recorded; let time pass with advance() of the recorder")
        drives = self.drives
        raw = np.stack(self._rows)  # (n, objects, A)
        k = {name: raw[:, column] for column, name in enumerate(self._names)}
        nothing = np.full(raw[:, 0].shape, np.nan)
        si = dict.fromkeys(_OF_TORQUE, nothing)
        si |= {name: from_raw(drives, name, values, self._axes) for name, values in k.items() if name != MODE}
        mode = k[MODE]
        lag = None
        if CURRENT not in k and Role.FULL_STEPS in drives.device.roles:
            behind = from_raw(drives, POSITION, wrapped(k[POSITION_DEMAND] - k[POSITION]), self._axes)
            lag = behind / (2.0 * np.pi) * drives.read(Role.FULL_STEPS)[self._axes]
        # From one millisecond to the next, across the end of the counter too.
        slope = wrapped(np.diff(k[POSITION_DEMAND], axis=0, prepend=k[POSITION_DEMAND][:1]))
        profiled = from_raw(drives, POSITION_DEMAND, slope, self._axes) / self._period
        wanted = np.stack(self._wanted)
        followed = from_raw(drives, POSITION_DEMAND, wanted[:, 0], self._axes)
        followed_velocity = from_raw(drives, TARGET_VELOCITY, wanted[:, 1], self._axes)
        velocity_demand = np.where(mode == _CSV, si[TARGET_VELOCITY], np.where(np.isin(mode, _PROFILED_MODES), profiled,
                                                                               followed_velocity))  # fmt: skip
        from mechanics.shaft import way

        found = way(drives.inside.groups[0].load)
        return Recording(
            load=drives.load,
            title=title or f"{drives.load.name} · {drives.motor.name} · {drives.device.name}",
            gears=1.0 / found.position,
            linear=found.linear,
            t=np.arange(len(raw), dtype=np.float64) * self._period,
            joints=np.stack(self._joints),
            position_demand=np.where(np.isin(mode, _PROFILED_MODES[::2]), si[POSITION_DEMAND], followed),
            position=si[POSITION],
            velocity_demand=velocity_demand,
            velocity=si[VELOCITY],
            current_demand=np.where(mode == _CST, si[TARGET_CURRENT], np.nan),
            current=si[CURRENT],
            load_torque=np.array(self._load_torque),
            events=tuple(self._events),
            lag=lag,
        )


def from_raw(drives: EmulatedDrives, name: tuple[int, int], raw: ArrayLike, axes: slice = slice(None)) -> Floats:
    """Return an object's integers [drive units] as SI, axes last."""
    values = np.asarray(raw, np.float64)
    code = drives.codes[name]
    return decode(code, values, code.factor(_context(drives, axes)))


def to_raw(drives: EmulatedDrives, name: tuple[int, int], value: ArrayLike) -> Integers:
    """Return an SI value, one or one per axis, as an object's integers [drive units], saturated at its range."""
    code = drives.codes[name]
    values = np.broadcast_to(np.asarray(value, np.float64), (drives.num_axes,))
    return encode(code, values, code.factor(_context(drives, slice(None))))


def _context(drives: EmulatedDrives, axes: slice) -> units.Context:
    whole = drives.inside.objects.context()
    here: dict[str, Any] = {name: one[axes] for name, one in whole._asdict().items() if isinstance(one, np.ndarray)}
    return whole._replace(**here)
