"""A scale of positions that two objects make: full steps of a turn, and microsteps of a full step."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.canopen_wire import Wire
from rigs.world_bus import on_bus

from drive_env import EmulatedDrives, Limits, ObjectAccessError, motion
from drive_env.dictionary.position_scale import position_scale
from drive_env.dictionary.roles import Role
from drive_env.safety.errors import SafetyError
from drive_env.safety.rotor import scale_objects

MODULE, AXES = "tmcm6212", 6
FULL_STEPS, MICROSTEPS = 0x2001, 0x2000


@pytest.fixture
def drives():
    with EmulatedDrives(MODULE, load="inertia", num_machines=AXES, num_threads=1) as made:
        yield made


def test_the_rule():
    assert position_scale({}) is None
    assert position_scale({Role.FULL_STEPS: (1, 0)}) is None
    rule = position_scale({Role.FULL_STEPS: (1, 0), Role.MICROSTEPS: (2, 0)})
    assert rule.keys == ((1, 0), (2, 0))
    np.testing.assert_array_equal(rule.increments([np.array([200.0, 400.0]), np.array([8.0, 0.0])]), [51200.0, 400.0])


def test_positions_are_microsteps_from_power_on(drives):
    assert drives.read(Role.POSITION_SCALE).tolist() == [51200] * AXES
    motion.enable(drives, mode="pp")
    motion.start_move(drives, 5120)
    drives.advance(0.5)
    np.testing.assert_allclose(drives.inside.records["theta_meas"].reshape(-1)[:AXES], 0.2 * np.pi, atol=2e-3)


def test_a_coarser_resolution_keeps_what_is_stored_and_rescales_what_is_measured(drives):
    drives.write(0x6081, 51200)
    before = drives.inside.records["max_velocity"].reshape(-1)[:AXES].copy()
    motion.enable(drives, mode="pp")
    motion.start_move(drives, 5120)
    drives.advance(0.5)
    motion.disable(drives)
    at = drives.read(0x6064)
    drives.write(MICROSTEPS, 4, where=np.arange(AXES) == 2)
    assert drives.read(Role.POSITION_SCALE).tolist() == [51200, 51200, 3200, 51200, 51200, 51200]
    assert drives.read(0x6081).tolist() == [51200] * AXES
    after = drives.inside.records["max_velocity"].reshape(-1)[:AXES]
    np.testing.assert_allclose(after / before, [1, 1, 16, 1, 1, 1])
    assert abs(drives.read(0x6064)[2] - at[2] / 16) <= 1
    drives.write(FULL_STEPS, 400, where=np.arange(AXES) == 2)
    assert drives.read(Role.POSITION_SCALE)[2] == 6400


def test_the_same_over_a_bus_and_after_a_reset(drives):
    wire = Wire(drives)
    assert wire.download(MICROSTEPS + 0x200, 0, 3, 1) == 0  # axis 1
    assert drives.read(Role.POSITION_SCALE).tolist() == [51200, 1600, 51200, 51200, 51200, 51200]
    assert wire.download(0x1010, 5, 0x65766173, 4) == 0
    assert wire.download(MICROSTEPS + 0x400, 0, 0, 1) == 0  # axis 2, not stored
    wire.receive(0, "81 05")
    assert drives.read(Role.POSITION_SCALE).tolist() == [51200, 1600, 51200, 51200, 51200, 51200]


def test_neither_object_is_played(drives):
    with pytest.raises(ObjectAccessError, match="cannot be played"):
        drives.record([0x6064], 0.002, play={MICROSTEPS: np.array([4, 4])})


def test_a_master_reads_it_and_its_limits_stay_with_the_rotor():
    emulated = EmulatedDrives(MODULE, load="inertia", num_machines=AXES, num_threads=1)
    with on_bus(emulated, device=MODULE, safety=Limits(position=(-51200, 51200))) as drives:
        assert scale_objects(drives.description) == ((FULL_STEPS, 0), (MICROSTEPS, 0))
        assert drives.read(Role.POSITION_SCALE).tolist() == [51200] * AXES
        drives.write(MICROSTEPS, 4)
        assert drives.read(Role.POSITION_SCALE).tolist() == [3200] * AXES
        motion.enable(drives, mode="csp")
        with pytest.raises(SafetyError, match="changes the scale of positions, and the axis is enabled"):
            drives.write(MICROSTEPS, 5)
        with pytest.raises(SafetyError, match="would lead to 3201, beyond the limits -3200 to 3200"):
            drives.write(0x607A, 3201)
        motion.disable(drives)


def test_a_port_that_has_read_before_follows_a_scale_that_changes():
    """A node reads an axis by its port, which keeps the factor of a unit as long as the scale is the same."""
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        wire = Wire(drives)
        motion.enable(drives, mode="pp")
        motion.move_to(drives, 65_536)
        assert wire.value(0x6064) == pytest.approx(65_536, abs=200)
        motion.disable(drives)
        assert wire.download(0x2058, 0, 32_768, 4) == 0
        assert wire.value(0x6064) == pytest.approx(32_768, abs=100)
