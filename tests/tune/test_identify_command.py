"""`drive-tune identify` as a user meets it."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from rigs import ROOT


def drive_tune(*arguments, cwd):
    return subprocess.run(
        [sys.executable, "-m", "tuning.commands.cli", *map(str, arguments)],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "140", "NO_COLOR": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.mark.slow
def test_values_intervals_and_reasons_are_shown_and_written(tmp_path):
    done = drive_tune("identify", "--load", "inertia", "--out", "found.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    resistance = rows[0]["estimates"]["resistance"]
    assert resistance["low"] < 0.36 < resistance["high"]
    assert "phase resistance" in done.stdout
    assert "no resonance between" in done.stdout  # of the resonance
    assert rows[0]["estimates"]["resonance"]["value"] is None
    assert rows[0]["drive_time"] < 20.0


@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "text"), [
    (("--motor", "nema17"), "no motor is named 'nema17'"),
    (("--travel", "0.1"), "--travel 0.1 must be LOW:HIGH"),
    (("--bus",), "--travel is missing"),
    (("--out", "nowhere/found.json"), "there is no folder nowhere"),
    (("--out", "kept.json"), "kept.json exists already, and files are not overwritten; choose another --out"),
    (("--out", "/proc/found.json"), "/proc/found.json cannot be written"),  # nobody writes there, not even root
])  # fmt: skip
def test_a_mistake_is_said_in_one_line(tmp_path, arguments, text):
    (tmp_path / "kept.json").write_text("mine")
    done = drive_tune("identify", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert text in done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "kept.json").read_text() == "mine"
