"""`drive-env serve tmcm3313 --interface ethercat`, and a stock master in another network namespace that moves it."""

from __future__ import annotations

import struct

import ethercat_cable
import numpy as np
import pytest
from rigs.namespaces import needs_namespaces, seen_by
from rigs.namespaces import spaces as spaces

from drive_env import EmulatedDrives, motion

CYCLES = 400


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
