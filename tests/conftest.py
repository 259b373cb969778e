import numpy as np
import pytest

from drive_env import EmulatedDrives, motion


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
