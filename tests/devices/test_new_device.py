"""A device from any EDS: 32 files in the manner of thirteen makers, some of them dirty, become drives that live.

Each is enabled, moved in vl, pp, pv and csp as far as it has them, and homed, as emulated drives; and over a bus by our
own master, which knows the vendor's EDS alone, and by python-canopen, which knows the EDS of the folder; stored, and
exported as a DCF. By default one of each maker as emulated drives, and over the bus a few.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
import time
import uuid
from contextlib import contextmanager

import canopen
import numpy as np
import pytest
from canopen.objectdictionary import ODVariable
from rigs.canopen_wire import Wire
from rigs.makers import files
from rigs.pump import NODE, PATIENCE, BootUps, Pump, until
from rigs.small_eds import FOLDER, entry, put
from rigs.world_bus import bus_of
from typer.testing import CliRunner

from drive_env import CanDrives, EmulatedDrives, cia402, motion
from drive_env.canopen.frames import Frame
from drive_env.commands.cli import app
from drive_env.devices import find_device
from drive_env.devices.gains import check_linear_model
from drive_env.devices.new_device import new_device
from drive_env.dictionary.access import ObjectAccessError
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import read_current_limit, to_counts, write_current_limit
from drive_env.drives.speeds import per_increment
from drive_env.fieldbus.description import describe
from drive_env.master.commissioned_eds import commissioned_eds, commissioned_values
from drive_env.motors import find_motor
from tuning import target
from tuning.commands.cli import app as tune
from tuning.identify.identification import identify
from tuning.response.frequency_response import measure

FILES = files()
# rpm; scaled counts, 6060h write-only; two axes; PDOs that can only be read; a DCF
ON_THE_BUS = ("alpina_ax40", "cascade_cm3_dirty", "fjord_ft3_dirty", "jura_1", "kymi_1")
FIRST = {name.split("_")[0]: name for name in reversed(FILES)}.values()


def some(names):
    """All files, of which these are in each run."""
    return [name if name in names else pytest.param(name, marks=pytest.mark.slow) for name in FILES]


MOTOR = "qbl4208"


class Folders(dict):
    """Devices, made at the first look, and what was told of each."""

    def __init__(self, home):
        super().__init__()
        self._home = home

    def source(self, name):
        """The maker's file."""
        path = self._home / f"{name}.eds"
        path.write_bytes(FILES[name])
        return path

    def __missing__(self, name):
        self[name] = made = new_device(self.source(name), self._home / name, find_motor(MOTOR))
        return made


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The devices of all files, and what was told of each."""
    return Folders(tmp_path_factory.mktemp("devices"))


def emulated(device, **options):
    return EmulatedDrives(
        device, "inertia", MOTOR, num_machines=find_device(device).num_axes, num_threads=1, seed=2, **options
    )


def live(drives, turn, counts, modes):
    """Enable, vl, pp, pv, csp, homing, in the modes that it has; `turn` [inc] and `counts` as `facts_of` has them.

    Set-points of csp go by SDO where no RPDO brings 607Ah alone.
    """
    if cia402.VL in modes:
        motion.enable(drives, mode="vl")
        motion.turn(drives, 300)
        drives.advance(0.5)
        np.testing.assert_allclose(drives.read(0x6044), 300, rtol=0.05)
        motion.turn(drives, 0)
        drives.advance(0.5)
    if cia402.PP in modes:
        far = round(1.5 * turn)
        motion.enable(drives, mode="pp")
        here = drives.read(0x6064)
        motion.move_to(drives, here + far)
        went = drives.read(0x6064) - here
        assert np.all(np.abs(went - far) < turn / 50), went
    if cia402.PV in modes:
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, np.rint(2.0 * turn * counts).astype(int))
        drives.advance(0.4)
        before = drives.read(0x6064)
        drives.advance(0.2)
        speed = (drives.read(0x6064) - before) / 0.2
        np.testing.assert_allclose(speed, 2.0 * turn, rtol=0.05)
        np.testing.assert_allclose(drives.read(0x606C) / counts, 2.0 * turn, rtol=0.25)
        drives.write(0x60FF, 0)
        drives.advance(0.3)
    if cia402.CSP in modes:
        motion.enable(drives, mode="csp")
        start = drives.read(0x6064)
        way = (0.5 * turn * np.linspace(0.0, 1.0, 250) ** 2).astype(int)
        try:
            drives.record([0x6041], 0.25, play={0x607A: start + way[:, None]})
        except ObjectAccessError as error:
            assert "can only be read" in str(error)
            for row in way[9::10]:
                drives.write(0x607A, start + row)
                drives.advance(0.01)
        drives.advance(0.3)
        np.testing.assert_allclose(drives.read(0x6064) - start, 0.5 * turn, atol=turn / 20)
    if cia402.HM in modes:
        drives.write(0x6098, 35)
        motion.home(drives)
        assert np.all(np.abs(drives.read(0x6064)) < turn / 50)
    motion.disable(drives)
    assert drives.emergencies() == []


def facts_of(device):
    """Return a revolution [inc], counts of 606Ch of one inc/s, 0 without a position, and the modes."""
    known = find_device(device)
    modes = known.allowed_values[0x6060, 0]
    if not known.new_dictionary().has(0x6064):
        return 0, 0.0, modes
    with emulated(device) as drives:
        turn, counts = int(drives.read(Role.POSITION_SCALE)[0]), float(np.min(per_increment(drives, 0x606C)))
    return turn, counts, modes


@pytest.mark.every(9)
@pytest.mark.parametrize("name", some(FIRST))
def test_each_becomes_a_drive_that_lives(folders, name):
    folder = str(folders[name].folder)
    facts = facts_of(folder)
    with emulated(folder) as drives:
        live(drives, *facts)
        for entry_ in drives.device.new_dictionary():
            if entry_.access != "wo" and entry_.bits is not None:
                value = drives.read((entry_.index, entry_.sub))
                assert np.all((entry_.low <= value) & (value <= entry_.high)) or entry_.access == "const", entry_.label
    assert find_device(folder).num_axes == (2 if "fjord" in name else 1)
    check_linear_model(find_device(folder))  # identification, rules and agents know its loops


@pytest.mark.slow
@pytest.mark.parametrize("name", ["jura_1", "helvia_1"])
def test_it_is_identified_and_tuned_as_a_drive_of_ours(folders, name):
    known = ("--device", str(folders[name].folder), "--load", "inertia")
    found = CliRunner().invoke(tune, ["rules", *known, "--json"])
    assert found.exit_code == 0, found.output
    assert json.loads(found.stdout)[0]["axis"] == 0
    steps = [part for step in ("motor", "wiring", "current") for part in ("--step", step)]
    found = CliRunner().invoke(
        tune, ["commission", *known, *steps, "--yes", "--out", str(folders[name].folder.parent / f"path_{name}")]
    )
    assert found.exit_code == 0 and "Current loop done" in found.output, found.output


@pytest.mark.parametrize(
    ("name", "lacks"),
    [("everest_ed1", "no cst"), ("lotus_2", "no csp, no csv, no cst"), ("cascade_cm2", "no 6065h:00"),
     ("granit_fu3", "no pp, no csp, no csv, no cst")],
)  # fmt: skip
def test_what_it_lacks_to_be_identified_is_named_before_anything_moves(folders, tmp_path, monkeypatch, name, lacks):
    known, told = str(folders[name].folder), f"this drive has {lacks}, by which its loops are measured"
    monkeypatch.chdir(tmp_path)
    for command in ("auto", "auto --by rule", "auto --by tpe", "auto --dry-run", "identify", "rules"):
        refused = CliRunner().invoke(tune, [*command.split(), "--device", known, "--load", "inertia"])
        assert refused.exit_code == 2 and told in refused.stderr, refused.output
    assert not any(tmp_path.iterdir())
    if find_device(known).new_dictionary().has(0x6064):
        with target.emulated(known, "inertia") as axis:
            with pytest.raises(ValueError, match=told):
                identify(axis)
            assert axis.drives.read(0x6041)[0] & 0x6F == 0x40  # never enabled


def test_a_response_needs_the_mode_of_its_loop_alone(folders):
    lotus, everest = (str(folders[name].folder) for name in ("lotus_2", "everest_ed1"))
    for loop, mode in (("velocity", "csv"), ("position", "csp")):
        refused = CliRunner().invoke(tune, ["response", loop, "--device", lotus])
        assert refused.exit_code == 2 and f"has no {mode}, by which" in refused.stderr, refused.output
    with target.emulated(everest, "inertia") as axis:  # without cst
        assert measure(axis, "velocity").fits[0] is not None


@contextmanager
def on_a_bus(folder):
    """A bus in lockstep with an emulated drive of a folder as node 5, and options of a master's."""
    with bus_of(emulated(folder), (NODE,)) as bus:
        yield {"bus": bus, "nodes": (NODE,), "pace": "lockstep"}


@pytest.mark.every(10)
@pytest.mark.parametrize("name", some(ON_THE_BUS))
def test_our_master_moves_it_by_the_vendors_eds(folders, name):
    folder = str(folders[name].folder)
    facts = facts_of(folder)
    turn = facts[0]
    with on_a_bus(folder) as options:
        with CanDrives(eds=folders.source(name), safety=False, **options) as drives:
            live(drives, *facts)
        if cia402.PP not in facts[2]:
            return
        with CanDrives(folder, **options) as drives:  # by the folder, and with limits
            motion.enable(drives, mode="pp")
            motion.move_to(drives, turn // 2)
            assert np.all(np.abs(drives.read(0x6064) - turn // 2) < turn / 50)


@pytest.mark.every(6)
@pytest.mark.parametrize("name", some(ON_THE_BUS))
def test_what_is_stored_stays_and_a_dcf_makes_the_same_drive(folders, tmp_path, name):
    folder = folders[name].folder
    known = find_device(str(folder))
    with on_a_bus(str(folder)) as options, CanDrives(str(folder), safety=False, **options) as drives:
        has_store = known.new_dictionary().has((0x1010, 1))
        ways = ((0x6081, 0x6084), ((0x6048, 1), (0x6049, 1)), (0x604F, 0x6050))
        two = next(both for both in ways if known.new_dictionary().has(both[0]))
        was = {key: int(drives.read(key)[0]) for key in two}
        factory = [known.new_dictionary().find(key).default for key in was]
        for key, raw in was.items():
            drives.write(key, raw + 3 + np.arange(drives.num_axes))  # another value of each axis
        if has_store:
            drives.write((0x1010, 1), 0x65766173)
        drives.reset_node()
        assert {key: int(drives.read(key)[0]) - raw for key, raw in was.items()} == dict.fromkeys(was, 3 * has_store)
        values = commissioned_values(drives)
        if has_store and known.new_dictionary().has((0x1011, 1)):
            drives.write((0x1011, 1), 0x64616F6C)
            drives.reset_node()
            assert [drives.read(key)[0] for key in was] == factory
    path = tmp_path / "node5.dcf"
    path.write_text(commissioned_eds(known.eds, values, path.name, node_id=NODE), encoding="utf-8")
    read = canopen.import_od(str(path))
    for (index, sub), value in values.items():
        item = read[index]
        assert (item if isinstance(item, ODVariable) else item[sub]).value == value, f"{index:04X}h:{sub:02X}"
    again = new_device(path, tmp_path / "again", find_motor(MOTOR))
    with on_a_bus(str(again.folder)) as options, CanDrives(str(again.folder), safety=False, **options) as drives:
        assert commissioned_values(drives) == values


def command(node, word, mask, value):
    """Write a controlword and wait for a statusword."""
    node.sdo[0x6040].raw = word
    until(lambda: node.sdo[0x6041].raw & mask == value)


def select(node, mode):
    node.sdo[0x6060].raw = mode
    until(lambda: node.sdo[0x6061].raw == mode)


@pytest.mark.every(6)
@pytest.mark.parametrize("name", some(ON_THE_BUS))
def test_python_canopen_moves_it(folders, name):
    folder = folders[name].folder
    facts = facts_of(str(folder))
    where = {"interface": "virtual", "channel": str(uuid.uuid4())}
    with emulated(str(folder)) as drives:
        pump = Pump(drives, **where)
        network = canopen.Network()
        network.connect(**where)
        try:
            node = canopen.RemoteNode(NODE, str(folder / "drive.eds"))
            network.add_node(node)
            node.sdo.RESPONSE_TIMEOUT = PATIENCE
            heard = BootUps(network)
            pump.power_on()
            heard.wait()
            drive_by_sdo(node, *facts)
        finally:
            network.disconnect()
            pump.close()


def drive_by_sdo(node, turn, counts, modes):
    """The same life as `live`, by an independent master and in real time, of the node's first axis."""
    sdo = node.sdo
    select(node, next(mode for mode in modes if mode))
    command(node, 0x06, 0x6F, 0x21)
    command(node, 0x07, 0x6F, 0x23)
    command(node, 0x0F, 0x6F, 0x27)
    if cia402.VL in modes:
        select(node, 2)
        sdo[0x6042].raw = 300
        sdo[0x6040].raw = 0x7F
        until(lambda: abs(sdo[0x6044].raw - 300) < 15)
        sdo[0x6042].raw = 0
        until(lambda: abs(sdo[0x6044].raw) < 15)
        sdo[0x6040].raw = 0x0F
    if cia402.PP in modes:
        select(node, 1)
        sdo[0x607A].raw = turn
        command(node, 0x1F, 0x1000, 0x1000)
        command(node, 0x0F, 0x1400, 0x0400)
        assert abs(sdo[0x6064].raw - turn) < turn / 50
    if cia402.PV in modes:
        select(node, 3)
        sdo[0x60FF].raw = round(2.0 * turn * counts)
        until(lambda: abs(sdo[0x606C].raw / counts / turn - 2.0) < 0.3)
        sdo[0x60FF].raw = 0
        until(lambda: sdo[0x6041].raw & 0x0400)
    if cia402.CSP in modes:
        select(node, 8)
        start = sdo[0x6064].raw
        for step in range(1, 11):
            sdo[0x607A].raw = start + step * turn // 100
        until(lambda: abs(sdo[0x6064].raw - start - turn // 10) < turn / 50)
    if cia402.HM in modes:
        select(node, 6)
        sdo[0x6098].raw = 35
        command(node, 0x1F, 0x1400, 0x1400)
        assert abs(sdo[0x6064].raw) < turn / 50
    command(node, 0x00, 0x4F, 0x40)
    if 0x1010 in sdo:
        sdo[0x1010][1].raw = 0x65766173


# --- what is taken from the file --------------------------------------------------------------------------------------
@pytest.mark.every(5)
@pytest.mark.parametrize(
    ("name", "units", "scale"),
    [
        ("alpina_ax40", ("rpm", "rpm/s", "1/1000 rated"), 4096),  # 60A9h, 60AAh; the scale is the encoder's
        ("brandt_bs7", ("pps", "pps^2", "1/1000 rated"), 3600),  # 6092h over 6091h
        ("brandt_bs8_dirty", ("pps", "pps^2", "1/1000 rated"), 4096),  # 6092h has lost a part: 608Fh
        ("cascade_cm2", ("0.1 pps", "10 pps^2", "1/1000 rated"), 4096),
        ("deltron_dl751_dirty", ("rpm", "rpm/s", "1/1000 rated"), 10000),
        ("fjord_ft3_dirty", ("pps", "pps^2", "1/1000 rated"), 8192),
    ],
)
def test_its_units_are_the_files(folders, name, units, scale):
    folder = str(folders[name].folder)
    bindings = find_device(folder).bindings
    assert tuple(bindings[index, 0].unit for index in (0x606C, 0x6083, 0x6077)) == units
    assert facts_of(folder)[0] == scale


def test_a_gear_that_is_written_changes_what_a_position_is(folders):
    with emulated(str(folders["brandt_bs7"].folder)) as drives:
        drives.write((0x6091, 1), 4)
        assert drives.read(Role.POSITION_SCALE)[0] == 1800
        with pytest.raises(ObjectAccessError, match="its lowest is 1"):
            drives.write((0x6091, 2), 0)


def test_thousandths_are_of_the_motors_rated_current(folders):
    """3.5 A peak are 1000: a set-point of 300 in cst is 1.05 A."""
    with emulated(str(folders["alpina_ax40"].folder), ideal=True) as drives:
        drives.machine.brake = "closed"
        motion.enable(drives, mode="cst")
        drives.record([0x6077], 0.05, play={0x6071: np.full(50, 300)})
        assert drives.inside.records["i_q"][0][0] == pytest.approx(1.05, abs=0.05)
        assert drives.read(0x6077)[0] == pytest.approx(300, abs=15)
        assert drives.read(0x6073)[0] == 2000  # twice the rated current, as every preset
        assert read_current_limit(drives)[0] == pytest.approx(7.0) and to_counts(drives, 1.05)[()] == 300
        write_current_limit(drives, 1.75)
        assert drives.read(0x6073)[0] == 500


@pytest.mark.parametrize(
    ("name", "modes", "methods"),
    [
        ("alpina_ax40", (0, 1, 3, 6, 8, 9, 10), (0, 17, 18, 33, 35)),  # 60E3h
        ("everest_ed1", (0, 1, 3, 6, 8, 9), None),
    ],
)
def test_modes_and_homing_are_what_both_have(folders, name, modes, methods):
    device = find_device(str(folders[name].folder))
    assert device.allowed_values[0x6060, 0] == modes
    with emulated(device.name) as drives:
        assert drives.read(0x6502)[0] == sum(1 << mode - 1 for mode in modes if mode)
        with pytest.raises(ObjectAccessError, match="cannot be 2; allowed are"):
            drives.write(0x6060, 2)
        if methods is not None:
            assert device.allowed_values[0x6098, 0] == methods
            with pytest.raises(ObjectAccessError, match="cannot be -4"):
                drives.write(0x6098, -4)
            told = {note.what: note.why for note in folders[name].modes}
            assert told["homing method -4"].startswith("60E3h has it, and the emulator does not: negative numbers are")


# By the index to the right of the left edge, where a turn of the motor begins; to the edges, where they become active.
@pytest.mark.every(3)
@pytest.mark.parametrize(("method", "home"), [(4, -0.04), (24, -0.06), (28, -0.02)])
def test_methods_of_the_standard_home_it_at_real_switches(folders, method, home):
    """A carriage on a belt, by a drive whose EDS lists no methods: the home switch is from -0.06 to -0.02 m."""
    with EmulatedDrives(str(folders["everest_ed1"].folder), "belt", MOTOR, num_threads=1, ideal=True) as drives:
        assert set(drives.device.allowed_values[0x6098, 0]) == {0, *range(1, 15), *range(17, 31), 33, 34, 35, 37}
        metre = int(drives.read(Role.POSITION_SCALE)[0]) / 0.04
        counts = float(np.min(per_increment(drives, 0x60FF)))
        drives.write((0x6099, 1), round(0.1 * metre * counts))
        drives.write((0x6099, 2), round(0.02 * metre * counts))
        drives.write(0x6098, method)
        motion.home(drives, timeout=12.0)
        carriage = float(drives.inside.records["load_position"][0][0])
        assert carriage - int(drives.read(0x6064)[0]) / metre == pytest.approx(home, abs=1e-4)
        assert carriage == pytest.approx(home, abs=1e-3)


@pytest.mark.every(3)
@pytest.mark.parametrize("method", [33, 34, 35, 37])
@pytest.mark.parametrize("offset", [1000, -250])
def test_zero_is_at_home_plus_607ch_in_methods_without_a_switch_too(folders, method, offset):
    """CiA 402-2: home has the position -607Ch. An index is at each whole turn since power-on; 35 and 37 are here."""
    with emulated(str(folders["everest_ed1"].folder), ideal=True) as drives:
        turn, counts = int(drives.read(Role.POSITION_SCALE)[0]), float(np.min(per_increment(drives, 0x60FF)))
        motion.enable(drives, "pp")
        motion.move_to(drives, turn // 3)
        for name, value in ((0x6098, method), (0x607C, offset), ((0x6099, 2), round(0.5 * turn * counts))):
            drives.write(name, value)
        before = drives.inside.records["theta_m"][0][0] / (2 * math.pi)
        motion.home(drives)
        drives.advance(0.2)
        turns = drives.inside.records["theta_m"][0][0] / (2 * math.pi)
        assert turns == pytest.approx({33: 0.0, 34: 1.0}.get(method, before), abs=0.01)
        assert drives.read(0x6062)[0] == -offset
        assert drives.read(0x6064)[0] == pytest.approx(-offset, abs=turn / 100)


def test_an_object_that_is_lacking_is_no_role_and_is_not_made(folders):
    device = find_device(str(folders["cascade_cm2"].folder))
    assert Role.OUTPUTS not in device.roles and Role.BRAKE_CHOPPER not in device.roles
    known = device.new_dictionary()
    assert not known.has(0x6065) and not known.has(0x6073)
    assert device.roles[Role.CURRENT_LIMIT] == (0x5F02, 2)  # the emulator's own, and the list says so
    told = {note.what: note.why for note in folders["cascade_cm2"].fill_in}
    assert "no 6073h" in told["5F02:2 Current limit"]


def test_what_has_no_effect_is_stored_and_listed(folders):
    made = folders["alpina_ax40"]
    told = {note.what: note.why for note in made.without_effect}
    assert told["6080h"] == "no speed is limited by it"
    assert {"2200h", "3000h", "3010h", "6402h"} <= told.keys()
    assert not {"6040h", "607Ah", "6502h", "5F00h", "1017h"} & told.keys()
    with emulated(str(made.folder)) as drives:
        drives.write(0x6080, 1234)
        assert drives.read(0x6080)[0] == 1234
        drives.write((0x3010, 1), 2048)
        assert drives.read((0x3010, 1))[0] == 2048
        with pytest.raises(ObjectAccessError, match="can only be read"):
            drives.write(0x2200, 1)
    text = (made.folder / "to_fill_in.md").read_text(encoding="utf-8")
    assert text == made.text() and "- 6080h: no speed is limited by it" in text


def test_process_data_that_a_node_could_not_start_with_are_put_right(folders):
    told = {note.what: note.why for note in folders["deltron_dl751_dirty"].repairs}
    assert told["[1602]"] == "607Bh:00 does not exist: nothing is mapped"
    assert told["[1401sub1]"] == told["[1801sub1]"] == "has no COB-ID: that of the predefined connection set"
    known = find_device(str(folders["deltron_dl751_dirty"].folder)).new_dictionary(5)
    assert known.find((0x1602, 0)).default == 0
    assert known.find((0x1601, 0)).default == 2
    assert (known.find((0x1401, 1)).default, known.find((0x1801, 1)).default) == (0x305, 0x285)


def test_texts_and_floats_are_served_as_they_are(folders):
    folder = folders["everest_ed1"].folder
    where = {"interface": "virtual", "channel": str(uuid.uuid4())}
    with emulated(str(folder)) as drives:
        pump, network = Pump(drives, **where), canopen.Network()
        network.connect(**where)
        try:
            node = canopen.RemoteNode(NODE, str(folder / "drive.eds"))
            network.add_node(node)
            node.sdo.RESPONSE_TIMEOUT = PATIENCE
            heard = BootUps(network)
            pump.power_on()
            heard.wait()
            assert node.sdo[0x2000].raw == 25.5
            assert node.sdo[0x2001].raw == "E-0001"
            assert node.sdo[0x2002].raw == 0
            assert node.sdo[0x2100][6].raw == 0
            assert node.sdo[0x2003].raw == 7
        finally:
            network.disconnect()
            pump.close()


# --- what a file tells in another way, or not at all ------------------------------------------------------------------
def without(text, *indices):
    """Return an EDS without objects."""
    return re.sub(rf"(?m)^\[({'|'.join(indices)})(sub\w+)?\]\n(?:(?!\[).*\n?)*", "", text)


def made_of(tmp_path, text, **options):
    """Return what became of a changed EDS, and the notes of what to fill in."""
    path = tmp_path / "vendor.eds"
    path.write_text(text, encoding="utf-8")
    made = new_device(path, tmp_path / "device", find_motor(MOTOR), **options)
    return made, {note.what: note.why for note in made.fill_in}


BASE = (FOLDER / "alpina_ax40.eds").read_text(encoding="utf-8")  # 6091h, 60A8h to 60AAh; no 608Fh, no 6092h
FEED_36000 = (
    entry("6092", "Feed constant", kind="0x8", data_type=None, access=None, SubNumber=3)
    + entry("6092sub0", "Entries", data_type="0x5", access="ro", DefaultValue=2)
    + entry("6092sub1", "Feed", DefaultValue=36000)
    + entry("6092sub2", "Revolutions", DefaultValue=1)
)


RESOLUTION = FEED_36000.replace("6092", "608F").replace("36000", "1")


def units_of(made):
    bindings = find_device(str(made.folder)).bindings
    return bindings[0x606C, 0].unit, bindings[0x6083, 0].unit


def test_a_drive_without_1005h_is_served_and_takes_sync_as_080h(tmp_path):
    made, told = made_of(tmp_path, without(BASE, "1005"))
    assert told["1005h"] == "the EDS has none: SYNC is taken as 080h, as CiA 301 has it"
    folder = str(made.folder)
    with on_a_bus(folder) as options, CanDrives(folder, safety=False, **options) as drives:
        motion.enable(drives, mode="csp")
        here = drives.read(0x6064)
        way = (1000 * np.linspace(0.0, 1.0, 200)).astype(int)
        drives.record([0x6064], 0.2, play={0x607A: here + way[:, None]})
        drives.advance(0.3)
        assert np.all(np.abs(drives.read(0x6064) - here - 1000) < 100)


@pytest.mark.every(3)
@pytest.mark.parametrize(
    ("position", "velocity", "acceleration", "feed", "scale", "units"),
    [
        ("0xFE410000", "0xFF410300", "0xFE415700", True, 36000, ("10 pps", "pps^2")),  # 0.01 deg, 0.1 deg/s
        ("0xFE410000", "0xFE410300", "0xFE415700", False, 36000, ("pps", "pps^2")),  # 60A8h alone
        ("0x00B50000", "0x00414700", "0x00415700", False, 4096, ("0.00277777777778 rpm", "0.166666666667 rpm/s")),
        ("0xFD100000", "0xFD100300", "0xFD105700", False, 6283, ("pps", "pps^2")),  # milliradians
        ("0xFDB40000", "0xFFB40300", "0x00B45700", False, 1000, ("6 rpm", "60 rpm/s")),  # 0.001 revolutions
        ("0x00B50000", "0x01B54700", "0x03B55700", False, 4096, ("0.166666666667 pps", "1000 pps^2")),
        ("0xFA010000", "0xFD010300", "0xFD015700", True, 36000, ("1000 pps", "1000 pps^2")),  # um, mm/s
    ],
)
def test_units_by_their_codes(tmp_path, position, velocity, acceleration, feed, scale, units):
    text = without(BASE, "6091") + (FEED_36000 if feed else "")
    for index, code in (("60A8", position), ("60A9", velocity), ("60AA", acceleration)):
        text = put(text, index, DefaultValue=code)
    made, told = made_of(tmp_path, text)
    assert units_of(made) == units
    assert facts_of(str(made.folder))[0] == scale
    assert not any(what.startswith(("unit of velocity", "unit of acceleration")) for what in told)
    if units[0].endswith("pps"):  # what was read is what the axis does: 72 degrees a second
        with emulated(str(made.folder), ideal=True) as drives:
            motion.enable(drives, mode="pv")
            number = float(units[0].removesuffix("pps") or 1.0)
            drives.write(0x60FF, round(0.2 * scale / number))
            drives.advance(0.5)
            assert drives.machine.rotor_speed[0] == pytest.approx(0.4 * math.pi, rel=0.05)


def test_a_unit_beside_an_object_may_be_an_angle(tmp_path):
    text = put(put(without(BASE, "60A9", "60AA"), "606C", Unit="0.1 deg/s"), "6083", Unit="rad/s^2")
    made, told = made_of(tmp_path, text)
    assert units_of(made) == ("0.0166666666667 rpm", "9.54929658551 rpm/s")
    assert not any(what.startswith(("unit of velocity", "unit of acceleration")) for what in told)


def test_a_code_that_is_not_known_is_told(tmp_path):
    text = put(put(BASE, "60A9", DefaultValue="0xFD220300"), "60A8", DefaultValue="0xFD010000")
    _, told = made_of(tmp_path, text)
    assert told["60A9h"] == "FD220300h is a code of CiA 303-2 that is not known here"
    assert told["60A8h"] == "FD010000h is no angle: how many of it a turn has only 6092h tells"
    assert any(what.startswith("unit of velocity") for what in told)
    assert "a gear changes nothing" in told["6091h"]


def test_a_resolution_that_no_position_could_be_held_by_is_told_and_not_taken(tmp_path):
    made, told = made_of(tmp_path, BASE + RESOLUTION)
    assert told["608Fh"] == "1 : 1 is not taken: a position cannot be held by fewer than 100 units a turn"
    with emulated(str(made.folder)) as drives:
        assert drives.read(Role.POSITION_SCALE)[0] == 4096
        motion.enable(drives, mode="pp")
        motion.move_to(drives, 4096)
        assert abs(drives.read(0x6064)[0] - 4096) < 82


@pytest.mark.filterwarnings("error")
def test_every_object_is_read_before_commissioning(tmp_path):
    """Without a scale in the file, what is in increments was divided by 0 increments of a revolution."""
    made, _ = made_of(tmp_path, BASE)
    with emulated(str(made.folder), commissioned=False) as drives:
        assert drives.read(Role.POSITION_SCALE)[0] == find_motor(MOTOR).encoder_counts
        for entry in drives.inside.objects.entries:
            if "r" in entry.access:
                drives.read((entry.index, entry.sub))


@pytest.mark.every(3)
@pytest.mark.parametrize("factory", [(4096, 0), (0, 1), (0, 0), (0, 5), (4294967295, 0)])
@pytest.mark.filterwarnings("error")
def test_a_resolution_with_a_0_is_that_of_the_motor_s_encoder(tmp_path, factory):
    """With factory values the drive divided by its 0 revolutions."""
    text = BASE + RESOLUTION
    for sub, value in enumerate(factory, 1):
        text = put(text, f"608Fsub{sub}", DefaultValue=value, LowLimit="0")
    made, told = made_of(tmp_path, text)
    assert told["608Fh"] == "has no factory value: the counts of the motor's encoder"
    assert "makes no scale of positions: it is " in made.text()
    with emulated(str(made.folder)) as drives:
        assert drives.read(Role.POSITION_SCALE)[0] == find_motor(MOTOR).encoder_counts
        for sub in (1, 2):
            with pytest.raises(ObjectAccessError):
                drives.write((0x608F, sub), 0)
    with emulated(str(made.folder), commissioned=False) as drives:
        assert drives.read(Role.POSITION_SCALE)[0] == find_motor(MOTOR).encoder_counts


@pytest.mark.parametrize(
    ("changes", "object_", "ratio"),
    [({"6091sub1": 1, "6091sub2": 4294967295}, "6092h over 6091h", "154618822620000 : 1"),
     ({"6092sub1": 4294967295}, "6092h over 6091h", "4294967295 : 1"),
     ({"60A8": "0xF7410000"}, "60A8h", "3.6e+11 : 1")],
)  # fmt: skip
def test_a_scale_of_which_32_bits_hold_no_8_turns_is_told_and_not_taken(tmp_path, changes, object_, ratio):
    """With 6091h of 1 : 4294967295 an axis never moved, and nothing said why."""
    text = BASE + ("" if "60A8" in changes else FEED_36000)
    for section, value in changes.items():
        text = put(text, section, DefaultValue=value)
    made, told = made_of(tmp_path, text)
    assert (
        told[object_]
        == f"{ratio} is not taken: positions of 32 bits hold fewer than 8 turns of more than 268435456 units"
    )
    with emulated(str(made.folder)) as drives:
        motion.enable(drives, mode="pp")
        motion.move_to(drives, 4096)
        assert abs(drives.read(0x6064)[0] - 4096) < 82


@pytest.mark.parametrize(
    ("text", "changes", "told"),
    [(put(BASE + RESOLUTION, "608Fsub1", DefaultValue=4096), {"608Fsub2": 0},
      "608Fh:01 Feed constant.Feed = 4096, 608Fh:02 Feed constant.Revolutions = 0 make inf units"),
     (BASE + FEED_36000, {"6091sub1": 1, "6091sub2": 4294967295}, "= 4294967295 make 1.54619e+14 units"),
     (BASE + FEED_36000, {"6092sub1": 0, "6092sub2": 0}, "= 1 make nan units")],
    ids=["608Fh:02 = 0", "6091h 1/max", "6092h 0/0"],
)  # fmt: skip
def test_a_folder_whose_factory_values_make_no_scale_is_refused(tmp_path, text, changes, told):
    """Folders from before `drive-env new` looked for it: positions of -2^63, and axes that never moved."""
    eds = made_of(tmp_path, text)[0].folder / "drive.eds"
    content = eds.read_text()
    for section, value in changes.items():
        content = put(content, section, DefaultValue=value)
    eds.write_text(content)
    with pytest.raises(ValueError, match=r"100 to 268435456 are possible; correct their DefaultValue") as refused:
        find_device(str(eds.parent))
    assert str(refused.value).startswith(f"{eds}: the factory values of ") and told in str(refused.value)


def test_a_folder_that_found_no_room_can_be_made_again(tmp_path, monkeypatch):
    """The empty folder that stayed was refused: "exists already"."""
    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(errno.ENOSPC, "No space left on device")))
        with pytest.raises(OSError, match="No space left"):
            made_of(tmp_path, BASE)
    assert made_of(tmp_path, BASE)[0].folder.is_dir()


INTERPOLATION = (
    entry("60C1", "Interpolation data", kind="0x8", data_type=None, access=None, SubNumber=2)
    + entry("60C1sub0", "Entries", data_type="0x5", access="ro", DefaultValue=1)
    + entry("60C1sub1", "Position", data_type="0x4", DefaultValue=0, PDOMapping=1)
)


def test_ip_follows_60c1h_and_is_refused_without_it(tmp_path):
    text = put(without(BASE, "60C1"), "6502", DefaultValue="0x000000EB")
    (tmp_path / "a").mkdir()
    made, _ = made_of(tmp_path / "a", text)
    assert cia402.IP not in find_device(str(made.folder)).allowed_values[0x6060, 0]
    assert any(note.what == "mode 7, ip" and "no 60C1h:01" in note.why for note in made.modes)
    made, _ = made_of(tmp_path, text + INTERPOLATION)
    assert any(note.what == "ip" for note in made.modes)
    with emulated(str(made.folder)) as drives:
        motion.enable(drives, mode="ip")
        here = drives.read(0x6064)
        way = 10 * np.arange(300)
        drives.record([0x6064], 0.3, play={(0x60C1, 1): here + way[:, None]})
        drives.advance(0.3)
        assert abs(int((drives.read(0x6064) - here)[0]) - way[-1]) < 82
        assert "60C1h" not in {note.what for note in made.without_effect}


def test_a_mode_without_its_target_is_told_and_refused(tmp_path):
    made, _ = made_of(tmp_path, without(BASE, "60FF"))
    assert not {cia402.PV, cia402.CSV} & set(find_device(str(made.folder)).allowed_values[0x6060, 0])
    told = {note.what: note.why for note in made.modes}
    assert "no 60FFh:00" in told["mode 3, pv"] and "no 60FFh:00" in told["mode 9, csv"]


def test_a_drive_without_a_position_window_has_arrived_when_it_has(tmp_path):
    made, told = made_of(tmp_path, without(BASE, "6067", "6068"))
    assert any("no 6067h" in why for why in told.values())
    with emulated(str(made.folder)) as drives:
        motion.enable(drives, mode="pp")
        motion.move_to(drives, 6144)
        assert abs(drives.read(0x6064)[0] - 6144) < 41  # a hundredth of a turn


def test_a_mapping_with_a_dummy_can_be_written_back(tmp_path):
    text = put(put(BASE, "1600sub0", DefaultValue=3), "1600sub2", DefaultValue="0x00050008")
    text = put(text, "1600sub3", DefaultValue="0x607A0020")
    text = without(text, "DummyUsage") + "[DummyUsage]\nDummy0005=1\nDummy0006=0\n\n"
    made, _ = made_of(tmp_path, text)
    with emulated(str(made.folder)) as drives:
        wire = Wire(drives, NODE)
        mapping = [wire.value(0x1600, sub) for sub in range(4)]
        assert mapping[0] == 3 and mapping[2] == 0x00050008
        cob_id = wire.value(0x1400, 1)
        assert wire.download(0x1400, 1, cob_id | 0x80000000, 4) == 0
        assert wire.download(0x1600, 0, 0, 1) == 0
        assert wire.download(0x1600, 2, 0x00060010, 4) == 0x06020000  # which the EDS does not allow
        assert wire.download(0x1600, 2, 0x00050010, 4) == 0x06040041  # of another length
        for sub in (1, 2, 3):
            assert wire.download(0x1600, sub, mapping[sub], 4) == 0
        assert wire.download(0x1600, 0, 3, 1) == 0
        assert wire.download(0x1400, 1, cob_id, 4) == 0
        wire.start()
        wire.receive(cob_id & 0x7FF, "06 00 FF 10 27 00 00")
        wire.receive(0x80)
        wire.wait(2)
        assert (wire.value(0x6040, 0), wire.value(0x607A, 0)) == (6, 10000)
        # A frame to the master has no room to pass over.
        wire.take()
        transmit = wire.value(0x1800, 1)
        assert wire.download(0x1800, 1, transmit | 0x80000000, 4) == 0
        assert wire.download(0x1A00, 0, 0, 1) == 0
        assert wire.download(0x1A00, 1, 0x00050008, 4) == 0x06040041


def test_603fh_shows_what_holds_the_axis_in_fault(folders):
    made = folders["deltron_dl750"]
    assert "603Fh" not in {note.what for note in made.without_effect}
    with emulated(str(made.folder)) as drives:
        wire = Wire(drives, NODE)
        assert drives.read(0x603F)[0] == wire.value(0x603F, 0) == 0
        motion.enable(drives, mode="pp")
        drives.machine.supply = 5.0
        seen = drives.record([0x603F, 0x6041], 0.5)
        in_fault = (seen[0x6041][:, 0] & 0x08) != 0
        assert in_fault.any() and not in_fault.all()
        np.testing.assert_array_equal(seen[0x603F][:, 0], np.where(in_fault, 0x3220, 0))
        assert drives.read(0x603F)[0] == 0x3220
        assert wire.value(0x603F, 0) == 0x3220
        drives.machine.supply = 24.0
        drives.advance(0.5)
        motion.reset_fault(drives)
        assert drives.read(0x603F)[0] == 0


@pytest.mark.parametrize(
    ("told", "lose"),
    [
        (0x8100, lambda wire: wire.receive(0, f"02 {NODE:02X}")),
        (0x8140, lambda wire: (wire.node.bus_off(wire.now), wire.wait(1), wire.node.bus_on(wire.now))),
        (0x8130, lambda wire: (wire.receive(0x707, "05"), wire.wait(60))),
    ],
    ids=["stopped", "bus-off", "heartbeat"],
)
def test_603fh_has_the_code_of_the_emergency_that_a_lost_network_had(tmp_path, told, lose):
    """CiA 402: the code of the last error, as the emergency and 1003h have it."""
    more = entry("1016sub1", "Consumer") + entry("1029sub1", "Communication error", data_type="0x0005")
    path = tmp_path / "watching.eds"
    path.write_text((FOLDER / "deltron_dl750.eds").read_text(encoding="cp1252") + "\n" + more, encoding="cp1252")
    made = new_device(path, tmp_path / "out", find_motor(MOTOR))
    with emulated(str(made.folder)) as drives:
        wire = Wire(drives, NODE)
        assert wire.download(0x1016, 1, 0x0007_0032, 4) == 0  # node 7, 50 ms
        assert wire.download(0x1029, 1, 2, 1) == 0  # to stopped
        motion.enable(drives, mode="pp")
        wire.start()
        lose(wire)
        wire.wait(2)
        wire.node.receive(Frame(0, bytes((0x80, NODE))), wire.now)
        codes = [int.from_bytes(frame.data[:2], "little") for frame in wire.take() if frame.can_id == 0x80 + NODE]
        assert codes in ([told], []), "a heartbeat's was told before"
        assert wire.value(0x603F, 0) == drives.read(0x603F)[0] == told


# --- objects of the standard with sub-objects -------------------------------------------------------------------------
WORDS = {"6040": ("0x0006", "rw"), "6041": ("0x0006", "ro"), "6060": ("0x0002", "rw")}


def with_sub_objects(tmp_path, index, sections):
    """Return an EDS in which an object is described otherwise, and the line at which it begins."""
    text = (FOLDER / "alpina_ax40.eds").read_text(encoding="cp1252")
    before = re.search(rf"\[{index}\].*?(?=\n\[)", text, re.DOTALL)[0]
    path = tmp_path / "subs.eds"
    path.write_text(text.replace(before, sections), encoding="cp1252")
    return path, text[: text.index(before)].count("\n") + 1


@pytest.mark.every(4)
@pytest.mark.parametrize("index", WORDS)
@pytest.mark.parametrize(("kind", "of_its_own"), [("0x7", True), ("0x9", True), ("0x7", False)])
def test_sub_objects_of_a_word_do_not_matter_where_sub_index_0_is_the_word(tmp_path, index, kind, of_its_own):
    """Bits that were described one by one, for instance: sub-index 0 is what CiA 402 has."""
    data_type, access = WORDS[index]
    bit = entry(f"{index}sub1", "Bit 0", data_type="0x0001", access="ro")
    if of_its_own:
        sections = entry(index, "Word", kind, data_type=None, access=None)
        sections += entry(f"{index}sub0", "Word", data_type=data_type, access=access) + bit
    else:
        sections = entry(index, "Word", kind, data_type=data_type, access=access) + bit
    path, _ = with_sub_objects(tmp_path, index, sections)
    made = new_device(path, tmp_path / "out", find_motor(MOTOR))
    told = [note.why for note in made.repairs if note.what == f"[{index}]"]
    assert any("that of sub-index 0, which was added" in why for why in told) is not of_its_own
    with emulated(str(made.folder)) as drives:
        motion.enable(drives, mode="pp")
        assert int(drives.read(0x6041)[0]) & 0x6F == 0x27


@pytest.mark.parametrize("index", WORDS)
@pytest.mark.parametrize(
    ("sub_0", "says"),
    [("Number of entries", "counts them at sub-index 0 (Number of entries, UNSIGNED8)"), (None, "has no sub-index 0")],
)
def test_a_word_at_another_sub_index_is_refused_with_its_line_and_a_remedy(tmp_path, index, sub_0, says):
    data_type, access = WORDS[index]
    sections = entry(index, "Word", "0x9", data_type=None, access=None)
    if sub_0 is not None:
        sections += entry(f"{index}sub0", sub_0, data_type="0x0005", access="ro", DefaultValue="1")
    sections += entry(f"{index}sub1", "Word", data_type=data_type, access=access)
    path, line = with_sub_objects(tmp_path, index, sections)
    with pytest.raises(ValueError, match=rf"subs\.eds, line {line}: {index}h has sub-indices 01 and ") as refused:
        new_device(path, tmp_path / "out", find_motor(MOTOR))
    assert says in str(refused.value)
    assert f"make [{index}] one object with ObjectType=0x7" in str(refused.value)
    with pytest.raises(ValueError, match=rf"line {line}: {index}h has sub-indices 01"):
        describe(None, path)  # a master's
    assert not (tmp_path / "out").exists()


# --- the command ------------------------------------------------------------------------------------------------------
def run(*line):
    return CliRunner().invoke(app, [str(word) for word in line])


def test_the_command_makes_the_folder_and_prints_the_list(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run("new", "--eds", FOLDER / "deltron_dl750.eds", "--motor", MOTOR)
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("# deltron_dl750: what its EDS does not say")
    assert "serve it: drive-env serve deltron_dl750" in done.stdout
    with EmulatedDrives("./deltron_dl750", "inertia", num_threads=1) as drives:
        assert drives.read(0x1000)[0] == 0x00020192
    again = run("new", "--eds", FOLDER / "deltron_dl750.eds")
    assert again.exit_code == 2 and "exists already, and is not overwritten" in again.stderr


def test_a_unit_that_the_eds_does_not_tell_may_be_given(tmp_path):
    out = tmp_path / "d"
    line = ["new", "--eds", FOLDER / "brandt_bs7.eds", "--out", out, "--velocity-unit", "0.1 rpm"]
    assert run(*line).exit_code == 0
    device = find_device(str(out))
    assert device.bindings[0x60FF, 0].unit == "0.1 rpm"
    assert device.bindings[0x6083, 0].unit == "rpm/s"
    with EmulatedDrives(str(out), "inertia", num_threads=1) as drives:
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, "120 rpm")
        assert drives.read(0x60FF)[0] == 1200
        drives.advance(0.5)
        assert drives.machine.rotor_speed[0] == pytest.approx(4.0 * math.pi, rel=0.02)


@pytest.mark.parametrize(
    ("text", "options", "says"),
    [
        (None, (), "there is no EDS at"),
        ("no EDS at all\n", (), "describes no CiA 402 drive: it has no statusword 6041h"),
        (entry("6041", "Statusword", data_type="0x0006"), (), "no drive that could be enabled: it has no 6040h"),
        (entry("6041", "Statusword", data_type="0x0005"), (), "CiA 402 has it with 16 bits; a drive needs an integer"),
        ("", ("--velocity-unit", "furlong"), "there is no unit 'furlong'"),
        ("", ("--motor", "none"), "no motor is named 'none'"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_told_and_leaves_nothing(tmp_path, text, options, says):
    path, out = tmp_path / "a.eds", tmp_path / "out"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    done = run("new", "--eds", path, "--out", out, *options)
    assert done.exit_code == 2, done.output
    assert says in done.stderr and not out.exists()


# --- export -----------------------------------------------------------------------------------------------------------
def test_eds_and_dcf_have_the_commissioned_values_and_python_canopen_reads_them(folders, tmp_path):
    folder = folders["alpina_ax40"].folder
    of_motor = ("--device", folder, "--motor", MOTOR)
    done = run("export", "dcf", tmp_path / "a.dcf", *of_motor, "--node", 9)
    assert done.exit_code == 2 or done.exit_code == 1  # --node means a bus, and there is none
    eds_done, dcf_done = (run("export", kind, tmp_path / f"a.{kind}", *of_motor) for kind in ("eds", "dcf"))
    assert eds_done.exit_code == dcf_done.exit_code == 0, eds_done.output + dcf_done.output
    preset = find_device(str(folder)).preset(find_motor(MOTOR))
    eds, dcf = (canopen.import_od(str(tmp_path / name), node) for name, node in (("a.eds", 7), ("a.dcf", None)))
    for name, value in preset.items():
        index, sub = int(name[:4], 16), int(name[5:])
        both = [od[index] if sub == 0 else od[index][sub] for od in (eds, dcf)]
        assert both[0].default == both[1].value == value, name
    assert eds[0x1400][1].default == 0x207  # what follows the node-ID goes on following it
    assert (dcf.node_id, dcf.bitrate, dcf[0x1400][1].value) == (1, 1_000_000, 0x201)
    assert "LastEDS=alpina_ax40.eds" in (tmp_path / "a.dcf").read_text(encoding="utf-8")  # which it was made of
    assert eds_done.stdout.endswith(f"parameters of {folder}\n")
    assert dcf_done.stdout.endswith(f"parameters of {folder}, as node 1 at 1000 kbit/s\n")
    printed = run("export", "eds", "-", "--device", folder).stdout  # as the device has it
    assert printed == find_device(str(folder)).eds.read_text(encoding="utf-8")
    assert run("export", "eds", "-", *of_motor).stdout != printed
    done = run("export", "eds", tmp_path / "b.eds", "--eds", FOLDER / "alpina_ax40.eds")
    assert done.exit_code == 2 and "is of a drive on a bus, and no bus is named" in done.stderr
    again = run("export", "eds", tmp_path / "a.eds", "--device", folder)
    assert again.exit_code == 2 and "files are not overwritten" in again.stderr
    assert run("export", "eds", tmp_path / "a.txt", "--device", folder).exit_code == 2


def test_a_drive_on_a_bus_is_exported_as_it_is(folders, tmp_path, monkeypatch):
    folder, source = str(folders["fjord_ft2"].folder), FOLDER / "fjord_ft2.eds"
    with on_a_bus(folder) as options:
        opened = lambda *_, **__: CanDrives(eds=source, safety=False, **options)  # noqa: E731
        with opened() as drives:
            drives.write(0x6081, [1111, 2222])
            values = commissioned_values(drives)
        monkeypatch.setattr("drive_env.commands.options.BusOptions.connect", opened)
        done = run("export", "eds", tmp_path / "named.eds", "--eds", source, "--node", NODE)
        assert done.stdout.endswith(f"{len(values)} parameters of {source.stem}\n"), done.output
    assert (values[0x6081, 0], values[0x6881, 0]) == (1111, 2222)
    assert (0x607A, 0) not in values and (0x6040, 0) not in values  # a set-point, a command
    path = tmp_path / "two.dcf"
    path.write_text(commissioned_eds(source, values, path.name, node_id=NODE, bit_rate=500), encoding="utf-8")
    dcf = canopen.import_od(str(path))
    assert (dcf[0x6081].value, dcf[0x6881].value, dcf.node_id, dcf.bitrate) == (1111, 2222, NODE, 500_000)
    assert dcf[0x607A].value is None


def test_making_a_device_is_quick(tmp_path):
    begun = time.process_time()
    new_device(FOLDER / "fjord_ft2.eds", tmp_path / "d", find_motor(MOTOR))
    assert time.process_time() - begun < 20.0  # a few tenths of a second; a busy computer counts its neighbours
