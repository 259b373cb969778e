"""A page that moves a drive of a bus and is gone: the drive stops. The truth is read inside the emulator."""

from __future__ import annotations

import os
import signal
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from rigs import TESTS
from rigs.fault_injection import served
from rigs.studio_rig import StudioProcess, Tab, chromium, needs_chromium, until

from drive_env import EmulatedDrives

pytestmark = needs_chromium

RPM = 2.0 * np.pi / 60.0
SPEED = 300.0 * RPM  # of the jog [rad/s]
STOPS = 2.0  # s that a stop may take here: half a second of silence, the ramp, and a busy computer
AT_ONCE = 0.25  # s from the press of quick stop to rest, of which the ramp takes 25 ms: a busy computer comes late
BUSY = 5.0  # s that a page computes here
PROGRAM = (str(TESTS / "busy_studio.py"),)


@pytest.fixture(scope="module")
def emulated():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        yield drives


@pytest.fixture(scope="module")
def driver():
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def bus(emulated):
    """A world in real time, its channel, and the studios that were started on it."""
    studios = []
    with served(emulated) as (world, channel):
        yield world, channel, studios
        for one in studios:
            one.end()


@pytest.fixture
def bench(bus):
    """A world in real time, and a studio on its bus, one of whose pages computes when it is asked to."""
    world, channel, studios = bus
    if not studios or studios[-1].process.poll() is not None:
        studios.append(StudioProcess("--channel", channel, program=PROGRAM))
    return world, studios[-1]


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


@pytest.mark.slow
def test_a_button_that_is_released_ends_the_jog(driver, bench):
    world, _ = bench
    tab = turning(driver, bench)
    tab.release()
    stands_within(world, STOPS)
    assert world.truth.is_on().all()  # it stays enabled


@pytest.mark.slow
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


# --- pages that compute ---------------------------------------------------------------------------------------------
@contextmanager
def busy(made):
    """Have a page compute meanwhile, so that no page answers; yield what tells whether it still does."""
    begun, over = made.output.count("begins to compute"), made.output.count("has computed")
    call = threading.Thread(target=fetch, args=(made.page(f"/busy/{BUSY}"),), daemon=True)
    call.start()
    until(lambda: made.output.count("begins to compute") > begun, "a page that computes")
    yield lambda: made.output.count("has computed") == over
    call.join()


def fetch(url):
    with suppress(urllib.error.URLError, OSError):
        urllib.request.urlopen(url, timeout=BUSY + 20.0).close()


@pytest.mark.slow
@pytest.mark.parametrize("way", ["button", "space", "request"])
def test_quick_stop_does_not_wait_for_a_page_that_computes(driver, bench, way):
    """A settings.toml of 40 kB kept the quick stop for 47 s."""
    world, made = bench
    took = []
    for _ in range(5):  # beside others the processor comes late: the quickest of some tells what the studio takes
        tab = turning(driver, bench)
        with busy(made) as still:
            if speed(world) < 0.8 * SPEED:  # stopped, since beats came late
                tab.release()
                continue
            begun = time.monotonic()
            if way == "request":  # the second way, without a page
                asked = urllib.request.Request(made.page("/studio/quick-stop"), method="POST")
                urllib.request.urlopen(asked, timeout=10.0).close()
            elif way == "space":
                tab.key(" ")
            else:
                driver.execute_script("document.querySelector('.studio-stop').click()")
            until(lambda: speed(world) < 1.0, "rest", 10.0, step=0.001)
            took.append(time.monotonic() - begun)
            assert still(), f"the stop came with the page, after {took[-1]:.1f} s"
            tab.release()
        if took[-1] < AT_ONCE:
            return
    raise AssertionError(f"the stops took {took} s")


@pytest.mark.slow
def test_a_release_does_not_wait_for_a_page_that_computes(driver, bench):
    world, made = bench
    tab = turning(driver, bench)
    with busy(made) as still:
        tab.release()
        stands_within(world, STOPS)
        assert still()


@pytest.mark.slow
def test_a_jog_ends_with_its_browser_though_a_page_computes(driver, bench):
    world, made = bench
    turning(driver, bench)
    processes = chromium_processes(driver)
    with busy(made) as still:
        for pid in processes:
            os.kill(pid, signal.SIGSTOP)
        try:
            stands_within(world, STOPS)
            assert still()
        finally:
            for pid in processes:
                os.kill(pid, signal.SIGCONT)
    driver.get("about:blank")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_studio_ends_though_a_page_computes(driver, bench, number):
    world, made = bench
    turning(driver, bench)
    with busy(made):
        made.end(number)
        assert world.truth.at_rest()
    assert "Traceback" not in made.output, made.output
    driver.get("about:blank")


# --- pages that are gone --------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_move_ends_with_its_page_though_another_one_is_there(driver, bench):
    """900 revolutions: it ran on, 60 of them, until somebody stopped it."""
    world, made = bench
    mover = Tab(driver, made).open("/axes")
    with another_tab(driver) as mine:
        Tab(driver, made).open("/scope")
        driver.switch_to.window(mine)
        for _ in range(4):
            mover.press("enable")
            with suppress(AssertionError):
                mover.await_state("Operation enabled", 5.0)
            mover.type("goal", "900 rev")
            mover.type("rate", "300 rpm")
            mover.press("move-by")
            with suppress(AssertionError):
                until(lambda: speed(world) > 0.8 * SPEED, "the speed of the move", 4.0, step=0.01)
                break
        before = world.truth.theta(world.truth.cycles - 1)[-1, 0]
        driver.get("about:blank")
        stands_within(world, STOPS)
        turns = (world.truth.theta(world.truth.cycles - 1)[-1, 0] - before) / (2.0 * np.pi)
        assert abs(turns) < 5.0 * STOPS


@pytest.mark.slow
def test_a_step_that_is_played_ends_with_its_page_though_another_one_is_there(driver, bench):
    """Its set-points go out in one call, which takes ten seconds."""
    world, made = bench
    tuner = Tab(driver, made).open("/tune")
    with another_tab(driver) as mine:
        Tab(driver, made).open("/scope")
        driver.switch_to.window(mine)
        for name, text in (("travel", "free"), ("step-rpm", "300"), ("step-hold", "5000")):
            tuner.type(name, text)
        for _ in range(4):
            tuner.press("record-step")
            with suppress(AssertionError):
                until(lambda: speed(world) > 0.8 * SPEED, "the speed of the step", 6.0, step=0.01)
                break
        else:
            raise AssertionError(f"{tuner.told()}, {made.output}")
        driver.get("about:blank")
        stands_within(world, STOPS)


@contextmanager
def another_tab(driver):
    """Open one more tab and stay in it; yield the one before, and close the new one at the end."""
    mine = driver.current_window_handle
    driver.switch_to.new_window("tab")
    other = driver.current_window_handle
    try:
        yield mine
    finally:
        driver.switch_to.window(other)
        driver.close()
        driver.switch_to.window(mine)


@pytest.mark.slow
def test_the_page_is_closed(driver, bench):
    world, _ = bench
    turning(driver, bench)
    driver.get("about:blank")
    stands_within(world, STOPS)
    until(lambda: not world.truth.is_on().any(), "the voltage off, since no page is there", 10.0)


@pytest.mark.slow
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


@pytest.mark.slow
def test_the_studio_is_killed(driver, bench):
    """Nobody is left to command anything: the drive's own watchdog stops it."""
    world, made = bench
    turning(driver, bench)
    made.kill()
    stands_within(world, STOPS)
    until(lambda: not world.truth.is_on().any(), "the voltage off")
    driver.get("about:blank")


@pytest.mark.slow
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
