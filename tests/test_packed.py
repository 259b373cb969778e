"""Copies packed into one model: each is what it would be alone, and one that leaves physics leaves alone."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion
from mechanics import loads
from mechanics.compiled import cached
from mechanics.loads import LOADS
from mechanics.packed import PackedLoad
from mechanics.stepping import step

STEPS = 1000
COPY = 5


@cached(Path(loads.__file__).parent)
def step_plant(plant, torque, h, motion_):
    """Step all copies through torques (n, C); write angle, speed and reaction of each, shape (n, 3, C)."""
    moment, position = np.zeros((2, torque.shape[1]))
    for n in range(torque.shape[0]):
        step(plant, torque[n], moment, h, motion_[n, 0], motion_[n, 1], motion_[n, 2], position)


def parameters(name, copies):
    """Return parameters that differ from copy to copy; copy k of a larger set is copy k of a smaller one."""
    rows = LOADS[name].parameters
    shares = np.random.default_rng(1).random((copies, len(rows) + 2))
    single = PackedLoad(LOADS[name], np.full((1, 1), 4e-6), np.zeros((1, 1, 4)), {}, 50e-6)
    values = {p.name: single.get(p.name) * (p.low + shares[:, k] * (p.high - p.low)) for k, p in enumerate(rows)}
    armature = 4e-6 + 2e-6 * shares[:, -1:]
    bearing = np.zeros((copies, 1, 4))
    bearing[:, 0, :2] = 2e-3 * shares[:, -2:-1]
    bearing[:, 0, 2] = 1.0
    return values, armature, bearing


def torques(copies):
    """Return torques that differ from copy to copy, (STEPS, copies)."""
    amplitudes = np.random.default_rng(2).uniform(0.005, 0.05, copies)
    levels = np.repeat(np.random.default_rng(3).uniform(-1, 1, STEPS // 50), 50)
    return levels[:, None] * amplitudes


def simulate(name, chosen, copies, integrator):
    """Return the motion of the chosen copies of a set of `copies`, (STEPS, 3, chosen), and their final qpos."""
    values, armature, bearing = parameters(name, copies)
    load = PackedLoad(
        LOADS[name],
        armature[chosen],
        bearing[chosen],
        {key: value[chosen] for key, value in values.items()},
        200e-6,
        integrator=integrator,
    )
    load.plant.load_torque[:] = 0.01 * np.arange(copies)[chosen] / copies
    assert len(set(load.get("viscous"))) == load.copies
    found = np.zeros((STEPS, 3, load.copies))
    step_plant(load.plant, np.ascontiguousarray(torques(copies)[:, chosen]), 200e-6, found)
    return found, load.data.qpos.reshape(load.copies, -1).copy()


@pytest.mark.parametrize("integrator", ["leapfrog", "rk4"])
@pytest.mark.parametrize("name", sorted(LOADS))
@pytest.mark.parametrize("copies", [8, 64])
def test_a_copy_is_bit_for_bit_the_load_alone(name, integrator, copies):
    packed, packed_qpos = simulate(name, np.arange(copies), copies, integrator)
    alone, alone_qpos = simulate(name, np.array([COPY]), copies, integrator)
    assert np.abs(alone[:, 1]).max() > 5  # it moved
    assert np.array_equal(packed[:, :, COPY], alone[:, :, 0])
    assert np.array_equal(packed_qpos[COPY], alone_qpos[0])
    assert not np.array_equal(packed[:, :, COPY], packed[:, :, COPY + 1])


def test_every_copy_of_eight_is_itself_alone():
    packed, _ = simulate("two_mass", np.arange(8), 8, "leapfrog")
    for k in range(8):
        alone, _ = simulate("two_mass", np.array([k]), 8, "leapfrog")
        assert np.array_equal(packed[:, :, k], alone[:, :, 0])


def test_a_template_gives_the_same_model_and_shares_no_memory():
    values, armature, bearing = parameters("two_mass", 8)
    first = PackedLoad(LOADS["two_mass"], armature, bearing, values, 200e-6)
    second = PackedLoad(LOADS["two_mass"], armature, bearing, values, 200e-6, template=first.model)
    assert np.array_equal(first.mass_matrix(), second.mass_matrix())
    second.set("inertia", np.full(8, 9e-5), np.ones(8, bool))
    assert np.array_equal(first.get("inertia"), values["inertia"])


# --- divergence -------------------------------------------------------------------------------------------------------
SICK = 3
OBJECTS = [0x6064, 0x606C, 0x6077, 0x6041]


def running(num_machines=6, load="two_mass"):
    drives = EmulatedDrives(load=load, num_machines=num_machines, seed=4, randomise=["load", "motor"])
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 600_000)
    drives.advance(0.05)
    return drives


@pytest.mark.parametrize("load", sorted(LOADS))
@pytest.mark.parametrize("torque", [1e8, -1e8, 1e12, np.inf])
def test_a_diverging_machine_is_frozen_alone(load, torque, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a log file where it stands
    healthy, drives = running(load=load), running(load=load)
    reference = healthy.record(OBJECTS, 0.2)
    torques_ = np.zeros(6)
    torques_[SICK] = torque
    drives.machine.load_torque = torques_
    with pytest.warns(RuntimeWarning, match=rf"machine {SICK} left the range of physics") as caught:
        trace = drives.record(OBJECTS, 0.2)
    assert len(caught) == 1
    assert drives.machine.diverged.tolist() == [k == SICK for k in range(6)]
    others = np.arange(6) != SICK
    for index in OBJECTS:
        assert np.array_equal(trace[index][:, others], reference[index][:, others])
    assert drives.machine.rotor_speed[SICK] == 0.0
    assert drives.machine.load_torque[SICK] == 0.0
    assert np.isfinite(drives.machine.rotor_angle).all()

    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once
        trace = drives.record([0x606C], 0.05)
    assert np.all(trace[0x606C][-1, SICK] == 0)
    assert drives.machine.rotor_angle[SICK] == 0.0  # frozen at rest means there


def test_a_frozen_machine_lives_again_after_reset():
    drives, fresh = running(), running()
    sick = np.arange(6) == SICK
    drives.machine.load_torque = np.where(sick, 1e8, 0.0)
    with pytest.warns(RuntimeWarning, match="until machine.reset"):
        drives.advance(0.01)
    fresh.advance(0.01)
    for each in (drives, fresh):
        each.machine.reset(sick)
    assert not drives.machine.diverged.any()
    results = []
    for each in (drives, fresh):
        motion.enable(each, mode="pv", where=sick)
        each.write("Target velocity", 600_000, where=sick)
        results.append(each.record(OBJECTS, 0.3))
    assert results[0][0x606C][-50:, SICK].mean() == pytest.approx(600_000, rel=0.02)
    for index in OBJECTS:
        assert np.array_equal(results[0][index], results[1][index])


def test_a_machine_that_diverges_again_is_reported_again():
    drives = running(2)
    for _ in range(2):
        drives.machine.load_torque = [0.0, 1e8]
        with pytest.warns(RuntimeWarning, match="machine 1 left"):
            drives.advance(0.01)
        drives.machine.reset(np.array([False, True]))


def test_divergence_leaves_no_file_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    drives = running(2)
    drives.machine.load_torque = [0.0, 1e8]
    with pytest.warns(RuntimeWarning):
        drives.advance(0.01)
    assert list(tmp_path.iterdir()) == []


def test_a_torque_that_is_no_number_is_refused():
    drives = running(2)
    with pytest.raises(ValueError, match="load torque must be a number, not nan"):
        drives.machine.load_torque = [0.01, np.nan]
    assert drives.machine.load_torque.tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match="one for each of 2 machines"):
        drives.machine.load_torque = [0.0, 0.0, 0.0]
