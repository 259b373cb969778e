"""The page Commission: steps in a session, a stop and a page that is gone, and the page in a real browser over CAN."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager

import pytest
from rigs.fault_injection import served as on_a_bus
from rigs.studio_rig import StudioProcess, Tab, chromium, needs_chromium, size_of, until
from rigs.truth import settings_of

from drive_env import EmulatedDrives, cia402
from drive_env.fieldbus.description import describe
from drive_env.studio.errors import JobEndedError
from drive_env.studio.session import Session
from tuning.snapshot import DEVICE_OBJECTS
from tuning.studio.commissioning_jobs import room_of

PATIENCE = 120.0  # s, of a computer that is busy: a bus in real time
SELDOM = 0.5  # s between two looks: the node on the bus lives in this process


def parameters(emulated):
    """The drive's settings, read one by one inside the emulator; how it talks is its master's."""
    return {key: value for key, value in settings_of(emulated).items() if key[0] >= DEVICE_OBJECTS}


def is_off(emulated):
    return not cia402.is_live(int(emulated.read(cia402.STATUSWORD)[0]))


@pytest.fixture
def belt(tmp_path, monkeypatch):
    """A belt whose drive is as it comes from the factory; runs are left in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    with EmulatedDrives(load="belt", commissioned=False, num_threads=1) as drives:
        yield drives


@contextmanager
def a_page_is_there(session):
    """A page that says that it is there, as long as the block lasts."""
    ended = threading.Event()

    def beat():
        while not ended.wait(0.05):
            session.presence.beat("page")

    thread = threading.Thread(target=beat)
    session.presence.beat("page")
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.fixture
def room(belt):
    made = Session(lambda: belt, "a machine", describe("tmcm1636", None))
    with a_page_is_there(made):
        made.start()
        until(lambda: made.state != "opening", "the drives", 120.0)
        assert made.state == "open", made.failure
        yield room_of(made)
        made.close()


def do(room, job):
    return room.desk.session.do(job, "a job", page="page", paced=False).result(120)


# --- in a session -----------------------------------------------------------------------------------------------------
def test_steps_are_done_and_the_end_of_the_studio_takes_them_back(room, belt, monkeypatch):
    before = parameters(belt)
    monkeypatch.setattr(belt, "close", lambda: None)  # so that it can be read once the session has closed it
    do(room, room.begin("page"))
    assert list(room.methods) == [17, 18, 19, 21, 35]
    do(room, room.run("motor"))
    assert room.path.states["motor"].state == "done" and parameters(belt) != before
    room.desk.session.close()
    assert parameters(belt) == before and is_off(belt)
    assert "It ended: the studio ended. The drives are off, and have their parameters from before." in room.told


def test_a_stop_within_a_step_takes_everything_back(room, belt):
    before = parameters(belt)
    do(room, room.begin("page"))
    do(room, room.run("motor"))
    session = room.desk.session
    future = session.do(room.run("wiring"), "wiring", page="page")
    until(lambda: abs(float(belt.machine.rotor_speed[0])) > 0.5 or future.done(), "a motion", 60.0)
    session.stop_now("a page")
    with pytest.raises(JobEndedError, match="stopped: a page"):
        future.result(60)
    assert room.path is None and room.told.startswith("It ended: a page. The drives are off")
    assert session.do(lambda drives: parameters(belt), "read").result(PATIENCE) == before
    assert is_off(belt)


def test_a_step_that_fails_can_be_done_again_and_the_page_that_is_gone_ends_it(room, belt):
    before = parameters(belt)
    do(room, room.begin("page"))
    do(room, room.run("motor"))
    with pytest.raises(RuntimeError, match="no homing method is chosen"):
        do(room, room.run("homing"))
    assert room.path.next == "wiring"  # it goes on
    room.plan.method = 35
    do(room, room.run("homing"))
    do(room, room.back_to("homing"))
    assert belt.read(cia402.HOMING_METHOD)[0] == 0
    room.leave("another", "its page was closed")
    room.leave("page", "its page was closed")
    do(room, lambda drives: None)
    assert room.path is None and parameters(belt) == before


# --- in a browser, over CAN -------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def driver():
    with chromium() as found:
        yield found


@pytest.fixture
def tab(driver, belt):
    """The page of a studio on the bus of a drive in real time."""
    with on_a_bus(belt) as (_, channel):
        made = StudioProcess("--channel", channel, "--timeout", "20")  # on a busy computer
        try:
            size_of(driver, 1280, 1000)
            yield Tab(driver, made).open("/commission")
            driver.get("about:blank")
        finally:
            made.end()
        assert "Traceback" not in made.output, made.output


def text_of(tab, name):
    script = "const one = document.querySelector(arguments[0]); return one ? one.innerText : ''"
    return tab.driver.execute_script(script, f"[data-test={name}]")


@needs_chromium
@pytest.mark.slow
def test_the_path_in_a_browser_and_a_page_that_is_left(tab, belt):
    before = parameters(belt)
    assert (tab.errors(), tab.foreign(), tab.nameless()) == ([], [], [])
    tab.press("begin")
    until(lambda: "the travel is missing" in "".join(tab.told()), "what is missing")
    tab.type("travel", "-8:8")
    tab.press("begin")
    until(lambda: "Under way" in text_of(tab, "path-told"), "the path", PATIENCE, SELDOM)
    tab.press("do-motor")
    until(lambda: "Motor: done" in text_of(tab, "step-motor"), "the motor", PATIENCE, SELDOM)
    assert parameters(belt) != before
    for step in ("wiring", "current", "limits"):
        tab.press(f"skip-{step}")
        until(lambda: "skipped" in text_of(tab, f"step-{step}"), step)  # noqa: B023
    until(lambda: len(tab.all(".studio-methods svg")) == 5, "a sketch of each method of the drive")
    assert "17: left to the left limit switch" in text_of(tab, "step-homing")
    for width in (360, 800, 1400):
        size_of(tab.driver, width, 900)
        time.sleep(0.3)
        assert tab.driver.execute_script("return document.documentElement.scrollWidth") <= width
    assert (tab.errors(), tab.nameless()) == ([], [])
    tab.press("back-motor")
    until(lambda: "Motor: pending" in text_of(tab, "step-motor"), "the way back", PATIENCE, SELDOM)
    assert parameters(belt) == before
    tab.press("do-motor")
    until(lambda: "Motor: done" in text_of(tab, "step-motor"), "the motor again", PATIENCE, SELDOM)
    assert parameters(belt) != before
    tab.open("/commission")  # the page that began it is gone
    told = "It ended: its page was closed. The drives are off, and have their parameters from before."
    until(lambda: told in text_of(tab, "path-told"), "the end", PATIENCE, SELDOM)
    assert is_off(belt)
    tab.served.end()  # the envelope gives back what it has lent: the limits of travel
    assert parameters(belt) == before and is_off(belt)
