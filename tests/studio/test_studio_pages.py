"""Every page of the studio for every kind of drive, and for addresses that nobody should ask for."""

from __future__ import annotations

import json
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from rigs import ROOT, TESTS
from rigs.fault_injection import served
from rigs.studio_rig import Tab, chromium, needs_chromium, studio, until

from drive_env import EmulatedDrives
from drive_env.devices import device_names

VENDOR = ROOT / "drive_env" / "devices" / "tmcm1636" / "tmcm1636.eds"
PAGES = ("/axes", "/scope", "/dictionary", "/tune", "/machine", "/runs")
LONG = "a" * 5000


def status(url, method="GET"):
    """Return the status of an answer, and its text."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, method=method), timeout=30.0) as answer:
            return answer.status, answer.read().decode("utf-8", "replace")
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode("utf-8", "replace")


def open_drives(made):
    """Wait until a page shows drives, not that they are being opened."""
    until(lambda: "Opening the drives" not in status(made.page("/axes"))[1], "open drives", 120.0, step=0.2)


def check_pages(made):
    open_drives(made)
    for page in PAGES:
        assert status(made.page(f"{page}?axis=1"))[0] == 200, (page, made.output)
    made.end()
    assert "Traceback" not in made.output, made.output


# --- every kind of drive --------------------------------------------------------------------------------------------
@pytest.mark.every(2)
@pytest.mark.slow  # the pages of one are asked for below
@pytest.mark.parametrize("device", [*device_names(), TESTS / "bare_stepper", TESTS / "invented_drive"], ids=str)
def test_every_page_answers_for_every_device(device):
    with studio("--device", str(device), "--load", "inertia") as made:
        check_pages(made)


@pytest.fixture(scope="module")
def bus():
    with EmulatedDrives(load="inertia", num_threads=1) as drives, served(drives) as (_, channel):
        yield channel


@pytest.mark.slow
def test_every_page_answers_for_a_drive_that_is_known_by_its_eds_alone(bus, tmp_path):
    """The page Tune was an error 500 with a traceback."""
    eds = tmp_path / "vendor.eds"
    eds.write_bytes(VENDOR.read_bytes())
    with studio("--eds", str(eds), "--channel", bus) as made:
        open_drives(made)
        assert "vendor is known by its EDS alone" in status(made.page("/tune"))[1]
        check_pages(made)


@pytest.mark.slow
def test_every_page_answers_on_a_bus(bus):
    with studio("--channel", bus) as made:
        check_pages(made)


# --- addresses and requests that nobody should send -------------------------------------------------------------------
@pytest.fixture(scope="module")
def made():
    with studio("--load", "inertia") as made:
        open_drives(made)
        yield made
        assert "Traceback" not in made.output, made.output


@pytest.mark.every(7)
@pytest.mark.parametrize(("path", "code"), [
    (f"/studio/runs/{LONG}", 404), (f"/studio/runs/{LONG}/{LONG}", 404), ("/studio/runs/", 404),
    ("/studio/runs/%00", 400), ("/studio/runs/a%0d%0ab", 400), ("/studio/runs/..%2f..%2fetc/passwd", 404),
    ("/studio/runs/%ff%fe", 404), (f"/runs?run={LONG}", 200), ("/runs?run=%00", 200), ("/runs?run=..", 200),
    *((f"{page}?axis={axis}", 200) for page in PAGES for axis in (-5, 99999999999999999999)),
    ("/axes?axis=x", 422), ("/axes?axis=1e3", 422), ("/axes?axis=", 422), ("/nothing", 404),
    ("//evil.example/", 400),
    ("/studio/quick-stop", 405), ("/studio/life", 404), ("/studio/assets/..%2fserver.py", 404), ("/" + LONG, 404),
    ("/%5cevil.example", 400),
])  # fmt: skip
def test_an_odd_address_is_refused_in_one_line(made, path, code):
    found, text = status(made.page(path))
    assert found == code, text[:300]
    assert "Traceback" not in text


@pytest.mark.parametrize("head", [
    "GET /axes HTTP/1.1\r\nHost: {host}\r\nHost: {host}", "GET /axes HTTP/1.1\r\nHost: evil.example\r\nHost: {host}",
    "GET /axes HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nOrigin: http://evil.example",
    "POST /studio/quick-stop HTTP/1.1\r\nHost: {host}\r\nOrigin: http://evil.example\r\nContent-Length: 0",
    "GET /axes HTTP/1.0", "GET http://evil.example/axes HTTP/1.1\r\nHost: evil.example",
])  # fmt: skip
def test_a_request_with_two_hosts_or_a_foreign_origin_is_refused(made, head):
    host = made.page("").removeprefix("http://").rstrip("/")
    name, _, port = host.partition(":")
    with socket.create_connection((name, int(port)), timeout=20.0) as line:
        line.sendall((head.format(host=host) + "\r\nConnection: close\r\n\r\n").encode())
        answer = line.recv(65536)
    assert answer.split()[1] in (b"400", b"403", b"421"), answer


# --- frames -----------------------------------------------------------------------------------------------------------
class Framing(BaseHTTPRequestHandler):
    """A page of another port that shows a page of the studio in a frame that nobody sees."""

    inside = ""

    def do_GET(self):
        frame = f'<iframe src="{self.inside}" style="opacity: 0.01" width="900" height="900"></iframe>'
        self.send_response(200)
        self.send_header("content-type", "text/html")
        self.end_headers()
        with suppress(OSError):
            self.wfile.write(f"<!doctype html><title>Win a prize</title>{frame}".encode())

    def log_message(self, *_):
        pass


@contextmanager
def framing(inside):
    handler = type("FramingThis", (Framing,), {"inside": inside})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.mark.slow
@needs_chromium
@pytest.mark.parametrize("path", ["/axes", "/nothing", "/studio/assets/studio.js"])
def test_a_page_of_another_port_shows_nothing_of_the_studio_in_a_frame(made, path):
    """One click in it enabled the drive; a held one jogged it at 6.8 rad/s."""
    with chromium() as driver, framing(made.page(path)) as other:
        driver.get(other)
        driver.switch_to.frame(0)
        until(lambda: driver.execute_script("return document.readyState") == "complete", "the frame")
        time.sleep(1.0)
        assert driver.execute_script("return location.href").startswith("chrome-error:")
        assert not Tab(driver, made).all(".studio-card, .studio-stop")
        driver.switch_to.default_content()
        refusals = [row["message"] for row in driver.get_log("browser") if "frame" in row["message"].lower()]
        assert refusals, "the browser says that it was refused"


# --- texts of others --------------------------------------------------------------------------------------------------
EVIL = """<img src=x onerror="window.hacked = 1">' onclick='window.hacked = 1"""


@needs_chromium
@pytest.mark.slow
def test_no_text_of_an_eds_a_run_or_a_settings_file_is_taken_for_html(bus, tmp_path, monkeypatch):
    names = re.compile(rb"(?m)^ParameterName=.*$")
    (tmp_path / "vendor.eds").write_bytes(names.sub(lambda line: line[0] + EVIL.encode(), VENDOR.read_bytes()))
    run = tmp_path / "runs" / "<img src=x onerror=window.hacked=1>"
    run.mkdir(parents=True)
    (run / "settings.toml").write_text(f"{json.dumps(EVIL)} = {json.dumps(EVIL)}")
    (run / "<b onclick=alert()>.csv").write_text(EVIL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    with studio("--eds", str(tmp_path / "vendor.eds"), "--channel", bus) as made, chromium() as driver:
        tab = Tab(driver, made)
        for page in PAGES:
            tab.open(page)
            time.sleep(1.5)  # values, rows and charts come
            if page == "/dictionary":
                tab.type("search", "actual")
                time.sleep(1.0)
            opened = "[...document.querySelectorAll('.q-expansion-item .q-item, .studio-row button')].slice(0, 6)"
            driver.execute_script(f"{opened}.forEach((one) => one.click())")
            time.sleep(1.0)
            assert "onerror" in driver.execute_script("return document.body.innerText") or page in ("/tune", "/machine")
            assert driver.execute_script("return window.hacked") is None, page
            assert not tab.all("img[src=x], [onclick], [onerror]"), page
        tab.open("/axes")
        driver.execute_script("emitEvent('studio_command', 999999)")  # told as an error, in a line of the page
        time.sleep(1.0)
        assert driver.execute_script("return window.hacked") is None
