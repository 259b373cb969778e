"""Copies packed into one model: each is what it would be alone, and one that leaves physics leaves alone."""

import copy
import dataclasses
import os
import re
import warnings
from functools import cache

import mujoco
import numpy as np
import pytest
from rigs.stepped_load import stepped

from drive_env import EmulatedDrives, motion
from mechanics.loads import LOADS
from mechanics.model import COPIES_OF_MANY, compile_packed, copies_per_model
from mechanics.packed import PackedLoad, pack
from mechanics.template import Template, template_of

STEPS = 400
H = 200e-6
COPY = 5
J_M = 4.8e-6
INTEGRATORS = ("leapfrog", "rk4")
END_STOPS = [name for name, row in LOADS.items() if any(not contact.transmits for contact in row.contacts)]


def near_the_end_stops(load):
    """Return the load a little before its upper end stops: springs relaxed, backlash in its middle."""
    model = compile_packed(load, 1)
    joints = [model.joint(k).name.removeprefix("0/") for k in range(model.nv)]
    wanted = [(row.motion, 0.0 if row.transmits else row.high - 1e-4 * abs(row.high)) for row in load.contacts]
    wanted += [({joint: 1.0}, 0.0) for k, joint in enumerate(joints) if model.jnt_stiffness[k] > 0.0]
    matrix = np.array([[motion_.get(joint, 0.0) for joint in joints] for motion_, _ in wanted])
    positions = np.linalg.lstsq(matrix, np.array([position for _, position in wanted]), rcond=None)[0]
    return dataclasses.replace(load, start=dict(zip(joints, positions.tolist(), strict=True)))


def parameters(name, copies):
    """Return parameters that differ from copy to copy; copy k of a larger set is copy k of a smaller one."""
    load = LOADS[name]
    rows, axes = load.parameters, load.num_axes
    shares = np.random.default_rng(1).random((copies, len(rows) + 2))
    single = PackedLoad(load, np.full((1, axes), J_M), np.zeros((1, axes, 4)), {}, 1e-6)
    values = {p.name: single.get(p.name) * (p.low + shares[:, k] * (p.high - p.low)) for k, p in enumerate(rows)}
    armature = J_M * (1.0 + 0.4 * shares[:, -1:]) * (1.0 + 0.1 * np.arange(axes))
    bearing = np.zeros((copies, axes, 4))
    bearing[:, :, :2] = 2e-3 * shares[:, -2:-1, None]
    bearing[:, :, 2] = 1.0
    return values, armature, bearing


def torques(copies, axes):
    """Return torques that differ from copy to copy and axis to axis, (STEPS, copies, axes)."""
    amplitudes = np.random.default_rng(2).uniform(0.12, 0.2, (copies, axes))
    levels = np.repeat(np.random.default_rng(3).uniform(-1, 1, (STEPS // 50, axes)), 50, axis=0)
    levels[:50] = 1.0  # into the end stops, where they are near
    return levels[:, None] * amplitudes


@cache
def simulate(name, integrator, friction, chosen, copies, *, stops=False):
    """Return what the chosen copies of a set of `copies` do.

    Angle, speed and reaction of their axes, (STEPS, 3, chosen, axes), qpos and bristles at the end, and the greatest
    force of each contact, (chosen, contacts).
    """
    values, armature, bearing = parameters(name, copies)
    row = near_the_end_stops(LOADS[name]) if stops else LOADS[name]
    rows = np.array(chosen)
    load = PackedLoad(
        row,
        armature[rows],
        bearing[rows],
        {key: value[rows] for key, value in values.items()},
        H,
        integrator=integrator,
        friction=friction,
    )
    load.plant.load_torque[:] = 0.01 * rows / copies
    assert len(set(load.get("viscous"))) == load.copies
    torque = torques(copies, load.num_axes)[:, rows].reshape(STEPS, -1)
    found = stepped(load.plant, torque, H)
    assert not load.plant.diverged.any()
    shape = (STEPS, 3, load.copies, load.num_axes)
    at = load.data.qpos.reshape(load.copies, -1).copy()
    moved = np.stack([found.theta, found.omega, found.reaction], axis=1).reshape(shape)
    return moved, at, load.plant.bristle.copy(), np.abs(found.carried).max(axis=0)


def assert_a_copy_is_itself_alone(name, integrator, friction, copies, **options):
    packed = simulate(name, integrator, friction, tuple(range(copies)), copies, **options)
    alone = simulate(name, integrator, friction, (COPY,), copies, **options)
    assert np.all(np.abs(alone[0][:, 1]).max(axis=0) > 1.0)  # every axis moved
    assert np.array_equal(packed[0][:, :, COPY], alone[0][:, :, 0])
    for whole, one in zip(packed[1:], alone[1:], strict=True):
        assert np.array_equal(whole[COPY], one[0])
    assert not np.array_equal(packed[0][:, :, COPY], packed[0][:, :, COPY + 1])
    return packed


@pytest.mark.every(24)
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", list(LOADS))
@pytest.mark.parametrize(("copies", "friction"), [(8, "stribeck"), (64, "lugre")])
def test_a_copy_is_bit_for_bit_the_load_alone(name, integrator, copies, friction):
    assert LOADS[name].packing_bound == 0.0
    assert_a_copy_is_itself_alone(name, integrator, friction, copies)


@pytest.mark.every(12)
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", END_STOPS)
@pytest.mark.parametrize(("copies", "friction"), [(8, "lugre"), (64, "stribeck")])
def test_so_it_is_where_it_runs_into_its_end_stops(name, integrator, copies, friction):
    carried = assert_a_copy_is_itself_alone(name, integrator, friction, copies, stops=True)[-1]
    stops = [not contact.transmits for contact in LOADS[name].contacts]
    touched = carried[:, stops] > 0.0
    assert np.all(np.any(touched, axis=1))  # every copy has been at a stop
    assert np.all(touched[COPY])


def test_every_copy_of_eight_is_itself_alone():
    packed = simulate("two_mass", "leapfrog", "stribeck", tuple(range(8)), 8)[0]
    for k in range(8):
        alone = simulate("two_mass", "leapfrog", "stribeck", (k,), 8)[0]
        assert np.array_equal(packed[:, :, k], alone[:, :, 0])


def test_a_template_gives_the_same_model_and_shares_no_memory():
    values, armature, bearing = parameters("two_mass", 8)
    first = PackedLoad(LOADS["two_mass"], armature, bearing, values, 200e-6)
    second = PackedLoad(LOADS["two_mass"], armature, bearing, values, 200e-6, template=first.template)
    assert np.array_equal(first.mass_matrix(), second.mass_matrix())
    second.set("inertia", np.full(8, 9e-5), np.ones(8, bool))
    assert np.array_equal(first.get("inertia"), values["inertia"])


@pytest.mark.every(9)
@pytest.mark.parametrize("friction", ["stribeck", "lugre"])
@pytest.mark.parametrize("name", list(LOADS))
def test_machines_packed_at_once_are_those_packed_one_by_one(name, friction, monkeypatch):
    monkeypatch.setattr("mechanics.packed.COPIES_AT_ONCE", 16)  # two models, then one, then what is left
    values, armature, bearing = parameters(name, 30)
    together = pack(LOADS[name], armature, bearing, values, H, copies=8, friction=friction)
    assert [load.copies for load in together] == [8, 8, 8, 6]
    for k, load in enumerate(together):
        some = slice(8 * k, 8 * k + load.copies)
        own = {key: value[some] for key, value in values.items()}
        alone = PackedLoad(LOADS[name], armature[some], bearing[some], own, H, friction=friction)
        for field in dataclasses.fields(load.plant):
            if not field.name.endswith("_address"):
                found, expected = getattr(load.plant, field.name), getattr(alone.plant, field.name)
                np.testing.assert_array_equal(found, expected, err_msg=field.name)
        assert load.data.qpos.tobytes() == alone.data.qpos.tobytes()


def test_a_machine_that_cannot_be_stepped_is_named_among_all():
    stiffness = np.where(np.arange(30) == 19, 1e9, 20.0)
    with pytest.raises(ValueError, match=r"joint 'twist' of machine 19 resonates at"):
        pack(LOADS["two_mass"], np.full((30, 1), J_M), np.zeros((30, 1, 4)), {"stiffness": stiffness}, H, copies=8)
    with pytest.raises(ValueError, match=r"stiffness of load 'two_mass' must be finite and not negative"):
        pack(LOADS["two_mass"], np.full((30, 1), J_M), np.zeros((30, 1, 4)), {"stiffness": -stiffness}, H, copies=8)


@pytest.mark.parametrize("name", list(LOADS))
def test_what_follows_from_masses_is_what_mujoco_finds(name):
    template, seed = Template(LOADS[name], 3), 1
    changed = []
    for weigh in (mujoco.mj_setConst, template.weigh):
        model, rng = copy.copy(template.model), np.random.default_rng(seed)
        model.body_mass[:] *= rng.uniform(0.5, 2.0, model.nbody)
        model.body_inertia[:] *= rng.uniform(0.5, 2.0, (model.nbody, 1))
        model.body_ipos[:] *= rng.uniform(0.5, 2.0, (model.nbody, 1))
        model.dof_armature[:] = rng.uniform(1e-6, 1e-3, model.nv)
        weigh(model, mujoco.MjData(model))
        data = mujoco.MjData(model)
        data.qpos[:] = rng.uniform(-0.5, 0.5, model.nq)
        mujoco.mj_forward(model, data)
        changed.append((model.body_subtreemass.tobytes(), data.M.tobytes(), data.qfrc_bias.tobytes()))
    assert changed[0] == changed[1]


@pytest.mark.every(2)
@pytest.mark.parametrize("load", ["two_mass", "gantry"])
def test_many_machines_in_fewer_models_are_the_same_machines(load, monkeypatch):
    records, models = [], []
    for rows in (COPIES_OF_MANY, ((200, 128),), ((300, 256), (200, 128))):
        monkeypatch.setattr("mechanics.model.COPIES_OF_MANY", rows)
        with EmulatedDrives(load=load, num_machines=300, seed=3, randomise=True) as drives:
            motion.enable(drives, mode="pv")
            drives.write("Target velocity", 200_000)
            drives.advance(0.02)
            records.append(drives.inside.records.tobytes())
            models.append([group.load.copies for group in drives.inside.groups])
    assert models == [[64, 64, 64, 64, 44], [128, 128, 44], [256, 44]]
    assert records[0] == records[1] == records[2]


@pytest.mark.parametrize(("machines", "copies"), [(16_383, 64), (16_384, 128), (65_535, 128), (65_536, 256)])
def test_the_more_machines_there_are_the_more_of_them_a_model_holds(machines, copies):
    assert copies_per_model(LOADS["two_mass"], machines) == copies


def test_copies_are_named_by_their_number_in_its_order():
    """They are attached ten by ten; names and places are those of copies that are attached one by one."""
    model = compile_packed(LOADS["two_mass"], 123)
    joints = [model.joint(k).name for k in range(model.njnt)]
    assert joints == [f"{k}/{name}" for k in range(123) for name in ("motor", "twist")]


# --- divergence -------------------------------------------------------------------------------------------------------
SICK = 3
OBJECTS = [0x6064, 0x606C, 0x6077, 0x6041]


def running(num_machines=6, load="two_mass"):
    drives = EmulatedDrives(load=load, num_machines=num_machines, seed=4, randomise=["load", "motor"])
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 600_000)
    drives.advance(0.05)
    return drives


@pytest.mark.every(3)
@pytest.mark.parametrize(
    ("load", "torque"),
    [*((load, (-1e8, 1e300)[k % 2]) for k, load in enumerate(LOADS)), ("two_mass", 1e8), ("inertia", 1e12)],
)
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
    others = np.repeat(np.arange(6), drives.load.num_axes) != SICK
    for index in OBJECTS:
        assert np.array_equal(trace[index][:, others], reference[index][:, others])
    assert np.all(drives.machine.rotor_speed[~others] == 0.0)
    assert drives.machine.load_torque[SICK] == 0.0
    assert np.isfinite(drives.machine.rotor_angle).all()

    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once
        trace = drives.record([0x606C], 0.05)
    assert np.all(trace[0x606C][-1, ~others] == 0)
    assert np.all(drives.machine.rotor_angle[~others] == 0.0)  # frozen at rest means there


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


def test_a_torque_or_temperature_that_is_not_finite_is_refused():
    drives = running(2)
    for value in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match=f"load torque must be finite, not {value:g}; give a finite number"):
            drives.machine.load_torque = [0.01, value]
        with pytest.raises(ValueError, match=f"a temperature must be finite, not {value:g} degC"):
            drives.machine.set_temperatures(40.0, [25.0, value])
    assert drives.machine.load_torque.tolist() == [0.0, 0.0]
    assert drives.machine.temperatures[0].max() < 26.0
    with pytest.raises(ValueError, match="one for each of 2 machines"):
        drives.machine.load_torque = [0.0, 0.0, 0.0]


def test_files_are_read_and_models_compiled_as_often_for_many_machines_as_for_few(monkeypatch):
    from mechanics import model, template

    seen = []
    for module, name in ((model, "_spec"), (template, "compile_packed")):
        truly = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *args, _name=name, _truly=truly: seen.append(_name) or _truly(*args))
    counts = []
    for num_machines in (64, 640):
        seen.clear()
        template._templates.clear()
        EmulatedDrives(num_machines=num_machines).close()
        counts.append({name: seen.count(name) for name in seen})
    assert counts[0] == counts[1]
    assert counts[0]["compile_packed"] == 2  # of the machine from which defaults are read, and of 64
    seen.clear()
    EmulatedDrives(num_machines=64).close()
    assert "compile_packed" not in seen  # the row and its file are as they were


@pytest.mark.slow
@pytest.mark.parametrize("change", ["its file", "the row"])
def test_a_model_is_compiled_anew_where_the_load_has_changed(change, tmp_path):
    file = tmp_path / "arm.xml"
    file.write_text(LOADS["inertia"].mjcf.read_text())
    row = dataclasses.replace(LOADS["inertia"], mjcf=file)
    first = template_of(row, 2)
    assert template_of(row, 2) is first is not template_of(row, 3)
    if change == "its file":
        before = file.stat()
        file.write_text(re.sub(r'diaginertia="[^"]*"', 'diaginertia="7 7 7"', file.read_text()))
        os.utime(file, (before.st_atime, before.st_mtime))
    else:
        row = dataclasses.replace(row, gear=3.0)
    second = template_of(row, 2)
    assert second is not first
    if change == "its file":
        assert second.model.body_inertia[-1].tolist() == [7.0, 7.0, 7.0]
    else:
        assert list(second.turning[0].values()) == [3.0]


def test_a_model_that_takes_in_other_files_is_always_read(files_read_here, tmp_path):
    (tmp_path / "body.xml").write_text(LOADS["inertia"].mjcf.read_text())
    file = tmp_path / "whole.xml"
    file.write_text('<mujoco><include file="body.xml"/></mujoco>')
    row = dataclasses.replace(LOADS["inertia"], mjcf=file)
    assert template_of(row, 2) is not template_of(row, 2)
