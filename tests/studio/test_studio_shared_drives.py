"""What a job of the studio gets of its drives once it was stopped: it puts back what it changed, and moves nothing."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.dictionary.roles import Role
from drive_env.safety.errors import SafetyError
from drive_env.studio.errors import JobStoppedError
from drive_env.studio.shared_drives import SharedDrives


@pytest.fixture
def job():
    """A job's drives, why it was stopped, and what its drives were asked; `told` is what the envelope has to tell."""
    made = SimpleNamespace(stopped="", told=[], asked=[])

    def call(*asked, **options):
        if made.told:
            raise made.told.pop()
        made.asked.append(asked)
        return np.zeros(1, np.int64)

    drives = SimpleNamespace(read=call, write=call, time_waits=True, num_axes=1, device=find_device("tgz_d"))
    recorder = SimpleNamespace(period=0.001)
    made.drives = SharedDrives(drives, recorder, lambda: None, list, lambda: False, lambda: made.stopped)
    return made


def test_a_stop_that_the_envelope_made_itself_ends_a_job(job):
    job.told.append(SafetyError("axis 0: too fast"))
    with pytest.raises(SafetyError, match="too fast"):
        job.drives.write(cia402.CONTROLWORD, cia402.DISABLE_VOLTAGE)


def test_a_stop_that_a_job_knows_of_does_not_hinder_what_it_puts_back(job):
    """Else the envelope's error takes the place of the stop, and the job goes on as after any other error."""
    job.stopped = "the button of a page"
    for ask in (lambda: job.drives.write(cia402.CONTROLWORD, cia402.DISABLE_VOLTAGE), lambda: job.drives.read(0x6041)):
        job.told.append(SafetyError("the drives were quick-stopped: the button of a page"))
        ask()
    assert job.asked == [(cia402.CONTROLWORD, cia402.DISABLE_VOLTAGE), (0x6041,)] and not job.told


@pytest.mark.parametrize("name", [cia402.CONTROLWORD, (cia402.CONTROLWORD, 0), "Controlword"])
@pytest.mark.parametrize("word", [0x0F, 0x1F, np.array([0x06, 0x0F])])
def test_a_job_that_was_stopped_has_no_axis_operate(job, name, word):
    job.drives.write(name, word)
    job.stopped = "the last page is gone"
    with pytest.raises(JobStoppedError, match="the last page is gone"):
        job.drives.write(name, word)
    assert len(job.asked) == 1


@pytest.mark.parametrize("word", [0x00, 0x02, 0x06, 0x07, 0x0B, 0x80, 0x10F])
def test_a_job_that_was_stopped_may_stop_and_switch_off(job, word):
    job.stopped = "the last page is gone"
    job.drives.write(cia402.CONTROLWORD, word)
    assert job.asked == [(cia402.CONTROLWORD, word)]


@pytest.mark.parametrize(
    "name",
    [0x607A, (0x60FF, 0), "Target torque", 0x60B0, 0x60B1, 0x60B2, (0x60C1, 1), Role.TARGET_INSIDE, (0x23C7, 0)],
)
def test_what_moves_an_axis_belongs_to_the_page_that_wrote_it(job, name):
    job.drives.write(0x6083, 1000)
    assert not job.drives.moved.any()
    job.drives.write(name, 1000)
    assert job.drives.moved.all()
