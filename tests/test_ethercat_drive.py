"""`drive-env serve tmcm3313 --interface ethercat`, and a stock master in another network namespace that moves it."""

from __future__ import annotations

import json
import os
import select
import struct
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import ethercat_cable
import numpy as np
import pytest
from test_ethercat_ways import needs_namespaces

from drive_env import EmulatedDrives, motion
from drive_env.ethercat.namespaces import Namespaces

HERE = Path(__file__).parent
PATIENCE = 240.0  # s; kernels may have to be compiled
CYCLES = 400


@pytest.fixture
def spaces():
    number = os.getpid() % 100_000
    spaces = Namespaces(f"drive-{number}", f"master-{number}", "veth1", "veth0")
    spaces.make()
    yield spaces
    spaces.remove()


def inside(space, *arguments):
    return ["ip", "netns", "exec", space, sys.executable, *map(str, arguments)]


def first_line(process):
    """Return what a process prints first; it may compile before."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and process.poll() is None:
        if select.select((process.stdout,), (), (), 1.0)[0]:
            return process.stdout.readline()
    raise AssertionError(f"it did not begin: {process.poll()}")


@contextmanager
def served(spaces, pace, device="tmcm3313", load="portal"):
    """Serve a drive in its namespace."""
    program = "from drive_env.programs import drive_env; drive_env()"
    serve = ("-c", program, "serve", device, "--load", load, pace)
    process = subprocess.Popen(
        inside(spaces.slave, *serve, "--interface", "ethercat", "--channel", spaces.slave_interface),
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert f"1 slave ({device}" in first_line(process)
        yield
    finally:
        process.terminate()
        process.wait(PATIENCE)
        process.stdout.close()


def seen_by(spaces, pace, program_of_master, *arguments, device="tmcm3313", load="portal", library="pysoem"):
    """Return what a master saw of a drive that is served."""
    pytest.importorskip(library, reason=f"{library} is not installed: pip install -e '.[test]'")
    with served(spaces, pace, device, load):
        master = inside(spaces.master, HERE / program_of_master, spaces.master_interface, *arguments)
        done = subprocess.run(master, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@needs_namespaces
def test_soem_moves_all_three_axes_in_csp(spaces):
    seen = seen_by(spaces, "--lockstep", "ethercat_drive_master.py", CYCLES)
    assert seen["slaves"] == 1 and seen["identity"] == [0x286, 3313, 0x10009] and seen["name"] == "TMCM-3313"
    mapping = struct.unpack("<H9I", bytes.fromhex(seen["mapping"]))
    assert mapping[:3] == (9, 0x60400010, 0x607A0020), "complete access"
    assert seen["refused"] == 0x06010002, "1018h is read only"
    assert seen["objects"] == 331 and seen["described"] == ["Statusword", 6, 16] and seen["entries"] == 4
    assert seen["sizes"] == [30, 30] and seen["safe_op"] and seen["op"]
    assert seen["words"] == [0x27] * 3, "operation enabled"
    assert seen["wrong"] <= 50  # of 700, on a machine that others use, too
    assert seen["moved"] == pytest.approx([CYCLES * 4, CYCLES * 8, CYCLES * 12], abs=200)
    assert seen["stopped"] == [0x08] * 3, "who leaves Op has its motors stopped, by a fault"
    assert seen["error"] == 0x8100, "and is told"


@pytest.mark.slow
@needs_namespaces
@pytest.mark.parametrize(
    ("device", "load", "clock"),
    [("tmcm3313", "portal", "free"), ("tgz_d", "gantry", "free"), ("tmcm3313", "portal", "sync0")],
)
def test_ethercat_drives_on_soem_give_the_integers_of_emulated_ones(spaces, device, load, clock):
    seen = seen_by(
        spaces, "--lockstep", "ethercat_drives_master.py", CYCLES, "lockstep", device, clock, device=device, load=load
    )
    with EmulatedDrives(device, load=load, num_threads=1) as drives:
        motion.enable(drives, mode="csp")
        start = drives.read(0x6064)
        targets = start + np.minimum(np.arange(CYCLES + 100), CYCLES)[:, None] * 4 * np.arange(1, drives.num_axes + 1)
        trace = drives.record([0x6041, 0x6064], (CYCLES + 100) * 0.001, {0x607A: targets})
        expected = trace[0x6064]
        if clock == "free":
            assert seen["moved"] == (drives.read(0x6064) - start).tolist()
    rows = np.array(seen["rows"])
    if clock == "sync0":  # what is played acts at the next pulse, a cycle later
        rows, expected = rows[1:], expected[:-1]
    np.testing.assert_array_equal(rows, expected)
    assert seen["words"] == [0x27] * drives.num_axes
    assert seen["disabled"] == [0x40] * drives.num_axes and seen["emergencies"] == 0


@pytest.mark.slow
@needs_namespaces
def test_a_cable_that_is_pulled_in_motion_stops_the_drive_within_its_watchdog_and_it_comes_back():
    """50 times of 50: python tests/ethercat_cable.py 50."""
    pytest.importorskip("pysoem", reason="pysoem is not installed: pip install -e '.[ethercat]'")
    for pulled in ethercat_cable.main(2):
        assert pulled["watchdog"] == ethercat_cable.SILENCE
        assert pulled["left_op"] <= pulled["watchdog"] + 0.01  # s: a cycle, and what this computer is late by
        assert pulled["at_rest"] <= pulled["left_op"] + 0.1, "the ramp of the fault reaction"
