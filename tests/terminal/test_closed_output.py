"""Nobody takes what a command prints (`| head -1`): it ends quietly with 141; a disk that is full is told."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

if os.name != "posix":
    pytest.skip("pipes end otherwise there", allow_module_level=True)

PROGRAM = "import sys; from drive_env import programs; getattr(programs, sys.argv.pop(1))()"
COMMANDS = {
    "help": ("drive_env", "--help"),
    "help of a command": ("drive_tune", "auto", "--help"),
    "version of nothing": ("drive_agent", "--help"),
    "a file": ("drive_tune", "sweep", "--show-config"),
    "a run": ("drive_env", "render", "--show-config"),
    "a card": ("drive_agent", "evaluate", "gain_tuning", "--card"),
    "a card as JSON": ("drive_agent", "evaluate", "gain_tuning", "--card", "--json"),
    "a server": ("drive_env", "serve", "--port", "0", "--duration", "0.1"),
}


def run(arguments, unbuffered="", **streams):
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments], timeout=120, text=True,
        env=os.environ | {"PYTHONUNBUFFERED": unbuffered}, **streams,
    )  # fmt: skip


@pytest.fixture
def broken():
    """The writing end of a pipe that nobody reads."""
    read, write = os.pipe()
    os.close(read)
    yield write
    os.close(write)


@pytest.mark.slow
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_closed_output_ends_quietly(name, unbuffered, broken):
    found = run(COMMANDS[name], unbuffered, stdout=broken, stderr=subprocess.PIPE)
    assert (found.returncode, found.stderr) == (141, "")


@pytest.mark.slow
def test_both_closed_end_quietly(broken):
    assert run(COMMANDS["a card"], stdout=broken, stderr=broken).returncode == 141
    assert run(("drive_env", "get"), stdout=broken, stderr=broken).returncode == 141


@pytest.mark.slow
def test_a_mistake_keeps_its_code_where_nothing_was_printed(broken):
    found = run(("drive_agent", "evaluate", "nothing.npz"), stdout=broken, stderr=subprocess.PIPE)
    assert found.returncode == 2 and "there is no file" in found.stderr


@pytest.mark.slow
def test_without_an_output_a_command_does_its_work():
    command = [sys.executable, "-c", PROGRAM, *COMMANDS["a card"]]
    found = subprocess.run(["sh", "-c", '"$@" >&-', "sh", *command], timeout=120, stderr=subprocess.PIPE, text=True)
    assert (found.returncode, found.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such device here")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_full_disk_is_told(unbuffered):
    with Path("/dev/full").open("w") as full:
        found = run(COMMANDS["a card"], unbuffered, stdout=full, stderr=subprocess.PIPE)
    assert found.returncode == 2
    assert found.stderr.endswith("No space left on device\n") and found.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such device here")
@pytest.mark.parametrize(("kind", "device"), [("esi", "tmcm3313"), ("eds", "tmcm1636_fw109")])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_of_a_file_that_is_printed_a_full_disk_is_told_by_name_and_remedy(kind, device, unbuffered):
    with Path("/dev/full").open("w") as full:
        found = run(
            ("drive_env", "export", kind, "-", "--device", device), unbuffered, stdout=full, stderr=subprocess.PIPE
        )
    assert found.returncode == 2
    assert found.stderr.splitlines()[0] == (
        "drive-env: standard output: No space left on device; print to where there is room"
    )
