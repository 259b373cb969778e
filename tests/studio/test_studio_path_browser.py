"""A whole commissioning in a real browser: an own motor on an own MJCF, emulated, over CAN and over EtherCAT.

What the page says is held against what the emulator has inside: its dictionary, its stage, its rotor.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from urllib.request import urlopen

import pytest
from rigs import ROOT, TESTS
from rigs.namespaces import needs_namespaces, spaces, within  # noqa: F401
from rigs.studio_rig import StudioProcess, Tab, choose, chromium, needs_chromium, size_of, until
from rigs.truth import truth_of
from selenium.webdriver.common.keys import Keys

from drive_env import EmulatedDrives
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.devices import find_device
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.ways import RawSocket
from drive_env.ethercat.world import EtherCatWorld

pytestmark = [
    needs_chromium,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::drive_env.emulator.inertia_check.MisfitWarning"),
]

LONG = 600.0  # s of a tuning on a computer that is busy
SELDOM = 0.5  # s between two looks: a drive on a bus lives in this process
SOON = 60.0  # s
TRAVEL = "-20:20"  # turns
HOME_HERE = 35
PICTURES = os.environ.get("STUDIO_PICTURES")  # folder for pictures of every page, which people look at
SUPPLIES = {"tmcm1636": "48", "tgz_s": "560"}  # V, of the own motors
LENT = ("607D:01", "607D:02")  # limits of travel
D_MODE = "2303:00"  # of a TGZ; it goes with the mode of operation
WIDTHS = (360, 800, 1400)
OVER = "return document.documentElement.scrollWidth"

TABLE = """
<mujoco model="turntable">
  <worldbody>
    <body name="table">
      <joint name="axle" type="hinge" axis="0 0 1"/>
      <geom type="cylinder" size="0.05 0.005" mass="0.03" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor joint="axle" gear="1"/></actuator>
</mujoco>
"""


@dataclass
class Bench:
    """A studio and its drive: its page, what the emulator has inside, and what a power cycle leaves of it.

    link: Its name. fail: has the supply dip; None where the page Machine does.
    """

    link: str
    device: str
    studio: StudioProcess
    truth: object
    power_cycle: object = None
    fail: object = None


def own_files(folder, device):
    """Write the own motor, and the own machine, and return their files."""
    motor, machine = folder / "own_motor.toml", folder / "turntable.xml"
    if device == "tmcm1636":
        shutil.copy(ROOT / "examples" / "models" / "my_motor.toml", motor)
    else:  # of the voltage of this drive: a data sheet like that of the catalogue, under another name
        text = (ROOT / "drive_env" / "motors" / "am3033_e.toml").read_text()
        motor.write_text(re.sub(r'title = ".*"', 'title = "Own motor, 560 V"', text))
    machine.write_text(TABLE)
    return motor, machine


def factory(device, motor, machine):
    """Return an emulated drive as it comes from the factory, compiled before time counts."""
    drives = EmulatedDrives(device, str(machine), str(motor), commissioned=False, num_threads=1)
    drives.advance(0.002)
    drives.machine.reset()
    return drives


def studio_on(*options):
    return StudioProcess(*options, program=(str(TESTS / "studio_with_truth.py"),))


def inside(studio):
    """Wait for the emulator of a studio's own drive and return its state."""
    return until(lambda: json.load(urlopen(studio.page("/truth"))), "the emulator")


@contextmanager
def emulated(folder):
    motor, machine = own_files(folder, "tmcm1636")
    made = studio_on("--load", str(machine), "--motor", str(motor), "--factory")
    try:
        yield Bench("emulated", "tmcm1636", made, lambda: inside(made))
    finally:
        made.end()


@contextmanager
def over_can(folder):
    drives = factory("tmcm1636", *own_files(folder, "tmcm1636"))
    world, hub = World(lockstep=True), Hub()
    world.add(drives, [1])
    world.power_on()
    with Server(world, hub):
        made = studio_on("--timeout", "20", "--channel", hub.channel)
        try:
            yield Bench("can", "tmcm1636", made, lambda: truth_of(drives), world.power_on, drives.machine.fault)
        finally:
            made.end()
    world.close()


@contextmanager
def over_ethercat(folder, spaces):  # noqa: F811
    """A drive at one end of a cable; studio and browser at the other."""
    drives = factory("tgz_s", *own_files(folder, "tgz_s"))
    world = EtherCatWorld()
    world.add(EtherCatSlave(CoeNode(drives)), drives)
    with within(spaces.slave):
        way = RawSocket(spaces.slave_interface)
    with EtherCatServer(world, way), within(spaces.master):
        bus = ("--timeout", "20", "--interface", "ethercat", "--channel", spaces.master_interface)
        made = studio_on("--device", "tgz_s", *bus)
        try:
            yield Bench("ethercat", "tgz_s", made, lambda: truth_of(drives), world.power_on, drives.machine.fault)
        finally:
            made.end()
    world.close()


LINKS = ("emulated", "can", pytest.param("ethercat", marks=needs_namespaces))


@pytest.fixture
def bench(request, tmp_path, monkeypatch):
    """The studio runs in a folder of its own, and leaves its runs there."""
    monkeypatch.chdir(tmp_path)
    if request.param == "ethercat":
        pytest.importorskip("pysoem", reason="pysoem is not installed: pip install -e '.[ethercat]'")
        made = over_ethercat(tmp_path, request.getfixturevalue("spaces"))
    else:
        made = {"emulated": emulated, "can": over_can}[request.param](tmp_path)
    with made as found, chromium() as driver:
        size_of(driver, 1280, 1000)
        yield SimpleNamespace(**vars(found), tab=Tab(driver, found.studio))
        driver.get("about:blank")
    assert "Traceback" not in found.studio.output, found.studio.output


def text_of(tab, name):
    script = "const one = document.querySelector(arguments[0]); return one ? one.innerText : ''"
    return tab.driver.execute_script(script, f"[data-test={name}]")


def told(tab, name, words, patience=SOON):
    """Wait until an element says something; what it said instead stands in the failure."""
    try:
        return until(lambda: words in text_of(tab, name) and text_of(tab, name), words, patience, SELDOM)
    except AssertionError:
        raise AssertionError(f"{name}: {text_of(tab, name)!r}, and not {words!r}; told: {tab.told()}") from None


def look(bench, page):
    """Nothing is wider than the page or nameless, at any width; and take pictures where they are wanted."""
    driver = bench.tab.driver
    for dark in (False, True):
        for width in WIDTHS:
            size_of(driver, width, 900, dark=dark)
            until(lambda: driver.execute_script(OVER) <= width, f"{page} within {width} px")  # noqa: B023
            if PICTURES:
                height = driver.execute_script("return document.documentElement.scrollHeight")
                size_of(driver, width, min(6000, max(900, height)), dark=dark)
                name = f"{bench.link}-{page}-{width}-{'dark' if dark else 'light'}.png"
                until(lambda: driver.save_screenshot(str(Path(PICTURES) / name)), name)  # noqa: B023
    size_of(driver, 1280, 1000)
    assert bench.tab.nameless() == []


def numbers(text):
    return [int(one) for one in text.replace(",", " ").split()]


def settings(bench):
    """Return the parameters inside, but for what the envelope lends and what follows the mode of operation."""
    return {name: value for name, value in bench.truth()["parameters"].items() if name not in (*LENT, D_MODE)}


def gains_inside(bench):
    keys = find_device(bench.device).gains.keys
    return [bench.truth()["parameters"][f"{index:04X}:{sub:02X}"] for index, sub in keys]


def tuned(tab, step="step-tune"):
    """Return the gains that the page says a tuning has left in the drive."""
    found = re.search(r"now ([\d, ]+)", text_of(tab, step))
    return numbers(found[1])


def do(tab, step, title, patience=SOON):
    tab.press(f"do-{step}")
    return told(tab, f"step-{step}", f"{title}: done", patience)


@pytest.mark.parametrize("bench", LINKS, indirect=True)
def test_an_own_motor_on_an_own_machine_from_the_motor_to_the_certificate_and_after_a_fault(bench):
    before = bench.truth()["parameters"]
    gains = commission(bench)
    assert not bench.truth()["is_on"]
    stored = settings(bench)
    assert stored != {name: before[name] for name in stored}
    home_and_scope_a_move(bench)
    assert settings(bench) == stored
    tune_and_go_back(bench, gains)
    assert settings(bench) == stored
    fail_and_recover(bench)
    store_and_switch_off(bench, stored, before)


def commission(bench):
    """Go the whole path, tuned at two dynamics with a way back between them; return the gains that it leaves."""
    tab = bench.tab
    tab.open("/commission")
    if bench.link != "emulated":
        tab.type("motor", str(Path("own_motor.toml").resolve()))
        tab.named("motor").send_keys(Keys.ENTER)
        until(lambda: tab.named("supply").get_attribute("value") == SUPPLIES[bench.device], "the supply of the motor")
    tab.type("travel", TRAVEL)
    tab.press("begin")
    told(tab, "path-told", "Under way")
    do(tab, "motor", "Motor")
    do(tab, "wiring", "Wiring and commutation", LONG)
    do(tab, "current", "Current loop", LONG)
    do(tab, "limits", "Limits")
    choose_method(tab, HOME_HERE)
    do(tab, "homing", "Homing")
    look(bench, "commission")
    do(tab, "identify", "Identification", LONG)
    first = gains_inside(bench)
    choose(tab, "path-dynamics", "soft")
    do(tab, "tune", "Tuning", LONG)
    soft = gains_inside(bench)
    assert soft == tuned(tab) != first
    tab.press("back-tune")
    told(tab, "step-tune", "Tuning: pending")
    assert gains_inside(bench) == first
    choose(tab, "path-dynamics", "standard")
    do(tab, "tune", "Tuning", LONG)
    standard = gains_inside(bench)
    assert standard == tuned(tab) and standard not in (first, soft)
    do(tab, "verify", "Verification", LONG)
    do(tab, "store", "Store")
    do(tab, "certificate", "Certificate")
    run = next(Path("runs").glob("*-commission"))
    assert (run / "report.html").is_file()
    page_says = json.loads((run / "certificate.json").read_text())
    assert "accepted" in json.dumps(page_says)
    look(bench, "commissioned")
    return standard


def home_and_scope_a_move(bench):
    """Enable, home, and make a move that the scope waits for."""
    tab = bench.tab
    tab.open("/axes")
    tab.press("enable")
    tab.await_state("Operation enabled", SOON)
    tab.press("home")
    until(lambda: abs(tab.value("Position actual value")) < 0.01, "home", SOON)
    look(bench, "axes")
    tab.open("/scope")
    status = lambda: tab.one(".studio-scope-status").text  # noqa: E731
    tab.type("level", "300 rpm")  # noise of the speed is below it
    choose(tab, "trigger-mode", "single")
    until(lambda: status() == "waiting for the trigger", "an armed trigger", SOON)
    tab.type("goal", "3 rev")
    tab.press("move-by")
    until(lambda: status() == "halted", "the picture", SOON)
    assert tab.driver.execute_script("return studioScope.header.triggered")
    look(bench, "scope")
    tab.open("/axes")
    until(lambda: abs(tab.value("Position actual value") - 3.0) < 0.02, "the end of the move", SOON)
    tab.press("disable")
    tab.await_state("Switch on disabled", SOON)


def tune_and_go_back(bench, standard):
    """Have auto tune with stiff dynamics, and go back from its certificate to the state before."""
    tab = bench.tab
    tab.open("/tune")
    until(lambda: page_gains(bench) == standard, "the gains on the page", SOON)
    choose(tab, "dynamics", "stiff")
    tab.press("run-auto")
    told(tab, "run-head", ": done", LONG)
    assert "accepted" in text_of(tab, "verdict-0")
    stiff = gains_inside(bench)
    assert f"Now: {', '.join(map(str, stiff))}." in text_of(tab, "verdict-0") and stiff != standard
    until(lambda: tab.all("[data-test=report]"), "its certificate")
    look(bench, "tune")
    tab.press("restore-before")
    until(lambda: page_gains(bench) == standard, "the gains before", SOON)


def fail_and_recover(bench):
    """Have the supply dip while the axis is enabled; reset the fault, and move again."""
    tab = bench.tab
    tab.open("/axes")
    tab.press("enable")
    tab.await_state("Operation enabled", SOON)
    if bench.fail is None:
        tab.open("/machine")
        tab.press("fault-supply_dip")
        tab.await_state("Fault", SOON)
        look(bench, "machine")
        tab.press("end-faults")
        until(lambda: not tab.all(".studio-fault-row.is-active"), "the end of the fault", SOON)
        tab.open("/axes")
    else:
        bench.fail("supply_dip", duration=5.0)  # the capacitors of the link are empty by then
        tab.await_state("Fault", SOON)
    assert "Remedy: " in tab.one(".card-faults").text and not bench.truth()["is_on"]
    look(bench, "fault")
    until(lambda: (tab.press("reset"), tab.state == "Switch on disabled")[1], "the end of the fault", SOON, 2.0)
    tab.press("enable")
    tab.await_state("Operation enabled", SOON)
    here = tab.value("Position actual value")
    tab.type("goal", "-1 rev")
    tab.press("move-by")
    until(lambda: abs(tab.value("Position actual value") - here + 1.0) < 0.02, "a move after the fault", SOON)
    tab.press("disable")
    tab.await_state("Switch on disabled", SOON)


def store_and_switch_off(bench, stored, before):
    """Store, and compare what the drive has after a power cycle with what it had."""
    tab = bench.tab
    tab.open("/dictionary")
    tab.press("store")
    kept, not_kept = "the drive keeps its parameters from now on", "has no service behind it in this emulator"
    until(lambda: (kept if bench.power_cycle else not_kept) in "".join(tab.told()), "whether it is stored", SOON)
    now = bench.truth()
    assert settings(bench) == stored and not now["is_on"] and abs(now["speed"]) < 1.0
    tab.driver.get("about:blank")
    if bench.power_cycle is not None:
        bench.studio.end()
        bench.power_cycle()
        lent = {name: before[name] for name in LENT if name in before}
        assert {**bench.truth()["parameters"], D_MODE: None} == stored | lent | {D_MODE: None}


def page_gains(bench):
    """Return the numbers in the fields of the gains."""
    script = "return [...document.querySelectorAll('[data-test^=gain-]')].map((one) => one.value)"
    found = [one for one in bench.tab.driver.execute_script(script) if one]
    return [int(one.replace(",", "")) for one in found]


def choose_method(tab, number):
    """Take a homing method by its radio button."""
    script = """const all = [...document.querySelectorAll('[data-test=methods] .q-radio')];
        const one = all.find((radio) => radio.textContent.trim() === arguments[0]);
        if (one) one.click(); return !!one"""
    until(lambda: tab.driver.execute_script(script, f"Method {number}"), f"method {number}")
