"""The rows of the loads: complete, resonant where their numbers say so, and honest about energy."""

import dataclasses

import mujoco
import numpy as np
import pytest
from rigs.stepped_load import stepped
from scipy.linalg import eigh, null_space

from drive_env.motors import MOTORS
from mechanics.friction import FRICTION_MODELS
from mechanics.load import Contact, Friction, Roll
from mechanics.loads import LOADS, find_load
from mechanics.model import motion_of
from mechanics.packed import PackedLoad

H = 200e-6  # the default: 5 steps per ms
FINE = 62.5e-6  # 16 steps per ms
J_M = MOTORS["qbl4208"].inertia


def run(load, torque):
    """Return qpos and qvel after every step, (n, copies, D), and contact forces, (n, copies, B); torque (n, C A)."""
    found = stepped(load.plant, torque, load.h)
    shape = (len(torque), load.copies, load.num_dofs)
    return found.qpos.reshape(shape), found.qvel.reshape(shape), found.carried


class Twin:
    """A row's MJCF without the packing, and rotors on its axes by hand: the oracle."""

    def __init__(self, name, rotor=J_M):
        self.load = find_load(name)
        self.model = mujoco.MjModel.from_xml_path(str(self.load.mjcf))
        self.data = mujoco.MjData(self.model)
        self.joints = [self.model.joint(k).name for k in range(self.model.nv)]
        self.axes = np.array(
            [
                gear * self.row(motion_of(self.model, joint))
                for joint, gear in zip(self.load.joints, self.load.gears, strict=True)
            ]
        )
        self.rotors = rotor * self.axes.T @ self.axes

    def row(self, motion):
        """Return a motion as coefficients of the joints."""
        return np.array([motion.get(joint, 0.0) for joint in self.joints])

    def turning(self):
        """Return the joints' speeds per speed of each rotor, (A, D): springs relaxed and backlash taken up."""
        held = [self.row(row.motion) for row in self.load.contacts if row.transmits]
        held += list(np.eye(len(self.joints))[self.model.jnt_stiffness > 0.0])
        return np.linalg.pinv(np.vstack([self.axes, *held]))[:, : len(self.axes)].T

    def near_the_stops(self):
        """Return joints' positions a little before the upper end stops."""
        rows = [(self.row(row.motion), 0.0 if row.transmits else 0.998 * row.high) for row in self.load.contacts]
        rows += [(row, 0.0) for row in np.eye(len(self.joints))[self.model.jnt_stiffness > 0.0]]
        matrix, positions = (np.array(column) for column in zip(*rows, strict=True))
        return dict(zip(self.joints, np.linalg.lstsq(matrix, positions, rcond=None)[0].tolist(), strict=True))

    def inertia(self, qpos):
        """Return the inertia matrix with rotors; rolls as wound there."""
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, full)
        for roll in self.load.rolls:
            turned = self.row({roll.joint: 1.0})
            full += np.outer(turned, turned) * self.wound(roll, turned @ qpos)
        return full + self.rotors

    @staticmethod
    def radius(roll, angle):
        return roll.start + roll.thickness * angle / (2 * np.pi)

    def wound(self, roll, angle):
        """Return what is on the core: a hollow cylinder, J = pi/2 density (r^4 - core^4)."""
        return 0.5 * np.pi * roll.density * (self.radius(roll, angle) ** 4 - roll.core**4)

    def energy(self, qpos, qvel):
        """Return kinetic energy, that of gravity and of the joints' springs [J]."""
        kinetic = 0.5 * qvel @ self.inertia(qpos) @ qvel
        mujoco.mj_energyPos(self.model, self.data)
        return kinetic + self.data.energy[0]


# --- resonances -------------------------------------------------------------------------------------------------------
def frequencies(inertia, stiffness):
    """Return the frequencies of M q'' + K q = 0 [Hz], rigid motions left out."""
    squares = eigh(stiffness, inertia, eigvals_only=True)
    return np.sqrt(squares[squares > 1.0]) / (2 * np.pi)


def extremum(sweep, gain, largest):
    """Return where the gain is largest or smallest [Hz]: a parabola through the logarithm at the extremum."""
    y = np.log(gain) * (1 if largest else -1)
    k = int(np.argmax(y))
    assert 0 < k < len(y) - 1, "the extremum must lie within the sweep"
    a, b, c = y[k - 1 : k + 2]
    return sweep[k] + 0.5 * (a - c) / (a - 2 * b + c) * (sweep[1] - sweep[0])


def amplitude(signal, t, sweep):
    """Return the amplitude of each column at its own frequency, Hann-weighted."""
    window = np.hanning(len(t))[:, None]
    return 2 * np.abs((signal * window * np.exp(-2j * np.pi * t[:, None] * sweep)).sum(axis=0)) / window.sum()


@pytest.mark.every(3)
@pytest.mark.parametrize(
    ("name", "axis", "resonances", "damping"),
    [
        ("two_mass", 0, 1, 1.0),
        ("three_mass", 0, 2, 1.0),
        ("belt", 0, 1, 0.2),  # its damping alone moves the peak by 2 %
        ("gantry", 0, 1, 1.0),
        ("gantry", 1, 1, 1.0),
    ],
)
def test_resonances_and_anti_resonances_lie_where_mass_and_stiffness_put_them(name, axis, resonances, damping):
    """Sine torque in at an axis, its speed out; one frequency per copy. An anti-resonance is a mode with it held."""
    twin = Twin(name)
    inertia, stiffness = twin.inertia(np.zeros(len(twin.joints))), np.diag(twin.model.jnt_stiffness)
    free = null_space(twin.axes[axis : axis + 1])
    expected = [(f, True) for f in frequencies(inertia, stiffness)]
    expected += [(f, False) for f in frequencies(free.T @ inertia @ free, free.T @ stiffness @ free)]
    assert len(expected) == 2 * resonances
    points = 64 // len(expected)
    sweeps = [np.linspace(0.97, 1.03, points) * f for f, _ in expected]
    load = find_load(name)
    axes = load.num_axes
    machine = PackedLoad(load, np.full((64, axes), J_M), np.zeros((64, axes, 4)), {}, H, friction="none")
    machine.set("damping", damping * machine.get("damping"), np.ones(64, bool))
    sweep = np.concatenate(sweeps)
    n = 6000
    t = np.arange(n) * H
    torque = np.zeros((n, 64, axes))
    torque[:, :, axis] = 0.005 * np.sin(2 * np.pi * (t[:, None] + 0.5 * H) * sweep)
    _, qvel, carried = run(machine, torque.reshape(n, -1))
    assert np.all(carried == 0.0)
    speed = qvel @ twin.axes[axis]
    gain = amplitude(speed[n // 2 :], t[n // 2 :] + H, sweep)
    for k, (frequency, largest) in enumerate(expected):
        found = extremum(sweeps[k], gain[k * points : (k + 1) * points], largest)
        print(f"{name} {'anti-' * (not largest)}resonance {frequency:.2f} Hz: {100 * (found / frequency - 1):+.3f} %")
        assert found == pytest.approx(frequency, rel=0.01)


# --- energy -----------------------------------------------------------------------------------------------------------
def at_step_ends(middles):
    """Return positions at the ends of all steps but the last, from those in their middles: cubic interpolation."""
    ends = 0.5 * (middles[:-1] + middles[1:])
    ends[1:-1] = (9.0 * (middles[1:-2] + middles[2:-1]) - middles[:-3] - middles[3:]) / 16.0
    return ends


def friction_power(twin, mass, friction, speed, carried, h):
    """Return the power that friction takes [W], (n, D'): the law at each step's mean speed."""
    model, load = FRICTION_MODELS[friction], twin.load
    total = np.zeros(len(speed))
    for k, row in enumerate(load.frictions):
        v = speed @ twin.row(row.motion)
        size = np.abs(v)
        loss = np.zeros(len(v))
        if row.carries:
            names = [contact.name for contact in load.contacts]
            loss = (1.0 / row.efficiency - 1.0) * np.abs(carried[:, names.index(row.carries)])
        rise = (row.breakaway - row.coulomb) * np.exp(-((v / row.stribeck) ** 2)) * model.stribeck
        dry = row.coulomb * model.dry + rise + loss
        wet = (row.viscous * model.viscous + row.drag * size) * size
        if not model.bristles:
            total += (dry + wet) * size
            continue
        s_0 = row.breakaway / row.bristle
        s_1 = np.sqrt(s_0 * mass[load.num_axes + k])  # damping ratio 0.5 with the mass at the start
        total += bristle_force(v, dry, s_0, s_1, h) * v + wet * size
    return total


def bristle_force(v, dry, s_0, s_1, h):
    """Return LuGre's s_0 z + s_1 dz/dt, mean over each step of constant speed: z relaxes towards dry/s_0 sign(v)."""
    force, z = np.zeros(len(v)), 0.0
    for n, (u, sliding) in enumerate(zip(v.tolist(), dry.tolist(), strict=True)):
        rate = s_0 * abs(u) / sliding
        if rate * h > 1e-9:
            to = np.sign(u) * sliding / s_0
            end = to + (z - to) * np.exp(-rate * h)
            mean = to + (z - end) / (rate * h)
        else:
            end = z + u * h
            mean = z + 0.5 * u * h
        force[n] = s_0 * mean + s_1 * (end - z) / h
        z = end
    return force


def contact_energy(twin, middles, ends, speed, h):
    """Return what is lost in contacts during each step, and what is in their springs at its end [J], (n,) each."""
    lost, stored = np.zeros(len(speed)), np.zeros(len(speed))
    for row in twin.load.contacts:
        deep = lambda x: x - np.clip(x, row.low, row.high)  # noqa: B023, E731
        v, inside = speed @ twin.row(row.motion), deep(middles @ twin.row(row.motion))
        spring = 0.5 * row.stiffness * deep(ends @ twin.row(row.motion)) ** 2
        pushing = (row.stiffness * inside + row.damping * v) * inside > 0.0
        # Where the damper would pull, it parts; what the spring then has it loses in the damper.
        parted = np.maximum(np.append(0.0, spring[:-1]) - spring, 0.0)
        lost += np.where(pushing, row.damping * v**2 * h, parted)
        stored += spring
    return lost, stored


def account(name, h, friction, *, stops=False, pressed=False):
    """Let sines of two frequencies turn every axis for 0.4 s, about what gravity asks; follow where energy goes.

    Args:
        name: Of the load.
        h: Step [s].
        friction: Model of friction.
        stops: Start near the end stops and run into them, again and again.
        pressed: Let so much load force act that nothing crosses its backlash.

    Returns:
        The largest error of the balance as a share of the work done, and the greatest force of each contact.
    """
    twin = Twin(name)
    load, axes = twin.load, twin.load.num_axes
    if stops:
        load = dataclasses.replace(load, start=twin.near_the_stops())
    machine = PackedLoad(load, np.full((1, axes), J_M), np.zeros((1, axes, 4)), {}, h, friction=friction)
    mass = machine.plant.mass[:, 0].copy()
    n = round(0.4 / h)
    t = (np.arange(n) + 0.5) * h
    start = machine.start.copy()
    twin.inertia(start)
    hold = twin.turning() @ (twin.data.qfrc_bias - twin.data.qfrc_passive)
    rate = 2 * np.pi * (11.0 + 1.7 * np.arange(axes))
    torque = hold + 0.05 * np.cos(rate * t[:, None]) + 0.02 * np.cos(5.3 * rate * t[:, None])
    lever = twin.turning() @ twin.row(load.disturbance)
    external = (0.1 if pressed else 0.004) / np.abs(lever).max()
    if pressed:
        torque -= external * lever
    machine.plant.load_torque[:] = external
    qpos, qvel, carried = (x[:, 0] for x in run(machine, torque))
    assert not machine.plant.diverged.any()
    # qpos after a step is the middle of the next.
    middles = np.vstack([start, qpos[:-1]])
    ends = at_step_ends(np.vstack([start, qpos]))
    speed = 0.5 * (np.vstack([np.zeros_like(start), qvel[:-1]]) + qvel)
    push = np.tile(twin.row(load.disturbance), (n, 1))
    brought = np.zeros(n)
    for roll in load.rolls:
        turned = twin.row({roll.joint: 1.0})
        radius = twin.radius(roll, middles @ turned)
        push = radius[:, None] * turned
        # Web arrives with the surface's speed and brings dJ/dt w^2 / 2.
        brought += 0.5 * roll.density * roll.thickness * radius**3 * (speed @ turned) ** 3
    power = (torque * (speed @ twin.axes.T)).sum(axis=1) + external * (push * speed).sum(axis=1)
    lost, springs = contact_energy(twin, middles, ends, speed, h)
    lost += h * (twin.model.dof_damping * speed**2).sum(axis=1)
    lost += h * friction_power(twin, mass, friction, speed, carried, h)
    balance = h * np.cumsum(power + brought) - np.cumsum(lost)
    chosen = np.unique(np.linspace(0, n - 2, 200).astype(int))
    stored = np.array([twin.energy(ends[k], qvel[k]) + springs[k] for k in chosen])
    stored -= twin.energy(start, np.zeros_like(start))
    work = np.abs(h * np.cumsum(power)).max()
    assert np.abs(stored).max() > 0.05 * work
    assert friction == "none" or lost.sum() > 0.2 * work
    error = np.abs(balance[chosen] - stored).max() / work
    print(f"{name}, {h * 1e6:g} us, {friction}: {100 * error:.4f} % of {work:.3f} J")
    return error, np.abs(carried).max(axis=0, initial=0.0)


def is_stop(name):
    return np.array([not contact.transmits for contact in LOADS[name].contacts], bool)


@pytest.mark.every(12)
@pytest.mark.parametrize("friction", list(FRICTION_MODELS))
@pytest.mark.parametrize("name", list(LOADS))
def test_energy_is_accounted_for_at_16_steps_per_millisecond(name, friction):
    """Work of motors and load force = kinetic, gravity's, springs' energy + friction + damping: within 0.1 %."""
    error, carried = account(name, FINE, friction)
    assert error < 1e-3
    assert np.all(carried[is_stop(name)] == 0.0)  # no end stop
    if not np.all(is_stop(name)):
        error, carried = account(name, FINE, friction, pressed=True)
        assert error < 1e-3


@pytest.mark.every(12)
@pytest.mark.parametrize("friction", list(FRICTION_MODELS))
@pytest.mark.parametrize("name", list(LOADS))
def test_energy_is_accounted_for_at_the_default_step_within_the_bound_of_the_row(name, friction):
    """The same, the blows in backlash and end stops included."""
    error, _ = account(name, H, friction)
    assert error < LOADS[name].energy_bound <= 2e-3
    if np.any(is_stop(name)):
        error, carried = account(name, H, friction, stops=True)
        assert np.all(carried[is_stop(name)] > 0.0)
        assert error < LOADS[name].energy_bound


@pytest.mark.parametrize(
    ("name", "start", "speed", "bound"),
    [
        ("cart_pendulum", {"swing": 2.5}, {}, 1e-6),
        ("inverted_pendulum", {"swing": 0.5}, {}, 1e-6),
        ("arm", {"joint": 2.5}, {}, 1e-6),
        ("robot", {"shoulder": 0.3, "elbow": -0.5}, {"base": 3.0, "roll": 20.0, "pitch": 5.0, "turn": -20.0}, 1e-5),
    ],
)
def test_a_machine_left_to_itself_keeps_its_energy(name, start, speed, bound):
    """It falls and swings for 0.3 s at the default step; centrifugal and Coriolis forces do no work."""
    twin = Twin(name)
    load = dataclasses.replace(twin.load, start=start, contacts=())
    axes = load.num_axes
    machine = PackedLoad(load, np.full((1, axes), J_M), np.zeros((1, axes, 4)), {}, H, friction="none")
    machine.data.qvel[:] = machine.plant.qvel_before[:] = first = twin.row(speed)
    # Half a step on, as everywhere: positions lie in the middles of steps.
    begin = machine.start.copy()
    machine.data.qpos[:] += 0.5 * H * first
    qpos, qvel, _ = (x[:, 0] for x in run(machine, np.zeros((1500, axes))))
    ends = at_step_ends(np.vstack([begin + 0.5 * H * first, qpos]))
    before = np.vstack([first, qvel[:-1]])
    lost = H * np.cumsum((twin.model.dof_damping * (0.5 * (before + qvel)) ** 2).sum(axis=1))
    chosen = np.arange(2, len(ends), 10)
    kinetic = np.array([0.5 * qvel[k] @ twin.inertia(ends[k]) @ qvel[k] for k in chosen])
    whole = np.array([twin.energy(ends[k], qvel[k]) for k in chosen]) + lost[chosen]
    error = np.abs(whole - twin.energy(begin, first)).max() / kinetic.max()
    print(f"{name}: {error:.1e} of {kinetic.max():.3f} J")
    assert np.ptp(kinetic) > 0.02 * kinetic.max()
    assert error < bound


@pytest.mark.parametrize(
    ("name", "start"),
    [("robot", {"shoulder": 0.7, "elbow": -0.9, "pitch": 0.5}), ("cart_pendulum", {"swing": 1.2}), ("arm", {}),
     ("winder", {"shaft": 60.0})],
)  # fmt: skip
def test_what_each_motion_weighs_follows_the_pose(name, start):
    """1 / (motion M^-1 motion'), as the compiled step has it after it looked."""
    twin = Twin(name)
    load, axes = dataclasses.replace(twin.load, start=start), twin.load.num_axes
    machine = PackedLoad(load, np.full((1, axes), J_M), np.zeros((1, axes, 4)), {}, H, friction="lugre")
    machine.plant.mass[:] = machine.plant.share[:] = 0.0
    run(machine, np.zeros((1, axes)))
    rows = [*twin.axes, *(twin.row(row.motion) for row in (*load.frictions, *load.contacts))]
    inverse = np.linalg.inv(twin.inertia(machine.start))
    for found, share, row in zip(machine.plant.mass[:, 0], machine.plant.share[:, :, 0], rows, strict=True):
        weight = 1.0 / (row @ inverse @ row)
        assert found == pytest.approx(weight, rel=1e-9)
        np.testing.assert_allclose(share, weight * inverse @ row, rtol=1e-9, atol=1e-12)


def test_a_roll_gains_the_inertia_of_what_is_wound_up():
    """Under a constant torque the speed's slope is the torque over the inertia of the present radius."""
    twin = Twin("winder")
    machine = PackedLoad(twin.load, np.full((1, 1), J_M), np.zeros((1, 1, 4)), {}, H, friction="none")
    torque = np.full((2000, 1), 0.02)
    qpos, qvel, _ = (x[:, 0] for x in run(machine, torque))
    middles = np.vstack([[0.0], qpos[:-1]])
    inertia = np.array([twin.inertia(angle)[0, 0] for angle in middles])
    slope = np.diff(qvel[:, 0], prepend=0.0) / H
    np.testing.assert_allclose(slope, 0.02 * twin.load.gears[0] / inertia, rtol=1e-9)
    assert inertia[-1] > 1.05 * inertia[0]
    assert machine.plant.disturbance[0, 0] == pytest.approx(twin.radius(twin.load.rolls[0], middles[-1, 0]), rel=1e-12)


# --- the rows ---------------------------------------------------------------------------------------------------------
UNITS = {  # of a parameter by where it lives: on a hinge, on a slide
    "body_mass": ("kg", "kg"),
    "body_inertia": ("kg*m^2", "kg*m^2"),
    "body_ipos": ("m", "m"),
    "jnt_stiffness": ("N*m/rad", "N/m"),
    "dof_damping": ("N*m*s/rad", "N*s/m"),
    "coulomb": ("N*m", "N"),
    "breakaway": ("N*m", "N"),
    "viscous": ("N*m*s/rad", "N*s/m"),
    "drag": ("N*m*s^2/rad^2", "N*s^2/m^2"),
    "efficiency": ("1", "1"),
    "gap": ("rad", "m"),
    "contact_stiffness": ("N*m/rad", "N/m"),
    "contact_damping": ("N*m*s/rad", "N*s/m"),
    "start": ("m", "m"),
    "thickness": ("m", "m"),
    "density": ("kg/m^2", "kg/m^2"),
}


def element(load, parameter):
    """Return the row of the load in which a parameter lives, or None for one of the MJCF."""
    rows = (*load.frictions, *load.contacts, *load.rolls)
    if parameter.field in ("body_mass", "body_inertia", "body_ipos", "jnt_stiffness", "dof_damping"):
        return None
    return next(row for row in rows if row.name == parameter.element and parameter.field in FIELDS[type(row)])


FIELDS = {
    Friction: ("coulomb", "breakaway", "viscous", "drag", "efficiency"),
    Contact: ("gap", "contact_stiffness", "contact_damping"),
    Roll: ("start", "thickness", "density"),
}


def test_the_machines_that_are_coupled_to_drives_are_there():
    assert set(LOADS) >= {
        "inertia", "two_mass", "three_mass", "belt", "ball_screw", "vertical_screw", "geared_joint", "arm",
        "cart_pendulum", "inverted_pendulum", "fan", "winder", "gantry", "portal", "robot",
    }  # fmt: skip
    assert {name: row.num_axes for name, row in LOADS.items() if row.num_axes > 1} == {
        "gantry": 2, "portal": 3, "robot": 6,
    }  # fmt: skip


@pytest.mark.parametrize("name", list(LOADS))
def test_a_row_is_complete(name):
    twin = Twin(name)
    load = twin.load
    assert load.name == name
    assert len(load.meaning) > 10
    assert load.disturbance_unit in ("N*m", "N")
    assert load.frictions
    assert all(friction.breakaway >= friction.coulomb > 0.0 for friction in load.frictions)
    contacts = {contact.name: contact for contact in load.contacts}
    assert len(contacts) == len(load.contacts)
    assert all(contacts[friction.carries].transmits for friction in load.frictions if friction.carries)
    assert all(contact.low < contact.high for contact in load.contacts)
    names = [parameter.name for parameter in load.parameters]
    assert len(set(names)) == len(names)
    assert {"coulomb", "breakaway", "viscous"} < set(names)
    for parameter in load.parameters:
        assert 0.0 <= parameter.low <= 1.0 <= parameter.high, parameter
        assert parameter.low < parameter.high, parameter
        assert parameter.meaning, parameter
        row = element(load, parameter)
        joints = [parameter.element] if row is None else [row.joint] if isinstance(row, Roll) else list(row.motion)
        kinds = {int(twin.model.joint(joint).type[0]) for joint in joints if joint in twin.joints}
        slides = int(mujoco.mjtJoint.mjJNT_SLIDE) in kinds
        # The nut's friction is that of a line, though its motion is the screw's angle times its lead.
        assert parameter.unit == UNITS[parameter.field][int(slides)], parameter


@pytest.mark.parametrize("name", list(LOADS))
def test_defaults_are_the_model_file_s_or_the_row_s(name):
    twin = Twin(name)
    axes = twin.load.num_axes
    machine = PackedLoad(twin.load, np.full((1, axes), J_M), np.zeros((1, axes, 4)), {}, H)
    for parameter in twin.load.parameters:
        found, row, model = float(machine.get(parameter.name)[0]), element(twin.load, parameter), twin.model
        if parameter.field.startswith("body_"):
            body = model.body(parameter.element)
            expected = {
                "body_mass": body.mass[0], "body_inertia": body.inertia[0], "body_ipos": np.linalg.norm(body.ipos)
            }[parameter.field]  # fmt: skip
        elif row is None:
            joint = model.joint(parameter.element)
            expected = joint.stiffness[0] if parameter.field == "jnt_stiffness" else joint.damping[0]
        elif parameter.field == "gap":
            expected = row.high - row.low
        else:
            expected = getattr(row, parameter.field.removeprefix("contact_"))
        assert found == pytest.approx(float(expected), rel=1e-12), parameter


@pytest.mark.parametrize("name", list(LOADS))
def test_switches_and_end_stops_bound_the_travel(name):
    load = find_load(name)
    stops = [contact for contact in load.contacts if not contact.transmits]
    ways = [way for way in load.travel if way is not None]
    assert len(load.travel) in (0, load.num_axes)
    assert sorted(ways) == sorted((stop.low, stop.high) for stop in stops)  # an end stop at each end of each travel
    assert all(low < 0.0 < high for low, high in ways)
    for switch in load.switches:
        low, high = load.travel[switch.axis]
        assert low < {"left": switch.high, "right": switch.low, "home": switch.low}[switch.kind] < high
        # A limit switch stays pressed up to the stop and beyond; zero, where an axis starts, is free.
        assert switch.kind != "left" or switch.low < low
        assert switch.kind != "right" or switch.high > high
        assert not switch.low <= 0.0 <= switch.high
    for axis in range(load.num_axes):
        kinds = sorted(switch.kind for switch in load.switches if switch.axis == axis)
        assert kinds in ([], ["home", "left", "right"])
