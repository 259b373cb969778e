import functools
import gc
import signal
from collections import Counter
from types import SimpleNamespace

import canopen
import numpy as np
import pytest
import typer.testing
from serial.urlhandler import protocol_socket

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.fieldbus.description import Description

ANSWER_PATIENCE = 20.0  # a busy machine may keep a thread waiting for longer than any drive takes to answer [s]

pytest.register_assert_rewrite("rigs")  # what they judge fails as a test's own assertion does

# Typer makes a program's commands anew for each call, which takes longer than most commands.
typer.testing._get_command = functools.cache(typer.testing._get_command)

# Stock clients rest: one of slcan for 0.3 s after it has closed its socket, for adapters that are slow to serve the
# next one; python-canopen's until a second in which nothing comes is over, before it closes a bus.
protocol_socket.time = SimpleNamespace(sleep=lambda seconds: None)
canopen.Network.NOTIFIER_CYCLE = 0.02  # s

# A shell starts what runs in the background deaf to Ctrl-C, and nohup to the terminal's end; some tests send both.
signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Of the rows of a test that is marked `every(n)` and are not slow each n-th is in each run; the others are slow.

    SLOW_STRIDE and SLOW_SHARE leave out slow rows and slow tests: see rigs/thinning.py. With --last-failed none is left
    out: tests that failed stand alone here, and no row is the n-th of all.
    """
    if config.getoption("lf", False):
        return
    from rigs.thinning import EACH, FIRST, STRIDE

    rows, slow, numbers, left_out = Counter(), Counter(), {}, []
    for item in items:
        test = item.nodeid.partition("[")[0]
        every = item.get_closest_marker("every")
        if every is not None and item.get_closest_marker("slow") is None:
            if rows[test] % every.args[0]:
                item.add_marker(pytest.mark.slow)
            rows[test] += 1
        if item.get_closest_marker("slow") is not None:
            number = numbers.setdefault(test, len(numbers))
            if slow[test] % STRIDE or number % EACH != FIRST:
                left_out.append(item)
            slow[test] += 1
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        gone = set(left_out)
        items[:] = [item for item in items if item not in gone]


@pytest.hookimpl(wrapper=True)
def pytest_collection(session):
    """Collect tests without the garbage collector, which never looks at what is there then: nothing of that goes."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(autouse=True, scope="session")
def quick_realtime_sections():
    """Keep real-time sections from collecting, which takes half a second here, and from ending the freeze above."""
    with pytest.MonkeyPatch.context() as patch:
        kept = SimpleNamespace(collect=lambda: None, freeze=lambda: None, unfreeze=lambda: None)
        patch.setattr("drive_env.realtime_section.gc", kept)
        yield


@pytest.fixture(scope="module")
def files_read_here():
    """Have files of others be read in this process, not in one of their own with limits: for what tests no limit."""

    def read(what, function, *arguments, memory=None, time=None):
        try:
            return function(*arguments)
        except ValueError as error:  # another process sends its words alone
            raise ValueError(str(error)) from None

    with pytest.MonkeyPatch.context() as patch:
        for reader in ("drive_env.commands.recorded_frames", "mechanics.model", "agents.policies.onnx_policy"):
            patch.setattr(f"{reader}.call_limited", read)
        yield


@pytest.fixture(scope="session")
def emulated():
    """Drives of a device by its name, as many as it has axes, made once: what the conformance tests share."""
    made = {}

    def of(name):
        if name not in made:
            made[name] = EmulatedDrives(name, "inertia", num_machines=find_device(name).num_axes, num_threads=1)
        return made[name]

    yield of
    for drives in made.values():
        drives.close()


@pytest.fixture(scope="module")
def drives():
    """One commissioned drive on a rigid inertia, for a module's tests."""
    with EmulatedDrives(load="inertia", num_threads=1) as made:
        yield made


@pytest.fixture
def wire(drives):
    """Node 5 of a module's drives, freshly reset and pre-operational."""
    from rigs.canopen_wire import Wire

    drives.machine.reset()
    return Wire(drives)


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


@pytest.fixture
def quick_designs(monkeypatch):
    """Have auto look at few sets of gains on its twins."""
    from rigs.auto_stages import short_designs

    short_designs(monkeypatch.setattr)


@pytest.fixture(autouse=True, scope="session")
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
