"""The studio in a real browser, on an emulated machine: every page, and what people do on it."""

from __future__ import annotations

import time

import pytest
from rigs.studio_rig import Tab, chromium, needs_chromium, size_of, studio, until
from selenium.webdriver import ActionChains
from selenium.webdriver.common.keys import Keys

pytestmark = needs_chromium
PAGES = ("/axes", "/scope", "/dictionary")
WIDTHS = (360, 1280, 2560)
POSITION, VELOCITY = "Position actual value", "Velocity actual value"


@pytest.fixture(scope="module")
def served():
    with studio() as made:
        yield made
        assert "Traceback" not in made.output, made.output


@pytest.fixture(scope="module")
def driver():
    with chromium() as found:
        yield found


@pytest.fixture
def tab(driver, served):
    size_of(driver, 1280, 1000)
    return Tab(driver, served)


def at_rest(tab):
    """Have the axis off, whatever the test before did."""
    tab.open("/axes")
    tab.press("disable")
    tab.await_state("Switch on disabled")


# --- every page ---------------------------------------------------------------------------------------------------
@pytest.mark.every(3)
@pytest.mark.parametrize("path", PAGES)
def test_a_page_opens_without_an_error_from_this_computer_alone_and_every_control_has_a_name(tab, path):
    tab.open(path)
    time.sleep(0.5)
    assert (tab.errors(), tab.foreign(), tab.nameless()) == ([], [], [])
    assert tab.one(".studio-stop").is_displayed()


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("path", PAGES)
def test_nothing_is_wider_than_the_window(tab, path, width):
    size_of(tab.driver, width, 800)
    tab.open(path)
    time.sleep(0.3)
    wide = tab.driver.execute_script("return document.documentElement.scrollWidth")
    assert wide <= width
    box = tab.one(".studio-stop").rect
    assert box["x"] >= 0 and box["x"] + box["width"] <= width


@pytest.mark.slow
def test_a_notice_on_a_phone_has_its_own_room_and_covers_nothing(tab):
    at_rest(tab)
    size_of(tab.driver, 360, 800)
    tab.open("/axes")
    tab.press("home")
    until(lambda: tab.told(), "a notice")
    edges = """window.scrollTo(0, document.body.scrollHeight);
        const box = (css) => [...document.querySelectorAll(css)].map((one) => one.getBoundingClientRect());
        return [Math.max(...box(".studio-card").map((one) => one.bottom)), box(".studio-footer")[0].top,
            box(".q-notification")[0].top, box(".q-notification").at(-1).bottom, box(".studio-stop")[0].top]"""

    def has_own_room():
        card, footer, notice, end, stop = tab.driver.execute_script(edges)
        return card <= footer <= notice < end <= stop

    until(has_own_room, "the cards end above the footer, and the notice lies in it, above the quick stop")


@pytest.mark.slow
def test_navigation_by_keyboard_alone(tab):
    tab.open("/axes")
    for _ in range(12):
        tab.key(Keys.TAB)
        here = tab.driver.switch_to.active_element
        if here.text.endswith("Scope"):
            break
    tab.key(Keys.ENTER)
    until(lambda: tab.driver.current_url.endswith("/scope?axis=0"), "the page Scope")


@pytest.mark.slow
def test_light_and_dark(tab):
    tab.open("/axes")
    background = "return getComputedStyle(document.body).backgroundColor"
    light = tab.driver.execute_script(background)
    size_of(tab.driver, 1280, 1000, dark=True)
    tab.open("/axes")
    until(lambda: tab.driver.execute_script(background) != light, "the dark page")


# --- axes ---------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_enabled_moved_and_disabled(tab):
    at_rest(tab)
    tab.press("enable")
    tab.await_state("Operation enabled")
    before = tab.value(POSITION)
    tab.type("goal", "90 deg")
    assert tab.named("goal").get_attribute("value") == "90 deg", "in a text the space bar is a space, and stops nobody"
    tab.press("move-by")
    until(lambda: abs(tab.value(POSITION) - before - 0.25) < 0.01, "the end of the move")
    tab.press("disable")
    tab.await_state("Switch on disabled")


@pytest.mark.slow
def test_a_move_of_an_axis_that_is_off_says_what_to_do(tab):
    at_rest(tab)
    tab.press("move-by")
    until(lambda: any("enable it first" in line for line in tab.told()), f"the remedy; told: {tab.told()}")


@pytest.mark.slow
def test_home_says_that_no_method_is_chosen_and_offers_those_of_the_drive(tab):
    at_rest(tab)
    until(lambda: "no homing method chosen" in tab.named("homing-told").text, "what is missing")
    tab.press("home")
    until(lambda: "no homing method is chosen (6098h is 0)" in "".join(tab.told()), "why not")
    choose(tab, "homing-method", "17 left to the left limit switch, then right: home is where it becomes inactive")
    label = "return (document.querySelector('.studio-homing') || {}).ariaLabel || ''"
    until(lambda: "method 17: left to the left limit" in tab.driver.execute_script(label), "its sketch")


@pytest.mark.slow
def test_transitions_are_pressed_in_the_diagram(tab):
    at_rest(tab)
    for transition, state in (("2", "Ready to switch on"), ("3", "Switched on"), ("6", "Ready to switch on")):
        arrow = f".studio-diagram .can[aria-label^='{transition} ']"
        until(lambda arrow=arrow: tab.all(arrow), f"transition {transition}")
        tab.driver.execute_script(
            "document.querySelector(arguments[0]).dispatchEvent(new MouseEvent('click', {bubbles: true}))", arrow
        )
        tab.await_state(state)
    lit = tab.one(".studio-diagram .is-lit").text
    assert lit == "Ready to switch on"


@pytest.mark.every(12)
@pytest.mark.parametrize("way", ["space", "button", "space, with a button focused", "control and space in a text"])
@pytest.mark.parametrize("path", PAGES)
def test_quick_stop_from_every_page(tab, path, way):
    at_rest(tab)
    tab.press("enable")
    tab.await_state("Operation enabled")
    tab.open(path)
    assert tab.state == "Operation enabled"
    if way == "button":
        tab.one(".studio-stop").click()
    elif way == "space":
        tab.key(" ")
    elif way == "space, with a button focused":
        tab.driver.execute_script("document.querySelector('.studio-header button').focus()")
        tab.key(" ")
    else:
        field = {"/axes": "goal", "/scope": "level", "/dictionary": "search"}[path]
        tab.named(field).send_keys(Keys.CONTROL, " ")
    until(lambda: tab.state != "Operation enabled", "the quick stop", 3.0)


@pytest.mark.slow
def test_a_jog_lasts_as_long_as_its_button_is_held(tab):
    at_rest(tab)
    tab.type("jog-speed", "300 rpm")
    for _ in range(3):  # a computer that is so busy that beats stay out stops it, as it shall
        tab.press("enable")
        tab.await_state("Operation enabled")
        tab.hold_jog(-1)
        until(lambda: tab.value(VELOCITY) < -200, "the jog")
        tab.release()
        until(lambda: abs(tab.value(VELOCITY)) < 5, "its end")
        if tab.state == "Operation enabled":
            return
    raise AssertionError(f"it was stopped instead of released: {tab.told()}")


@pytest.mark.slow
def test_two_pages_at_once(tab, served):
    """Both see the same axis; one stops what the other moves."""
    at_rest(tab)
    with chromium() as another:
        second = Tab(another, served).open("/scope")
        tab.press("enable")
        second.await_state("Operation enabled")
        tab.type("jog-speed", "200 rpm")
        tab.hold_jog()
        until(lambda: tab.value(VELOCITY) > 150, "the jog")
        second.key(" ")
        until(lambda: abs(tab.value(VELOCITY)) < 5, "the quick stop of the other page", 3.0)
        tab.release()
        until(lambda: second.state != "Operation enabled", "its state on the other page")
        assert any("quick stop" in line for line in tab.told())


@pytest.mark.slow
def test_a_gantry_is_enabled_jogged_and_stopped_by_its_table(driver):
    with studio("--load", "gantry") as served:
        size_of(driver, 1280, 1000)
        tab = Tab(driver, served).open("/axes")
        until(lambda: tab.all("[data-test=in-1]"), "the table")
        assert tab.nameless() == []

        def column(number):
            rows = tab.all("[data-test=axes] tr")[1:]
            return [row.find_elements("css selector", "td")[number].text for row in rows]

        tab.press("enable-group")
        until(lambda: all("Operation enabled" in text for text in column(0)), "both axes enabled")
        tab.type("group-speed", "30 rpm")
        button = tab.one("[data-jog='1'][data-group=all]")
        tab.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
        ActionChains(tab.driver).click_and_hold(button).perform()
        until(lambda: all(float(text.split()[0]) > 20.0 for text in column(3)), "both axes turning")
        seen = "return studioScope.header.traces.filter((one) => one.channel === 1).map((one) => one.high)[0]"
        until(lambda: tab.driver.execute_script(seen) > 20.0, "the speed in the live plot")
        tab.release()
        until(lambda: all(abs(float(text.split()[0])) < 5.0 for text in column(3)), "their rest")
        tab.press("stop-group")
        until(lambda: not any("Operation enabled" in text for text in column(0)), "both axes stopped")
        assert "Traceback" not in served.output, served.output


# --- scope --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("moved_on", ["/scope", "/axes"])
def test_a_step_is_scoped_from_its_trigger_and_measured(tab, moved_on):
    """Moved on the same page; or on another one, where the trigger stays armed, with its cursors and its mode."""
    at_rest(tab)
    tab.open("/scope")
    tab.press("enable")
    tab.await_state("Operation enabled")
    choose(tab, "trigger-mode", "rolling")
    choose(tab, "trigger-mode", "single")
    status = lambda: tab.one(".studio-scope-status").text  # noqa: E731
    until(lambda: status() == "waiting for the trigger", "an armed trigger")
    cursors = tab.driver.execute_script("studioScope.toggle(); return studioScope.cursors")
    tab.open(moved_on)
    before = until(lambda: tab.value(POSITION), "a position") if moved_on == "/axes" else None
    tab.type("goal", "5 rev")
    tab.press("move-by")
    if before is not None:
        until(lambda: abs(tab.value(POSITION) - before - 5.0) < 0.05, "the move")
        tab.open("/scope")
    until(lambda: status() == "halted", "the picture")
    assert tab.driver.execute_script("return studioScope.cursors") == cursors
    header = tab.driver.execute_script("return studioScope.header")
    assert header["triggered"] and header["from"] == pytest.approx(-0.2, abs=0.01)
    assert {row["unit"] for row in header["channels"]} == {"rev", "rpm", "A"}
    tab.driver.execute_script("studioScope.toggle()")  # figures of all of it

    tab.press("measure")
    told = until(lambda: " ".join(one.text for one in tab.all(".studio-figures")).strip(), "figures")
    assert "rise" in told, told


@pytest.mark.slow
def test_a_test_signal_is_played_beside_its_traces_or_refused_with_its_remedy(tab):
    at_rest(tab)
    tab.open("/scope")
    tab.press("enable")
    tab.await_state("Operation enabled")
    choose(tab, "trigger-mode", "rolling")  # whatever a test before has left
    choose(tab, "signal", "Velocity square wave (csv)")
    tab.type("signal-speed", "50 rpm")
    tab.press("play-signal")
    until(lambda: any("100 rpm are more than the 50 rpm" in line for line in tab.told()), "the refusal")
    tab.type("signal-speed", "300 rpm")
    tab.press("play-signal")
    seen = "return studioScope.header.traces.filter((one) => one.channel === 1).map((one) => [one.low, one.high])[0]"
    low, high = until(lambda: (lambda v: v if v and v[1] > 90 and v[0] < -90 else None)(
        tab.driver.execute_script(seen)), "the square wave on the scope")  # fmt: skip
    assert high < 150 and low > -150
    until(lambda: tab.all(".studio-mode")[0].text == "pp", "its mode of before")
    assert tab.state == "Operation enabled"


@pytest.mark.slow
def test_twenty_frames_a_second(tab):
    tab.open("/scope")
    until(lambda: tab.driver.execute_script("return studioScope.frames") > 5, "frames")
    begun, first = time.monotonic(), tab.driver.execute_script("return studioScope.frames")
    time.sleep(2.0)
    frames = tab.driver.execute_script("return studioScope.frames") - first
    assert frames / (time.monotonic() - begun) > 10.0  # on a busy computer; see benchmarks/studio.py


def choose(tab, name, text):
    """Choose a row of a select by keyboard and mouse; a page that is still being built may lose a click."""

    def row():
        return next((one for one in tab.all(".q-menu .q-item") if one.text == text), None)

    def opened():
        field = tab.named(name)
        tab.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", field)
        tab.driver.execute_script("arguments[0].closest('.q-field').querySelector('.q-field__control').click()", field)
        end = time.monotonic() + 1.0
        while not (found := row()) and time.monotonic() < end:
            time.sleep(0.05)
        return found

    until(opened, f"the choice {text}").click()


# --- dictionary ---------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_an_object_is_found_written_and_rolled_back(tab, tmp_path):
    at_rest(tab)
    tab.driver.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    tab.open("/dictionary")
    tab.press("backup")
    until(lambda: list(tmp_path.glob("*.toml")), "the backup")
    before = profile_velocity(tab)
    assert before.endswith("rpm)")
    tab.driver.execute_script("document.querySelector('[data-set=\"6081:00\"]').click()")
    tab.type("value-6081-00", "-5 rpm")
    until(lambda: not tab.named("write").is_enabled(), "a value that is refused before it is sent")
    tab.type("value-6081-00", "432 rpm")
    until(lambda: tab.named("write").is_enabled(), "a value that can be sent")
    tab.press("write")
    until(lambda: "(432 rpm)" in shown(tab, "6081:00"), "the new value")
    tab.one("[data-test=restore-file] input[type=file]").send_keys(str(next(tmp_path.glob("*.toml"))))
    until(lambda: "1 parameters were written" in tab.named("differences").text, "the restore")
    tab.press("close-differences")
    until(lambda: shown(tab, "6081:00") == before, "the value of before")


def profile_velocity(tab):
    """Return what is shown of 6081h once it has been found."""
    tab.type("search", "profile vel")
    until(lambda: "rpm" in shown(tab, "6081:00"), "the profile velocity")
    return shown(tab, "6081:00")


def shown(tab, name):
    found = tab.all(f"[data-value='{name}']")
    return found[0].text if found else ""


@pytest.mark.slow
def test_favourites_and_units_are_those_of_every_page(tab, served):
    tab.open("/dictionary")
    tab.type("search", "6064")
    until(lambda: tab.all("[data-key='6064:00'] button"), "its star")[0].click()
    with chromium() as another:
        second = Tab(another, served).open("/dictionary")
        second.type("search", "6064")
        until(lambda: second.one("[data-key='6064:00'] .q-icon").text == "star", "its star")
        second.open("/axes")
        units = "return (studioScope.header || {channels: []}).channels.map((one) => one.unit)"
        until(lambda: "rev" in second.driver.execute_script(units), "the live plot")
        tab.open("/scope")
        choose(tab, "unit-angle", "deg")
        until(lambda: "deg" in tab.driver.execute_script(units), "the unit on the scope")
        until(lambda: "deg" in second.driver.execute_script(units), "the unit in the live plot that is open")
    tab.open("/axes")
    until(lambda: "deg" in tab.one(".card-motion").text, "the unit on the page Axes")
    tab.open("/scope")
    choose(tab, "unit-angle", "rev")


@pytest.mark.slow
def test_compared_with_stored_nothing_differs(tab):
    tab.open("/dictionary")
    tab.press("stored")
    until(lambda: "differ from stored" in tab.named("differences").text, "the comparison")
    assert tab.named("differences").text.startswith("0 of")
    tab.press("close-differences")
