"""The modes pp, pv and cst, mode 0 and the changes between them: sections 5 to 7 and 11 of the TMCM-1636 manual."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import EmulatedDrives, ObjectAccessError, cia402, motion

ACKNOWLEDGED, REACHED, LIMITED = 0x1000, 0x0400, 0x0800  # statusword bits 12, 10, 11
TURN = 65536  # increments


@pytest.fixture(scope="module")
def shared():
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as made:
        yield made


@pytest.fixture
def drives(shared):
    """Two commissioned drives in switch on disabled."""
    shared.machine.load_torque = 0.0
    shared.machine.reset()
    shared.emergencies()
    return shared


@pytest.fixture(scope="module")
def shared_ideal():
    quiet = {"load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0}
    with EmulatedDrives(load="inertia", ideal=True, parameters=quiet, num_threads=1) as made:
        yield made


@pytest.fixture
def ideal(shared_ideal):
    """One drive with a faultless stage and encoder on a frictionless disc."""
    shared_ideal.machine.set("load.inertia", LIGHT)
    shared_ideal.machine.reset()
    return shared_ideal


LIGHT = 2e-5  # kg m^2


def status(drives):
    return int(drives.read(0x6041)[0])


def bit(trace, mask, axis=0):
    return (trace[0x6041][:, axis] & mask) != 0


# --- the manual's recipes ---------------------------------------------------------------------------------------------
def test_recipe_of_section_6_2_moves_in_pp(drives):
    drives.write(0x2005, 3)
    drives.write(0x6060, 1)
    drives.write(0x6040, 6)
    assert status(drives) & 0x6F == 0x21
    drives.write(0x6040, 7)
    assert status(drives) & 0x6F == 0x23
    drives.write(0x6040, 15)
    assert status(drives) & 0x6F == 0x27
    drives.write(0x607A, 500_000)
    drives.advance(0.050)
    assert np.abs(drives.read(0x6064)).max() < 100, "the target is not active yet"
    drives.write(0x6040, 31)
    drives.advance(0.050)
    assert (drives.read(0x6064) > 10_000).all(), "the motor starts moving now"
    drives.write(0x6040, 15)  # this can be done while the motor is still moving
    assert not status(drives) & REACHED
    drives.advance(1.0)
    assert (drives.read(0x6041) & REACHED).all()
    np.testing.assert_allclose(drives.read(0x6064), 500_000, atol=200)
    assert drives.read(0x6062).tolist() == [500_000, 500_000]


def test_recipe_of_section_7_2_moves_in_pv(drives):
    drives.write(0x2005, 3)
    drives.write(0x6060, 3)
    drives.write(0x6040, 6)
    drives.write(0x6040, 7)
    drives.write(0x6040, 15)
    assert status(drives) & 0x6F == 0x27
    drives.write(0x60FF, 100_000)
    drives.advance(0.400)
    assert (drives.read(0x6041) & REACHED).all()
    speed = drives.record([0x606C], duration=0.2)[0x606C].mean(axis=0)
    np.testing.assert_allclose(speed, 100_000, rtol=0.02)
    drives.write(0x60FF, 0)
    drives.advance(0.400)
    assert (drives.read(0x6041) & REACHED).all()
    assert np.abs(drives.record([0x606C], duration=0.2)[0x606C].mean(axis=0)).max() < 2_000


# --- pp: the handshake of bits 4 and 12 -------------------------------------------------------------------------------
def test_a_set_point_is_taken_on_the_rising_edge_only(drives):
    motion.enable(drives, mode="pp")
    drives.write(0x607A, 200_000)
    assert not status(drives) & ACKNOWLEDGED
    drives.write(0x6040, 0x1F)
    assert status(drives) & ACKNOWLEDGED, "at once"
    drives.advance(0.010)
    assert status(drives) & ACKNOWLEDGED, "as long as bit 4 is set"
    drives.write(0x607A, -200_000)
    drives.write(0x6040, 0x1F)
    drives.advance(0.800)
    assert drives.read(0x6062).tolist() == [200_000] * 2, "written again it is no edge"
    drives.write(0x6040, 0x0F)
    assert not status(drives) & ACKNOWLEDGED
    drives.advance(0.020)
    assert drives.read(0x6062).tolist() == [200_000] * 2, "a falling edge is none"
    drives.write(0x6040, 0x1F)
    assert status(drives) & ACKNOWLEDGED
    assert not status(drives) & REACHED, "a new target is not reached yet"
    drives.advance(1.2)
    assert drives.read(0x6062).tolist() == [-200_000] * 2


def test_a_set_point_is_ignored_outside_operation_enabled(drives):
    drives.write(0x6060, 1)
    for word in (0x06, 0x07):
        drives.write(0x6040, word)
    drives.write(0x607A, 200_000)
    drives.write(0x6040, 0x17)
    assert not status(drives) & ACKNOWLEDGED
    drives.write(0x6040, 0x07)
    drives.write(0x6040, 0x0F)
    drives.advance(0.3)
    assert np.abs(drives.read(0x6064)).max() < 100


def test_a_set_point_of_before_does_not_move_an_axis_that_is_enabled_anew(drives):
    motion.enable(drives, mode="pp")
    motion.start_move(drives, 1_000_000)
    drives.advance(0.2)
    motion.disable(drives)
    drives.advance(3.0)
    stands = drives.read(0x6064)
    motion.enable(drives)
    drives.advance(0.3)
    assert np.abs(drives.read(0x6064) - stands).max() < 500


# --- pp: relative moves (table 178) -----------------------------------------------------------------------------------
def ends_of_relative_moves(drives, option):
    """Return, for a relative move of 100,000 in flight, where it ends and the candidates to start from."""
    drives.write(0x60F2, option)
    motion.enable(drives, mode="pp")
    motion.start_move(drives, 600_000)
    drives.advance(0.250)
    demand, actual = drives.read(0x6062), drives.read(0x6064)
    assert (demand - actual > 20_000).all(), "the axis lags, or the options could not be told apart"
    motion.start_move(drives, 100_000, relative=True)
    drives.advance(2.0)
    return drives.read(0x6062), demand, actual


def test_relative_to_the_preceding_target(drives):
    end, _, _ = ends_of_relative_moves(drives, 0)
    assert end.tolist() == [700_000] * 2
    motion.move_to(drives, -50_000, relative=True)
    assert drives.read(0x6062).tolist() == [650_000] * 2


def test_relative_to_the_demand(drives):
    end, demand, _ = ends_of_relative_moves(drives, 1)
    np.testing.assert_allclose(end, demand + 100_000, atol=1)


def test_relative_to_the_actual_position(drives):
    end, _, actual = ends_of_relative_moves(drives, 2)
    np.testing.assert_allclose(end, actual + 100_000, atol=1)


def test_relative_without_a_preceding_target_starts_from_where_the_axis_is(drives):
    motion.enable(drives, mode="pp")
    motion.move_to(drives, [30_000, -30_000], relative=True)
    np.testing.assert_allclose(drives.read(0x6062), [30_000, -30_000], atol=32)


# --- pp: target reached -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("window", [0, 0xFFFFFFFF])  # FFFFFFFFh: control off, which acts as 0
def test_without_a_window_the_demand_decides(drives, window):
    drives.write(0x6067, window)
    motion.enable(drives, mode="pp")
    drives.write(0x607A, [300_000, -300_000])
    drives.write(0x6040, 0x1F)
    trace = drives.record([0x6041, 0x6062, 0x6064], duration=0.6)
    for axis, target in enumerate((300_000, -300_000)):
        arrived = int(np.argmax(trace[0x6062][:, axis] == target))
        assert arrived > 100
        # The demand may round to the target within the last millisecond before it is there.
        first = int(np.argmax(bit(trace, REACHED, axis)))
        assert arrived <= first <= arrived + 1
        assert abs(int(trace[0x6064][first, axis]) - target) > 1_000, "the axis itself is still on its way"
        assert bit(trace, REACHED, axis)[first:].all()


@pytest.mark.parametrize(("window", "time"), [(500, 0), (500, 20), (20_000, 5)])
def test_with_a_window_the_axis_decides_and_must_stay(drives, window, time):
    drives.write(0x6067, window)
    drives.write(0x6068, time)
    motion.enable(drives, mode="pp")
    drives.write(0x607A, [300_000, -300_000])
    drives.write(0x6040, 0x1F)
    trace = drives.record([0x6041, 0x6064], duration=1.0)
    for axis, target in enumerate((300_000, -300_000)):
        inside = np.abs(trace[0x6064][:, axis] - target) <= window
        assert not inside[0]
        assert inside[-1]
        # Row k tells what the drive saw in row k - 1: in the window for `time` ms, time + 1 looks.
        stayed = [k > time and inside[k - time - 1 : k].all() for k in range(len(inside))]
        assert bit(trace, REACHED, axis).tolist() == stayed


# --- pp: software limits (607Dh) --------------------------------------------------------------------------------------
@pytest.mark.parametrize(("target", "end"), [(500_000, 120_000), (-500_000, -80_000)])
def test_607dh_clamps_the_target_and_tells_it_in_bit_11(drives, target, end):
    drives.write((0x607D, 1), -80_000)
    drives.write((0x607D, 2), 120_000)
    motion.enable(drives, mode="pp")
    motion.start_move(drives, target)
    assert status(drives) & LIMITED
    drives.advance(1.0)
    assert drives.read(0x6062).tolist() == [end, end]
    assert status(drives) & LIMITED
    motion.move_to(drives, 10_000)
    assert not status(drives) & LIMITED
    assert drives.read(0x6062).tolist() == [10_000, 10_000]


# --- pv ---------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("target", [600_000, -600_000])
def test_pv_ramps_with_6083h_both_ways_and_bit_10_tells_the_ramps_end(drives, target):
    drives.write(0x6083, 3_000_000)
    drives.write(0x6084, 50_000_000)  # of no effect here
    motion.enable(drives, mode="pv")
    start = 0
    for goal in (target, target // 3, -target, 0):
        drives.write(0x60FF, goal)
        trace = drives.record([0x6041, 0x6062], duration=0.6)
        # The demand's velocity from its position: exactly the ramp, sampled in the middle of each ms.
        velocity = np.diff(trace[0x6062][:, 0]) * 1000.0
        middle = trace.t[:-1] + 0.0005
        step = goal - start
        expected = start + np.sign(step) * np.minimum(3e6 * middle, abs(step))
        np.testing.assert_allclose(velocity, expected, atol=2_500)  # increments are whole: 1,000 pps each
        ended = int(np.ceil(abs(step) / 3e6 * 1000.0 - 1e-6))
        assert not bit(trace, REACHED)[1:ended].any()
        assert bit(trace, REACHED)[ended + 1 :].all()
        start = goal


def test_pv_without_a_ramp_does_not_move(drives):
    drives.write(0x6083, 0)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, 500_000)
    drives.advance(0.3)
    assert np.abs(drives.read(0x6064)).max() < 100


# --- cst --------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("current", [1500, -4000])
def test_cst_torque_is_kt_times_current_at_a_locked_rotor(ideal, current):
    ideal.machine.set("load.inertia", 100.0)
    motion.enable(ideal, mode="cst")
    ideal.write(0x6071, current)
    ideal.advance(0.050)
    assert int(ideal.read(0x6077)[0]) == pytest.approx(current, abs=5)
    assert ideal.machine.motor_torque[0] == pytest.approx(ideal.motor.torque_constant * current * 1e-3, rel=2e-3)


def test_cst_torque_accelerates_a_free_rotor(ideal):
    motion.enable(ideal, mode="cst")
    ideal.write(0x6071, 800)
    ideal.advance(0.005)
    before = ideal.machine.rotor_speed[0]
    current = ideal.record([0x6077], duration=0.050)[0x6077].mean() * 1e-3
    acceleration = (ideal.machine.rotor_speed[0] - before) / 0.050
    assert acceleration == pytest.approx(
        ideal.motor.torque_constant * current / (ideal.motor.inertia + LIGHT), rel=5e-3
    )
    # The back-EMF rises with the speed; the integrator lags behind it by some 12 mA.
    assert current == pytest.approx(0.8, abs=0.020)


# --- modes of operation -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("mode", ["pp", "pv", "cst"])
def test_mode_0_stops_a_running_motor(drives, mode):
    motion.enable(drives, mode=mode)
    if mode == "pp":
        motion.start_move(drives, 5_000_000)
    drives.write(0x60FF, 800_000)
    drives.write(0x6071, 300)
    drives.advance(0.250)
    assert (drives.read(0x606C) > 200_000).all()
    drives.write(0x6060, 0)
    drives.advance(0.600)
    assert np.abs(drives.record([0x606C], duration=0.1)[0x606C].mean(axis=0)).max() < 3_000
    assert (drives.read(0x6041) & 0x6F == 0x27).all(), "it stays enabled"
    assert drives.read(0x6061).tolist() == [0, 0]


def test_mode_0_does_not_run(drives):
    motion.enable(drives)
    drives.write(0x60FF, 500_000)
    drives.write(0x6071, 500)
    drives.write(0x607A, 500_000)
    drives.write(0x6040, 0x1F)
    drives.advance(0.3)
    assert np.abs(drives.read(0x6064)).max() < 200


def test_6061h_follows_6060h_at_once_and_each_axis_has_its_own(drives):
    assert drives.read(0x6061).tolist() == [0, 0]
    drives.write(0x6060, [1, 3])
    assert drives.read(0x6061).tolist() == [1, 3]
    drives.write(0x6060, 10, where=np.array([False, True]))
    assert drives.read(0x6061).tolist() == [1, 10]


def test_the_same_mode_twice_is_refused(drives):
    # Note on 6060h: "It is not allowed to write the same mode number twice".
    drives.write(0x6060, 3)
    with pytest.raises(ObjectAccessError, match=r"6060h:00 Modes of operation is 3 already") as refused:
        drives.write(0x6060, 3)
    assert refused.value.abort_code == 0x08000022
    with pytest.raises(ObjectAccessError) as refused:
        drives.write(0x6060, [1, 3])
    assert refused.value.abort_code == 0x08000022
    assert drives.read(0x6060).tolist() == [3, 3], "refused for one axis it changes none"
    drives.write(0x6060, 1)
    assert drives.read(0x6061).tolist() == [1, 1]


def test_the_same_mode_repeated_cyclically_is_ignored(drives):
    # In an RPDO masters repeat it every cycle.
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, 500_000)
    drives.advance(0.3)
    trace = drives.record([0x606C, 0x6061], duration=0.05, play={0x6060: np.full(50, 3)})
    assert (trace[0x6061] == 3).all()
    assert np.abs(trace[0x606C] - 500_000).max() < 40_000


def test_6502h_tells_the_modes_of_the_table(drives):
    # Table 138: bit per mode; CiA 402 numbers them by 6060h minus 1.
    told = int(drives.read(0x6502)[0])
    assert told == sum(1 << (number - 1) for number in (1, 3, 6, 8, 9, 10))
    for number in range(1, 11):
        if told >> (number - 1) & 1:
            drives.write(0x6060, number)
            assert int(drives.read(0x6061)[0]) == number
        else:
            with pytest.raises(ObjectAccessError, match="6060h"):
                drives.write(0x6060, number)


# --- changing the mode in motion (without a jump: test_cyclic.py) -----------------------------------------------------
@pytest.mark.parametrize("before", ["pv", "cst"])
def test_pp_without_a_set_point_brakes_with_6084h_out_of_another_mode(drives, before):
    speed, ramp = 800_000, 4_000_000  # pps, pps^2
    drives.write(0x6084, ramp)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, speed)
    drives.advance(0.8)
    if before == "cst":
        drives.write(0x6071, drives.record([0x6077], duration=0.1)[0x6077].mean(axis=0).round().astype(int))
        drives.write(0x6060, cia402.CST)
        drives.advance(0.1)
    start = drives.record([0x606C], duration=0.02)[0x606C].mean()
    drives.write(0x6060, cia402.PP)  # `motion.select_mode` would have it stay
    trace = drives.record([0x606C], duration=0.12)
    seen = np.apply_along_axis(np.convolve, 0, trace[0x606C].astype(float), np.ones(5) / 5.0, mode="valid")
    # The ramp is followed with the loops' lag: 1/k_v of 32 ms at most; measured noise (1 sigma) is 0.8 %.
    assert np.abs(seen - (start - ramp * trace.t[2:-2, None])).max() < 0.05 * speed + 0.032 * ramp


# --- shaft direction, position scaler, encoder direction --------------------------------------------------------------
def test_2057h_reverses_the_shaft(drives):
    drives.write(0x2057, [0, 1])
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, 500_000)
    drives.advance(0.3)
    np.testing.assert_allclose(drives.record([0x606C], duration=0.1)[0x606C].mean(axis=0), 500_000, rtol=0.02)
    straight, reversed_ = drives.machine.rotor_speed
    assert straight > 40.0
    assert reversed_ < -40.0
    assert (drives.read(0x6064) > 0).all()


def test_2057h_reverses_torque_too(ideal):
    ideal.write(0x2057, 1)
    motion.enable(ideal, mode="cst")
    ideal.write(0x6071, 1000)
    ideal.advance(0.010)
    assert ideal.machine.motor_torque[0] == pytest.approx(-ideal.motor.torque_constant, rel=0.05)
    assert int(ideal.read(0x6077)[0]) == pytest.approx(1000, abs=30)
    assert int(ideal.read(0x606C)[0]) > 0


def test_2058h_scales_positions_and_keeps_stored_integers(drives):
    kept = (0x6065, 0x6067, 0x607A, (0x607D, 1), (0x607D, 2), 0x6081, 0x6083, 0x6084, 0x6085, 0x60FF)
    drives.write(0x607A, 123_456)
    drives.write(0x60FF, -77)
    before = [drives.read(name).tolist() for name in kept]
    drives.write(0x2058, [1000, TURN])
    assert [drives.read(name).tolist() for name in kept] == before
    motion.enable(drives, mode="pp")
    drives.write(0x6081, [20_000, 20 * TURN])
    drives.write(0x6083, [400_000, 400 * TURN])
    drives.write(0x6084, [400_000, 400 * TURN])
    drives.write(0x6067, 0)
    motion.move_to(drives, [5_000, 5 * TURN])
    drives.advance(0.8)
    assert drives.read(0x6062).tolist() == [5_000, 5 * TURN]
    np.testing.assert_allclose(drives.machine.rotor_angle, 5.0 * 2.0 * np.pi, atol=0.02)


@pytest.mark.parametrize("scaler", [4096, 1_000_000])
def test_2058h_never_changes_loop_gain(scaler):
    # The same machine and noise twice, the same move in revolutions: the same currents, to the last bit.
    responses = []
    for inc in (TURN, scaler):
        with EmulatedDrives(load="two_mass", seed=3, num_threads=1) as one:
            one.write(0x2058, inc)
            for name, turns in ((0x6081, 16), (0x6083, 512), (0x6084, 512), (0x6065, 8)):
                one.write(name, turns * inc)
            one.write(0x6067, 0)
            motion.enable(one, mode="pp")
            motion.start_move(one, 2 * inc)
            responses.append(one.record([0x6077, (0x2042, 3)], duration=0.3))
    assert (responses[0][0x6077] == responses[1][0x6077]).all()
    assert (responses[0][0x2042, 3] == responses[1][0x2042, 3]).all()
    assert np.ptp(responses[0][0x6077]) > 500


def test_2080h_wrong_encoder_direction_does_not_follow(drives):
    drives.write((0x2080, 1), [1, 0])  # the encoder of this motor is wired the other way round
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, 500_000)
    drives.advance(0.4)
    right, wrong = drives.record([0x606C], duration=0.1)[0x606C].mean(axis=0)
    assert right == pytest.approx(500_000, rel=0.02)
    assert abs(wrong - 500_000) > 400_000, "the field turns away from the rotor"


# --- not commissioned -------------------------------------------------------------------------------------------------
def test_factory_state_enables_but_nothing_moves():
    with EmulatedDrives(load="inertia", commissioned=False, num_threads=1) as drives:
        assert drives.read(0x2003).tolist() == [0]
        assert drives.read(0x2050).tolist() == [0]
        drives.write(0x2005, 3)
        for mode in (1, 3, 10):
            drives.write(0x6060, mode)
            for word, code in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27)):
                drives.write(0x6040, word)
                assert status(drives) & 0x6F == code
            drives.write(0x6081, 1_000_000)
            drives.write(0x6083, 10_000_000)
            drives.write(0x607A, 500_000)
            drives.write(0x60FF, 500_000)
            drives.write(0x6071, 5_000)
            drives.write(0x6040, 0x1F)
            drives.advance(0.1)
            assert drives.machine.motor_torque.tolist() == [0.0]
            assert drives.machine.rotor_speed.tolist() == [0.0]
            drives.write(0x6040, 0)
            drives.advance(0.005)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        (0x2050, 0),  # no motor
        (0x2055, 0),  # FOC disabled
        (0x2003, 0),  # no current
    ],
)
def test_each_of_these_alone_keeps_the_motor_still(drives, name, value):
    drives.write(name, value)
    motion.enable(drives, mode="cst")
    drives.write(0x6071, 1000)
    drives.advance(0.1)
    assert np.abs(drives.machine.rotor_angle).max() < 0.01
    assert np.abs(drives.machine.motor_torque).max() < 0.01
