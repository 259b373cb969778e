"""Quirks of drives as switches of a device's data: what each does on the wire, and that our own motion copes with it.

Each quirk is a variant of the TMCM-1636 with one row; motion is run on the emulated drives, and over a bus by a master
that knows the EDS alone, as it knows a drive of another maker.
"""

from __future__ import annotations

import numpy as np
import pytest
from rigs.quirks import build, variant
from rigs.world_bus import on_bus

from drive_env import motion
from drive_env.devices import find_device
from drive_env.devices.drive_quirks import DriveQuirks

TURN = 65536
PP, PV, CSP, CSV = 1, 3, 8, 9
QUIRKS = {
    "no quirk": {},
    "same mode refused": {"refuses_same_mode": True},
    "mode delayed": {"mode_display_delay": 0.03},
    "mode at a halt": {"mode_change_needs_halt": True},
    "mode delayed, at a halt": {"mode_display_delay": 0.02, "mode_change_needs_halt": True},
    "no bit 10": {"absent_status_bits": [10]},
    "bits absent": {"absent_status_bits": [4, 7, 9, 11, 13, 14, 15]},
    "buffer": {"set_point_buffer": 1},
    "all": {
        "mode_display_delay": 0.01,
        "mode_change_needs_halt": True,
        "absent_status_bits": [4, 9, 10],
        "set_point_buffer": 1,
        "pv_slows_down_by_6084h": True,
        "pv_starts_and_stops": True,
        "homing_here_sets_zero": True,
    },
}


HERE = {"homing_here_sets_zero": True}


def one(drives, name):
    return int(drives.read(name)[0])


# --- what each does ---------------------------------------------------------------------------------------------------
def test_a_mode_that_is_delayed_is_shown_and_acts_late(tmp_path):
    with build(tmp_path, mode_display_delay=0.005) as drives:
        drives.write(0x6060, PP)
        seen = drives.record([0x6060, 0x6061], 0.01)
        assert seen[0x6060][:, 0].tolist() == [PP] * 10
        assert seen[0x6061][:, 0].tolist() == [0] * 5 + [PP] * 5
        drives.write(0x6060, PV)
        drives.advance(0.003)
        drives.write(0x6060, CSP)  # the clock begins anew
        assert drives.record([0x6061], 0.01)[0x6061][:, 0].tolist() == [PP] * 5 + [CSP] * 5


def test_a_mode_that_needs_a_halt_waits_for_rest_and_bit_8(tmp_path):
    with build(tmp_path, mode_change_needs_halt=True) as drives:
        drives.write(0x6060, PV)
        assert one(drives, 0x6061) == PV  # not enabled: at once
        motion.enable(drives)
        drives.write(0x60FF, 20 * TURN)
        drives.advance(0.3)
        drives.write(0x6060, CSV)
        drives.advance(0.1)
        assert one(drives, 0x6061) == PV and one(drives, 0x606C) > 15 * TURN  # it turns on
        drives.write(0x6040, 0x10F)
        drives.advance(0.002)
        assert one(drives, 0x6061) == PV  # it is braking
        drives.advance(0.5)
        assert one(drives, 0x6061) == CSV
        motion.disable(drives)
        drives.write(0x6060, PP)
        assert one(drives, 0x6061) == PP


@pytest.mark.every(2)
@pytest.mark.parametrize("bit", [4, 9, 10, 14])
def test_a_bit_that_is_absent_never_comes(tmp_path, bit):
    """Bits of a move of pp that others show: supply, remote, target reached, motor turns."""
    seen = {}
    for absent in ([], [bit]):
        with build(tmp_path, absent_status_bits=absent) as drives:
            motion.enable(drives, mode="pp")
            motion.start_move(drives, TURN)
            seen[bool(absent)] = drives.record([0x6041], 0.6)[0x6041]
        (tmp_path / "quirky.toml").unlink()
        find_device.cache_clear()
    np.testing.assert_array_equal(seen[True], seen[False] & ~(1 << bit))
    assert np.any(seen[False] & 1 << bit)


def set_point(drives, target, word=0x1F):
    """Give a set-point; return bit 12 as bit 4 is set, and as it is back."""
    drives.write(0x607A, target)
    drives.write(0x6040, word)
    with_bit = one(drives, 0x6041) >> 12 & 1
    drives.write(0x6040, word & ~0x10)
    return with_bit, one(drives, 0x6041) >> 12 & 1


def ends(drives, seconds=3.0):
    """Return where the demand has rested, in turns, until it rests for good."""
    demand = drives.record([0x6062], seconds)[0x6062][:, 0] / TURN
    resting = demand[1:][np.diff(demand) == 0.0]
    return sorted(set(np.round(resting, 6).tolist()), key=resting.round(6).tolist().index)


def test_a_second_set_point_waits_in_the_buffer_and_bit_12_tells_it(tmp_path):
    with build(tmp_path, set_point_buffer=1) as drives:
        motion.enable(drives, mode="pp")
        assert set_point(drives, 2 * TURN) == (1, 0)  # under way, the buffer is empty
        drives.advance(0.05)
        assert set_point(drives, TURN) == (1, 1)  # in the buffer: it is full
        assert set_point(drives, 9 * TURN) == (1, 1)  # one more is not taken
        assert one(drives, 0x6062) < 2 * TURN
        trace = drives.record([0x6041, 0x6062], 1.5)
        peak = int(np.argmax(trace[0x6062][:, 0]))
        assert trace[0x6062][peak, 0] == pytest.approx(2 * TURN, abs=1)
        full = trace[0x6041][:, 0] >> 12 & 1
        assert full[: peak - 1].all() and not full[peak + 2 :].any()  # taken out where the first one ends
        assert not np.any(trace[0x6041][:peak, 0] & 0x0400)  # and bit 10 comes at the last one alone
        assert trace[0x6062][-1, 0] == TURN and trace[0x6041][-1, 0] & 0x0400


def test_a_relative_set_point_in_the_buffer_goes_on_from_the_target_before(tmp_path):
    with build(tmp_path, set_point_buffer=1) as drives:
        motion.enable(drives, mode="pp")
        set_point(drives, 2 * TURN)
        drives.advance(0.02)
        set_point(drives, TURN, 0x5F)
        drives.advance(1.5)
        assert one(drives, 0x6062) == 3 * TURN


ON_SET_POINT = 0x21F  # bit 9, change on set-point


@pytest.mark.parametrize("second", [5, 1])
def test_change_on_set_point_passes_the_first_target_with_the_profiles_velocity(tmp_path, second):
    """Bit 9 of the set-point that waits; without it the axis stops at the first one."""
    speeds = {}
    for word in (0x1F, ON_SET_POINT):
        with build(tmp_path, set_point_buffer=1) as drives:
            motion.enable(drives, mode="pp")
            v = one(drives, 0x6081)
            set_point(drives, 3 * TURN)
            drives.advance(0.02)
            assert set_point(drives, second * TURN, word) == (1, 1)
            trace = drives.record([0x6041, 0x6062], 3.0)
            demand = trace[0x6062][:, 0]
            passed = int(np.argmax(demand >= 3 * TURN))
            speeds[word] = (demand[passed] - demand[passed - 1]) * 1000 / v
            full = trace[0x6041][:, 0] >> 12 & 1
            assert full[: passed - 1].all() and not full[passed + 2 :].any()
            assert not np.any(trace[0x6041][: passed + 2, 0] & 0x0400)
            assert demand[-1] == second * TURN and trace[0x6041][-1, 0] & 0x0400
            if word == ON_SET_POINT and second > 3:
                assert np.all(np.diff(demand) >= 0)
        (tmp_path / "quirky.toml").unlink()
        find_device.cache_clear()
    assert speeds[0x1F] < 0.1
    assert speeds[ON_SET_POINT] == pytest.approx(1.0, abs=0.02)


def test_bit_9_does_nothing_at_rest_nor_without_a_buffer(tmp_path):
    for buffer in (0, 1):
        with build(tmp_path, **({"set_point_buffer": 1} if buffer else {})) as drives:
            motion.enable(drives, mode="pp")
            assert set_point(drives, TURN, ON_SET_POINT) == (1, 0)
            drives.advance(1.0)
            assert one(drives, 0x6062) == TURN
            if not buffer:
                set_point(drives, 20 * TURN)
                drives.advance(0.05)
                assert set_point(drives, 2 * TURN, ON_SET_POINT) == (1, 0)
                drives.advance(2.0)
                assert one(drives, 0x6062) == 2 * TURN
        (tmp_path / "quirky.toml").unlink()
        find_device.cache_clear()


@pytest.mark.parametrize("buffer", [0, 1])
def test_change_set_immediately_replaces_what_is_under_way(tmp_path, buffer):
    with build(tmp_path, **({"set_point_buffer": 1} if buffer else {})) as drives:
        motion.enable(drives, mode="pp")
        set_point(drives, 20 * TURN)
        drives.advance(0.05)
        if buffer:
            assert set_point(drives, 15 * TURN) == (1, 1)
        assert set_point(drives, TURN, 0x3F) == (1, 0)  # the buffer is emptied, too
        drives.advance(2.0)
        assert one(drives, 0x6062) == TURN


def test_without_a_buffer_each_set_point_replaces_the_one_before(tmp_path):
    with build(tmp_path) as drives:
        motion.enable(drives, mode="pp")
        set_point(drives, 20 * TURN)
        drives.advance(0.05)
        assert set_point(drives, TURN) == (1, 0)
        drives.advance(2.0)
        assert one(drives, 0x6062) == TURN


@pytest.mark.every(3)
@pytest.mark.parametrize("how", ["disable", "quick stop", "mode", "reset"])
def test_a_set_point_that_waits_is_forgotten_with_the_move(tmp_path, how):
    with build(tmp_path, set_point_buffer=1) as drives:
        motion.enable(drives, mode="pp")
        set_point(drives, 20 * TURN)
        drives.advance(0.05)
        assert set_point(drives, TURN) == (1, 1)
        if how == "disable":
            motion.disable(drives)
        elif how == "quick stop":
            motion.quick_stop(drives)
        elif how == "reset":
            drives.reset_node()
        else:
            drives.write(0x6060, PV)
        drives.advance(0.5)
        motion.enable(drives, mode="pp")
        here = one(drives, 0x6062)
        drives.advance(0.3)
        assert one(drives, 0x6062) == here
        assert one(drives, 0x6041) & 0x1000 == 0
        motion.move_to(drives, here + TURN)


# --- that our motion copes --------------------------------------------------------------------------------------------
def life(drives):
    """Move, be moved elsewhere during a move, turn, be led, home."""
    motion.enable(drives, mode="pp")
    motion.move_to(drives, TURN)
    assert abs(one(drives, 0x6064) - TURN) < 1000
    motion.start_move(drives, 30 * TURN)
    drives.advance(0.05)
    motion.move_to(drives, -TURN)  # at once, whatever a buffer holds
    assert abs(one(drives, 0x6064) + TURN) < 1000
    motion.move_to(drives, 2 * TURN, relative=True)
    assert abs(one(drives, 0x6064) - TURN) < 2000
    motion.enable(drives, mode="pv")
    assert one(drives, 0x6061) == PV
    drives.write(0x60FF, 5 * TURN)
    drives.advance(0.3)
    assert abs(one(drives, 0x606C) - 5 * TURN) < TURN
    motion.select_mode(drives, "csv")  # turning
    assert one(drives, 0x6061) == CSV
    drives.record([0x606C], 0.05, play={0x60FF: np.zeros(50, int)})
    motion.enable(drives, mode="csp")
    here = one(drives, 0x6064)
    drives.record([0x6064], 0.1, play={0x607A: here + np.arange(100) * 100})
    drives.advance(0.2)
    assert abs(one(drives, 0x6064) - here - 9900) < 2000
    drives.write(0x6098, 35)
    motion.home(drives)
    assert abs(one(drives, 0x6064)) < 2000
    motion.disable(drives)
    assert drives.emergencies() == []


@pytest.mark.every(9)
@pytest.mark.parametrize("quirks", QUIRKS.values(), ids=QUIRKS)
def test_motion_copes_with_each_quirk(tmp_path, quirks):
    with build(tmp_path, **quirks) as drives:
        life(drives)


BY_DEFAULT = ("same mode refused", "all")


@pytest.mark.every(2)
@pytest.mark.parametrize(
    "name", [name if name in BY_DEFAULT else pytest.param(name, marks=pytest.mark.slow) for name in QUIRKS]
)
def test_a_master_that_knows_the_eds_alone_copes_with_each(tmp_path, name):
    path = tmp_path / "vendor.eds"
    path.write_text(find_device("tmcm1636").eds.read_text(encoding="utf-8"), encoding="utf-8")
    with on_bus(build(tmp_path, **QUIRKS[name]), eds=path) as known_by_eds:
        life(known_by_eds)


@pytest.mark.slow
def test_a_mode_that_never_comes_is_told_and_the_axis_is_not_left_running(tmp_path):
    with build(tmp_path, mode_display_delay=1.0) as drives:
        with pytest.raises(TimeoutError, match=r"did not change to csv in 0.5 s, at a halt neither"):
            motion.enable(drives, mode="pv")
            motion._await_mode(drives, "csv", np.ones(1, bool), timeout=0.5)
        assert one(drives, 0x6040) == 0x10F  # halted


def test_a_move_that_does_not_arrive_is_no_move_that_has(tmp_path):
    """Without bit 10 the position decides: an axis that stands elsewhere has not got there."""
    with build(tmp_path, absent_status_bits=[10]) as drives:
        motion.enable(drives, mode="pp")
        motion.move_to(drives, TURN)
        drives.write((0x607D, 2), 2 * TURN)
        with pytest.raises(TimeoutError, match=r"axis 0 did not reach its target in 1"):
            motion.move_to(drives, 5 * TURN, timeout=1.0)


@pytest.mark.parametrize(("quirks", "position"), [(HERE, 0), ({"homing_here_sets_zero": False}, -1000)])
def test_method_35_leaves_607ch_out_on_drives_that_set_zero_here(tmp_path, quirks, position):
    with build(tmp_path, **quirks) as drives:
        motion.select_mode(drives, "hm")
        drives.write(0x607C, 1000)
        drives.write(0x6098, 35)
        drives.write(0x6040, 0x10)
        assert one(drives, 0x6062) == position


# --- the data ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("quirks", "message"),
    [
        ({"mode_display_delay": 2.0}, "mode_display_delay = 2.0 must be 0 to 1 s"),
        ({"absent_status_bits": [3]}, r"absent_status_bits = \[3\] must be some of 4, 7, 9, 10, 11, 13, 14, 15"),
        ({"absent_status_bits": [12]}, "what a master waits for"),
        ({"set_point_buffer": 2}, "set_point_buffer = 2 must be 0, or 1"),
        ({"mode_delay": 0.1}, "quirks.mode_delay is nothing that a device has"),
        ({"mode_change_needs_halt": 1}, "must be true or false"),
        ({"pv_starts_and_stops": 0}, "pv_starts_and_stops = 0 must be true or false"),
    ],
)
def test_a_quirk_that_cannot_be_is_told(tmp_path, quirks, message):
    with pytest.raises(ValueError, match=message):
        find_device(variant(tmp_path, quirks))


@pytest.mark.parametrize(
    ("device", "quirks"),
    [
        ("tmcm1636", HERE),  # its manual, 607Ch and section 8.1.5
        ("tmcm1636_fw109", HERE),
        ("tgz_d", HERE),  # its manual, homing method: "set zero to the actual position"
        ("tmcm6212", HERE | {"pv_starts_and_stops": True}),  # its manual, section 1.5
        ("tmcm3313", HERE | {"pv_slows_down_by_6084h": True}),  # its manual, sections 8.1.10 and 7.1.14
    ],
)
def test_the_devices_that_ship_have_those_of_their_manuals_alone(device, quirks):
    assert find_device(device).quirks == DriveQuirks(**quirks)
