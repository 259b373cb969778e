"""Run lamp and error lamp of a node (TMCM-6212 manual, section 2.3; CiA 303-3)."""

from __future__ import annotations

import pytest

from drive_env import EmulatedDrives
from drive_env.bus.faults import Faults
from drive_env.bus.wire import Wire
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.canopen.leds import PATTERNS, is_lit
from drive_env.canopen.nmt import Command

NODE = 5


@pytest.fixture
def world():
    made = World()
    made.add(EmulatedDrives(load="inertia", num_threads=1), [NODE])
    made.power_on()
    yield made
    made.close()


def shown(world, axis=0):
    run, error = world.drives[0].machine.leds
    return run[axis], error[axis]


def sdo(world, index, sub, raw, size):
    world.receive(
        Frame(0x600 + NODE, bytes((0x23 | (4 - size) << 2, index & 0xFF, index >> 8, sub)) + raw.to_bytes(4, "little"))
    )


@pytest.mark.parametrize(
    ("command", "run"),
    [
        (Command.STOP, "single flash"),
        (Command.ENTER_PRE_OPERATIONAL, "blinking"),
        (Command.START, "on"),
        (Command.RESET_NODE, "blinking"),
    ],
)
def test_the_run_lamp_shows_the_nmt_state(world, command, run):
    assert shown(world) == ("blinking", "off")
    world.receive(Frame(0x000, bytes((Command.START, 0))))
    assert shown(world) == ("on", "off")
    world.receive(Frame(0x000, bytes((command, NODE))))
    assert shown(world) == (run, "off")


def test_a_lost_heartbeat_is_a_double_flash_until_it_is_back(world):
    sdo(world, 0x1016, 1, 0x0001_0014, 4)  # node 1, 20 ms
    world.receive(Frame(0x701, b"\x05"))
    for _ in range(25):
        assert shown(world)[1] in ("off", "double flash")
        world.receive(Frame(0x080, b""))
    assert shown(world)[1] == "double flash"
    world.receive(Frame(0x701, b"\x05"))
    assert shown(world)[1] == "off"


def test_error_frames_are_a_single_flash_from_the_warning_limit_on_and_bus_off_a_steady_light():
    """8 for each error frame (ISO 11898-1): 12 of them make 96, 32 make 256."""
    wire = Wire(faults=Faults(corrupt=1.0, only=(0x700 + NODE,)), instant=False)
    world = World(lockstep=False, wire=wire)
    world.add(EmulatedDrives(load="inertia", num_threads=1), [NODE])
    world.power_on()  # its boot-up message meets an error, again and again
    seen = []
    for k in range(1, 8_000):
        world.run_until(k * 5e-6)
        if not seen or shown(world)[1] != seen[-1][0]:
            seen.append((shown(world)[1], wire.statistics.errors))
        if seen[-1][0] == "on":
            break
    assert [pattern for pattern, _ in seen] == ["off", "single flash", "on"]
    assert [errors for _, errors in seen[1:]] == [12, 32]
    world.close()


def test_axes_of_a_module_share_its_lamps_and_drives_on_no_bus_show_what_they_do_after_power_on():
    world = World()
    drives = EmulatedDrives("tmcm6212", "gantry", num_machines=6, num_threads=1)
    assert [lamps.tolist() for lamps in drives.machine.leds] == [["blinking"] * 12, ["off"] * 12]
    world.add(drives, [1, 2])
    world.power_on()
    world.receive(Frame(0x000, bytes((Command.START, 2))))
    assert drives.machine.leds[0].tolist() == ["blinking"] * 6 + ["on"] * 6
    world.close()


@pytest.mark.parametrize(
    ("pattern", "lit"),
    [  # in steps of 200 ms, from 0.1 s on
        ("off", "0000000000"),
        ("on", "1111111111"),
        ("blinking", "1010101010"),
        ("single flash", "1000001000"),
        ("double flash", "1010000010"),
    ],
)
def test_times_of_the_patterns_are_those_of_the_manual(pattern, lit):
    assert "".join(str(int(is_lit(pattern, 0.1 + 0.2 * k))) for k in range(10)) == lit
    assert pattern in PATTERNS
