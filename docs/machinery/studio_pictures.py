"""Photograph the pages of `drive-env studio` on an emulated machine, into docs/assets/studio.

python docs/machinery/studio_pictures.py             # those of the documentation
python docs/machinery/studio_pictures.py --all OUT   # every page at 360, 1280 and 2560 px, light and dark, to look at

Pictures are committed: they need Chromium with its driver (Debian's chromium-driver) and the extra `test`.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from PIL import Image
from selenium import webdriver
from selenium.webdriver import Chrome
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By

ASSETS = Path(__file__).resolve().parent.parent / "assets" / "studio"
PROGRAM = "from drive_env.programs import drive_env; drive_env()"
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
)  # fmt: skip
QUALITY = 82  # of WebP
SIZES = {360: 780, 1280: 900, 2560: 1440}
SETTLE = 3.0  # s until a page shows what it has


class Shot(NamedTuple):
    """A picture: its file, its page, its size, light or dark, and the actions before it."""

    name: str
    path: str
    width: int
    height: int
    dark: bool
    act: Callable[[Chrome], None]


@contextmanager
def served() -> Iterator[str]:
    """Yield the address of a studio."""
    folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)  # where it leaves its runs
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "studio", "--no-browser", "--port", "0"], stdout=subprocess.PIPE, text=True,
        cwd=folder.name,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        found = next(found for line in process.stdout if (found := re.search(r"(http://\S+?)/?\s", line)))
        yield found[1]
    finally:
        process.terminate()
        process.wait(20)
        folder.cleanup()


@contextmanager
def browser() -> Iterator[Chrome]:
    """Yield a browser of its own profile."""
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


def press(driver: Chrome, css: str) -> None:
    """Press the element of a selector."""
    driver.execute_script("arguments[0].click()", driver.find_element(By.CSS_SELECTOR, css))
    time.sleep(0.3)


def enable(driver: Chrome) -> None:
    """Enable the axis, and move it away from its start."""
    press(driver, "[data-test=enable]")
    time.sleep(1.0)
    press(driver, "[data-test=move-by]")
    time.sleep(2.0)


def move(driver: Chrome) -> None:
    """Have the axis move while the scope looks: by another page of the same browser."""
    home = driver.current_window_handle
    base = driver.current_url.partition("/scope")[0]
    time.sleep(1.0)
    driver.switch_to.new_window("tab")
    driver.get(f"{base}/axes")
    time.sleep(1.5)
    press(driver, "[data-test=move-by]")
    time.sleep(0.9)
    driver.close()
    driver.switch_to.window(home)
    time.sleep(0.15)
    press(driver, "[data-test=run]")
    driver.execute_script("studioScope.fit(); studioScope.toggle()")
    driver.execute_script(  # A before the move, B after it
        "studioScope.cursors[0] = studioScope.header.from + 0.1; emitEvent('scope_cursors', studioScope.cursors)"
    )
    time.sleep(0.4)
    press(driver, "[data-test=measure]")


def find(driver: Chrome) -> None:
    """Show the profile's speeds, one of them a favourite."""
    driver.execute_script("localStorage.setItem('studio-favourites', '[\"6081:00\",\"606C:00\"]')")
    driver.refresh()
    time.sleep(1.5)
    driver.find_element(By.CSS_SELECTOR, "[data-test=search]").send_keys("profile")
    time.sleep(SETTLE)


def tune(driver: Chrome) -> None:
    """Have auto tune the axis, whose moves are the steps, and measure a response."""
    for button, told, text in (("run-auto", "run-head", "done"), ("measure-response", "stiffness-told", "Gains for")):
        press(driver, f"[data-test={button}]")
        while text not in driver.find_element(By.CSS_SELECTOR, f"[data-test={told}]").text:
            time.sleep(1.0)
    driver.execute_script("for (const one of document.querySelectorAll('.q-notification')) one.remove()")


def fail(driver: Chrome) -> None:
    """Have the encoder stuck; later pictures would suffer from it."""
    press(driver, "[data-test=fault-encoder_stuck]")
    time.sleep(1.0)
    driver.execute_script("document.activeElement.blur(); window.scrollTo(0, 0)")


def commission(driver: Chrome) -> None:
    """Begin a commissioning, and come to its homing."""
    press(driver, "[data-test=begin]")
    time.sleep(SETTLE)
    for step in ("motor", "wiring", "current", "limits"):
        press(driver, f"[data-test=do-{step}]")
        time.sleep(2.0 * SETTLE)


def nothing(driver: Chrome) -> None:
    """Do nothing."""


SHOTS = (
    Shot("axes", "/axes", 1280, 860, False, enable),
    Shot("scope", "/scope", 1280, 960, False, move),
    Shot("dictionary", "/dictionary", 1280, 860, False, find),
    Shot("tune", "/tune", 1920, 2060, False, tune),
    Shot("runs", "/runs", 1280, 960, False, nothing),
    Shot("axes-phone", "/axes", 360, 780, True, nothing),
    Shot("commission", "/commission", 1280, 1500, False, commission),
    Shot("machine", "/machine", 1280, 1750, False, fail),
)


def size(driver: Chrome, width: int, height: int, *, dark: bool) -> None:
    """Give the page a size, and light or dark."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})


def photograph(driver: Chrome, base: str, shot: Shot, folder: Path) -> Path:
    """Make a picture."""
    size(driver, shot.width, shot.height, dark=shot.dark)
    driver.get(base + shot.path)
    time.sleep(SETTLE)
    shot.act(driver)
    size(driver, shot.width, shot.height, dark=shot.dark)
    time.sleep(0.7)
    file = folder / f"{shot.name}.webp"
    Image.open(BytesIO(driver.get_screenshot_as_png())).convert("RGB").save(file, quality=QUALITY, method=6)
    return file


EVERY = ("axes", "scope", "dictionary", "commission", "tune", "machine", "runs")


def every(pages: tuple[str, ...] = EVERY) -> list[Shot]:
    """Return every page at every size, light and dark."""
    acts = dict.fromkeys(("scope", "axes", "dictionary", "commission"), nothing)
    return [
        Shot(f"{page}-{width}-{'dark' if dark else 'light'}", f"/{page}", width, height, dark, acts.get(page, nothing))
        for page in pages
        for width, height in SIZES.items()
        for dark in (False, True)
    ]


def main() -> None:
    """Make the pictures."""
    all_of_them = sys.argv[1:2] == ["--all"]
    folder = Path(sys.argv[2]) if all_of_them else ASSETS
    folder.mkdir(parents=True, exist_ok=True)
    with served() as base, browser() as driver:
        for shot in every() if all_of_them else SHOTS:
            print(photograph(driver, base, shot, folder))


if __name__ == "__main__":
    main()
