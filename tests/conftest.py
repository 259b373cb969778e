import functools
import signal

import numpy as np
import pytest
import typer.testing

from drive_env import EmulatedDrives, motion
from drive_env.master.description import Description

ANSWER_PATIENCE = 20.0  # a busy machine may keep a thread waiting for longer than any drive takes to answer [s]

# Typer makes a program's commands anew for each call, which takes longer than most commands.
typer.testing._get_command = functools.cache(typer.testing._get_command)

# A shell starts what runs in the background deaf to Ctrl-C, and nohup to the terminal's end; some tests send both.
signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture
def axis():
    """One commissioned drive on a rigid inertia, in switch on disabled."""
    with EmulatedDrives(load="inertia") as drives:
        yield drives


@pytest.fixture
def running(axis):
    """One drive at 1000 rpm in pv."""
    motion.enable(axis, mode="pv")
    axis.write("Target velocity", 1_092_267)
    axis.advance(0.3)
    assert abs(int(axis.read(0x606C)[0]) - 1_092_267) < 60_000
    return axis


@pytest.fixture(autouse=True)
def no_numpy_warnings():
    with np.errstate(all="raise", under="ignore"):
        yield


@pytest.fixture(autouse=True)
def patient_masters(monkeypatch):
    """A master of this process whose test gives no time-out waits for an answer as long as a busy machine may take."""
    monkeypatch.setattr(
        Description,
        "answer_timeout",
        property(lambda self: self.timeout if self.timeout is not None else ANSWER_PATIENCE),
    )
