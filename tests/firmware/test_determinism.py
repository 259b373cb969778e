"""Equal inputs give equal integers: alone or among many, on one thread or two, in one go or in pieces."""

import warnings

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion

POSITION, VELOCITY, TORQUE, STATUS = 0x6064, 0x606C, 0x6077, 0x6041
OBJECTS = [POSITION, VELOCITY, TORQUE, STATUS]
COPY = 5


def programme(drives):
    """Two seconds: pp both ways and changed in flight, a load step, pv both ways; return every object's integers."""
    traces = []

    def record(duration):
        traces.append(drives.record(OBJECTS, duration))

    for word, mode in ((0x06, 1), (0x07, None), (0x0F, None)):
        drives.write(0x6040, word)
        if mode is not None:
            drives.write(0x6060, mode)
        record(0.01)
    for target, duration in ((300_000, 0.37), (-200_000, 0.2), (100_000, 0.4)):
        drives.write(0x607A, target)
        drives.write(0x6040, 0x1F)
        record(0.005)
        drives.write(0x6040, 0x0F)
        record(duration - 0.005)
    drives.machine.load_torque = 0.02
    record(0.25)
    drives.machine.load_torque = 0.0
    drives.write(0x6060, 3)
    for speed in (900_000, -400_000, 0):
        drives.write(0x60FF, speed)
        record(0.25)
    return {index: np.concatenate([trace[index] for trace in traces]) for index in OBJECTS}


def machines(num_machines, **options):
    return EmulatedDrives(**{"load": "two_mass", "num_machines": num_machines, "seed": 7, "randomise": True, **options})


def assert_same(found, expected, axis=None):
    for index in OBJECTS:
        among = expected[index] if axis is None else expected[index][:, axis : axis + 1]
        assert np.array_equal(found[index], among), f"{index:04X}h"


@pytest.fixture(scope="module")
def sixty_four():
    with machines(64) as drives:
        return programme(drives)


def test_the_programme_moves(sixty_four):
    assert len(sixty_four[POSITION]) == 2000
    assert np.ptp(sixty_four[POSITION], axis=0).min() > 200_000
    assert np.abs(sixty_four[VELOCITY]).max(axis=0).min() > 800_000
    assert np.all(sixty_four[STATUS][50:] & 0x6F == 0x27)


@pytest.mark.parametrize("copy", [0, COPY, 63])
def test_a_machine_alone_is_the_same_machine_among_64(sixty_four, copy):
    with machines(1, first_machine=copy) as drives:
        assert_same(programme(drives), sixty_four, copy)


def test_a_machine_of_a_shifted_set_is_the_same_machine(sixty_four):
    """Machine 5 in lane 2 of three, instead of lane 5 of eight."""
    with machines(3, first_machine=3) as drives:
        assert_same({k: v[:, 2:3] for k, v in programme(drives).items()}, sixty_four, COPY)


def test_identical_machines_are_identical(sixty_four):
    with machines(9, first_machine=COPY, distinct=1) as drives:
        found = programme(drives)
    for lane in (0, 4, 8):
        assert_same({k: v[:, lane : lane + 1] for k, v in found.items()}, sixty_four, COPY)


def test_same_seed_same_bits_other_seed_other_bits(sixty_four):
    with machines(2, first_machine=COPY) as again, machines(2, first_machine=COPY, seed=8) as other:
        assert_same(programme(again), {k: v[:, COPY : COPY + 2] for k, v in sixty_four.items()})
        found = programme(other)
        assert not np.array_equal(found[POSITION], sixty_four[POSITION][:, COPY : COPY + 2])
        assert again.machine.parameters["load.inertia"][0] != other.machine.parameters["load.inertia"][0]


def test_noise_alone_follows_the_seed():
    """Machines without randomisation have the same parameters and different noise."""
    with machines(2, randomise=False) as drives, machines(2, randomise=False, seed=8) as other:
        assert {k: v.tolist() for k, v in drives.machine.parameters.items()} == {
            k: v.tolist() for k, v in other.machine.parameters.items()
        }
        motion.enable(drives, mode="pv")
        motion.enable(other, mode="pv")
        found, different = (d.record([TORQUE], 0.05)[TORQUE] for d in (drives, other))
    assert not np.array_equal(found, different)
    assert not np.array_equal(found[:, 0], found[:, 1])


def test_threads_change_no_bit():
    """130 machines are three groups: 64, 64 and 2."""
    results = []
    for threads in (1, 2):
        with machines(130, num_threads=threads) as drives:
            motion.enable(drives, mode="pv")
            drives.write(0x60FF, 900_000)
            first = drives.record(OBJECTS, 0.1)
            drives.machine.load_torque = 0.02
            second = drives.record(OBJECTS, 0.1)
            results.append({index: np.concatenate([first[index], second[index]]) for index in OBJECTS})
    assert_same(results[0], results[1])
    with machines(1, first_machine=129) as alone:  # the last of the third group
        motion.enable(alone, mode="pv")
        alone.write(0x60FF, 900_000)
        first = alone.record(OBJECTS, 0.1)
        assert np.array_equal(first[POSITION][:, 0], results[0][POSITION][:100, 129])


def moving(**options):
    drives = machines(3, **options)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, 900_000)
    return drives


def test_a_record_in_one_go_equals_one_in_pieces():
    with moving() as one, moving() as other:
        whole = one.record(OBJECTS, 0.06)
        parts = [other.record(OBJECTS, duration) for duration in (0.001, 0.017, 0.042)]
        assert_same(whole, {index: np.concatenate([part[index] for part in parts]) for index in OBJECTS})
        np.testing.assert_allclose(whole.t, np.arange(60) * 1e-3, atol=1e-12)


@pytest.mark.parametrize("name", ["load.inertia", "load.coulomb", "motor.inertia", "motor.R_s"])
def test_setting_one_machine_leaves_the_others_bits(name):
    """Set while all turn: a machine must not feel that its neighbour's parameters were worked out again."""
    with moving() as one, moving() as other:
        one.advance(0.05)
        other.advance(0.05)
        one.machine.set(name, 1.05 * one.machine.parameters[name], where=np.array([True, False, False]))
        found, expected = one.record(OBJECTS, 0.05), other.record(OBJECTS, 0.05)
        assert not np.array_equal(found[VELOCITY][:, 0], expected[VELOCITY][:, 0])
        for index in OBJECTS:
            assert np.array_equal(found[index][:, 1:], expected[index][:, 1:])
        for field in ("qpos", "qvel"):  # MuJoCo's: machine by machine
            values = [getattr(d.inside.groups[0].load.plant, field).reshape(3, -1)[1:] for d in (one, other)]
            assert np.array_equal(*values), field
        for field in ("mass", "friction"):  # machines last
            values = [getattr(d.inside.groups[0].load.plant, field)[..., 1:] for d in (one, other)]
            assert np.array_equal(*values), field


def test_recording_changes_nothing():
    with moving() as one, moving() as other:
        one.record(OBJECTS, 0.05)
        other.advance(0.05)
        for index in OBJECTS:
            assert np.array_equal(one.read(index), other.read(index))


def test_a_slower_record_holds_every_fifth_row():
    with moving() as one, moving() as other:
        fast, slow = one.record(OBJECTS, 0.063), other.record(OBJECTS, 0.063, period=0.005)
        assert_same(slow, {index: fast[index][::5] for index in OBJECTS})
        np.testing.assert_allclose(slow.t, fast.t[::5], atol=1e-12)
        assert np.array_equal(one.read(POSITION), other.read(POSITION))


def test_play_equals_writes_at_the_same_cycles():
    target = np.random.default_rng(0).integers(-900_000, 900_000, (40, 3))
    limit = np.linspace(2000, 7000, 40).astype(int)
    with moving() as played, moving() as written:
        trace = played.record([*OBJECTS, 0x60FF], 0.04, play={0x60FF: target, 0x2003: limit})
        rows = {index: [] for index in OBJECTS}
        for k in range(40):
            written.write(0x60FF, target[k])
            written.write(0x2003, limit[k])
            row = written.record(OBJECTS, 0.001)
            for index in OBJECTS:
                rows[index].append(row[index][0])
        assert_same(trace, {index: np.array(values) for index, values in rows.items()})
        assert np.array_equal(trace[0x60FF], target)
        assert np.array_equal(played.read(0x60FF), target[-1])


def test_play_of_the_controlword_equals_writes_of_it():
    words = np.full(40, 0x0F)
    words[10:15] = 0x1F  # the edge that takes a set-point
    words[30:] = 0x02  # quick stop

    def in_pp():
        drives = machines(2)
        motion.enable(drives, mode="pp")
        drives.write(0x607A, 200_000)
        return drives

    with in_pp() as played, in_pp() as written:
        trace = played.record(OBJECTS, 0.04, play={0x6040: words})
        rows = {index: [] for index in OBJECTS}
        for k in range(40):
            written.write(0x6040, int(words[k]))
            row = written.record(OBJECTS, 0.001)
            for index in OBJECTS:
                rows[index].append(row[index][0])
        assert_same(trace, {index: np.array(values) for index, values in rows.items()})
        assert np.all(trace[STATUS][12] & 0x1000)
        assert np.all(trace[STATUS][35] & 0x6F == 0x07)


# --- what is drawn ----------------------------------------------------------------------------------------------------
def test_randomising_one_group_leaves_the_other_draws():
    drawn = {
        str(chosen): machines(4, randomise=chosen).machine.parameters
        for chosen in (True, False, ["load"], ["motor", "load"], ["load.inertia"])
    }
    everything, nothing = drawn["True"], drawn["False"]
    for chosen, parameters in drawn.items():
        for name, values in parameters.items():
            picked = chosen == "True" or f"'{name}'" in chosen or f"'{name.split('.')[0]}'" in chosen
            assert np.array_equal(values, everything[name] if picked else nothing[name]), (chosen, name)
    assert np.unique(everything["load.inertia"]).size == 4
    assert np.unique(nothing["load.inertia"]).size == 1


def test_randomising_a_group_leaves_the_noise():
    """The encoder's line error is the motor's; the current's noise must stay what it was."""
    with machines(2, randomise=False) as plain, machines(2, randomise=["load"]) as drawn:
        found, other = (d.record([(0x2060, 1)], 0.05)[0x2060, 1] for d in (plain, drawn))
    assert np.ptp(found) > 0
    assert np.array_equal(found, other)  # at standstill, with the stage off, the load does not matter


def test_200_drawn_machines_run():
    with warnings.catch_warnings(), machines(200) as drives:
        warnings.simplefilter("error")
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, 500_000)
        speed = drives.record([VELOCITY], 0.2)[VELOCITY]
        assert not drives.machine.diverged.any()
        assert np.all(drives.read(STATUS) & 0x6F == 0x27)
        # every machine turned the right way
        assert speed[-20:].mean(axis=0).min() > 250_000
