"""`drive-env fault` and serve's --fault and --control, as a user meets them."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest
from rigs import ROOT
from typer.testing import CliRunner

from drive_env import CanDrives, motion
from drive_env.bus.fault_control import PORT, Control, ControlError, ask
from drive_env.commands.cli import app
from drive_env.commands.fault import CONTROL_PORT
from drive_env.faults.table import FAULTS
from drive_env.fieldbus.errors import NoAnswerError

SERVE = "import typer; from drive_env.commands.serve import serve; typer.run(serve)"
PATIENCE = 30.0  # s that a busy machine may take


def fault(*arguments):
    return CliRunner().invoke(app, ["fault", *map(str, arguments)], env={"COLUMNS": "200", "NO_COLOR": "1"})


@contextmanager
def served(*arguments):
    """A server in a process of its own; yields the process, its channel and its control port."""
    process = subprocess.Popen(
        [sys.executable, "-c", SERVE, "--port", "0", *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": str(ROOT), "NO_COLOR": "1"}, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    try:
        control = 0
        for line in process.stdout:
            if found := re.search(r"drive-env fault NAME --control (\d+)", line):
                control = int(found[1])
            if found := re.search(r'channel="(socket://127\.0\.0\.1:\d+)"', line):
                yield process, found[1], control
                break
        else:
            pytest.fail(process.stderr.read())
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def wait_until(condition, what):
    until = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < until, what
        time.sleep(0.02)


@pytest.mark.slow
def test_a_fault_is_given_to_a_running_server_listed_and_cleared():
    with served("tmcm1636", "--load", "inertia", "--control", 0) as (process, channel, control):
        with CanDrives("tmcm1636", interface="slcan", channel=channel, nodes=[1]) as drives:
            motion.enable(drives, mode="pv")
            given = fault("enable_lost", "--control", control)
            assert (given.exit_code, given.stdout) == (0, "1\n")
            wait_until(lambda: drives.read(0x6041)[0] & 0x4F == 0x08, "the drive did not trip")
            status = fault("--status", "--control", control)
            assert status.stdout == "1: enable_lost node 1, permanent, active\n"
            assert fault("--clear", 1, "--control", control).exit_code == 0
            wait_until(lambda: fault("--status", "--control", control).stdout == "", "the fault did not end")
            wait_until(lambda: int(drives.read(0x60FD)[0]) & 8, "the input did not close")
            motion.enable(drives, mode="pv")
            given = fault("payload_jump", "factor=2", "--at", 100, "--duration", 0.5, "--control", control, "--json")
            assert json.loads(given.stdout) == {"number": 2}
            told = json.loads(fault("--status", "--control", control, "--json").stdout)
            assert told == [
                {
                    "number": 2, "name": "payload_jump", "node": 1, "axis": None, "at": 100.0, "when": "",
                    "duration": 0.5, "parameters": {"factor": 2.0}, "active": False,
                }
            ]  # fmt: skip
            assert fault("--clear", "all", "--control", control).exit_code == 0
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE)
        assert (process.returncode, errors) == (0, "")
        with pytest.raises(ControlError, match=f"no bus takes faults at port {control}"):
            ask(control, "faults")


@pytest.mark.slow
def test_a_fault_that_serve_begins_with():
    order = "enable_lost when=enabled at=0.01"
    with served("tmcm1636", "--load", "inertia", "--fault", order) as (_, channel, control):
        assert control == 0
        with CanDrives("tmcm1636", interface="slcan", channel=channel, nodes=[1]) as drives:
            motion.enable(drives, mode="pv")
            wait_until(lambda: drives.read(0x6041)[0] & 0x4F == 0x08, "the drive did not trip")


@pytest.mark.slow
def test_a_master_is_told_what_the_bus_lost_and_goes_on_without_a_restart():
    with (
        served("tmcm1636", "--load", "inertia", "--control", 0) as (_, channel, control),
        CanDrives("tmcm1636", interface="slcan", channel=channel, nodes=[1], timeout=1.0) as drives,
    ):
        drives.read(0x6041)
        number = ask(control, "fault bus_loss share=1")["number"]
        wait_until(lambda: ask(control, "faults")["faults"][0]["active"], "the fault did not begin")
        with pytest.raises(NoAnswerError, match=r"node 1 did not answer the read of 6041h:00 Statusword within 1 s"):
            drives.read(0x6041)
        ask(control, f"clear {number}")
        wait_until(lambda: _answers(drives), "the bus did not come back")
        assert drives.read(0x6041)[0] & 0x4F == 0x40


def _answers(drives):
    try:
        drives.read(0x6041)
    except NoAnswerError:
        return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "message"), [
    (["--fault", "encoder_stuk"], "drive-env: --fault: no fault is named 'encoder_stuk'; there are "),
    (["--fault", "jam torque=1e9"], "drive-env: --fault: fault jam: torque=1e+09 must be 0 to 1000 rated torque"),
    (["--fault", "jam soon"], "'soon' must be as at=2"),
    (["--control", "70000"], "drive-env: --control 70000 must be 0 to 65535"),
])  # fmt: skip
def test_a_mistake_of_serve_is_one_line(arguments, message):
    done = subprocess.run(
        [sys.executable, "-c", SERVE, "--port", "0", "--load", "inertia", *arguments],
        env=os.environ | {"PYTHONPATH": str(ROOT), "NO_COLOR": "1"}, capture_output=True, text=True, timeout=120,
        check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_a_control_port_that_is_taken_is_told():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = subprocess.run(
            [sys.executable, "-c", SERVE, "--port", "0", "--load", "inertia", "--control", str(port)],
            env=os.environ | {"PYTHONPATH": str(ROOT), "NO_COLOR": "1"}, capture_output=True, text=True, timeout=120,
            check=False,
        )  # fmt: skip
    assert done.returncode == 2
    assert (
        f"drive-env: cannot listen on 127.0.0.1:{port}: Address already in use; choose another --control" in done.stderr
    )


# --- the command ------------------------------------------------------------------------------------------------------
def test_the_table_has_every_fault_and_every_parameter():
    text = fault("--list").stdout
    for row in FAULTS.values():
        assert row.name in text
        for name, parameter in row.parameters.items():
            assert f"    {name}: {parameter.meaning}" in text
    assert json.loads(fault("--list", "--json").stdout)["jam"]["parameters"]["torque"]["default"] == 20.0


class Calls:
    """What a bus's faults are asked."""

    def __init__(self):
        self.orders = []

    def add(self, order):
        self.orders.append(order)
        if order.node == 9:
            raise ValueError("no node has the number 9")
        return len(self.orders)

    def listing(self):
        return []

    def clear(self, number):
        self.orders.append(number)


@pytest.fixture
def control():
    calls = Calls()
    served = Control(calls, 0)
    yield served, calls
    served.close()


def test_all_options_reach_the_server(control):
    served, calls = control
    given = fault(
        "babbling_node", "rate=100", "--at", 2, "--when", "speed > 3", "--duration", 0.5, "--node", 3,
        "--axis", 2, "--control", served.port,
    )  # fmt: skip
    assert (given.exit_code, given.stdout) == (0, "1\n")
    (order,) = calls.orders
    assert (order.name, order.at, order.when, order.duration) == ("babbling_node", 2.0, "speed > 3", 0.5)
    assert (order.node, order.axis) == (3, 2)
    assert order.parameters == {"rate": 100.0}


@pytest.mark.parametrize(("arguments", "code", "message"), [
    ([], 2, "give one of a fault's name, --list, --status and --clear NUMBER"),
    (["jam", "--list"], 2, "give one of"),
    (["jam", "torque"], 2, "'torque' must be as at=2"),
    (["jam", "torque=much"], 2, "torque must be a number, not 'much'"),
    (["jam", "--node", "9"], 2, "no node has the number 9"),
    # Told with no server there.
    (["jem", "--control", "1"], 2, "no fault is named 'jem'; there are encoder_lost_counts, "),
    (["jam", "force=1", "--control", "1"], 2, "fault jam has no parameter 'force'; it has torque"),
    (["--clear", "first"], 2, "clear takes the number of a fault, or all, not 'first'"),
])  # fmt: skip
def test_a_mistake_is_one_line(control, arguments, code, message):
    done = fault("--control", control[0].port, *arguments)
    assert done.exit_code == code
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_no_server_is_told_with_the_remedy():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    done = fault("--status", "--control", port)
    assert done.exit_code == 1
    assert f"no bus takes faults at port {port}" in done.stderr
    assert f"start it with drive-env serve --control {port}" in done.stderr


def test_clients_that_do_not_speak_or_speak_nonsense_end_nothing(control):
    served, _ = control
    with socket.create_connection(("127.0.0.1", served.port)):  # says nothing
        pass
    with socket.create_connection(("127.0.0.1", served.port)) as one:
        one.sendall(b"\xff\xfe\x00\n")
        assert b"is not a request; there are fault, faults and clear" in one.recv(4096)
    with socket.create_connection(("127.0.0.1", served.port)) as one:
        one.sendall(b"x" * 100_000)
        one.settimeout(10.0)
        with contextlib.suppress(ConnectionResetError):  # it has answered and gone before all was read
            assert b"error" in one.recv(65536)
    assert ask(served.port, "faults") == {"faults": []}


def test_the_default_ports_are_one():
    assert PORT == CONTROL_PORT
