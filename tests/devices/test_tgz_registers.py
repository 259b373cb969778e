"""The registers of the TGZ's maker, by what they do to the machine or show of it: the emulator's truth on the one side.

Gains are in test_tgz_gains.py.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.canopen_wire import Wire
from rigs.coe_rig import CoeRig
from rigs.truth import brake_is_closed, field

from drive_env import EmulatedDrives, ObjectAccessError, cia402, motion
from drive_env.canopen.frames import Frame
from drive_env.devices import find_device
from drive_env.drives.currents import read_current_limit, write_current_limit
from drive_env.ethercat.application import AlState
from drive_env.firmware.record import set_lanes

DEVICE = find_device("tgz_d")
RPM = math.pi / 30.0
TURN = 2**32
TABLE = """
C-Type1 2000 - ro|C-Type2 2001 - ro|C-Type3 2002 - ro|C-Type4 2003 - ro|C-Type5 2004 - ro|C-HWVer 2005 - ro
C-FWVer 2006 - ro|C-FWBuild1 2007 - ro|C-FWBuild2 2008 - ro|C-FWBuild3 2009 - ro|C-FWBuild4 200A - ro
C-FWBuild5 200B - ro|C-IPAddress 200C - rw|C-ID 200D - rw|C-SyncTime 200E - ro|C-Enable_1G 200F - rw
C-SetCycleTime 2010 - rw|C-UserProgStart 2011 - rw|M-Name1 2100 2200 rw|M-Name2 2101 2201 rw
M-Name3 2102 2202 rw|M-Name4 2103 2203 rw|M-Name5 2104 2204 rw|M-Name6 2105 2205 rw|M-Inull 2106 2206 rw
M-Ipeak 2107 2207 rw|M-Nmax 2108 2208 rw|M-Polepairs 2109 2209 rw|M-CommutOffset 210A 220A rw
M-MinResTerm 210B 220B rw|M-MaxResTerm 210C 220C rw|M-StaticBrake 210D 220D rw|M-ThermTimeConst 210E 220E rw
D-Name1 2300 2400 rw|D-Name2 2301 2401 rw|D-Name3 2302 2402 rw|D-Mode 2303 2403 rw
D-DelayEnable_Hwen 230A 240A rw|D-DelayUnbrake_Enable 230B 240B rw|D-DelayDisable_Brake 230C 240C rw
D-VoltDCLinkMinErrLim 230D - rw|D-VoltDCLinkMaxErrLim 230E - rw|C-K 2500 2600 rw|C-Ti 2501 2601 rw
C-KDr 2502 2602 rw|C-Tc 2503 2603 rw|C-Filt 2504 2604 rw|C-LimN 2505 2605 rw|C-LimP 2506 2606 rw
C-VoltLimMin 2507 2607 rw|C-VoltLimMax 2508 2608 rw|C-CogCompFac 2509 2609 rw|V-K 2700 2800 rw|V-Ti 2701 2801 rw
V-LimN 2702 2802 rw|V-LimP 2703 2803 rw|V-Tfb 2704 2804 rw|V-Tv 2705 2805 rw|V-FiFact 2706 2806 rw
P-K 2900 2A00 rw|P-SFF 2901 2A01 rw|P-MaxAngleError 2902 2A02 rw|P-MaxRevolError 2903 2A03 rw
F-Type 2B00 2C00 rw|F-Resolution 2B01 2C01 rw|F-IncrEnc 2B02 2C02 rw|F-ExtIncrEnc 2B03 - rw
F-ResolverPoles 2B04 2C04 rw|K-Command 3100 3200 rw|K-I 3101 3201 rw|K-V 3102 3202 rw|K-P_Angle 3103 3203 rw
K-P_Revol 3104 3204 rw|K-DigitalOutputForce_Set 3109 3209 rw|K-DigitalOutputForce_Clr 310A 320A rw
Monitor-Counter 3300 - ro|aIa 3301 3401 ro|aIb 3302 3402 ro|aIc 3303 3403 ro|aIq 3306 3406 ro|aId 3307 3407 ro
aAngle 3310 3410 ro|aRevol 3311 3411 ro|aSpeed 3312 3412 ro|aSpeedError 3314 3414 ro|aAngleError 331C 341C ro
aRevolError 331D 341D ro|aDriveStatus 3325 3425 ro|aDriveError 3326 3426 ro|aDriveWarning 3327 3427 ro
AnInput 3328 3428 ro|VoltDCLink 3329 - ro|OnChipTemp 332A - ro|ec_SetPointAngle 332B 342B ro
ec_SetPointRevol 332C 342C ro|ec_control 332D 342D ro|ec_currentSetPoint 332E 342E ro
ec_currentLimit 332F 342F ro|Digital_Inputs 3330 3430 ro|Motor_temperature 3331 3431 ro|rIq 3332 3432 ro
Ia_rms 3333 3433 ro|Ib_rms 3334 3434 ro|Ic_rms 3335 3435 ro|aI2t 3337 3437 ro|rAngle 3338 3438 ro
rRevol 3339 3439 ro|rSpeed 333A 343A ro|DSL_status 333B 343B ro|DO 333C 343C rw|C-PackeTime 3340 - ro
Acc 3900 3A00 rw|Dec 3901 3A01 rw|APosAngle 3902 3A02 ro|APosRevol 3903 3A03 ro|DPosAngle 3904 3A04 rw
DPosRevol 3905 3A05 rw|ASpeed 3906 3A06 ro|PosSpeed 3907 3A07 rw|Speed 3908 3A08 rw|Mode 3909 3A09 rw
Rdy 390A 3A0A rw|Type 390B 3A0B rw|BitsPerRevol 390C 3A0C rw
"""
REGISTERS = [found.split() for line in TABLE.split("\n") for found in filter(None, line.split("|"))]
OVER_VOLTAGE, UNDER_VOLTAGE, BRAKE, MOTOR_HOT, FEEDBACK, COMMUTATION, OVER_SPEED, I2T = 3, 4, 6, 9, 12, 13, 14, 25
BRAKE_SWITCH, BRAKE_SUPPLY = 7, 23


def new_drives(load="inertia", **given):
    return EmulatedDrives("tgz_d", load, num_machines=given.pop("num_machines", 1), seed=0, ideal=True, **given)


@pytest.fixture
def drives():
    with new_drives() as drives:
        yield drives


def errors(drives):
    """Return the numbers of the error bits of axis 0 (aDriveError)."""
    return {bit for bit in range(32) if int(drives.read("aDriveError")[0]) >> bit & 1}


def turn(drives, speed, seconds=0.4):
    motion.enable(drives, mode="pv")
    drives.write(cia402.TARGET_VELOCITY, f"{speed} rpm")
    drives.advance(seconds)


# --- the table ----------------------------------------------------------------------------------------------------
def test_the_dictionary_has_the_makers_table():
    """Number of both axes and access of each register; a name has its group where it would be unclear without."""
    known = DEVICE.new_dictionary()
    for name, first, second, access in REGISTERS:
        assert known.find((int(first, 16), 0)).access == access, name
        if second != "-":
            assert int(second, 16) == int(first, 16) + 0x100
            entry = known.find((int(second, 16), 0))
            assert DEVICE.locate(entry.index) == (1, int(first, 16)) and entry.access == access, name
        assert known.find((int(first, 16), 0)).name.rpartition(" ")[2] == name
    assert len(REGISTERS) == 124


@pytest.mark.parametrize("bus", ["can", "coe"])
def test_each_register_is_read_with_32_bits_and_written_as_its_access_says(bus):
    """By a master's SDO: what is read is written back, which what is read only refuses."""
    with new_drives("gantry") as drives:
        rig = Wire(drives) if bus == "can" else CoeRig(drives)
        if bus == "coe":
            rig.bring_to(AlState.PRE_OP)
        for name, *numbers, access in REGISTERS:
            for index in (int(number, 16) for number in numbers if number != "-"):
                if bus == "can":
                    request = b"\x40" + index.to_bytes(2, "little") + bytes(5)
                    rig.node.receive(Frame(0x600 + rig.node.node_id, request), rig.now)
                    (answer,) = rig.take()
                    assert answer.data[0] == 0x43, name  # expedited, of four bytes
                    refused = rig.download(index, 0, int.from_bytes(answer.data[4:8], "little"), 4)
                else:
                    data = rig.upload(index)
                    assert len(data) == 4, name
                    refused = rig.download(index, 0, data)
                assert refused == (0 if access == "rw" else 0x06010002), (name, index)


@pytest.mark.parametrize(
    ("name", "now"),
    [
        (0x23C5, "2505h and 2506h, C-LimN and C-LimP"),
        ("23E0:0", "2109h, M-Polepairs"),
        ("Velocity loop P", "V-K"),
        (0x33C1, "3326h"),
    ],
)
def test_an_object_of_an_earlier_version_is_told_with_what_it_is_now(drives, name, now):
    with pytest.raises(ObjectAccessError, match=f"earlier versions had it: write {now}"):
        drives.read(name)


# --- the motor --------------------------------------------------------------------------------------------------------
def test_m_nmax_is_the_speed_of_error_14(drives):
    turn(drives, 1000)
    drives.write("M-Nmax", 1100)
    drives.advance(0.1)
    assert errors(drives) == set()
    drives.write("M-Nmax", 900)
    drives.advance(0.005)
    assert errors(drives) == {OVER_SPEED}
    assert field(drives, "stage_on")[0] == 0.0


def test_m_inull_and_m_thermtimeconst_are_the_motors_i2t(drives):
    """Of a step of the current the mean square is I^2 (1 - exp(-t / T)): with 2 M-Inull error 25 comes at T ln(4/3)."""
    drives.write("M-Inull", 1000)
    drives.write("M-ThermTimeConst", 2)
    drives.machine.brake = "closed"
    motion.enable(drives, mode="cst")
    drives.write(cia402.TARGET_TORQUE, f"{2.0 * math.sqrt(2.0)} A")
    expected = 2.0 * math.log(4.0 / 3.0)
    drives.advance(round(0.95 * expected, 3))
    assert errors(drives) == set()
    rms = 2.0 * math.sqrt(1.0 - math.exp(-0.95 * expected / 2.0))
    assert drives.read("aI2t")[0] == pytest.approx(1e3 * rms, rel=0.02)
    drives.advance(0.07)
    assert errors(drives) == {I2T}


def test_m_commutoffset_turns_the_field_by_as_much_of_a_revolution(drives):
    """A quarter of an electrical turn off no current makes torque; half a turn off the motor runs away from it."""
    pairs = int(drives.read("M-Polepairs")[0])
    drives.machine.brake = "closed"
    drives.write("M-CommutOffset", TURN // pairs // 12)  # 30 degrees electrical
    motion.enable(drives, mode="cst")
    drives.write(cia402.TARGET_TORQUE, "2 A")
    drives.advance(0.02)
    assert [field(drives, name)[0] for name in ("i_q", "i_d")] == pytest.approx(
        [2.0 * math.cos(math.pi / 6.0), -2.0 * math.sin(math.pi / 6.0)], abs=0.02
    )
    motion.disable(drives)
    drives.machine.brake = "open"
    drives.write("M-CommutOffset", TURN // pairs // 2)
    turn(drives, 500, 0.3)
    assert errors(drives) == {COMMUTATION}


@pytest.mark.parametrize(("name", "limit"), [("M-MaxResTerm", 1300), ("M-MinResTerm", 1200)])
def test_the_motors_sensor_is_a_pt1000_within_its_limits(drives, name, limit):
    for kelvin in (20.0, 60.0):
        set_lanes(drives.inside.records, "T_winding", np.array([kelvin]))
        drives.advance(0.001)
        assert drives.read("Motor_temperature")[0] == pytest.approx(1000.0 * (1.0 + 3.851e-3 * kelvin), abs=1.0)
    drives.write(name, limit)  # 60 degC are 1231 ohm
    drives.advance(0.002)
    assert errors(drives) == set()
    set_lanes(drives.inside.records, "T_winding", np.array([100.0 if name == "M-MaxResTerm" else 20.0]))
    drives.advance(0.003)
    assert errors(drives) == {MOTOR_HOT}
    drives.write("F-Type", 4)  # an incremental feedback has no line for it
    drives.advance(0.003)
    assert drives.read("Motor_temperature")[0] == 0
    motion.reset_fault(drives)


# --- the feedback -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("kind", "written", "told"),
    [
        (6, {"F-Resolution": 2**19}, 2.0),  # the encoder has 2^20 counts
        (7, {"F-Resolution": 2**21}, 0.5),
        (1, {"F-Resolution": 2**19}, 1.0),  # Hiperface DSL and EnDat tell theirs
        (2, {"F-Resolution": 2**19}, 1.0),
        (4, {"F-IncrEnc": 2**17}, 2.0),  # four counts a pulse
    ],
)
def test_f_type_says_which_resolution_positions_are_counted_by(drives, kind, written, told):
    drives.write("F-Type", kind)
    for name, value in written.items():
        drives.write(name, value)
    drives.advance(0.002)
    assert 2**20 / field(drives, "encoder_steps")[0] == told
    before, angle = drives.read(0x33C0)[0], drives.machine.rotor_angle[0]
    drives.machine.load_torque = 0.5
    drives.advance(0.05)
    drives.machine.load_torque = 0.0
    moved = drives.machine.rotor_angle[0] - angle
    assert abs(moved) > 0.1
    drives.advance(0.001)
    assert (drives.read(0x33C0)[0] - before) / TURN == pytest.approx(
        told * (drives.machine.rotor_angle[0] - angle) / (2.0 * math.pi), rel=0.02
    )


def test_dsl_status_is_that_a_dsl_feedback_answers(drives):
    drives.advance(0.002)
    assert drives.read("DSL_status")[0] == 0
    drives.write("F-Type", 1)
    drives.advance(0.002)
    assert drives.read("DSL_status")[0] == 1
    drives.machine.set("motor.encoder_broken", 1.0)
    drives.advance(0.002)
    assert drives.read("DSL_status")[0] == 0 and FEEDBACK in errors(drives)


def test_f_extincrenc_counts_the_shaft_of_the_first_motor(drives):
    """Four counts a pulse, from power-on on; without pulses there is no encoder."""
    external = 0x333E
    turn(drives, 600)
    assert drives.read(external)[0] == 0
    drives.write("F-ExtIncrEnc", 2500)
    drives.advance(0.002)
    before, angle = drives.read(external)[0], drives.machine.rotor_angle[0]
    drives.advance(0.1)
    turned = (drives.machine.rotor_angle[0] - angle) / (2.0 * math.pi)
    assert turned > 0.9
    assert drives.read(external)[0] - before == pytest.approx(10_000 * turned, abs=110)  # 1 ms of 10 rev/s
    drives.write(cia402.TARGET_VELOCITY, 0)
    drives.advance(0.5)
    drives.machine.power_cycle()
    drives.write("F-ExtIncrEnc", 2500)
    drives.advance(0.002)
    assert abs(drives.read(external)[0]) <= 1


# --- the link ---------------------------------------------------------------------------------------------------------
def test_the_levels_of_the_link_are_those_of_both_axes():
    with new_drives("gantry") as drives:
        wire = Wire(drives)
        for index, error in ((0x230D, UNDER_VOLTAGE), (0x230E, OVER_VOLTAGE)):
            before = wire.value(index, 0)
            level = round(field(drives, "u_dc")[0])
            assert wire.value(0x3329, 0) == level
            assert wire.download(index, 0, level + (20 if error == UNDER_VOLTAGE else -20), 4) == 0
            wire.wait(3)
            for axis in range(2):
                assert wire.value(0x3326 + 0x100 * axis, 0) >> error & 1, axis
            wire.take()
            assert wire.download(index, 0, before, 4) == 0
            wire.wait(3)
            motion.reset_fault(drives)


def test_c_setcycletime_is_the_time_in_which_a_set_point_is_reached():
    """csp with 2 ms: the demand is half way after the first, and there after the second."""
    with new_drives() as drives:
        drives.write("C-SetCycleTime", 2000)
        drives.advance(0.002)
        motion.enable(drives, mode="csp")
        trace = drives.record([0x6062], 0.006, {cia402.TARGET_POSITION: np.array([0, 0, 1000, 1000, 1000, 1000])})
        demand = trace[0x6062][:, 0] - trace[0x6062][0, 0]
        assert 400 < demand[3] < 600 or 400 < demand[4] < 600
        with pytest.raises(ObjectAccessError):
            drives.write("C-SetCycleTime", 3000)


# --- enabling and the brake -------------------------------------------------------------------------------------------
def braked():
    """Return a drive whose motor has a brake at the output that opens and closes within 20 and 10 ms."""
    drives = new_drives()
    drives.machine.set("motor.brake_opens_in", 0.02)
    drives.machine.set("motor.brake_closes_in", 0.01)
    drives.machine.brake = "output"
    return drives


def test_m_staticbrake_is_that_there_is_a_brake_to_release():
    with braked() as drives:
        turn(drives, 200, 0.3)
        assert BRAKE in errors(drives), "nobody has released it"
        assert drives.machine.rotor_speed[0] == pytest.approx(0.0, abs=0.1)
    with braked() as drives:
        drives.write("M-StaticBrake", 1)
        drives.advance(0.002)
        assert drives.read("aDriveStatus")[0] & 8 == 0
        turn(drives, 200, 0.3)
        assert errors(drives) == set()
        assert drives.machine.rotor_speed[0] == pytest.approx(200.0 * RPM, rel=0.05)
        assert int(drives.read("aDriveStatus")[0]) & 0x7F == 0x7F


def test_a_brake_is_held_open_by_less_than_its_supply_and_closes_without_it():
    """0.2 of the 24 V hold it (it drops out below), 0.6 pull it in; error 23 is there below 21.6 V."""
    with braked() as drives:
        drives.write("M-StaticBrake", 1)
        turn(drives, 200, 0.3)
        for volts, is_closed in ((22.0, False), (6.0, False), (4.0, True), (12.0, True), (15.0, False)):
            drives.machine.set("stage.brake_supply", volts)
            set_lanes(drives.inside.records, "drive_function", np.ones(1))  # held up, whatever the error commands
            for _ in range(40):
                drives.advance(0.001)
                set_lanes(drives.inside.records, "drive_function", np.ones(1))
            assert brake_is_closed(drives)[0] == is_closed, volts
            assert (BRAKE_SUPPLY in errors(drives)) == (volts < 21.6)
        drives.write("M-StaticBrake", 0)
        drives.advance(0.002)
        assert BRAKE_SUPPLY not in errors(drives), "without a brake nothing needs it"


@pytest.mark.parametrize(("has_switch", "expected"), [(0.0, set()), (1.0, {BRAKE_SWITCH})])
def test_a_worn_brake_that_no_longer_closes_is_seen_by_its_switch_alone(has_switch, expected):
    with braked() as drives:
        drives.write("M-StaticBrake", 1)
        drives.machine.set("motor.brake_switch", has_switch)
        turn(drives, 200, 0.3)
        assert errors(drives) == set()
        drives.machine.brake = "open"
        motion.disable(drives)
        drives.advance(0.15)
        assert errors(drives) == set(), "it has time to follow its output"
        drives.advance(0.15)
        assert errors(drives) == expected


def test_current_flows_before_the_brake_is_released_and_until_it_has_closed():
    with braked() as drives:
        drives.write("M-StaticBrake", 1)
        drives.write("D-DelayUnbrake_Enable", 500)  # 50 ms
        drives.write("D-DelayDisable_Brake", 800)  # 80 ms
        drives.write(cia402.MODE, cia402.PV)
        drives.write("D-Mode", 6)
        drives.advance(0.002)
        for word in (0x06, 0x07, 0x0F):
            drives.write(cia402.CONTROLWORD, word)
        seen = []
        for _ in range(80):
            drives.advance(0.001)
            seen.append((field(drives, "stage_on")[0], field(drives, "brake_output")[0], enabled(drives)))
        on, released, operates = (np.argmax(np.array(seen)[:, k]) for k in range(3))
        assert on <= 2 and released - on == pytest.approx(50, abs=2) and operates == pytest.approx(released, abs=1)
        drives.write(cia402.CONTROLWORD, 0x06)  # shutdown: the brake first
        seen = []
        for _ in range(120):
            drives.advance(0.001)
            seen.append((field(drives, "stage_on")[0], field(drives, "brake_output")[0]))
        off, applied = (np.argmin(np.array(seen)[:, k]) for k in range(2))
        assert applied <= 2 and off - applied == pytest.approx(80, abs=2)


def enabled(drives):
    return bool(cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)[0])


def test_a_weight_does_not_fall_while_its_brake_closes():
    """Without the delay the stage is off before the brake holds: within 10 ms it falls by some micrometres more."""
    fallen = []
    for delay in (0, 500):
        with EmulatedDrives("tgz_d", "vertical_screw", num_threads=1, seed=0, ideal=True) as drives:
            drives.machine.set("motor.brake_closes_in", 0.03)
            drives.write("M-StaticBrake", 1)
            drives.write("D-DelayDisable_Brake", delay)
            drives.machine.brake = "output"
            motion.enable(drives, mode="pp")
            drives.advance(1.0)
            there = float(drives.machine.rotor_angle[0])
            drives.write(cia402.CONTROLWORD, 0x06)
            drives.advance(0.3)
            assert field(drives, "stage_on")[0] == 0.0 and brake_is_closed(drives)[0]
            fallen.append(abs(float(drives.machine.rotor_angle[0]) - there))
    assert fallen[1] < 0.2 * fallen[0]


def test_a_cause_that_cuts_leaves_no_current_to_wait_for_the_brake():
    with braked() as drives:
        drives.write("M-StaticBrake", 1)
        drives.write("D-DelayDisable_Brake", 5000)
        motion.enable(drives, mode="pv")
        drives.advance(0.05)
        drives.write(cia402.CONTROLWORD, 0x06)
        drives.advance(0.01)
        assert field(drives, "stage_on")[0] == 1.0
        drives.machine.enable_input = False
        drives.advance(0.003)
        assert field(drives, "stage_on")[0] == 0.0


def test_d_delayenable_hwen_is_from_the_inputs_edge_to_enabling(drives):
    drives.write("D-DelayEnable_Hwen", 3000)  # 300 ms
    drives.machine.enable_input = False
    drives.advance(0.005)
    drives.machine.enable_input = True
    drives.advance(0.002)
    motion.reset_fault(drives)
    drives.write(cia402.MODE, cia402.PV)
    drives.write("D-Mode", 6)
    drives.advance(0.002)
    for word in (0x06, 0x07, 0x0F):
        drives.write(cia402.CONTROLWORD, word)
    drives.advance(0.25)
    assert not enabled(drives) and field(drives, "stage_on")[0] == 0.0
    drives.advance(0.06)
    assert enabled(drives) and field(drives, "stage_on")[0] == 1.0


# --- limits -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("name", "other", "way"), [("C-LimP", "C-LimN", 1.0), ("C-LimN", "C-LimP", -1.0)])
def test_c_limn_and_c_limp_limit_one_sign_each_to_parts_of_m_inull(drives, name, other, way):
    """R's example: 3000 thousandths of 2000 mA are 6000 mA; here 500 of 2000, 1000 mA."""
    drives.write("M-Inull", 2000)
    drives.write(name, 500)
    drives.write(other, 2000)
    drives.machine.brake = "closed"
    motion.enable(drives, mode="cst")
    for sign, most in ((way, 1.0), (-way, 3.0)):
        drives.write(cia402.TARGET_TORQUE, f"{sign * 3.0} A")
        drives.advance(0.02)
        assert field(drives, "i_q")[0] == pytest.approx(sign * most, abs=0.02)
    motion.disable(drives)
    drives.write("V-K", 60_000)
    for ramp in (cia402.PROFILE_ACCELERATION, cia402.PROFILE_DECELERATION):
        drives.write(ramp, "1000000 rpm/s")
    motion.enable(drives, mode="pv")  # the velocity controller's output, too
    for sign, most in ((way, 1.0), (-way, 4.0)):
        drives.write(cia402.TARGET_VELOCITY, f"{sign * 3000} rpm")
        drives.advance(0.04)
        assert field(drives, "i_q")[0] == pytest.approx(sign * most, abs=0.05)


def test_the_current_limit_in_amperes_is_both_of_them(drives):
    drives.write("M-Inull", 2000)
    write_current_limit(drives, 3.0)
    assert (drives.read("C-LimN")[0], drives.read("C-LimP")[0]) == (1500, 1500)
    assert read_current_limit(drives)[0] == pytest.approx(3.0)
    drives.write("C-LimN", 1000)
    assert read_current_limit(drives)[0] == pytest.approx(2.0)


@pytest.mark.parametrize(("name", "way"), [("C-VoltLimMax", 1.0), ("C-VoltLimMin", -1.0)])
def test_c_voltlim_limits_one_sign_of_the_voltage(drives, name, way):
    """The speed at which the back-EMF takes all of it: half the voltage, half the speed; the other way is free."""
    drives.write(name, 10)
    motion.enable(drives, mode="cst")
    seen = []
    for sign in (way, -way):
        drives.write(cia402.TARGET_TORQUE, f"{sign * 1.0} A")
        drives.advance(0.6)
        seen.append(abs(drives.machine.rotor_speed[0]))
        assert errors(drives) <= {OVER_SPEED}
        if errors(drives):
            break
    # 1/sqrt(3) of the link, 10 % of it, over the flux linkage of the pole pairs, less R i.
    flux = field(drives, "psi_m")[0] * field(drives, "n_p")[0]
    least = 0.1 / math.sqrt(3.0) * field(drives, "u_dc")[0] / flux
    assert 0.7 * least < seen[0] < 1.01 * least
    assert seen[1] > 2.0 * least or OVER_SPEED in errors(drives)


@pytest.mark.parametrize(("name", "way"), [("V-LimP", 1.0), ("V-LimN", -1.0)])
def test_v_lim_limits_what_the_position_controller_asks_for(drives, name, way):
    drives.write(name, 120)
    drives.write(cia402.FOLLOWING_WINDOW, 0)
    drives.write(cia402.PROFILE_VELOCITY, "3000 rpm")
    motion.enable(drives, mode="pp")
    for sign, free in ((way, False), (-way, True)):
        motion.start_move(drives, int(sign * 5 * 2**20))
        drives.advance(0.2)
        speed = sign * drives.machine.rotor_speed[0] / RPM
        assert speed > 300.0 if free else speed == pytest.approx(120.0, abs=3.0)


@pytest.mark.parametrize(("angle", "turns"), [(2**31, 0), (0, 1)])
def test_p_max_error_is_error_15_at_once(drives, angle, turns):
    drives.write("P-MaxAngleError", angle)
    drives.write("P-MaxRevolError", turns)
    drives.write(cia402.FOLLOWING_WINDOW, 0)
    drives.write("P-K", 1000)  # 1/s: far behind
    motion.enable(drives, mode="csp")
    limit = turns + angle / TURN
    path = np.rint(np.linspace(0.0, 1.5 * limit, 300) * 2**20).astype(int)
    trace = drives.record(["aDriveError", 0x33C9], 0.3, {cia402.TARGET_POSITION: path})
    came = int(np.argmax(trace["aDriveError"][:, 0] >> 15 & 1))
    assert came > 0
    assert trace[0x33C9][came - 2, 0] / TURN == pytest.approx(limit, rel=0.02)


# --- the profile generator --------------------------------------------------------------------------------------------
def test_acc_dec_and_posspeed_are_those_of_moves(drives):
    """A trapezoid by closed form: 4 revolutions with 20 rev/s^2 up, 40 down, 5 rev/s."""
    drives.write("PG BitsPerRevol", 20)
    for name, value in (("PG Acc", 20), ("PG Dec", 40), ("PG PosSpeed", 5)):
        drives.write(name, value * 2**20)
    motion.enable(drives, mode="pp")
    motion.start_move(drives, 4 * 2**20)
    trace = drives.record(["PG ASpeed", "PG APosRevol", "PG APosAngle", "PG Rdy"], 1.5)
    speed = trace["PG ASpeed"][:, 0] / 2**20
    way = trace["PG APosRevol"][:, 0] + trace["PG APosAngle"][:, 0] / TURN
    assert speed.max() == pytest.approx(5.0, rel=1e-3)
    assert np.argmax(speed > 4.999) == pytest.approx(250, abs=2)  # ms, 5 / 20
    duration = 5 / 20 + 5 / 40 + (4 - 25 / 40 - 25 / 80) / 5
    assert np.argmax(way >= 4.0 - 1e-9) == pytest.approx(1e3 * duration, abs=3)
    assert trace["PG Rdy"][-1, 0] == 1 and trace["PG Rdy"][300, 0] == 0
    assert drives.machine.rotor_angle[0] / (2.0 * math.pi) == pytest.approx(4.0, abs=0.01)


def test_rdy_that_is_written_0_waits_for_the_next_arrival(drives):
    drives.write(cia402.PROFILE_VELOCITY, "3000 rpm")
    motion.enable(drives, mode="pp")
    motion.move_to(drives, 2**19)
    assert drives.read("PG Rdy")[0] == 1
    drives.write("PG Rdy", 0)
    drives.advance(0.05)
    assert drives.read("PG Rdy")[0] == 0 and drives.read(cia402.STATUSWORD)[0] & 0x0400, "the target is reached still"
    motion.start_move(drives, 2**19, relative=True)
    drives.advance(0.01)
    assert drives.read("PG Rdy")[0] == 0
    drives.advance(1.0)
    assert drives.read("PG Rdy")[0] == 1


def test_speed_is_that_of_the_velocity_profile_and_a_unit_changes_its_meaning(drives):
    motion.enable(drives, mode="pv")
    drives.write("PG BitsPerRevol", 16)
    drives.write("PG Speed", -5 * 2**16)
    drives.advance(0.6)
    assert drives.machine.rotor_speed[0] / (2.0 * math.pi) == pytest.approx(-5.0, rel=0.02)
    drives.write("PG BitsPerRevol", 15)  # the register keeps its number
    assert drives.read("PG Speed")[0] == -5 * 2**16
    drives.advance(0.6)
    assert drives.machine.rotor_speed[0] / (2.0 * math.pi) == pytest.approx(-10.0, rel=0.02)


def test_the_standards_objects_and_the_generators_are_two_views_of_one_value(drives):
    drives.write(cia402.PROFILE_VELOCITY, "600 rpm")
    assert drives.read("PG PosSpeed")[0] == 10 * 2**16
    drives.write("PG Acc", 100 * 2**16)
    assert drives.read(cia402.PROFILE_ACCELERATION)[0] == 6_000_000  # 1/1000 rpm/s, as commissioned
    for kind, profile in ((0, -1), (1, -2), (2, -3), (3, 0), (4, 1)):
        drives.write("PG Type", kind)
        assert drives.read(0x6086)[0] == profile
        drives.write(0x6086, 0)
        drives.write(0x6086, profile)
        assert drives.read("PG Type")[0] == kind
    before = drives.read(cia402.PROFILE_VELOCITY)[0]
    drives.machine.power_cycle()
    assert drives.read(cia402.PROFILE_VELOCITY)[0] != before, "what was commissioned is back, and no default of PG"
    assert drives.read("PG PosSpeed")[0] > 0


# --- readings ---------------------------------------------------------------------------------------------------------
def test_currents_speeds_and_positions_are_those_of_the_machine(drives):
    turn(drives, 300, 0.6)
    drives.machine.load_torque = -0.8
    drives.advance(0.5)
    assert drives.read("aIq")[0] == pytest.approx(1e3 * field(drives, "i_q")[0], abs=60)
    assert drives.read("rIq")[0] == pytest.approx(1e3 * field(drives, "i_q")[0], abs=60)
    assert drives.read("aId")[0] == pytest.approx(1e3 * field(drives, "i_d")[0], abs=60)
    assert sum(int(drives.read(f"aI{phase}")[0]) for phase in "abc") == pytest.approx(0, abs=3)
    amplitude = math.hypot(field(drives, "i_d")[0], field(drives, "i_q")[0])
    assert amplitude > 0.5
    for phase in "abc":
        assert drives.read(f"I{phase}_rms")[0] == pytest.approx(1e3 * amplitude / math.sqrt(2.0), rel=0.15)
    assert drives.read("aSpeed")[0] == pytest.approx(drives.machine.rotor_speed[0] / RPM, abs=2)
    assert drives.read("rSpeed")[0] - drives.read("aSpeed")[0] == pytest.approx(drives.read("aSpeedError")[0], abs=1)
    whole = int(drives.read("aRevol")[0]) * TURN + int(drives.read("aAngle")[0])
    assert whole / TURN == pytest.approx(drives.machine.rotor_angle[0] / (2.0 * math.pi), abs=0.02)
    assert whole == drives.read(0x33C0)[0]
    assert drives.read("OnChipTemp")[0] == pytest.approx(field(drives, "T_stage")[0], abs=0.5)


@pytest.mark.parametrize("way", [1, -1])
def test_demand_target_and_error_are_split_in_revolutions_and_an_angle(drives, way):
    motion.enable(drives, mode="csp")
    path = np.rint(way * np.minimum(np.arange(1000), 900) * 2.5 / 900 * 2**20).astype(int)
    drives.write(cia402.FOLLOWING_WINDOW, 0)
    drives.record([cia402.POSITION_ACTUAL], 1.0, {cia402.TARGET_POSITION: path})
    drives.advance(0.5)
    for angle, turns, expected in (("rAngle", "rRevol", 2.5), ("ec_SetPointAngle", "ec_SetPointRevol", 2.5)):
        assert drives.read(turns)[0] + drives.read(angle)[0] / TURN == pytest.approx(way * expected, abs=1e-5)
    error = drives.read("aRevolError")[0] + drives.read("aAngleError")[0] / TURN
    assert error == pytest.approx(field(drives, "position_error")[0] / (2.0 * math.pi), abs=1e-6)


def test_inputs_and_analog_inputs_are_told_as_each_axis_has_them():
    with new_drives("gantry") as drives:
        wire = Wire(drives)
        drives.machine.digital_inputs = [0b11000110, 0]
        wire.wait(2)
        levels = wire.value(0x4000, 0)
        for axis, index in enumerate((0x3330, 0x3430)):
            assert wire.value(index, 0) == sum((levels >> (2 * k + axis) & 1) << k for k in range(4))
            assert wire.value(index - 0xB, 0) >> 28 == wire.value(index, 0), "aDriveStatus, bits 28 to 31"
        drives.machine.analog_inputs = [[32767, 0], [16384, 0]]
        assert [wire.value(index, 0) for index in (0x3328, 0x3428)] == [1000, 500]


def test_the_counter_counts_on(drives):
    before = drives.read("Monitor-Counter")[0]
    drives.advance(0.123)
    assert drives.read("Monitor-Counter")[0] - before == 123


def test_what_the_fieldbus_sends_is_shown(drives):
    drives.write(cia402.TARGET_TORQUE, -1234)
    drives.write(0x23C6, 4321)
    assert (drives.read("ec_currentSetPoint")[0], drives.read("ec_currentLimit")[0]) == (-1234, 4321)


def test_names_are_kept_and_texts_of_the_amplifier_read(drives):
    drives.write("M-Name1", int.from_bytes(b"AM30", "little"))
    drives.advance(0.01)
    assert int(drives.read("M-Name1")[0]).to_bytes(4, "little") == b"AM30"
    found = b"".join(int(drives.read(f"C-Type{k}")[0]).to_bytes(4, "little") for k in range(1, 6))
    assert found.decode().strip() == "TGZ-D-560-10"


def test_a_fast_port_and_a_user_program_that_are_not_there_are_refused(drives):
    """Of the second the EDS has 0 as the highest value."""
    for name, code in (("C-Enable_1G", 0x06090030), ("C-UserProgStart", 0x06090031)):
        with pytest.raises(ObjectAccessError) as caught:
            drives.write(name, 1)
        assert caught.value.abort_code == code
