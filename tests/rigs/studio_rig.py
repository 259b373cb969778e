"""The studio as its users have it: a process that serves it, and Debian's Chromium, headless."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager, suppress

import pytest

pytest.importorskip("nicegui", reason="the extra `studio` is not installed")
pytest.importorskip("selenium", reason="selenium is not installed (extra `test`)")

from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException, WebDriverException
from selenium.webdriver import ActionChains
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

PROGRAM = "from drive_env.programs import drive_env; drive_env()"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DRIVER = shutil.which("chromedriver")
needs_chromium = pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="chromium and chromedriver are not installed (apt-get install chromium-driver)"
)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
)  # fmt: skip
NAMELESS = """
const nameless = [];
for (const one of document.querySelectorAll("button, input, select, textarea, a, [role=button], [role=slider]")) {
  if (one.closest("[aria-hidden=true]") || one.type === "file" || one.type === "hidden") continue;
  const around = one.matches("[role=slider]") && one.closest("[aria-label]");
  const text = one.getAttribute("aria-label") || one.textContent.trim() || (around && around.ariaLabel);
  const label = text || (one.closest("label") || {}).textContent;
  if (!label || !label.trim()) nameless.push(one.outerHTML.slice(0, 160));
}
return nameless;
"""
PATIENCE = 120.0  # s: a cold cache compiles for a minute


class StudioProcess:
    """A studio that is served by a process of its own; `program` is what Python runs, `drive-env` by default."""

    def __init__(self, *options, program=("-c", PROGRAM)):
        environment = dict(os.environ, PYTHONUNBUFFERED="1")
        self.process = subprocess.Popen(
            [sys.executable, *program, "studio", "--no-browser", "--port", "0", *options],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment,
        )  # fmt: skip
        self.lines = []
        self.url = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        until(lambda: self.url or self.process.poll() is not None, "the address of the studio", PATIENCE)
        assert self.url, "".join(self.lines)

    def _read(self):
        for line in self.process.stdout:
            self.lines.append(line)
            if found := re.search(r"(http://\S+)", line):
                self.url = self.url or found[1]

    @property
    def output(self):
        return "".join(self.lines)

    def page(self, path):
        return self.url.split("?")[0].rstrip("/") + path

    def kill(self):
        self.process.kill()
        self.process.wait(10)

    def end(self, number=signal.SIGINT):
        if self.process.poll() is None:
            self.process.send_signal(number)
            try:
                self.process.wait(20)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait(10)
        self._reader.join(5)
        return self.process.returncode


@contextmanager
def studio(*options):
    """Yield a studio; it ends with the block."""
    made = StudioProcess(*options)
    try:
        yield made
    finally:
        made.end()


@contextmanager
def chromium(width=1280, height=1000, *, dark=False):
    """Yield a browser of its own profile."""
    folder = tempfile.mkdtemp(prefix="studio-chromium-")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={folder}", f"--window-size={width},{height}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    driver.set_page_load_timeout(60)
    # As a window that a person looks at: a select opens for nobody else.
    driver.execute_cdp_cmd("Emulation.setFocusEmulationEnabled", {"enabled": True})
    size_of(driver, width, height, dark=dark)
    try:
        yield driver
    finally:
        with suppress(WebDriverException):
            driver.quit()
        shutil.rmtree(folder, ignore_errors=True)


def size_of(driver, width, height, *, dark=False):
    """Give a browser's page a size, and light or dark."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})


def until(condition, what, patience=20.0, step=0.05):
    """Wait for a condition, and return what it returned."""
    end = time.monotonic() + patience
    while not (found := condition()):
        assert time.monotonic() < end, f"{what} never came"
        time.sleep(step)
    return found


class Tab:
    """A page of the studio in a browser, as a person uses it."""

    def __init__(self, driver, served):
        self.driver, self.served = driver, served

    def open(self, path):
        self.driver.get(self.served.page(path))
        until(lambda: self.all(".studio-card"), f"the page {path}", PATIENCE)
        until(lambda: self.driver.execute_script("return !!(window.studio && studio.page)"), "its script")
        until(lambda: self.state not in ("", "opening"), "the state of the axis")
        return self

    def all(self, css):
        return self.driver.find_elements(By.CSS_SELECTOR, css)

    def one(self, css):
        return until(lambda: self.all(css), css)[0]

    def named(self, name):
        return self.one(f"[data-test={name}]")

    def press(self, name):
        element = self.named(name)
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
        self.driver.execute_script("arguments[0].click()", element)

    def type(self, name, text):
        field = self.named(name)
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", field)
        until(lambda: field.is_displayed() and field.is_enabled(), f"{name}, to be typed into")
        field.send_keys(Keys.CONTROL, "a")
        field.send_keys(text)
        time.sleep(0.2)  # the server has it

    @property
    def state(self):
        found = self.all(".studio-chip")
        try:
            text = found[0].text if found else ""
        except StaleElementReferenceException:  # the page has loaded itself anew between the two questions
            text = ""
        return text.split("\n")[1] if "\n" in text else ""

    def await_state(self, name, patience=20.0):
        end = time.monotonic() + patience
        told = []
        while self.state != name:
            told += [one for one in self.told() if one not in told]
            assert time.monotonic() < end, f"{name} never came: it is {self.state}; told: {told}"
            time.sleep(0.05)

    def value(self, label):
        """Return the number of a quantity of the page Axes."""
        script = """for (const name of document.querySelectorAll('.studio-values .name'))
            if (name.textContent === arguments[0]) return name.nextElementSibling.textContent"""
        text = self.driver.execute_script(script, label)
        return float(text.replace(",", "")) if text and text != "—" else float("nan")

    def hold_jog(self, direction=1):
        button = self.one(f"[data-jog='{direction}']")
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
        ActionChains(self.driver).click_and_hold(button).perform()

    def release(self):
        ActionChains(self.driver).release().perform()

    def key(self, key):
        ActionChains(self.driver).send_keys(key).perform()

    def told(self):
        """Return the lines that the page shows now."""
        return [one.text for one in self.all(".q-notification")]

    def errors(self):
        """Return what went wrong in the browser: scripts that failed, requests that were refused."""
        return [row for row in self.driver.get_log("browser") if row["level"] == "SEVERE"]

    def foreign(self):
        """Return the addresses outside this studio from which the page has loaded something."""
        script = "return performance.getEntriesByType('resource').map((one) => one.name)"
        ours = self.served.page(""), "data:", "blob:"
        return [one for one in self.driver.execute_script(script) if not one.startswith(ours)]

    def nameless(self):
        """Return the controls for which a screen reader has no words: a label, a text or an aria-label."""
        return self.driver.execute_script(NAMELESS)


def choose(tab, name, text):
    """Choose a row of a select."""

    def row():
        return next((one for one in tab.all(".q-menu .q-item") if one.text.startswith(text)), None)

    def opened():
        field = tab.named(name)
        tab.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", field)
        tab.driver.execute_script("arguments[0].closest('.q-field').querySelector('.q-field__control').click()", field)
        return until(lambda: row() or "none", "its rows", 2.0) if not row() else row()

    until(lambda: (found := opened()) != "none" and found, f"the choice {text}").click()
