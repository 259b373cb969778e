"""Commands of the TGZ that are not CiA 402's, by what they move: the native image's control, K-Command, outputs."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from rigs.canopen_wire import Wire
from rigs.coe_rig import CoeRig
from rigs.fault_injection import ANSWER
from rigs.tgz_images import select
from rigs.truth import field
from rigs.world_bus import bus_of, on_bus

from drive_env import CanDrives, EmulatedDrives, Limits, SafetyError, cia402, motion
from drive_env.ethercat.application import AlState

RPM = math.pi / 30.0
TURN, UNITS = 2**32, 2**20
REMOTE = 0x0200


def new_drives(load="inertia", **given):
    return EmulatedDrives("tgz_d", load, num_threads=1, seed=0, ideal=True, **given)


@pytest.fixture
def drives():
    with new_drives() as drives:
        yield drives


def serve(drives, d_mode, command=1):
    """Let the service program enable an axis whose master has no mode."""
    drives.write("D-Mode", d_mode)
    drives.write(cia402.MODE, 0)
    drives.advance(0.005)
    drives.write("K-Command", 0)
    drives.advance(0.002)
    drives.write("K-Command", command)
    drives.advance(0.01)


def is_on(drives):
    return field(drives, "stage_on")[0] == 1.0


# --- the native image -------------------------------------------------------------------------------------------------
class Native:
    """A master that knows nothing of CiA 402."""

    def __init__(self, drives):
        drives.machine.reset()
        self.rig = CoeRig(drives)
        self.rig.bring_to(AlState.PRE_OP)
        assert select(self.rig, 0x1721) + select(self.rig, 0x1B21) == [0] * 6
        self.rig.bring_to(AlState.OP, outputs=44, inputs=44)
        self.positions, self.control, self.limit = [0, 0], [0, 0], [0, 0]
        self.exchange()
        self.positions = list(self.actual)

    def exchange(self, cycles=1):
        for _ in range(cycles):
            axes = (
                struct.pack("<qIhH", *one) for one in zip(self.positions, self.control, (0, 0), self.limit, strict=True)
            )
            data, _ = self.rig.exchange_image(b"".join(axes) + bytes(12), 44)
        found = struct.unpack("<qqIIIHHhhII", data)
        self.actual, self.status, self.analog, self.current = found[0:2], found[3:5], found[5:7], found[7:9]


@pytest.fixture(scope="module")
def gantry():
    with new_drives("gantry") as drives:
        yield drives


def test_a_master_without_cia_402_moves_both_axes_by_1721h_alone(gantry):
    native = Native(gantry)
    assert [word & 0x7F for word in native.status] == [0x5A, 0x5A], "no power, not initialised before it was on"
    native.control = [2, 2]
    native.exchange(10)
    assert [word & 0x7F for word in native.status] == [0x7F, 0x7F]
    begin, angle = list(native.actual), gantry.machine.rotor_angle.copy()
    for share in np.linspace(0.0, 1.0, 400):
        native.positions = [start + round(share * TURN / 4) for start in begin]
        native.exchange()
    native.exchange(300)
    moved = gantry.machine.rotor_angle - angle
    assert moved == pytest.approx([math.pi / 2.0] * 2, abs=0.02)
    assert [now - start for now, start in zip(native.actual, begin, strict=True)] == pytest.approx(
        [TURN / 4] * 2, rel=0.01
    )
    native.control = [0, 2]
    native.exchange(3)
    assert field(gantry, "stage_on").tolist() == [0.0, 1.0]
    native.control = [0, 0]
    native.exchange(3)
    assert field(gantry, "stage_on").tolist() == [0.0, 0.0]


def test_no_value_of_the_image_voids_a_falling_enable_bit(gantry):
    native = Native(gantry)
    start = list(native.positions)
    for axis in range(2):
        for position in (start[axis], -(2**63), 2**63 - 1, 0):
            for limit in (0, 0xFFFF):
                native.positions, native.limit = list(start), [0, 0]
                native.control = [0, 0]
                native.exchange(2)
                gantry.machine.error_bits = 0
                native.control = [2, 2]
                native.exchange(8)
                assert field(gantry, "stage_on")[axis] == 1.0
                native.positions[axis], native.limit[axis], native.control[axis] = position, limit, 0
                native.exchange()
                assert field(gantry, "stage_on")[axis] == 0.0


def test_errors_are_cleared_by_an_edge_and_an_old_enable_bit_enables_nothing(gantry):
    native = Native(gantry)
    native.control = [2, 2]
    native.exchange(10)
    gantry.machine.error_bits = [1 << 21, 0]
    native.exchange(4)
    assert native.status[0] & 0x11 == 0 and field(gantry, "stage_on")[0] == 0.0
    gantry.machine.error_bits = 0
    native.exchange(4)
    native.control = [3, 2]
    native.exchange(4)
    assert native.status[0] & 0x11 == 0x10, "no error, and still no power"
    native.control = [0, 2]
    native.exchange(2)
    native.control = [2, 2]
    native.exchange(10)
    assert native.status[0] & 0x11 == 0x11


FRAMES = [(0, 0.0)] * 3 + [(2, min(max(k / 40.0 - 0.3, 0.0), 1.0)) for k in range(60)] + [(0, 1.0)] * 12
FAULTS = {  # of one frame: what arrives, in its order
    "lost": lambda at: [*range(at), *range(at + 1, len(FRAMES))],
    "doubled": lambda at: [*range(at + 1), *range(at, len(FRAMES))],
    "late": lambda at: [*range(at), at + 1, at, *range(at + 2, len(FRAMES))],
    "the last one": lambda at: [*range(at + 1)],  # the master dies
}


@pytest.mark.every(4)
@pytest.mark.parametrize("step", [25, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("fault", FAULTS)
def test_whatever_happens_to_a_frame_of_the_native_image_the_axes_end_at_rest_and_off(gantry, fault, step):
    fastest = 0.0
    for at in range(0, len(FRAMES) - 1, step):
        gantry.machine.reset()
        native = Native(gantry)
        start = list(native.positions)
        for number in FAULTS[fault](at):
            control, share = FRAMES[number]
            native.control, native.positions = [control] * 2, [one + round(share * TURN / 8) for one in start]
            native.exchange()
            fastest = max(fastest, float(np.abs(gantry.machine.rotor_speed).max()))
        world = native.rig.world
        world.lockstep = False
        world.run_until(world.time + 2.0)  # and no frame more
        assert field(gantry, "stage_on").tolist() == [0.0, 0.0], at
        assert np.abs(gantry.machine.rotor_speed).max() < 0.05, at
    assert fastest > 5.0, "it moved"


def test_the_native_images_current_limit_inputs_and_outputs(gantry):
    native = Native(gantry)
    gantry.machine.analog_inputs = [[32767, 0], [100, 0]]
    gantry.machine.digital_inputs = [0b10010010, 0]
    native.control = [1 << 28 | 1 << 30, 1 << 29]
    native.exchange(2)
    assert native.analog == (32767, 100)
    levels = int(gantry.read(0x4000)[0])
    for axis, word in enumerate(native.status):
        assert word >> 28 == sum((levels >> (2 * k + axis) & 1) << k for k in range(4))
    assert gantry.machine.outputs[0] == 0b011001  # outputs 1, 5 of the first axis, 4 of the second
    assert gantry.read("ec_control").tolist() == [1 << 28 | 1 << 30, 1 << 29]
    native.limit = [32767, 0]
    native.exchange(2)
    assert field(gantry, "i_high").tolist()[0] == 0.0 < field(gantry, "i_high")[1]


# --- the service modes ------------------------------------------------------------------------------------------------
def test_k_i_is_the_current_of_d_mode_1(drives):
    drives.machine.brake = "closed"
    serve(drives, 1)
    assert is_on(drives) and not int(drives.read(cia402.STATUSWORD)[0]) & REMOTE
    for current in (1500, -700):
        drives.write("K-I", current)
        drives.advance(0.02)
        assert field(drives, "i_q")[0] == pytest.approx(1e-3 * current, abs=0.02)


def test_k_v_is_the_speed_of_d_mode_2(drives):
    serve(drives, 2)
    drives.write("K-V", -400)
    drives.advance(0.5)
    assert drives.machine.rotor_speed[0] == pytest.approx(-400.0 * RPM, rel=0.03)


def test_k_p_is_the_position_of_d_mode_3_and_begins_where_the_axis_is(drives):
    drives.write("K-P_Revol", 40)  # before: it moves nothing
    serve(drives, 3)
    drives.advance(0.2)
    assert abs(drives.machine.rotor_angle[0]) < 0.01
    assert drives.read("K-P_Revol")[0] in (0, -1)
    drives.write("V-LimP", 600)
    drives.write(cia402.FOLLOWING_WINDOW, 0)
    drives.write("M-Nmax", 100_000)
    for share in np.linspace(0.0, 1.0, 200):  # led there, as a service program's jog does
        drives.write("K-P_Angle", int(share * 0.75 * TURN))
        drives.advance(0.001)
    drives.write("K-P_Revol", 0)
    drives.advance(0.5)
    assert drives.machine.rotor_angle[0] / (2.0 * math.pi) == pytest.approx(0.75, abs=0.01)


def test_dpos_is_the_destination_of_d_mode_7_with_acc_and_posspeed(drives):
    for name, value in (("PG Acc", 50), ("PG Dec", 50), ("PG PosSpeed", 10)):
        drives.write(name, value * 2**16)
    serve(drives, 7)
    drives.write("PG DPosAngle", 0)
    drives.write("PG DPosRevol", -6)
    trace = drives.record(["PG ASpeed"], 1.5)["PG ASpeed"][:, 0] / 2**16
    assert trace.min() == pytest.approx(-10.0, rel=0.01)
    assert drives.machine.rotor_angle[0] / (2.0 * math.pi) == pytest.approx(-6.0, abs=0.01)
    assert drives.read("PG Rdy")[0] == 1


@pytest.mark.parametrize(("d_mode", "mode"), [(6, 1), (7, 0)])
def test_speed_leads_d_mode_6_and_with_mode_0_d_mode_7(drives, d_mode, mode):
    drives.write("PG Mode", mode)
    serve(drives, d_mode)
    drives.write("PG Speed", 8 * 2**16)
    drives.advance(0.6)
    assert drives.machine.rotor_speed[0] / (2.0 * math.pi) == pytest.approx(8.0, rel=0.03)


def turns():
    drives = new_drives()
    serve(drives, 2)
    drives.write("K-V", 900)
    drives.advance(0.5)
    assert drives.machine.rotor_speed[0] > 80.0
    return drives


@pytest.mark.parametrize("word", [0x00, 0x02, 0x06, 0x07], ids=lambda word: f"{word:02X}h")
@pytest.mark.parametrize("order", [(0, 1), (1, 0)], ids=["word first", "edge first"])
def test_a_controlword_that_stops_wins_over_an_edge_that_enables(drives, word, order):
    motion.enable(drives, mode="csv")
    drives.write(cia402.TARGET_VELOCITY, "300 rpm")
    drives.advance(0.3)
    assert drives.machine.rotor_speed[0] == pytest.approx(300.0 * RPM, rel=0.05)
    writes = ((cia402.CONTROLWORD, word), (0x23C8, 2))
    for k in order:
        drives.write(*writes[k])
    drives.advance(1.0)
    assert not is_on(drives)
    drives.write(cia402.TARGET_VELOCITY, 0)
    for control in (0, 2):
        drives.write(0x23C8, control)
        drives.advance(0.02)
    assert is_on(drives), "another edge enables"


STOPS = {
    "K-Command": lambda drives: drives.write("K-Command", 0),
    "another D-Mode": lambda drives: drives.write("D-Mode", 1),
    "a mode that fits": lambda drives: drives.write(cia402.MODE, cia402.CSV),
    "an error": lambda drives: setattr(drives.machine, "error_bits", 1 << 20),
    "the enable input": lambda drives: setattr(drives.machine, "enable_input", False),
}


@pytest.mark.parametrize("name", STOPS)
def test_what_stops_an_axis_of_the_service(name):
    with turns() as drives:
        STOPS[name](drives)
        drives.advance(0.7)
        assert not is_on(drives)
        if name != "the enable input":  # which cuts: the rotor coasts
            assert abs(drives.machine.rotor_speed[0]) < 1.0
        drives.machine.error_bits = 0
        drives.machine.enable_input = True
        drives.write(cia402.MODE, 0)
        drives.write("D-Mode", 2)
        drives.advance(0.3)
        assert not is_on(drives), "K-Command of before enables nothing"


def test_a_lost_network_stops_it_too():
    with new_drives(num_machines=2) as drives:
        wire = Wire(drives)
        wire.start()
        for index, value in ((0x2303, 2), (0x3102, 900), (0x3100, 1)):
            assert wire.download(index, 0, value, 4) == 0
            wire.wait(3)
        wire.wait(300)
        assert drives.machine.rotor_speed[0] > 60.0 > abs(drives.machine.rotor_speed[1])
        wire.receive(0, "02 05")  # NMT: stop
        wire.wait(600)
        assert not is_on(drives) and abs(drives.machine.rotor_speed[0]) < 1.0


def test_the_master_has_its_set_points_back_and_commands_nothing_meanwhile(drives):
    drives.write(cia402.TARGET_VELOCITY, "123 rpm")
    drives.write(cia402.TARGET_TORQUE, 77)
    serve(drives, 2)
    drives.write("K-V", 300)
    for word in (0x06, 0x07, 0x0F, 0x02, 0x00):
        drives.write(cia402.CONTROLWORD, word)
        drives.advance(0.02)
    drives.advance(0.3)
    assert drives.machine.rotor_speed[0] == pytest.approx(300.0 * RPM, rel=0.05)
    assert drives.read(cia402.TARGET_VELOCITY)[0] == 123_000 and drives.read(cia402.TARGET_TORQUE)[0] == 77
    assert drives.read(cia402.MODE)[0] == 0


def test_bit_3_of_k_command_clears_errors(drives):
    serve(drives, 2)
    drives.machine.error_bits = 1 << 21
    drives.advance(0.005)
    drives.machine.error_bits = 0
    drives.write("K-Command", 0)
    drives.advance(0.005)
    assert drives.read("aDriveError")[0] or not int(drives.read("aDriveStatus")[0]) & 1
    drives.write("K-Command", 8)
    drives.advance(0.005)
    drives.write("K-Command", 1)
    drives.advance(0.02)
    assert is_on(drives)


def test_while_the_master_is_connected_k_command_does_nothing(drives):
    motion.enable(drives, mode="csv")
    drives.write("K-V", 500)
    drives.write("K-Command", 1)
    drives.advance(0.2)
    assert drives.machine.rotor_speed[0] == pytest.approx(0.0, abs=0.1)
    drives.write("K-Command", 0)
    drives.advance(0.05)
    assert is_on(drives)


@pytest.mark.parametrize(("name", "raw"), [("K-Command", 1), (0x23C8, 2)])
def test_a_program_with_limits_enables_by_neither(drives, name, raw):
    drives.machine.reset()
    with on_bus(drives, stay=True, timeout=ANSWER) as master:
        with pytest.raises(SafetyError, match=r"enables a motor beside the controlword.*Enable by 6040h"):
            master.write(name, raw)
        master.write(name, 0)


@pytest.mark.parametrize("name", ["M-Inull", "M-Ipeak"])
def test_a_limit_of_current_is_not_raised_by_what_its_counts_are(drives, name):
    """Limits of a TGZ are parts of the motor's currents: with greater ones the drive would give more ampere."""
    drives.machine.reset()
    with bus_of(drives, [1], stay=True) as bus:
        with CanDrives("tgz_d", bus=bus, pace="lockstep", timeout=ANSWER, safety=Limits(current=8000)) as master:
            motion.enable(master, mode="pv")
            master.advance(0.002)
            lent = field(drives, "i_high")[0]
            assert lent == pytest.approx(8000 / 32767 * field(drives, "peak_current")[0], rel=2e-3)
            motion.disable(master)
            with pytest.raises(SafetyError, match="changes the scale of currents"):
                master.write(name, 60_000)
            motion.enable(master, mode="pv")
            master.advance(0.002)
            assert field(drives, "i_high")[0] == lent
        with CanDrives("tgz_d", bus=bus, pace="lockstep", timeout=ANSWER) as master:
            motion.enable(master, mode="pv")
            with pytest.raises(SafetyError, match="changes the scale of currents"):
                master.write(name, 60_000)
            motion.disable(master)
            master.write(name, 60_000)  # a motor is commissioned so


def test_speeds_ramps_and_counts_change_past_the_limits_by_no_register_of_an_enabled_axis(drives):
    """PosSpeed and Speed are 6081h and 60FFh in other units: what they had before is refused as the move begins."""
    drives.machine.reset()
    with on_bus(drives, stay=True, timeout=ANSWER, safety=Limits(velocity=10_000)) as master:
        master.write("PG PosSpeed", 100 * 2**16)
        motion.enable(master, mode="pp")
        with pytest.raises(SafetyError, match=r"its drive has 6081h:00 .* beyond the limit 10000"):
            motion.start_move(master, UNITS)
        for register in (
            *(f"PG {name}" for name in ("Acc", "Dec", "PosSpeed", "Speed", "BitsPerRevol")),
            "F-Type", "F-Resolution", "F-IncrEnc", "M-Polepairs", "M-CommutOffset",
        ):  # fmt: skip
            now = master.read(register)
            with pytest.raises(SafetyError, match=r"past the checked objects of CiA 402.*Disable it first"):
                master.write(register, now)
        motion.disable(master)
        master.write("PG PosSpeed", 2**16)


def test_outputs_are_forced_and_set_by_the_axis_own_registers():
    with new_drives("gantry") as drives:
        wire = Wire(drives)
        assert wire.download(0x333C, 0, 0b101, 4) == wire.download(0x343C, 0, 0b010, 4) == 0
        assert drives.machine.outputs.tolist() == [0b011001] * 2
        assert wire.download(0x3209, 0, 0b001, 4) == wire.download(0x310A, 0, 0b100, 4) == 0
        assert drives.machine.outputs.tolist() == [0b001011] * 2
