"""README's commands and programs, as they stand, one after the other, as a reader would type them."""

from __future__ import annotations

import os
import pty
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from rigs import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", README, re.M | re.S)
PROGRAMS = [text for kind, text in BLOCKS if kind == "python"]
SHELLS = [text for kind, text in BLOCKS if not kind]
# Commands within the text that are complete: with an option, and without a name that the reader chooses.
INLINE = [text for text in re.findall(r"`(drive-\w+ [^`]+)`", README) if " --" in text and "socketcan" not in text]
PORT = 29636  # that of `serve`


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the reader is: with the examples."""
    path = tmp_path_factory.mktemp("reader")
    (path / "examples").symlink_to(ROOT / "examples")
    return path


def environment():
    programs = str(Path(sys.executable).parent)
    return os.environ | {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", "PYTHONUNBUFFERED": "1"}


def run(command, folder, wanted=0):
    keyboard, terminal = pty.openpty()  # who is asked whether the way is clear says yes
    os.write(keyboard, b"y\n")
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment(), stdin=terminal, capture_output=True, text=True, timeout=900,
            check=False,
        )  # fmt: skip
    finally:
        os.close(keyboard)
        os.close(terminal)
    assert done.returncode == wanted, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def lines(text):
    return [line for line in text.splitlines() if line and "pip install" not in line]


def test_it_is_short_and_begins_with_the_two_commands_and_a_picture():
    assert len(README.splitlines()) <= 150
    first, second = SHELLS[:2]
    assert "pip install" in first and "drive-tune auto" in first
    assert "pip install" in second and "pytest" in second
    pictures = re.findall(r"!\[.+\]\((.+)\)", README)
    assert len(pictures) == 2 and all((ROOT / picture).is_file() for picture in pictures)


@pytest.fixture(scope="module")
def served(folder):
    """The block that serves a drive, in a terminal of its own."""
    with socket.socket() as probe:
        if probe.connect_ex(("127.0.0.1", PORT)) == 0:
            pytest.skip(f"port {PORT} is taken")
    (block,) = [text for text in SHELLS if text.startswith("drive-env serve")]
    with subprocess.Popen(
        ["bash", "-c", f"exec {block}"], cwd=folder, env=environment(), stdout=subprocess.PIPE, text=True
    ) as process:
        while "29636" not in process.stdout.readline():
            assert process.poll() is None, "it ended"
        yield
        process.terminate()
        process.wait(60)


@pytest.mark.slow
def test_the_commands_of_a_bus_do_what_they_say_one_after_the_other(folder, served):
    (block,) = [text for text in SHELLS if "DRIVE_ENV_CHANNEL" in text]
    export, *others = lines(block)
    assert export.startswith("export ") and len(others) >= 4
    for line in others:
        run(["bash", "-ec", f"{export}\n{line}"], folder)
    (program,) = [text for text in PROGRAMS if "CanDrives(" in text]
    run([sys.executable, "-c", program], folder)
    assert {"move.csv", "move.png", "drive.toml"} <= {path.name for path in folder.iterdir()}


@pytest.mark.slow
def test_the_commands_that_tune_an_emulated_drive_do_what_they_say(folder):
    (block,) = [text for text in SHELLS if text.startswith("drive-tune")]
    for line in lines(block):
        run(["bash", "-ec", line], folder)
    assert (folder / "tuned" / "report.html").is_file()


@pytest.mark.slow
def test_the_programs_run_and_so_do_the_commands_within_the_text(folder):
    """Those before and after the bus, in one file each; what a program goes on with stands before it."""
    (first,) = [text for text in PROGRAMS if "EmulatedDrives(" in text and "num_machines=64" in text]
    for text in PROGRAMS:
        if "CanDrives(" not in text:
            run([sys.executable, "-c", text if "import" in text and "Load(" not in text else first + text], folder)
    assert INLINE
    for line in INLINE:
        run(["bash", "-ec", line], folder)
