"""Figures of the studio's scope: frames per second in a browser, and its server's share of a core meanwhile."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

SECONDS = 10.0
SETTLE = 3.0  # s
PROGRAM = "from drive_env.programs import drive_env; drive_env()"
CHANNELS = ("6062", "6064", "606B", "606C", "6074", "6077", "60F4", "60FF")  # as far as the drive has them
OTHERS = ("6041", "6061", "607A", "6071", "60FD", "6081", "6083", "6063")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--window-size=1280,900",
)  # fmt: skip


@contextmanager
def served() -> Iterator[tuple[int, str]]:
    """Yield process and address of a studio on an emulated machine."""
    command = [sys.executable, "-c", PROGRAM, "studio", "--no-browser", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        found = next(found for line in process.stdout if (found := re.search(r"(http://\S+?)/?\s", line)))
        yield process.pid, found[1]
    finally:
        process.terminate()
        process.wait(20)


@contextmanager
def browser() -> Iterator[Any]:
    """Yield Debian's Chromium."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        for flag in (*FLAGS, f"--user-data-dir={folder}"):
            options.add_argument(flag)
        driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
        try:
            yield driver
        finally:
            driver.quit()


def seconds_of(process: int) -> float:
    """Return the processor's time that a process has taken [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measured(process: int, driver: Any) -> tuple[float, float]:
    """Return frames per second, and the share of a core that the server takes."""
    frames = "return studioScope.frames"
    begun, first, before = time.monotonic(), driver.execute_script(frames), seconds_of(process)
    time.sleep(SECONDS)
    elapsed = time.monotonic() - begun
    return (driver.execute_script(frames) - first) / elapsed, (seconds_of(process) - before) / elapsed


def figures() -> dict[str, float]:
    """Return all figures of the studio; none where there is no browser."""
    if not (shutil.which("chromium") and shutil.which("chromedriver")):
        return {}
    found = {}
    with served() as (process, base), browser() as driver:
        driver.get(f"{base}/axes")
        time.sleep(SETTLE)
        found["page Axes: share of a core"] = idle(process)
        keep = json.dumps([f"{name}:00" for name in (*CHANNELS, *OTHERS)])
        driver.execute_script(f"localStorage.setItem('studio-scope-channels', {json.dumps(keep)})")
        driver.get(f"{base}/scope")
        time.sleep(SETTLE)
        channels = driver.execute_script("return studioScope.header.traces.length")
        rate, share = measured(process, driver)
        found |= {"scope: channels at 1 kHz": float(channels), "scope: frames per second": rate,
                  "scope: share of a core": share}  # fmt: skip
    return found


def idle(process: int) -> float:
    """Return the share of a core that the server takes while a page shows the axis and its machine lives."""
    begun, before = time.monotonic(), seconds_of(process)
    time.sleep(SECONDS)
    return (seconds_of(process) - before) / (time.monotonic() - begun)


if __name__ == "__main__":
    for what, value in figures().items():
        print(f"{what}: {value:.3g}")
