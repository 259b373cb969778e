"""Network namespaces with a cable: a drive in one, a master in the other."""

from __future__ import annotations

import ctypes
import json
import os
import select
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from drive_env.ethercat.namespaces import Namespaces
from rigs import TESTS


def why_no_namespace():
    """Return why this machine has no namespaces, None where it has."""
    if sys.platform != "linux" or shutil.which("ip") is None:
        return "network namespaces are Linux's, and made by iproute2"
    if os.geteuid() != 0:
        return "network namespaces take root (CAP_NET_ADMIN)"
    done = subprocess.run(["ip", "netns", "add", f"try-{os.getpid()}"], capture_output=True, text=True)
    if done.returncode:
        return f"this machine makes no network namespaces: {done.stderr.strip()}"
    subprocess.run(["ip", "netns", "delete", f"try-{os.getpid()}"], check=True)
    return None


NO_NAMESPACE = why_no_namespace()
needs_namespaces = pytest.mark.skipif(NO_NAMESPACE is not None, reason=str(NO_NAMESPACE))
NEW_NETWORK = 0x40000000  # CLONE_NEWNET of Linux
PATIENCE = 240.0  # s; kernels may have to be compiled


@pytest.fixture
def spaces():
    number = os.getpid() % 100_000
    spaces = Namespaces(f"drive-{number}", f"master-{number}", "veth1", "veth0")
    spaces.make()
    yield spaces
    spaces.remove()


def inside(space, *arguments):
    return ["ip", "netns", "exec", space, sys.executable, *map(str, arguments)]


@contextmanager
def within(space):
    """Have this thread, and the programs that it starts, in a namespace: sockets that are open stay where they are."""
    with Path("/proc/thread-self/ns/net").open() as before, Path("/run/netns", space).open() as there:
        _enter(there)
        try:
            yield
        finally:
            _enter(before)


def _enter(space):
    if ctypes.CDLL(None, use_errno=True).setns(space.fileno(), NEW_NETWORK):
        raise OSError(ctypes.get_errno(), "setns")


def first_line(process):
    """Return the first line that a process prints; it may compile before."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and process.poll() is None:
        if select.select((process.stdout,), (), (), 1.0)[0]:
            return process.stdout.readline()
    raise AssertionError(f"it did not begin: {process.poll()}")


@contextmanager
def served(spaces, pace, device="tmcm3313", load="portal", options=()):
    """Serve a drive in its namespace."""
    program = "from drive_env.programs import drive_env; drive_env()"
    serve = ("-c", program, "serve", device, "--load", load, pace)
    process = subprocess.Popen(
        inside(spaces.slave, *serve, "--interface", "ethercat", "--channel", spaces.slave_interface, *options),
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert f"1 slave ({device}" in first_line(process)
        yield
    finally:
        process.terminate()
        process.wait(PATIENCE)
        process.stdout.close()


def seen_by(
    spaces, pace, program_of_master, *arguments, device="tmcm3313", load="portal", library="pysoem", options=()
):
    """Return the report of a master on a served drive."""
    pytest.importorskip(library, reason=f"{library} is not installed: pip install -e '.[test]'")
    with served(spaces, pace, device, load, options):
        master = inside(spaces.master, TESTS / program_of_master, spaces.master_interface, *arguments)
        done = subprocess.run(master, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])
