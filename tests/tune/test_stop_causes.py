"""A drive that stops while it is experimented on says why; what braking gives back, the DC link must hold."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rigs.known_machines import proving

from drive_env import motion
from drive_env.drives.emergency import EmergencyMessage
from tuning.identify.identification import identify
from tuning.response.frequency_response import measure
from tuning.stop_causes import UNTOLD, stop_causes
from tuning.target import emulated, timed


def drives_that_told(*messages):
    told = [EmergencyMessage(axis, code, 0, (0,) * 5, name) for axis, code, name in messages]
    return SimpleNamespace(num_axes=2, emergencies=lambda: told, observers=())


def test_each_axis_has_its_causes_once_and_in_their_order():
    drives = drives_that_told((1, 0x3210, "Over voltage"), (1, 0x8611, "Following error"), (1, 0x3210, "Over voltage"),
                              (1, 0, "no error"))  # fmt: skip
    assert stop_causes(drives) == [
        "no emergency message with the cause was received",
        "Over voltage (3210h), Following error (8611h)",
    ]


def test_a_cause_is_remembered_for_as_long_as_the_axis_is_in_fault():
    """An emergency can be read but once, and a tuner asks in several places."""
    with emulated(load="inertia", num_machines=2, num_threads=1) as target, timed(target) as (watched, _):
        drives = watched.drives
        motion.enable(drives, "csv")
        drives.machine.fault("supply_surge", duration=0.1, where=np.array([True, False]))
        drives.advance(0.1)
        told = ["overvoltage (3210h)", UNTOLD]
        assert stop_causes(drives) == told
        assert stop_causes(drives) == told
        drives.advance(1.0)
        motion.reset_fault(drives)
        assert stop_causes(drives) == [UNTOLD, UNTOLD]


@pytest.mark.slow
def test_every_figure_of_an_identification_that_a_fault_ended_names_the_emergency():
    """Each said that no emergency message was received: it had been read before the second moves."""
    with emulated(load="inertia", num_threads=1) as target:
        target.drives.machine.fault("supply_surge", at=3.0, duration=0.1)  # in the first moves
        found = identify(target)[0]
    unknown = {name: one.reason for name, one in found.estimates.items() if not one.is_known}
    assert {"inertia", "coulomb", "viscous", "resonance", "velocity_filter"} <= unknown.keys()
    assert all("overvoltage (3210h)" in reason for reason in unknown.values()), unknown


@pytest.mark.slow
@pytest.mark.parametrize("motor", ["class_750w", "class_1kw"])
def test_large_motors_are_shaken_no_more_than_the_dc_link_bears(motor):
    with emulated(load="two_mass", motor=motor, num_threads=1) as target:
        found = identify(target)
        assert target.drives.emergencies() == []
    for name in ("anti_resonance", "resonance", "loop_delay", "velocity_filter"):
        assert found[0].estimates[name].is_known, found[0].estimates[name]


def surge(target, at):
    target.drives.machine.fault("supply_surge", at=at, duration=0.1)


def test_a_recorded_move_of_auto_names_the_emergency_that_ended_it():
    with emulated(load="inertia", num_threads=1) as target, timed(target) as (watched, _):
        ground, gains = proving(watched)
        everywhere = np.ones(1, bool)
        assert ground.run(gains, everywhere).reason == ("",)
        surge(target, 0.15)
        (reason,) = ground.show(gains, everywhere).reason
    assert reason.endswith("(cut off within 50 ms); the drive reported overvoltage (3210h)"), reason


def test_a_response_names_the_emergency_that_ended_it():
    with emulated(load="two_mass", num_threads=1) as target:
        target.drives.machine.fault("supply_surge", at=1.2, duration=0.1)  # while it is shaken
        found = measure(target)
    assert any("the drive stopped during the measurement: overvoltage (3210h)" in note for note in found.notes[0])
    assert np.isnan(found.open_loop).all()
