"""The TGZ-D with newer firmware: D-Mode 9 and 10, torques of M-Inull, homing on a stop, speeds in the native image."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from rigs.coe_rig import CoeRig
from rigs.tgz_images import select

from drive_env import EmulatedDrives, ObjectAccessError, cia402, motion
from drive_env.devices import find_device
from drive_env.drives import currents
from drive_env.ethercat.application import AlState
from drive_env.ethercat.esi import esi_text
from drive_env.firmware.record import get_lanes, set_lanes

NAME, TURN = "tgz_d_2026", 2**20
ATTAINED = 0x1400  # bits 10 and 12


@pytest.fixture(scope="module")
def inertia():
    with EmulatedDrives(NAME, "inertia", num_threads=1, ideal=True) as drives:
        yield drives


@pytest.fixture
def axis(inertia):
    inertia.machine.reset()
    inertia.machine.brake = "open"
    return inertia


@pytest.mark.parametrize(("mode", "needs", "before"), [("tq", 9, 1), ("cst", 9, 1), ("csv", 10, 2), ("csp", 3, 3)])
def test_a_mode_wants_the_d_mode_of_its_page(axis, mode, needs, before):
    number = {"tq": 4, "cst": 10, "csv": 9, "csp": 8}[mode]
    assert find_device("tgz_d").mode_gate[number] == before
    motion.enable(axis, mode=mode)
    assert axis.read("D-Mode")[0] == needs
    axis.write("D-Mode", before if before != needs else 2)
    axis.advance(0.3)
    assert not cia402.matches(axis.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED).any(), "not its master's any more"


def test_1000_of_the_target_torque_are_m_inull(axis):
    nominal = axis.read("M-Inull")[0] * 1e-3
    motion.enable(axis, mode="cst")
    axis.write(cia402.TARGET_TORQUE, 500)
    axis.advance(0.02)
    asked, found = (get_lanes(axis.inside.records, name, 1)[0] for name in ("i_q_ref", "i_q_meas"))
    assert asked == pytest.approx(0.5 * nominal) and found == pytest.approx(asked, rel=0.1)
    assert axis.read(cia402.TORQUE_ACTUAL)[0] == pytest.approx(found / nominal * 1000.0, abs=1)
    assert currents.ampere_per_count(axis) == pytest.approx(1e-3 * nominal)
    assert currents.highest_current(axis) == pytest.approx(axis.read("M-Ipeak")[0] * 1e-3)
    axis.write(cia402.TARGET_TORQUE, f"{0.25 * nominal} A")
    assert axis.read(cia402.TARGET_TORQUE)[0] == 250


def test_profile_type_1_is_reserved(axis):
    for shape in (-3, -2, -1, 0):
        axis.write(0x6086, shape)
    with pytest.raises(ObjectAccessError) as caught:
        axis.write(0x6086, 1)
    assert caught.value.abort_code == 0x06090030
    axis.write(0x6086, 0)


# --- homing on a stop -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("method", "sign", "sets_zero"), [(-1, 1, False), (-2, -1, False), (-3, 1, True), (-4, -1, True)]
)
def test_homing_ends_at_a_wall(axis, method, sign, sets_zero):
    """The wall is a brake that closes while it runs: its torque is twice the rated one, the current's limit half."""
    axis.write("C-LimP", 500)
    axis.write("C-LimN", 500)
    axis.write("Homing method", method)
    axis.write((0x6099, 1), 120_000)  # 120 rpm
    axis.write("Homing acceleration", 2_000_000)
    motion.enable(axis, mode="hm")
    begin = axis.machine.rotor_angle[0]
    axis.write(cia402.CONTROLWORD, 0x1F)
    axis.advance(0.5)
    assert (axis.machine.rotor_angle[0] - begin) * sign > 1.5, "it runs, on and on"
    assert not axis.read(cia402.STATUSWORD)[0] & ATTAINED
    axis.machine.brake = "closed"
    axis.advance(0.05)
    assert not axis.read(cia402.STATUSWORD)[0] & ATTAINED, "not yet 0.1 s"
    axis.advance(0.3)
    assert axis.read(cia402.STATUSWORD)[0] & ATTAINED == ATTAINED
    there = (axis.machine.rotor_angle[0] - begin) / (2.0 * math.pi) * TURN
    assert axis.read(0x6064)[0] == pytest.approx(0.0 if sets_zero else there, abs=0.002 * TURN)
    axis.advance(0.1)
    assert abs(get_lanes(axis.inside.records, "i_q_meas", 1)[0]) < 0.3, "it presses no more"
    motion.disable(axis)


def test_a_run_to_a_stop_can_be_ended(axis):
    axis.write("Homing method", -1)
    axis.write((0x6099, 1), 120_000)
    axis.write("Homing acceleration", 2_000_000)
    motion.enable(axis, mode="hm")
    axis.write(cia402.CONTROLWORD, 0x1F)
    axis.advance(0.3)
    axis.write(cia402.CONTROLWORD, 0x0F)
    axis.advance(0.3)
    before = axis.machine.rotor_angle[0]
    axis.advance(0.2)
    assert axis.machine.rotor_angle[0] == pytest.approx(before, abs=0.01)
    assert not axis.read(cia402.STATUSWORD)[0] & 0x1000


def test_the_older_firmware_has_none_of_it():
    with EmulatedDrives("tgz_d", "inertia", num_threads=1) as drives:
        for name, value in (("Homing method", -1), ("D-Mode", 9)):
            with pytest.raises(ObjectAccessError):
                drives.write(name, value)
        drives.write(0x6086, 1)


# --- the native image -------------------------------------------------------------------------------------------------
class NativeImage:
    def __init__(self, drives, d_mode):
        self.rig = CoeRig(drives)
        self.rig.bring_to(AlState.PRE_OP)
        for index in (0x2303, 0x2403):
            assert self.rig.download(index, 0, struct.pack("<I", d_mode)) == 0
        assert select(self.rig, 0x1721) + select(self.rig, 0x1B21) == [0] * 6
        self.rig.bring_to(AlState.OP, outputs=44, inputs=44)

    def exchange(self, set_points, control, current=0, cycles=1):
        axes = (struct.pack("<qIhH", one, control, current, 0) for one in set_points)
        data = b"".join(axes) + bytes(12)
        for _ in range(cycles):
            found, _ = self.rig.exchange_image(data, 44)
        return struct.unpack("<qqIIIHHhhII", found)


@pytest.fixture(scope="module")
def gantry():
    with EmulatedDrives(NAME, "gantry", num_threads=1) as drives:
        yield drives


@pytest.mark.every(2)
@pytest.mark.parametrize("rpm", [100, -100])
def test_with_d_mode_10_its_set_points_are_speeds(gantry, rpm):
    """500 rpm is 0x1F4_0000_0000 (R)."""
    gantry.machine.reset()
    native = NativeImage(gantry, 10)
    native.exchange([0, 0], 0, cycles=5)
    native.exchange([0, 0], 2, cycles=60)
    assert list(gantry.read(0x6061)) == [9, 9]
    before = gantry.machine.rotor_angle.copy()
    native.exchange([rpm << 32] * 2, 2, cycles=300)
    found = gantry.machine.rotor_speed * 30.0 / math.pi
    assert found == pytest.approx([rpm, rpm], rel=0.03)
    assert ((gantry.machine.rotor_angle - before) * np.sign(rpm) > 2.0).all()
    native.exchange([rpm << 32] * 2, 0, cycles=500)
    assert np.abs(gantry.machine.rotor_speed).max() < 1.0, "its enable bit is gone"


def test_with_d_mode_3_they_are_positions_and_its_currents_parts_of_m_ipeak(gantry):
    gantry.machine.reset()
    native = NativeImage(gantry, 3)
    start = native.exchange([0, 0], 0, cycles=2)[:2]
    native.exchange(start, 2, cycles=60)
    assert list(gantry.read(0x6061)) == [8, 8]
    for k in range(200):
        native.exchange([one + (k + 1) * 2**32 // 1000 for one in start], 2)
    end = native.exchange([one + 200 * (2**32 // 1000) for one in start], 2, current=3277, cycles=200)
    assert np.array(end[:2]) - start == pytest.approx([0.2 * 2**32] * 2, rel=0.03)
    peak, nominal = (gantry.read(name)[0] * 1e-3 for name in ("M-Ipeak", "M-Inull"))
    assert gantry.read(cia402.TARGET_TORQUE)[0] == pytest.approx(100.0 * peak / nominal, abs=1)
    ampere = get_lanes(gantry.inside.records, "torque_meas", 2)
    shown = native.exchange([one + 200 * (2**32 // 1000) for one in start], 2, current=3277)
    assert np.array(shown[7:9]) == pytest.approx(ampere * 32767.0 / peak, abs=2)
    native.exchange(start, 0, cycles=300)


def test_its_description_file_is_the_older_ones():
    assert esi_text(find_device(NAME)) == esi_text(find_device("tgz_d"))


# --- 64 bits of position ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("turns", [3000, 10_000, 172_800_000])  # the last: a day at 2,000 rev/s
def test_a_set_point_of_64_bits_means_all_of_them(axis, turns):
    """Of 607Ah's 32 bits 4,096 turns alias; a native set-point so far away is no near one."""
    set_lanes(axis.inside.records, "home_shift", np.full(1, -2.0 * math.pi * turns))
    axis.advance(0.01)
    start = axis.read(0x33C0)
    assert start[0] / 2**32 == pytest.approx(turns)
    motion.enable(axis, mode="csp")
    begin = axis.machine.rotor_angle[0]
    rows = start + np.minimum(np.arange(300), 200)[:, None] * (2**32 // 500)
    axis.record([0x33C0], 0.3, {0x23C7: rows})
    assert axis.read(0x33C0) - start == pytest.approx(0.4 * 2**32, rel=0.02)
    assert axis.machine.rotor_angle[0] - begin == pytest.approx(0.8 * math.pi, rel=0.02)
    axis.write(0x23C7, int(axis.read(0x33C0)[0]) - 4096 * 2**32)  # the same to 32 bits
    axis.advance(0.002)
    assert axis.read("aDriveError")[0] & 1 << 16
    assert not cia402.matches(axis.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED).any(), "a jump: trajectory"


def test_607ah_goes_on_round_the_counter(axis):
    """Its 32 bits refer to what 6064h shows, also after a native set-point."""
    set_lanes(axis.inside.records, "home_shift", np.full(1, -2.0 * math.pi * 10_000))
    axis.advance(0.01)
    motion.enable(axis, mode="csp")
    start, near = axis.read(0x33C0), axis.read(0x6064)
    axis.write(0x23C7, start)
    axis.advance(0.01)
    axis.record([0x6064], 0.2, {0x607A: near + np.minimum(np.arange(200), 100)[:, None] * 1000})
    assert axis.read(0x33C0) - start == pytest.approx(100_000 * 4096, rel=0.03)
    motion.disable(axis)
