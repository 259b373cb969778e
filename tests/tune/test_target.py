"""What is tuned: how far each rotor may turn, what the user says of it, and how a command names it."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import can
import numpy as np
import pytest
import typer

from agents.commands.options import errors_as_exit_codes as errors_of_drive_agent
from drive_env import EmulatedDrives, SafetyError, motion
from drive_env.bus.can_port import CanPort
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.devices import find_device
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.drives.speeds import per_increment
from drive_env.fieldbus.errors import refused
from drive_env.motors import find_motor
from mechanics.loads import LOADS, find_load
from mechanics.shaft import one, way
from tuning.commands.options import TargetOptions, errors_as_exit_codes, open_target, parse_travel
from tuning.target import (
    FREE,
    Target,
    address_of,
    emulated,
    hold_to_travel,
    of_bus,
    of_machines,
    on_bus,
    timed,
)

TURN = 2.0 * math.pi


def test_an_emulated_target_knows_its_machines():
    with emulated("tmcm1636", "inertia", "ec_i_40", num_machines=2, supply=30.0, seed=4) as target:
        assert target.num_axes == 2
        assert target.motor.name == "ec_i_40" and target.machine == "inertia"
        assert target.supply.tolist() == [30.0, 30.0]
        assert target.drives.machine.supply.tolist() == [30.0, 30.0]  # what it is told is true
        assert (target.speed, target.current) == (target.motor.rated_speed, target.motor.rated_current)
        assert np.isinf(target.low).all() and np.isinf(target.high).all()
        assert target.increments() == pytest.approx([65536 / TURN] * 2)


@pytest.mark.parametrize(("load", "ends"), [
    # The way to a limit switch, 20 mm before the end [m], over the way per turn of the rotor.
    ("belt", (0.25 - 0.02) / 0.04),
    ("ball_screw", (0.25 - 0.02) / 0.005),
    ("gantry", (0.30 - 0.02) / 0.04),
])  # fmt: skip
def test_travel_is_the_loads_own_and_never_wider(load, ends):
    with emulated(load=load, num_machines=2) as target:
        axes = target.axes_per_machine
        assert axes == LOADS[load].num_axes and target.num_axes == 2 * axes
        np.testing.assert_allclose(target.high, ends * TURN)
        np.testing.assert_allclose(target.low, -ends * TURN)
    with emulated(load=load, travel=(-0.1, 1e9)) as narrow:
        np.testing.assert_allclose(narrow.low, -0.1)
        np.testing.assert_allclose(narrow.high, ends * TURN)


def test_a_factory_fresh_drive_has_no_gains():
    with emulated(factory_fresh=True) as target:
        assert target.drives.read((0x2042, 1)) == [0]
        assert target.motor.name == find_device("tmcm1636").default_motor


def test_a_factory_fresh_drive_turns_the_motor_that_was_named():
    with emulated(motor="ec_i_40", factory_fresh=True) as target:
        assert target.motor.name == target.drives.motor.name == "ec_i_40"
        assert target.drives.read("Maximum Current").tolist() == [0]


def test_time_on_the_drives_is_counted_whoever_lets_it_pass():
    with emulated(load="inertia") as target, timed(target) as (watched, clock):
        assert clock.seconds == 0.0
        motion.enable(watched.drives, mode="pv")
        enabling = clock.seconds
        watched.drives.advance(0.25)
        trace = watched.drives.record([0x6064], 0.1, period=0.002)
        assert len(trace) == 50
        assert clock.seconds == pytest.approx(enabling + 0.35)
        assert watched.num_axes == 1 and watched.drives.machine is target.drives.machine


# --- on a bus -----------------------------------------------------------------------------------------------------
@pytest.fixture
def channel(request):
    """The name of a virtual bus with one drive, whose time passes by SYNC."""
    world = World(lockstep=True)
    world.add(EmulatedDrives(load="inertia", num_threads=1), [1])
    with Server(world, CanPort(can.Bus(interface="virtual", channel=request.node.name))):
        yield request.node.name
    world.close()


def opened(channel, **options):
    return on_bus(interface="virtual", channel=channel, pace="lockstep", timeout=20.0, supply=24.0, **options)


def test_the_envelope_holds_an_axis_of_a_bus_to_its_travel_and_some_overshoot(channel):
    with opened(channel, travel=(-0.5 * TURN, 0.25 * TURN)) as target:
        assert (target.low, target.high) == ([-0.5 * TURN], [0.25 * TURN])
        assert target.machine == f"{channel}, node 1"
        drives = target.drives
        here = int(drives.read(0x6064)[0])
        motion.enable(drives, mode="pp")
        drives.write(0x6081, 100_000)
        drives.write(0x6083, 1_000_000)
        motion.start_move(drives, here + 18_500)
        drives.advance(0.3)
        with pytest.raises(SafetyError, match="beyond the limits"):
            motion.start_move(drives, here + 19_000)  # a quarter turn and a twentieth of the way are 18842


def test_a_bus_that_says_nothing_of_its_channel_takes_it_from_the_environment(channel, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_INTERFACE", "virtual")
    monkeypatch.setenv("DRIVE_ENV_CHANNEL", channel)
    with on_bus(travel=FREE, pace="lockstep", timeout=20.0) as target:
        assert target.bus == {"interface": "virtual", "channel": channel, "nodes": [1], "pace": "lockstep"}
        assert target.supply == [24.0]  # the motor's


# --- options of commands ------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("text", "ends"), [
    ("-0.15:0.15", (-0.15 * TURN, 0.15 * TURN)),
    ("0:2", (0.0, 2 * TURN)),
    ("free", (-math.inf, math.inf)),
    ("-1:inf", (-TURN, math.inf)),
])  # fmt: skip
def test_travel_is_given_in_turns(text, ends):
    assert parse_travel(text) == pytest.approx(ends)


def test_every_axis_of_a_machine_may_have_its_own_travel():
    with open_target(TargetOptions(load="gantry", travel="-0.2:0.1, 0:0.3", machines=2)) as target:
        assert target.low == pytest.approx(TURN * np.array([-0.2, 0.0, -0.2, 0.0]))
        assert target.high == pytest.approx(TURN * np.array([0.1, 0.3, 0.1, 0.3]))
    with pytest.raises(ValueError, match="3 ranges of travel are given"):
        open_target(TargetOptions(load="gantry", travel="-1:1,-1:1,-1:1"))


@pytest.mark.parametrize("text", ["", "0.3", "a:b", "1:2", "-2:-1", "0:0", "0.1:-0.1", "nan:1", "1:"])
def test_a_travel_that_is_none_is_refused(text):
    with pytest.raises(ValueError, match=f"--travel {text}"):
        parse_travel(text)


def test_without_bus_the_drives_are_emulated_whatever_the_environment_says(monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_CHANNEL", "can0")
    with open_target(TargetOptions(load="inertia", travel="-1:1", machines=2)) as target:
        assert target.drives.machine is not None
        assert target.high.tolist() == [TURN, TURN]


@pytest.mark.parametrize(("options", "message"), [
    ({"nodes": [1]}, "--node, --bitrate and --lockstep are for drives on a bus; add --bus"),
    ({"lockstep": True}, "add --bus"),
    ({"seed": -1}, "--seed must be 0 or more, not -1"),
    ({"machines": 0}, "--machines must be 1 or more, not 0"),
    ({"bus": True}, "--travel is missing: give how far the motor may turn"),
    ({"load": "abc"}, "no load is named 'abc'"),
    ({"motor": "abc"}, "no motor is named 'abc'"),
])  # fmt: skip
def test_a_mistake_in_the_options_says_what_to_do(options, message):
    with pytest.raises(ValueError, match=message):
        open_target(TargetOptions(**options))


@pytest.mark.parametrize(("error", "code"), [
    (ValueError("x"), 2),
    (FileNotFoundError(2, "No such file or directory", "x"), 2),
    (ObjectAccessError(0x06020000, "x"), 2),  # found before anything was sent
    (refused("node 1", "the read of 1234h:00", 0x06020000), 1),  # the drive's answer
    (SafetyError("x"), 1),
    (TimeoutError("x"), 1),
    (RuntimeError("x"), 1),
    (KeyboardInterrupt(), 130),
])  # fmt: skip
@pytest.mark.parametrize("errors_as_exit_codes", [errors_as_exit_codes, errors_of_drive_agent])
def test_errors_end_with_a_line_and_their_code(errors_as_exit_codes, error, code, capsys):
    with pytest.raises(typer.Exit) as found, errors_as_exit_codes():
        raise error
    assert found.value.exit_code == code
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_mistake_of_ours_keeps_its_traceback():
    with pytest.raises(NotImplementedError), errors_as_exit_codes():
        raise NotImplementedError


@pytest.mark.parametrize(
    ("travel", "message"), [((1.0, 2.0), "must contain 0"), (((-1.0, 1.0),) * 2, "ranges of travel")]
)
def test_drives_of_a_bus_that_make_no_target_are_closed(travel, message, monkeypatch):
    """Whoever opened them has nothing to close them by."""
    closed = []
    drives = SimpleNamespace(
        num_axes=1, device=find_device("tmcm1636"), close=lambda: closed.append(1), safety=None,
        read=lambda name: np.array([65536]), axis_numbers=range(1),
    )  # fmt: skip
    monkeypatch.setattr("drive_env.master.open_drives.open_drives", lambda *arguments, **options: drives)
    with pytest.raises(ValueError, match=message):
        on_bus(channel="nowhere", travel=travel, safety=False)
    assert closed == [1]
    target = on_bus(
        channel="nowhere", travel=(-1.0, 2.0), safety=False, nodes=(7,), bitrate=500_000, token="x", pace="lockstep"
    )
    assert closed == [1] and (target.low, target.high, target.linked, target.axes_per_machine) == (-1.0, 2.0, False, 1)
    assert target.machine == "nowhere, node 7"
    assert target.bus == {"channel": "nowhere", "nodes": [7], "bitrate": 500_000, "pace": "lockstep"}
    target.close()
    assert closed == [1, 1]


@pytest.mark.parametrize("linked", [False, True])
def test_axes_that_pull_at_one_thing_move_together(linked):
    zero = np.zeros(4)
    target = Target(
        SimpleNamespace(num_axes=4), find_device("tmcm1636"), find_motor("qbl4208"), supply=zero + 24.0, low=zero - 1.0,
        high=zero + 1.0, speed=10.0, current=1.0, axes_per_machine=2, linked=linked,
    )  # fmt: skip
    where = np.array([False, True, False, False])
    assert target.together(where).tolist() == ([True, True, False, False] if linked else where.tolist())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"low": [0.0], "high": [0.0]},
            "axis 0: travel 0 to 0 rad must contain 0, where the rotor is now, and must not be",
        ),
        ({"low": [0.1]}, "axis 0: travel 0.1 to 1 rad"),
        ({"high": [-0.1]}, "axis 0"),
        ({"low": [0.0]}, None),
        ({"high": [0.0]}, None),
        ({"low": [-np.inf], "high": [np.inf]}, None),
        ({"low": [np.nan]}, "axis 0"),
        ({"supply": [8.0]}, "supply 8 V lies outside"),
        ({"supply": [100.0]}, "supply 100 V lies outside"),
        ({"supply": [np.nan]}, "supply nan V"),
        ({"supply": [24.0, 24.0]}, r"supply must have shape \(1,\), not \(2,\)"),
        ({"speed": 0.0}, "speed 0 rad/s must be above 0 and finite"),
        ({"speed": np.inf}, "speed inf"),
        ({"current": 0.0}, "current 0 A must be above 0"),
        ({"current": -1.0}, "current -1 A"),
    ],
)
def test_limits_of_a_target(change, message):
    given = {"supply": [24.0], "low": [-1.0], "high": [1.0], "speed": 10.0, "current": 1.0} | change
    given = {name: np.array(value) if isinstance(value, list) else value for name, value in given.items()}
    drives = SimpleNamespace(num_axes=1, axis_numbers=range(1))
    if message is None:
        Target(drives, find_device("tmcm1636"), find_motor("qbl4208"), **given)
        return
    with pytest.raises(ValueError, match=message):
        Target(drives, find_device("tmcm1636"), find_motor("qbl4208"), **given)


def test_chosen_axes_are_called_by_their_number_among_all():
    drives = SimpleNamespace(num_axes=2, axis_numbers=(1, 3))
    given = {"supply": np.full(2, 24.0), "low": np.full(2, -1.0), "speed": 10.0, "current": 1.0}
    target = Target(drives, find_device("tmcm1636"), find_motor("qbl4208"), high=np.ones(2), **given)
    assert target.axis_numbers == (1, 3)
    with pytest.raises(ValueError, match=r"axis 3: travel -1 to -0\.1 rad must contain 0"):
        replace(target, high=np.array([1.0, -0.1]))


# --- what is made of drives that are there already ----------------------------------------------------------------
DEVICE, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")


class Envelope:
    """An envelope that keeps what it was told."""

    def change(self, limits):
        self.limits = limits


def drives_of_a_bus(positions, scale=65536, device=DEVICE):
    """Drives of a bus that stand somewhere, with so many increments per turn."""
    values = {0x6064: np.asarray(positions)}
    return SimpleNamespace(
        num_axes=len(positions), device=device, safety=Envelope(),
        read=lambda name: values[name] if name in values else np.full(len(positions), scale),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("axes", "together", "linked"), [("apart", 1, False), ("coupled", 2, False), ("linked", 2, True)]
)
def test_how_the_axes_of_a_bus_belong_together(axes, together, linked):
    target = of_bus(
        drives_of_a_bus([0, 0]), MOTOR, {"channel": "can3", "nodes": [4, 9]}, travel=((-1.0, 2.0), (-3.0, 0.5)),
        axes=axes,
    )  # fmt: skip
    assert (target.axes_per_machine, target.linked) == (together, linked)
    assert (target.low.tolist(), target.high.tolist()) == ([-1.0, -3.0], [2.0, 0.5])
    assert target.machine == "can3, node 4, 9" and target.bus == {"channel": "can3", "nodes": [4, 9]}
    assert target.supply.tolist() == [24.0, 24.0]
    assert (target.speed, target.current) == (MOTOR.rated_speed, MOTOR.rated_current)


def test_what_the_user_knows_of_a_bus_counts():
    target = of_bus(drives_of_a_bus([0]), MOTOR, {}, travel=FREE, supply=30.0, speed=7.0, current=0.5)
    assert (target.supply.tolist(), target.speed, target.current) == ([30.0], 7.0, 0.5)
    assert target.machine == "a bus, node "
    with pytest.raises(ValueError, match="--axes loose must be one of apart, coupled, linked"):
        of_bus(drives_of_a_bus([0]), MOTOR, {}, travel=FREE, axes="loose")


@pytest.mark.parametrize(
    ("travel", "message"),
    [
        ((-1e9, 1e9), None),
        ((-1.001e9, 1.0), r"a travel of -1.001e\+09 to 1 rad is impossible; an axis has 1e\+09 rad to either side"),
        ((-1.0, 1.001e9), r"impossible"),
        ((-math.inf, math.nan), "impossible"),
        ((-math.inf, 5.0), None),
        (((-1.0, 1.0),) * 3, "3 ranges of travel are given, for 1 axis/axes; give one for all, or one for each"),
    ],
)
def test_no_axis_has_a_travel_beyond_what_counters_hold(travel, message):
    if message is None:
        assert of_bus(drives_of_a_bus([0]), MOTOR, {}, travel=travel).high.tolist() == [travel[1]]
        return
    with pytest.raises(ValueError, match=message):
        of_bus(drives_of_a_bus([0]), MOTOR, {}, travel=travel)


@pytest.mark.parametrize(
    ("travel", "slack"),  # in turns
    [
        ((-1.0, 1.0), 0.1),  # a twentieth of it
        ((0.0, 8.0), 0.4),
        ((-0.1, 0.1), 0.02),  # at least a fiftieth of a turn
        ((-50.0, 50.0), 0.5),  # at most half a turn
        ((-1.0, math.inf), 0.02),
    ],
)
def test_the_envelope_lets_an_axis_overshoot_its_travel_by_a_twentieth_of_it(travel, slack):
    drives = drives_of_a_bus([1000, -500])
    hold_to_travel(of_bus(drives, MOTOR, {}, travel=tuple(TURN * end for end in travel)))
    low, high = drives.safety.limits.position
    here = np.array([1000, -500])
    np.testing.assert_allclose(low, here + (travel[0] - slack) * 65536)
    np.testing.assert_allclose(high, here + (travel[1] + slack) * 65536)


@pytest.mark.parametrize(("device", "motor", "times"), [("tmcm1636", "qbl4208", 2), ("tmcm3313", None, 3)])
def test_the_envelope_holds_an_axis_to_a_multiple_of_its_motors_speed(device, motor, times):
    """Twice the rated one, thrice where an encoder commutates a stepper: it is faster while it catches up."""
    row = find_device(device)
    turned = find_motor(motor or row.default_motor)
    drives = drives_of_a_bus([0], 51_200, row)
    hold_to_travel(of_bus(drives, turned, {}, travel=FREE))
    per_radian = 51_200 / TURN * per_increment(drives, 0x606C)
    counts = float(np.squeeze(times * turned.rated_speed * per_radian))
    assert drives.safety.limits.velocity == [math.ceil(counts - 1e-9)]


def test_positions_and_speeds_are_counted_in_turns_of_the_rotor():
    target = of_bus(drives_of_a_bus([0, 0], 4096), MOTOR, {}, travel=FREE)
    assert target.increments() == pytest.approx([4096 / TURN] * 2)
    assert target.speed_counts() == pytest.approx([4096 / TURN] * 2)  # of this drive increments per second


def test_the_address_of_drives_is_what_a_file_can_hold(monkeypatch):
    for name in ("DRIVE_ENV_INTERFACE", "DRIVE_ENV_CHANNEL"):
        monkeypatch.delenv(name, raising=False)
    options = {"bitrate": 250_000, "pace": "lockstep", "safety": False, "bus": object(), "timeout": 3}
    assert address_of("pcan", "x", (3, 5), options) == {
        "interface": "pcan", "channel": "x", "nodes": [3, 5], "bitrate": 250_000, "pace": "lockstep",
    }  # fmt: skip
    assert address_of(None, None, (1,), {"bitrate": None, "pace": object()}) == {"nodes": [1]}
    monkeypatch.setenv("DRIVE_ENV_INTERFACE", "socketcan")
    monkeypatch.setenv("DRIVE_ENV_CHANNEL", "can7")
    assert address_of(None, "can2", (1,), {}) == {"interface": "socketcan", "channel": "can2", "nodes": [1]}
    assert address_of("pcan", None, (1,), {}) == {"interface": "pcan", "channel": "can7", "nodes": [1]}


def machines_that_stand_at(angles, load="belt"):
    row = find_load(load)
    return SimpleNamespace(
        load=row, num_machines=len(angles) // row.num_axes, num_axes=len(angles), device=DEVICE, motor=MOTOR,
        machine=SimpleNamespace(rotor_angle=np.array(angles)),
    )  # fmt: skip


def test_the_way_to_the_ends_of_a_load_is_counted_from_where_the_rotor_stands():
    """A rotor beyond one end has no way to that side; what the user gives narrows it and never widens it."""
    end = way(one(find_load("belt"))).high[0]
    made = machines_that_stand_at([0.0, 3.0, -3.0, end + 1.0, -end - 1.0])
    target = of_machines(SimpleNamespace(num_axes=5), made)
    np.testing.assert_allclose(target.low, [-end, -end - 3.0, 3.0 - end, -2.0 * end - 1.0, 0.0])
    np.testing.assert_allclose(target.high, [end, end - 3.0, end + 3.0, 0.0, 2.0 * end + 1.0])
    assert (target.axes_per_machine, target.linked, target.machine) == (1, False, "belt")
    assert (target.supply.tolist(), target.speed, target.current) == ([24.0] * 5, MOTOR.rated_speed, 3.5)
    near = of_machines(SimpleNamespace(num_axes=5), made, travel=(-2.0, 1e6), supply=20.0, speed=3.0, current=1.0)
    np.testing.assert_allclose(near.low, [-2.0, -2.0, -2.0, -2.0, 0.0])
    np.testing.assert_allclose(near.high, target.high)
    assert (near.supply.tolist(), near.speed, near.current) == ([20.0] * 5, 3.0, 1.0)


def test_the_axes_of_a_gantry_are_linked():
    target = of_machines(SimpleNamespace(num_axes=4), machines_that_stand_at([0.0] * 4, "gantry"))
    assert (target.axes_per_machine, target.linked) == (2, True)
