"""A page that moves a drive of a bus and is gone: the drive stops. The truth is read inside the emulator."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from fault_injection import served
from studio_rig import StudioProcess, Tab, chromium, needs_chromium, until

from drive_env import EmulatedDrives

pytestmark = needs_chromium

RPM = 2.0 * np.pi / 60.0
SPEED = 300.0 * RPM  # of the jog [rad/s]
STOPS = 2.0  # s that a stop may take here: half a second of silence, the ramp, and a busy computer


@pytest.fixture(scope="module")
def emulated():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        yield drives


@pytest.fixture(scope="module")
def driver():
    with chromium() as found:
        yield found


@pytest.fixture
def bench(emulated):
    """A world in real time, and a studio on its bus."""
    with served(emulated) as (world, channel):
        made = StudioProcess("--channel", channel)
        try:
            yield world, made
        finally:
            made.end()


def turning(driver, bench):
    """Return a page that holds the button that turns the axis, which does turn."""
    world, made = bench
    tab = Tab(driver, made).open("/axes")
    tab.type("jog-speed", "300 rpm")
    for _ in range(4):  # beside others, a stop may come of this computer's being late
        tab.press("enable")
        with suppress(AssertionError):
            tab.await_state("Operation enabled", 5.0)
        tab.hold_jog()
        with suppress(AssertionError):
            until(lambda: speed(world) > 0.8 * SPEED, "the speed of the jog", 4.0, step=0.01)
            return tab
        tab.release()
    raise AssertionError((speed(world), tab.state, tab.told(), made.output))


def speed(world):
    return abs(world.truth.omega(world.truth.cycles - 1)[-1, 0])


def stands_within(world, seconds):
    """Check that the axis comes to rest in time, and turns no more."""
    until(lambda: world.truth.stands().all(), "the end of the motion", seconds)
    time.sleep(0.3)
    assert world.truth.stands().all()


def test_a_button_that_is_released_ends_the_jog(driver, bench):
    world, _ = bench
    tab = turning(driver, bench)
    tab.release()
    stands_within(world, STOPS)
    assert world.truth.is_on().all()  # it stays enabled


@pytest.mark.parametrize("way", ["button", "space"])
def test_quick_stop(driver, bench, way):
    world, _ = bench
    tab = turning(driver, bench)
    if way == "space":
        tab.key(" ")
    else:
        driver.execute_script("document.querySelector('.studio-stop').click()")
    stands_within(world, 1.0)
    tab.release()
    until(lambda: not world.truth.is_on().any(), "the end of the quick stop")


def test_the_page_is_closed(driver, bench):
    world, _ = bench
    turning(driver, bench)
    driver.get("about:blank")
    stands_within(world, STOPS)
    until(lambda: not world.truth.is_on().any(), "the voltage off, since no page is there", 10.0)


def test_the_browser_sleeps(driver, bench):
    """No beat comes any more, though its connection stays."""
    world, _ = bench
    turning(driver, bench)
    processes = chromium_processes(driver)
    for pid in processes:
        os.kill(pid, signal.SIGSTOP)
    try:
        stands_within(world, STOPS)
        until(lambda: not world.truth.is_on().any(), "the voltage off, since no page is there", 10.0)
    finally:
        for pid in processes:
            os.kill(pid, signal.SIGCONT)
    driver.get("about:blank")


def test_the_studio_is_killed(driver, bench):
    """Nobody is left to command anything: the drive's own watchdog stops it."""
    world, made = bench
    turning(driver, bench)
    made.kill()
    stands_within(world, STOPS)
    until(lambda: not world.truth.is_on().any(), "the voltage off")
    driver.get("about:blank")


@pytest.mark.every(3)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_studio_is_ended_by_a_signal(driver, bench, number):
    world, made = bench
    turning(driver, bench)
    made.end(number)
    assert world.truth.at_rest()
    assert "Traceback" not in made.output, made.output
    driver.get("about:blank")


def chromium_processes(driver):
    """Return the processes of a browser: those whose ancestor is its driver."""
    parents = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with suppress(OSError):
                parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
    found, new = [], {driver.service.process.pid}
    while new:
        new = {pid for pid, parent in parents.items() if parent in new}
        found += new
    return found
