"""A drive that stops while it is experimented on says why; what braking gives back, the DC link must hold."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from drive_env.drives.emergency import EmergencyMessage
from tuning.identify.identification import identify
from tuning.response.frequency_response import measure
from tuning.stop_causes import stop_causes
from tuning.target import emulated


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


@pytest.mark.slow
@pytest.mark.parametrize("motor", ["class_750w", "class_1kw"])
def test_large_motors_are_shaken_no_more_than_the_dc_link_bears(motor):
    with emulated(load="two_mass", motor=motor, num_threads=1) as target:
        found = identify(target)
        assert target.drives.emergencies() == []
    for name in ("anti_resonance", "resonance", "loop_delay", "velocity_filter"):
        assert found[0].estimates[name].is_known, found[0].estimates[name]


def test_a_response_names_the_emergency_that_ended_it():
    with emulated(load="two_mass", num_threads=1) as target:
        target.drives.machine.fault("supply_surge", at=1.2, duration=0.1)  # while it is shaken
        found = measure(target)
    assert any("the drive stopped during the measurement: overvoltage (3210h)" in note for note in found.notes[0])
    assert np.isnan(found.open_loop).all()
