"""The machines that tuners are compared on: what the public ones are, that each is itself wherever it is opened."""

from __future__ import annotations

import math
import warnings
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.known_machines import open_machines

from drive_env import motion
from drive_env.emulator.inertia_check import MisfitWarning
from drive_env.motors import MOTORS
from mechanics.shaft import shaft_load
from tuning.compare import suite as module
from tuning.compare.suite import SHIPPED, SuiteMachine, _draw, _spread, groups, load_suite, open_group
from tuning.toml_tables import ExperimentError

SMALL = """
device = "tmcm1636"
[[group]]
load = "inertia"
motor = "qbl4208"
supply = [24, 20]
travel = [0.3, 2]
[group.parameters]
"load.inertia" = [1e-5, 2e-5]
[[generated]]
count = 3
groups = [["two_mass", "qbl4208"], ["inertia", "ec_i_40"]]
"""


@pytest.fixture
def small(tmp_path):
    def write(text=SMALL):
        path = tmp_path / "small.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


# --- the public part ----------------------------------------------------------------------------------------------
def test_there_are_forty_machines_of_eight_loads_and_several_motors():
    machines = load_suite()
    assert len(machines) >= 40
    assert len({machine.load for machine in machines}) >= 8
    assert len({machine.motor for machine in machines}) >= 5
    assert len({machine.name for machine in machines}) == len(machines)
    assert {"vertical_screw", "arm"} <= {machine.load for machine in machines}  # under gravity
    assert min(machine.travel for machine in machines) <= 0.3


def test_every_machine_is_one_that_its_motor_moves_well():
    machines = load_suite()
    with warnings.catch_warnings():
        warnings.simplefilter("error", MisfitWarning)
        for target, indices in open_machines(machines):
            packed = [group.load for group in target.drives.inside.groups]
            seen = [shaft_load(load) for load in packed]
            ratio = np.concatenate([row.inertia / load.armature for row, load in zip(seen, packed, strict=True)])
            assert np.all((ratio > 0.5) & (ratio < 20.0)), [machines[k].name for k in indices]
            assert np.concatenate([row.gravity for row in seen]).max() < 0.5 * target.motor.rated_torque
            assert np.all(np.abs(target.supply / target.motor.voltage - 1.0) <= 0.1 + 1e-9)


def test_the_ranges_are_those_of_real_drives():
    filters = [machine.parameters["stage.velocity_filter"] for machine in load_suite()]
    assert min(filters) == 150.0 and max(filters) == 800.0
    rigid = [m for m in load_suite() if m.load == "inertia" and m.motor == "qbl4208"]
    ratios = [m.parameters["load.inertia"] / MOTORS["qbl4208"].inertia for m in rigid]
    assert min(ratios) == pytest.approx(1.0) and max(ratios) == pytest.approx(18.0)
    two_mass = [m.parameters for m in load_suite() if m.load == "two_mass"]
    # Anti-resonance of a disc on a spring: sqrt(k / J) / 2 pi.
    found = [math.sqrt(p["load.stiffness"] / p["load.inertia"]) / (2.0 * math.pi) for p in two_mass]
    assert min(found) == pytest.approx(25.0, rel=0.01) and max(found) == pytest.approx(180.0, rel=0.01)


# --- a machine ----------------------------------------------------------------------------------------------------
def test_a_machine_has_the_parameters_supply_and_travel_of_its_column(small):
    with open_group(load_suite(small())) as target:
        assert target.drives.machine.parameters["load.inertia"].tolist() == [1e-5, 2e-5]
        assert target.drives.machine.supply.tolist() == [24.0, 20.0]
        assert target.supply.tolist() == [24.0, 20.0]
        np.testing.assert_allclose(target.high, 2.0 * math.pi * np.array([0.3, 2.0]))
        np.testing.assert_allclose(target.low, -target.high)


def test_the_travel_is_never_more_than_the_loads_own():
    belt = [machine for machine in load_suite() if machine.load == "belt"]
    with open_group(belt) as target:
        turns = target.high / (2.0 * math.pi)
        assert turns[0] == pytest.approx(5.0) and turns[-1] == pytest.approx(0.3)
        assert np.all(turns <= 0.23 / 0.04 + 1e-6)  # 0.23 m to the switch, 40 mm of belt per turn


def moved(machines, which):
    """Return what the named machine does in a move, opened among `machines`."""
    with open_group(machines) as target:
        motion.enable(target.drives, mode="pp")
        motion.start_move(target.drives, 20_000)
        trace = target.drives.record([0x6064, 0x6077], 0.1)
        k = [machine.name for machine in machines].index(which)
        return np.stack([trace[0x6064][:, k], trace[0x6077][:, k]])


def test_a_machine_is_the_same_alone_and_among_others():
    machines = [machine for machine in load_suite() if machine.load == "two_mass" and machine.motor == "ec_i_40"]
    third = machines[2]
    np.testing.assert_array_equal(moved(machines, third.name), moved([third], third.name))


def test_machines_of_several_kinds_cannot_share_drives():
    with pytest.raises(ValueError, match=r"one load and one motor, not .*belt on qbl4208"):
        open_group([machine for machine in load_suite() if machine.load in ("belt", "fan")])


# --- the drawn part -----------------------------------------------------------------------------------------------
def test_a_seed_adds_machines_that_depend_on_it_and_their_number_alone(small):
    path = small()
    assert len(load_suite(path)) == 2
    first, again, other = (load_suite(path, seed)[2:] for seed in (1, 1, 2))
    assert first == again
    assert [machine.load for machine in first] == ["two_mass", "inertia", "two_mass"]
    assert all(a.parameters != b.parameters for a, b in zip(first, other, strict=True))
    more = load_suite(small(SMALL.replace("count = 3", "count = 5")), 1)[2:]
    assert more[:3] == first


@pytest.mark.slow
def test_drawn_machines_are_sound():
    drawn = load_suite(seed=5)[len(load_suite()) :]
    assert len(drawn) >= 20
    with warnings.catch_warnings():
        warnings.simplefilter("error", MisfitWarning)
        for _ in open_machines(drawn):
            pass


def test_what_no_draw_can_make_sound_is_refused(small):
    # The 4 kg of the upright screw hang with 1.4 times the rated torque of this motor.
    text = SMALL.replace('["two_mass", "qbl4208"]', '["vertical_screw", "qube_servo_3"]')
    with pytest.raises(ExperimentError, match=r"no machine that 'qube_servo_3' can move; choose a stronger motor"):
        load_suite(small(text), seed=0)


def test_few_machines_are_taken_from_all_groups():
    kinds = groups(load_suite())
    few = load_suite(count=len(kinds))
    assert len({machine.kind for machine in few}) == len(kinds)
    assert len(load_suite(count=3)) == 3


# --- mistakes -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("wrong", "right", "message"),
    [
        ("[1e-5, 2e-5]", "[1e-5]", r"load.inertia has 1 numbers for 2 machines"),
        ("[24, 20]", "[24, -1]", r"supply -1 V and travel 2 rev of machine 1 must be above 0"),
        ("[24, 20]", '"high"', r"must be an array of numbers"),
        ("load.inertia", "load.weight", r"no parameter 'load.weight'; they have .*load.inertia"),
        ('"inertia"\nmotor', '"pendulum"\nmotor', r"no load is named 'pendulum'"),
        ("count = 3", "number = 3", r"key 'number' is unknown; there are count, groups"),
        ('"tmcm1636"', "1", r"device = 1 is a whole number; it must be a text"),
        ("[[generated]]", "[generated", r"is not TOML"),
        ("[[generated]]", "[generated]", r"generated is a table; write one table \[\[generated\]\]"),
    ],
)
def test_a_mistake_in_the_file_is_one_line_with_what_is_right(small, wrong, right, message):
    assert wrong in SMALL
    with pytest.raises(ExperimentError, match=message):
        load_suite(small(SMALL.replace(wrong, right, 1)), seed=0)


def test_two_groups_of_one_kind_are_refused(small):
    table = SMALL[SMALL.index("[[group]]") : SMALL.index("[[generated]]")]
    with pytest.raises(ExperimentError, match=r"two machines are named 'inertia-qbl4208-0'; put machines"):
        load_suite(small(SMALL.replace("[[generated]]", table + "[[generated]]")))


def test_unknown_suites_are_refused_with_those_that_ship():
    assert "public" in {path.stem for path in SHIPPED.glob("*.toml")}
    with pytest.raises(ExperimentError, match=r"no suite is named 'secret'; there are .*public"):
        load_suite("secret")
    with pytest.raises(ExperimentError, match=r"there is no file nowhere.toml"):
        load_suite("nowhere.toml")
    with pytest.raises(ExperimentError, match=r"count must be 1 or more, not 0"):
        load_suite(count=0)


# --- without a machine: what a file says, what is drawn, and in which order -------------------------------------------
PLAIN = 'device = "tmcm1636"\n'
GROUP = (
    '[[group]]\nload = "inertia"\nmotor = "qbl4208"\nsupply = [24, 20]\n[group.parameters]\n"load.inertia" = [1, 2]\n'
)


@pytest.fixture
def unmade(monkeypatch, small):
    """Read a suite whose machines have but an inertia, and draw them by their number alone."""
    drawn = []

    def draw(where, device, load, motor, seed, number):
        drawn.append((where, device, load, motor, seed, number))
        return SuiteMachine(f"drawn-{number}", device, load, motor, {}, 24.0)

    monkeypatch.setattr(module, "_defaults", lambda device, load, motor: {"load.inertia": 3.0})
    monkeypatch.setattr(module, "_draw", draw)

    def read(text, *arguments, **options):
        drawn.clear()
        return load_suite(small(PLAIN + text), *arguments, **options), drawn

    return read


def test_a_table_has_a_machine_in_each_column(unmade):
    (one, other), _ = unmade(GROUP)
    assert one == SuiteMachine("inertia-qbl4208-0", "tmcm1636", "inertia", "qbl4208", {"load.inertia": 1.0}, 24.0)
    assert (other.name, other.parameters, other.supply) == ("inertia-qbl4208-1", {"load.inertia": 2.0}, 20.0)
    assert (one.friction, one.travel, one.kind) == (
        "stribeck", math.inf, ("tmcm1636", "inertia", "qbl4208", "stribeck"),
    )  # fmt: skip
    given = GROUP.replace("supply", 'friction = "lugre"\ntravel = [inf, 0.5]\nsupply')
    (one, other), _ = unmade(given)
    assert (one.friction, one.travel, other.travel) == ("lugre", math.inf, 0.5)


@pytest.mark.parametrize(
    ("wrong", "right", "message"),
    [
        ("[24, 20]", "[24, 0]", r"supply 0 V and travel inf rev of machine 1 must be above 0"),
        ("[24, 20]", "[24, 20]\ntravel = [0, 1]", r"supply 24 V and travel 0 rev of machine 0 must be above 0"),
        ("[24, 20]", "[24, 20]\ntravel = [1]", r"travel has 1 numbers for 2 machines; give one per machine"),
        ("[24, 20]", "[]", r"supply = \[\] must be an array of numbers, one per machine"),
        ("[24, 20]", "[24, nan]", r"supply = nan is not finite; give a number"),
        ("[24, 20]", "[24, true]", r"supply = True is a truth value; it must be a number"),
        ("[24, 20]\n", "[24, 20]\nweight = 3\n", r"group: key 'weight' is unknown; there are load, motor, friction"),
        ('motor = "qbl4208"\n', "", r"group: key 'motor' is missing"),
        (GROUP, "", r"small.toml: it has no machine; add a \[\[group\]\], or \[\[generated\]\] and a seed"),
        (GROUP, "colour = 3", r"key 'colour' is unknown; there are device, group, generated"),
        (GROUP, "group = [3]", r"group is a whole number; it must be a table"),
    ],
)
def test_a_mistake_in_a_table_is_told(unmade, wrong, right, message):
    with pytest.raises(ExperimentError, match=message):
        unmade(GROUP.replace(wrong, right))


def test_machines_are_drawn_in_turn_and_numbered_on_from_table_to_table(unmade):
    tables = (
        '[[generated]]\ncount = 3\ngroups = [["a", "x"], ["b", "y"]]\n[[generated]]\ncount = 2\ngroups = [["c", "z"]]\n'
    )
    machines, drawn = unmade(GROUP + tables, 7)
    assert [machine.name for machine in machines] == [
        "inertia-qbl4208-0", "inertia-qbl4208-1", *(f"drawn-{k}" for k in range(5))
    ]  # fmt: skip
    assert drawn == [
        ("small.toml: generated", "tmcm1636", load, motor, 7, k)
        for k, (load, motor) in enumerate([("a", "x"), ("b", "y"), ("a", "x"), ("c", "z"), ("c", "z")])
    ]
    assert len(unmade(GROUP + tables)[0]) == 2 and unmade(GROUP + tables, 0)[1][0][4] == 0
    assert len(unmade(tables, 1)[0]) == 5
    with pytest.raises(ExperimentError, match="it has no machine"):
        unmade(tables)
    with pytest.raises(ExperimentError, match="seed must be 0 or more, not -1"):
        unmade(tables, -1)


@pytest.mark.parametrize("groups", ["[]", "3", "[3]", '[["a"]]', '[["a", "b", "c"]]', '[["a", "b"], "c"]'])
def test_what_is_drawn_are_pairs_of_load_and_motor(unmade, groups):
    with pytest.raises(ExperimentError, match=r"generated: groups must be an array of \[load, motor\]"):
        unmade(f"[[generated]]\ncount = 1\ngroups = {groups}\n", 1)


def machine(name, load):
    return SuiteMachine(name, "tmcm1636", load, "qbl4208", {}, 24.0)


ROW = [machine("a0", "a"), machine("b0", "b"), machine("a1", "a"), machine("a2", "a"), machine("b1", "b")]


def test_machines_of_a_kind_are_grouped_in_the_order_of_their_first():
    assert groups(ROW) == [[0, 2, 3], [1, 4]] and groups([]) == []


@pytest.mark.parametrize(
    ("count", "names"),
    [(1, "a0"), (2, "a0 b0"), (3, "a0 b0 a1"), (4, "a0 b0 a1 b1"), (5, "a0 b0 a1 a2 b1"), (9, "a0 b0 a1 a2 b1")],
)
def test_so_many_machines_are_taken_from_the_groups_in_turn(count, names):
    assert [one.name for one in _spread(ROW, count)] == names.split()


@pytest.mark.parametrize(("sound", "tries"), [(1, 1), (3, 3), (50, 50), (51, None)])
def test_a_machine_that_its_motor_cannot_move_is_drawn_again_fifty_times(sound, tries, monkeypatch):
    drawn = []

    class Laws:
        def draw(self, rng, known):
            drawn.append((rng.integers(10**9), known["supply.voltage"], known["load.inertia"]))
            return {"load.inertia": len(drawn), "supply.voltage": 20.0 + len(drawn)}

    monkeypatch.setattr(module, "_checked_defaults", lambda where, device, load, motor: {"load.inertia": 3.0})
    monkeypatch.setattr(module, "laws_of", lambda load, device, defaults: Laws())
    monkeypatch.setattr(module, "_sound", lambda device, load, motor, drawn: drawn["load.inertia"] >= sound)
    if tries is None:
        with pytest.raises(ExperimentError, match="here: 50 draws of 'inertia' gave no machine that 'qbl4208' can mov"):
            _draw("here", "tmcm1636", "inertia", "qbl4208", 5, 7)
        return
    found = _draw("here", "tmcm1636", "inertia", "qbl4208", 5, 7)
    assert (found.name, found.parameters, found.supply) == (
        "seed5-07-inertia-qbl4208", {"load.inertia": tries}, 20.0 + tries
    )  # fmt: skip
    assert len(drawn) == tries and drawn[0][1:] == (24.0, 3.0)
    assert drawn[0][0] == np.random.default_rng((5, 7)).integers(10**9)
    with pytest.raises(ExperimentError, match=r"here: load 'anvil' has no distributions; there are .*inertia"):
        _draw("here", "tmcm1636", "anvil", "qbl4208", 5, 7)


def test_the_noise_of_a_machine_follows_from_its_name(small):
    machines = load_suite(small())
    with open_group(machines) as target:
        seeds = target.drives.inside.noise_seeds.tolist()
        assert (target.axes_per_machine, target.linked, target.machine) == (1, False, "inertia")
        assert (target.speed, target.current) == (target.motor.rated_speed, target.motor.rated_current)
    assert seeds == [2.0 + zlib.crc32(one.name.encode()) % (2**32 - 2) for one in machines]


@pytest.mark.parametrize(("error", "sound"), [(None, True), (ValueError("no"), False), ("misfit", False)])
def test_a_machine_is_sound_that_can_be_made_without_a_warning_of_its_inertia(error, sound, monkeypatch):
    closed = []

    def made(*arguments, **options):
        assert arguments == ("tmcm1636", "inertia", "qbl4208") and options == {"parameters": {"a": 1}, "num_threads": 1}
        if error == "misfit":
            warnings.warn("it cannot move it", MisfitWarning, stacklevel=1)
        elif error:
            raise error
        return SimpleNamespace(close=lambda: closed.append(1))

    monkeypatch.setattr(module, "EmulatedDrives", made)
    assert module._sound("tmcm1636", "inertia", "qbl4208", {"a": 1}) is sound
    assert closed == ([1] if sound else [])
