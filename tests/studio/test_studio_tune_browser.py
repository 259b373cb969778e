"""Tune, Machine and Runs in a real browser: gains of a drive on a bus, auto stopped and certified, faults, runs."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from rigs.fault_injection import served as on_a_bus
from rigs.studio_rig import StudioProcess, Tab, chromium, needs_chromium, size_of, studio, until
from selenium.webdriver import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from drive_env import EmulatedDrives
from drive_env.drives.raw_gains import read_gains
from tuning.snapshot import DEVICE_OBJECTS, take_of

pytestmark = needs_chromium
PAGES = ("/tune", "/machine", "/runs")
WIDTHS = (360, 1280, 2560)
COLUMN = 2  # of velocity P


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the studio runs, and leaves its runs."""
    return tmp_path_factory.mktemp("studio")


@pytest.fixture(scope="module")
def served(folder):
    before = Path.cwd()
    os.chdir(folder)
    try:
        with studio("--load", "two_mass") as made:
            yield made
            assert "Traceback" not in made.output, made.output
    finally:
        os.chdir(before)


@pytest.fixture(scope="module")
def driver():
    with chromium() as found:
        yield found


@pytest.fixture
def tab(driver, served):
    size_of(driver, 1280, 1000)
    return Tab(driver, served)


def text_of(tab, name):
    """The text of an element; cards are drawn anew whenever there is something new."""
    tab.named(name)
    script = "const one = document.querySelector(arguments[0]); return one ? one.innerText : ''"
    return tab.driver.execute_script(script, f"[data-test={name}]")


def body(tab):
    return tab.driver.find_element(By.TAG_NAME, "body").text


def gain(tab, name="velocity_p"):
    """The number in the field of a gain, once it is shown."""
    field = tab.named(f"gain-{name}")
    until(lambda: (field.get_attribute("value") or "0") != "0", "the gains")
    return int(field.get_attribute("value").replace(",", ""))


def enter(tab, name, value):
    tab.type(name, str(value))
    tab.named(name).send_keys(Keys.ENTER)


def parameters(emulated):
    """The drive's parameters, read inside the emulator; how it talks is its master's."""
    return {key: value for key, value in take_of(emulated, {}).axes[0].items() if key[0] >= DEVICE_OBJECTS}


# --- every page ---------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("path", PAGES)
def test_a_page_opens_without_an_error_from_this_computer_alone_and_every_control_has_a_name(tab, path):
    tab.open(path)
    time.sleep(1.0)
    assert (tab.errors(), tab.foreign(), tab.nameless()) == ([], [], [])


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("path", PAGES)
def test_nothing_is_wider_than_the_window(tab, path, width):
    size_of(tab.driver, width, 800)
    tab.open(path)
    time.sleep(0.5)
    assert tab.driver.execute_script("return document.documentElement.scrollWidth") <= width


@pytest.mark.slow
def test_tune_on_a_narrow_page_is_sections_that_fold(tab):
    """But machine and gains they begin folded; a chart has its size once its section is opened."""
    size_of(tab.driver, 400, 800)
    tab.open("/tune")
    is_open = "return [...document.querySelectorAll('.studio-fold')].map((one) => one.open)"
    until(lambda: tab.driver.execute_script(is_open) == [True, True, *[False] * 5], "folded sections")
    summary = tab.one(".card-step summary")
    tab.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", summary)
    summary.click()
    until(lambda: tab.named("step-chart").size["width"] > 300, "its chart")
    assert tab.driver.execute_script("return document.documentElement.scrollWidth") <= 400
    size_of(tab.driver, 1280, 1000)
    tab.open("/tune")
    until(lambda: all(tab.driver.execute_script(is_open)), "open sections on a wide page")


# --- tune ---------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def emulated():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        yield drives


@pytest.fixture
def bench(emulated, tmp_path, monkeypatch):
    """A world in real time, and a studio on its bus."""
    monkeypatch.chdir(tmp_path)
    with on_a_bus(emulated) as (world, channel):
        made = StudioProcess("--channel", channel)
        try:
            yield world, made
        finally:
            made.end()


def slide(tab, name="slider-velocity_p", times=12):
    thumb = tab.named(name).find_element(By.CSS_SELECTOR, "[tabindex]")
    tab.driver.execute_script("arguments[0].focus()", thumb)
    for _ in range(times):
        tab.key(Keys.ARROW_RIGHT)


@pytest.mark.slow
def test_a_slider_changes_the_gain_that_the_drive_shows_and_undo_takes_it_back(tab):
    """What of it is in the drive: tests/studio/test_studio_tune.py, and the next one."""
    tab.open("/tune")
    before = gain(tab)
    slide(tab)
    until(lambda: "velocity P" in text_of(tab, "gain-history"), "the history")
    # Twelve keys are twelve writes: the last may come after the page is opened anew.
    until(lambda: gain(tab.open("/tune")) > 1.2 * before, "the gain on a new page")
    for _ in range(int(text_of(tab, "gain-history").split()[0])):
        tab.press("undo")
        time.sleep(0.5)
    until(lambda: gain(tab) == before, "the gain before")


@pytest.mark.slow
def test_a_slider_writes_the_gain_of_a_drive_on_the_bus_and_undo_takes_it_back(driver, bench, emulated):
    """Read inside the emulator, not by the page."""
    _, made = bench
    before = read_gains(emulated)[0]
    tab = Tab(driver, made).open("/tune")
    assert gain(tab) == before[COLUMN]
    slide(tab)
    until(lambda: read_gains(emulated)[0][COLUMN] > 1.2 * before[COLUMN], "the gain in the drive")
    until(lambda: gain(tab) == read_gains(emulated)[0][COLUMN], "the gain on the page")
    until(lambda: "velocity P" in text_of(tab, "gain-history"), "the history")
    enter(tab, "gain-velocity_p", 777)
    until(lambda: read_gains(emulated)[0][COLUMN] == 777, "the number in the drive")
    count = int(text_of(tab, "gain-history").split()[0])
    for _ in range(count):
        tab.press("undo")
        time.sleep(0.5)
    until(lambda: np.array_equal(read_gains(emulated)[0], before), "the gains before")
    driver.get("about:blank")


@pytest.mark.slow
def test_everything_goes_back_to_the_state_before(driver, bench, emulated):
    _, made = bench
    before = parameters(emulated)
    tab = Tab(driver, made).open("/tune")
    gain(tab)
    for name, value in (("velocity_p", 800), ("position_p", 99), ("torque_p", 3000)):
        enter(tab, f"gain-{name}", value)
        until(lambda: value in read_gains(emulated)[0], f"{name} in the drive")  # noqa: B023
    tab.press("restore-before")
    until(lambda: parameters(emulated) == before, "the parameters before")
    driver.get("about:blank")


@pytest.mark.slow
def test_a_step_is_recorded_on_the_bus_within_its_travel(driver, bench, emulated):
    world, made = bench
    tab = Tab(driver, made).open("/tune")
    gain(tab)
    tab.press("record-step")
    until(lambda: "the travel is missing" in "".join(tab.told()), "what is missing")
    tab.type("travel", "-2:2")
    tab.press("record-step")
    until(lambda: "rise" in text_of(tab, "step-figures"), "the figures", 30.0)
    until(lambda: world.truth.stands().all() and not world.truth.is_on().any(), "the end")
    assert tab.all("[data-test=step-chart] svg path")
    driver.get("about:blank")


@pytest.mark.slow
def test_quick_stop_in_the_middle_of_auto_on_the_bus(driver, bench, emulated):
    world, made = bench
    before = parameters(emulated)
    tab = Tab(driver, made).open("/tune")
    gain(tab)
    tab.type("travel", "free")
    tab.press("run-auto")
    until(lambda: "identifying" in text_of(tab, "run-lines"), "identification", 120.0)
    moves_or_ends = lambda: not world.truth.stands().all() or "stopped" in text_of(tab, "run-head")  # noqa: E731
    until(moves_or_ends, "a motion", 60.0)
    assert not world.truth.stands().all(), text_of(tab, "run-head")
    driver.execute_script("document.querySelector('.studio-stop').click()")
    until(lambda: world.truth.stands().all(), "rest", 2.0)
    until(lambda: "stopped" in text_of(tab, "run-head"), "the end of the run", 120.0)
    assert "the gains from before are back" in text_of(tab, "run-head")
    assert world.truth.stands().all() and not world.truth.is_on().any()
    gains = emulated.device.gains.keys
    assert {key: parameters(emulated)[key] for key in gains} == {key: before[key] for key in gains}
    driver.get("about:blank")
    made.end()  # the envelope gives back what it has lent: the reaction to a quick stop
    assert parameters(emulated) == before


@pytest.mark.slow
def test_a_machine_on_a_bus_has_no_page(driver, bench):
    _, made = bench
    tab = Tab(driver, made).open("/machine")
    assert "machine is real" in text_of(tab, "no-machine")
    driver.get("about:blank")


@pytest.mark.slow
def test_the_slider_from_soft_to_stiff_shows_what_it_would_do_and_is_one_change(tab):
    """A drag shows margins and step at once; the gains are written when it is let go."""
    tab.open("/tune")
    before = gain(tab)
    assert "press Measure" in text_of(tab, "stiffness-told")
    slide(tab, "stiffness", 3)
    assert text_of(tab, "gain-history").startswith("Nothing changed yet")
    tab.press("measure-response")
    until(lambda: "Gains for standard: 45°, 8 dB, Ms 2" in text_of(tab, "stiffness-told"), "the slider", 120.0)
    assert "before" not in text_of(tab, "margins")
    slider = tab.named("stiffness")
    tab.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", slider)
    hand = ActionChains(tab.driver).click_and_hold(slider).move_by_offset(round(0.3 * slider.size["width"]), 0)
    hand.perform()
    until(lambda: "Written when you let the slider go" in text_of(tab, "stiffness-told"), "what it would be")
    until(lambda: "velocity loop, before" in text_of(tab, "margins"), "the margins beside those now")
    until(lambda: gain(tab) > 1.05 * before, "the gain of the slider")
    assert text_of(tab, "gain-history").startswith("Nothing changed yet")
    ActionChains(tab.driver).release().perform()
    until(lambda: text_of(tab, "gain-history").startswith("1 change; the last: dynamics"), "the change")
    assert "has others now" not in text_of(tab, "stiffness-told")
    for chart in ("bode-chart", "nichols-chart", "predicted-step"):
        assert len(tab.all(f"[data-test={chart}] svg path")) > 10
    tab.press("undo")
    until(lambda: gain(tab) == before, "the gains before")
    assert (tab.errors(), tab.nameless()) == ([], [])


@pytest.mark.slow
def test_auto_comes_to_its_certificate_and_its_run_is_in_runs(tab, folder):
    tab.open("/tune")
    before = gain(tab)
    tab.press("run-auto")
    until(lambda: "done" in text_of(tab, "run-head"), "the end of auto", 400.0)
    assert "accepted" in text_of(tab, "verdict-0")
    time.sleep(1.0)  # the card is drawn for the last time
    frame = tab.named("report")
    assert frame.get_attribute("sandbox") == ""
    tab.driver.switch_to.frame(frame)
    try:
        until(lambda: "Tuning of tmcm1636" in body(tab), "the certificate")
    finally:
        tab.driver.switch_to.default_content()
    until(lambda: gain(tab) != before, "the new gains")
    name = next(one.name for one in (folder / "runs").iterdir() if one.name.endswith("-auto"))
    tab.open("/runs")
    until(lambda: tab.all(f"[data-run='{name}']"), "the run in its list")
    tab.driver.execute_script("document.querySelector(arguments[0]).click()", f"[data-run='{name}']")
    until(lambda: text_of(tab, "run-name") == name, "the run")
    until(lambda: tab.all("[data-test=report]"), "its report")
    tab.open("/tune")
    tab.press("restore-before")
    until(lambda: gain(tab) == before, "the gains before")


# --- machine ------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_picture_moves_while_the_load_does(tab):
    tab.open("/machine")
    until(lambda: tab.driver.execute_script("return studioMachine.frames") >= 1, "the first picture", 30.0)
    frames = tab.driver.execute_script("return studioMachine.frames")
    time.sleep(1.0)
    assert tab.driver.execute_script("return studioMachine.frames") <= frames + 1  # it stands
    width = "return document.querySelector('.studio-machine-picture').naturalWidth"
    assert tab.driver.execute_script(width) > 300


@pytest.mark.slow
def test_a_fault_that_is_switched_on_acts_on_the_drive(tab):
    tab.open("/axes")
    tab.press("enable")
    tab.await_state("Operation enabled")
    tab.open("/machine")
    tab.driver.execute_script("arguments[0].click()", tab.one("[data-test=faults-supply] .q-item"))
    switch = "fault-supply_dip"
    tab.press(switch)
    tab.await_state("Fault", 10.0)
    until(
        lambda: "is-active" in tab.one(f".studio-fault-row:has([data-test={switch}])").get_attribute("class"), "its row"
    )
    until(lambda: "Should show: emergency FF00h" in tab.named("reaction-supply_dip").text, "what it should show")
    until(lambda: "FF00h undervoltage; Fault" in tab.named("shows-supply_dip").text, "what the drive shows")
    tab.press("step-supply_dip-end")
    until(lambda: not tab.all(".studio-fault-row.is-active"), "the end of the fault")
    tab.press("step-supply_dip-reset_fault")
    tab.await_state("Switch on disabled")
    until(lambda: "no emergency; Switch on disabled" in tab.named("shows-supply_dip").text, "the end of the emergency")


@pytest.mark.slow
def test_a_parameter_by_its_number(tab):
    tab.open("/machine")
    enter(tab, "value-load-inertia", 2.5e-5)
    time.sleep(0.5)
    tab.open("/machine")
    assert float(tab.named("value-load-inertia").get_attribute("value")) == pytest.approx(2.5e-5)
    enter(tab, "value-load-inertia", -1)
    until(lambda: tab.told(), "why not")


# --- runs ---------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_report_runs_no_script_and_two_runs_are_compared(tab, folder):
    for k, name in enumerate(("one", "other")):
        run = folder / "runs" / name
        run.mkdir(parents=True, exist_ok=True)
        (run / "settings.toml").write_text(f"seed = {k}\n")
        (run / "report.html").write_text("<h1>Report</h1><script>parent.stolen = document.title = 'stolen'</script>")
    tab.open("/runs?run=one")
    until(lambda: text_of(tab, "run-name") == "one", "the run")
    frame = tab.named("report")
    tab.driver.switch_to.frame(frame)
    try:
        until(lambda: "Report" in body(tab), "the report")
    finally:
        tab.driver.switch_to.default_content()
    assert tab.driver.execute_script("return window.stolen") is None
    tab.driver.switch_to.frame(frame)
    try:
        assert tab.driver.execute_script("return document.title") != "stolen"
    finally:
        tab.driver.switch_to.default_content()
    tab.type("compare-with", "other")
    tab.named("compare-with").send_keys(Keys.ARROW_DOWN, Keys.ENTER)
    until(lambda: "1 of 1" in text_of(tab, "differences"), "the comparison")
    assert len(tab.all("[data-test=report]")) == 2


@pytest.mark.slow
def test_learning_curves_of_a_training(tab, folder):
    from rigs.trainings import write_events

    run = folder / "runs" / "training"
    run.mkdir(parents=True, exist_ok=True)
    write_events(run, 20)
    tab.open("/runs?run=training")
    until(lambda: "2 curves up to step 1,900" in text_of(tab, "curves-told"), "the curves", 30.0)
    until(lambda: tab.all("[data-test=curves-chart] svg path"), "the picture")
