"""Devices on EtherCAT by an EDS or an ESI in the manner of six makers: images, identity, EEPROM, and a move in csp."""

from __future__ import annotations

import shutil
import struct
import subprocess

import numpy as np
import pytest
from rigs import TESTS
from rigs.ethercat_segment import EmulatedSegment
from rigs.namespaces import needs_namespaces, seen_by
from rigs.namespaces import spaces as spaces
from rigs.small_eds import FOLDER, put
from typer.testing import CliRunner

from drive_env import EtherCatDrives, motion
from drive_env.commands.cli import app
from drive_env.devices import find_device
from drive_env.devices.new_device import new_device
from drive_env.devices.vendor_esi import read_esi
from drive_env.ethercat.application import AlState
from drive_env.ethercat.esi import esi_text
from drive_env.ethercat.sii_content import sii_content
from drive_env.motors import find_motor

TSHARK = shutil.which("tshark")
MOTOR = "qbl4208"
ESIS = TESTS / "data" / "esi"
# EDS with images of csp, without any that move it, and of two axes without; ESI with a dictionary and images that
# exclude each other; without a dictionary; of two axes with images in parts and bits.
CASES = {
    "alpina": {"eds": FOLDER / "alpina_ax40.eds", "on_ethercat": True},
    "cascade": {"eds": FOLDER / "cascade_cm3_dirty.eds", "on_ethercat": True},
    "fjord": {"eds": FOLDER / "fjord_ft2.eds", "on_ethercat": True},
    "harbor": {"eds": None, "esi": ESIS / "harbor_hx2.xml"},
    "isar": {"eds": FOLDER / "alpina_ax40.eds", "esi": ESIS / "isar_i7.xml", "product": "I7-A"},
    "jura": {"eds": None, "esi": ESIS / "jura_j4.xml"},
}
OF_ESI = ("harbor", "isar", "jura")
LOADS = {1: "inertia", 2: "gantry"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    home = tmp_path_factory.mktemp("devices")
    return {name: new_device(folder=home / name, motor=find_motor(MOTOR), **row) for name, row in CASES.items()}


def mapped(device):
    """Return the mapping objects that are assigned in both directions, each with its entries, of the factory."""
    known = device.new_dictionary()

    def values(index):
        return [known.find((index, sub)).default for sub in range(1, known.find((index, 0)).default + 1)]

    return [{index: values(index) for index in values(assignment)} for assignment in (0x1C12, 0x1C13)]


@pytest.mark.every(12)
@pytest.mark.parametrize("name", CASES)
def test_each_reaches_op_and_follows_in_csp(made, name):
    folder = str(made[name].folder)
    axes = find_device(folder).num_axes
    with (
        EmulatedSegment(folder, load="inertia", motor=MOTOR, num_machines=axes) as segment,
        EtherCatDrives(folder, master=segment.master(), nodes=(0,), pace="lockstep") as drives,
    ):
        found = mapped(find_device(folder))
        motion.enable(drives, mode="csp")
        assert segment.slaves[0].state is AlState.OP
        start = drives.read(0x6064)
        way = np.minimum((2000 * np.linspace(0.0, 1.0, 300) ** 2).astype(int), 2000)
        trace = drives.record([0x6041, 0x6064], 0.3, {0x607A: start + way[:, None]})
        assert {int(word) & 0x6F for word in trace[0x6041][-1]} == {0x27}
        drives.record([0x6064], 0.3, {0x607A: np.repeat(start[None] + 2000, 300, 0)})
        np.testing.assert_allclose(drives.read(0x6064) - start, 2000, atol=40)
        assert drives.read(0x6061).tolist() == [8] * axes
        if name != "alpina":  # whose image lacks the velocity, by which a master watches
            assert mapped_now(segment) == found
        motion.disable(drives)
        assert drives.emergencies() == []


def mapped_now(segment):
    """Return the images that the slave has now, in the form of `mapped`."""
    image = segment.slaves[0].application._image
    return [dict(image.mapped(direction)) for direction in (0x1C12, 0x1C13)]


def test_a_master_takes_another_of_the_ready_made_images(made):
    """Harbor's csp and csv exclude each other, and none can be written."""
    folder = str(made["harbor"].folder)
    with (
        EmulatedSegment(folder, load="inertia", motor=MOTOR) as segment,
        EtherCatDrives(folder, master=segment.master(), nodes=(0,), pace="lockstep") as drives,
    ):
        drives.record([0x606C], 0.002, {0x60FF: np.zeros((2, 1), int)})
        assert list(mapped_now(segment)[0]) == [0x1601]
        motion.enable(drives, mode="csv")
        drives.record([0x606C], 0.4, {0x60FF: np.full((400, 1), 40_000)})
        before = drives.read(0x6064)
        drives.record([0x606C], 0.2, {0x60FF: np.full((200, 1), 40_000)})
        np.testing.assert_allclose((drives.read(0x6064) - before) / 0.2, 40_000, rtol=0.05)
        motion.disable(drives)


# --- images -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("name", "outputs", "inputs"), [
    ("alpina", {0x1602: [0x60400010, 0x607A0020]}, {0x1A02: [0x60410010, 0x60640020]}),
    ("cascade", {0x1604: [0x60400010, 0x60600008, 8, 0x607A0020]},
     {0x1A04: [0x60410010, 0x60610008, 8, 0x60640020, 0x606C0020, 0x60770010]}),
    ("fjord", {0x1604: [0x60400010, 0x60600008, 8, 0x607A0020, 0x68400010, 0x68600008, 8, 0x687A0020]},
     {0x1A04: [0x60410010, 0x60610008, 8, 0x60640020, 0x606C0020, 0x60770010,
               0x68410010, 0x68610008, 8, 0x68640020, 0x686C0020, 0x68770010]}),
    ("harbor", {0x1600: [0x60400010, 0x60600008, 8, 0x607A0020, 0x60B10020, 0x60B20010]},
     {0x1A00: [0x60410010, 0x60610008, 8, 0x60640020, 0x606C0020, 0x60770010],
      0x1A01: [0x60F40020, 0x60FD0020, 0x31000210]}),
    ("isar", {0x1600: [0x60400010, 0x607A0020, 0x60600008, 0x24000120]},
     {0x1A00: [0x60410010, 0x60640020, 0x60610008, 0x606C0020, 0x60770010]}),
    ("jura", {0x1600: [0x60400010, 0x60600008, 24, 0x607A0020], 0x1601: [0x60FF0020],
              0x1610: [0x68400010, 0x68600008, 24, 0x687A0020]},
     {0x1A00: [0x60410010, 0x60610008, 8, 0x60640020], 0x1A10: [0x68410010, 0x68610008, 8, 0x68640020],
      0x1A20: [1, 1, 6, 32, 0x10010008]}),
])  # fmt: skip
def test_images(made, name, outputs, inputs):
    assert mapped(find_device(str(made[name].folder))) == [outputs, inputs]


def test_what_is_told(made):
    def told(name):
        notes = (*made[name].fill_in, *made[name].repairs)
        return {note.what: note.why for note in notes}

    assert told("alpina")["1005h, 1014h, 1016h, 1017h, 1400h, 1401h, 1402h, 1403h, 1800h, 1801h, 1802h, 1803h"] == (
        "left out: of CAN, and the device is on EtherCAT"
    )
    assert (
        "carry a controlword or a cyclic target of each axis"
        in told("cascade")["1604h Outputs csp, 1605h Outputs csv, 1606h Outputs cst"]
    )
    assert told("isar")["[2400:1]"] == "is in an image and not in the dictionary: it was added"
    assert told("isar")["[1018:1]"] == "A01h, and BC2h in the ESI: BC2h"
    assert told("harbor")["Mailbox/EoE"] == "the emulator has no such protocol"
    assert "start-up" in told("harbor")["Mailbox/CoE/InitCmd"]
    jura = [(note.what, note.why) for note in made["jura"].repairs]
    assert ("[2102]", "was left out: its type 'DT_UNKNOWN' is not known here") in jura
    assert ("[1A20]", "2101h:00 is no integer of whole bytes: its 32 bits are a gap") in jura


def test_values_of_a_dictionary(made):
    """Harbor has them in bytes, lowest first, Jura as numbers."""
    harbor, jura = (find_device(str(made[name].folder)).new_dictionary() for name in ("harbor", "jura"))
    assert harbor.find((0x60C2, 2)).default == -3 and harbor.find((0x607D, 1)).default == -(2**31)
    assert harbor.find(0x1008).default == "HX2-Servo" and harbor.find((0x3100, 2)).access == "rwr"
    assert harbor.find(0x6040).access == "rww" and not harbor.find(0x6083).pdo_mappable
    assert (jura.find(0x6083).low, jura.find(0x6883).high) == (1, 2**32 - 1)
    assert jura.find(0x6502).default == 0x3A5 and jura.find(0x100A).default == "J4.1"


# --- the ESI and the EEPROM of what was made --------------------------------------------------------------------------
def without_objects(entries):
    """Return entries as runs of bits: index 0 for gaps and for what no image here carries, neighbours together."""
    rows = []
    for entry in entries:
        key = (entry.index, entry.sub, entry.bits)
        if entry.index in (0, 0x2100, 0x2101, 0x100A):
            key = (0, 0, entry.bits)
            if rows and rows[-1][0] == 0:
                key = (0, 0, rows.pop()[2] + entry.bits)
        rows.append(key)
    return rows


@pytest.mark.every(3)
@pytest.mark.parametrize("name", OF_ESI)
def test_the_esi_made_again_has_the_makers_images_and_identity(made, name, tmp_path):
    row = CASES[name]
    theirs = read_esi(row["esi"], row.get("product", ""))
    path = tmp_path / "again.xml"
    path.write_text(esi_text(find_device(str(made[name].folder))), encoding="utf-8")
    ours = read_esi(path)
    for field in ("vendor", "product", "revision", "behaviour"):
        assert getattr(ours, field) == getattr(theirs, field), field
    assert {pdo.index for pdo in ours.pdos} == {pdo.index for pdo in theirs.pdos}
    again = {pdo.index: pdo for pdo in ours.pdos}
    for pdo in theirs.pdos:
        other = again[pdo.index]
        for field in ("name", "is_output", "is_assigned", "is_fixed", "rule"):
            assert getattr(other, field) == getattr(pdo, field), (hex(pdo.index), field)
        assert without_objects(other.entries) == without_objects(pdo.entries)
    second = new_device(None, tmp_path / "second", find_motor(MOTOR), esi=path)  # it has a dictionary
    assert mapped(find_device(str(second.folder))) == mapped(find_device(str(made[name].folder)))


def categories(content):
    found, at = {}, 0x80
    while True:
        kind, words = struct.unpack_from("<HH", content, at)
        if kind == 0xFFFF:
            return found
        found[kind] = content[at + 4 : at + 4 + 2 * words]
        at += 4 + 2 * words


def check_eeprom(content, esi):
    """Compare an EEPROM, byte by byte as ETG.2010 has it, with what an ESI says."""
    behaviour = esi.behaviour
    assert struct.unpack_from("<3I", content, 0x10) == (esi.vendor, esi.product, esi.revision)
    assert struct.unpack_from("<4H", content, 0x30) == (*behaviour.receive, *behaviour.send)
    boot = (*(behaviour.bootstrap_receive or (0, 0)), *(behaviour.bootstrap_send or (0, 0)))
    assert struct.unpack_from("<4H", content, 0x28) == boot
    assert struct.unpack_from("<H", content, 0x38)[0] == 4 | (8 if behaviour.has_foe else 0)
    assert (struct.unpack_from("<H", content, 0x7C)[0] + 1) * 128 == behaviour.eeprom
    parts = categories(content)
    strings, at = [""], 1
    for _ in range(parts[10][0]):
        strings.append(parts[10][at + 1 : at + 1 + parts[10][at]].decode("latin-1"))
        at += 1 + parts[10][at]
    assert strings[parts[30][2]] == behaviour.order
    starts = (behaviour.receive.start, behaviour.send.start, behaviour.outputs, behaviour.inputs)
    managers = [struct.unpack_from("<HHBBBB", parts[41], 8 * k) for k in range(4)]
    assert [(row[0], row[2]) for row in managers] == list(zip(starts, behaviour.controls, strict=True))
    for number, is_output, manager in ((51, True, 2), (50, False, 3)):
        pdos, at = {}, 0
        while at < len(parts[number]):
            index, count, sync, _, name, flags = struct.unpack_from("<HBBBBH", parts[number], at)
            rows = [struct.unpack_from("<HBBBBH", parts[number], at + 8 * k) for k in range(1, count + 1)]
            pdos[index] = (strings[name], sync, flags, [(row[0], row[1], row[4]) for row in rows])
            at += 8 * (count + 1)
        expected = {
            pdo.index: (pdo.name, manager if pdo.is_assigned else 0xFF, pdo.rule.mandatory | pdo.is_fixed << 4,
                        [(one.index, one.sub, one.bits) for one in pdo.entries])
            for pdo in esi.pdos if pdo.is_output == is_output
        }  # fmt: skip
        assert pdos == expected
        size = sum(bits for _, sync, _, rows in pdos.values() if sync == manager for _, _, bits in rows) // 8
        assert managers[manager][1] == size
    modes = [struct.unpack_from("<IiihHhBB", parts.get(60, b""), 24 * k) for k in range(len(parts.get(60, b"")) // 24)]
    assert [(strings[one[6]], strings[one[7]], one[4], one[0], one[1], one[2], one[3], one[5]) for one in modes] == [
        (m.name, m.title, m.activation, m.cycle0, m.shift0, m.shift1, m.factor1, m.factor0) for m in behaviour.clocks
    ]


def again(folder, tmp_path):
    path = tmp_path / "again.xml"
    path.write_text(esi_text(find_device(str(folder))), encoding="utf-8")
    return read_esi(path)


@pytest.mark.parametrize("name", OF_ESI)
def test_the_eeprom_says_what_the_esi_says(made, name, tmp_path):
    check_eeprom(sii_content(find_device(str(made[name].folder))), again(made[name].folder, tmp_path))


def test_names_in_the_eeprom_are_of_ascii(made):
    """pysoem reads them as UTF-8, others as Latin-1."""
    assert b"Isar Antriebstechnik Munchen" in sii_content(find_device(str(made["isar"].folder)))


@pytest.mark.slow
@needs_namespaces
@pytest.mark.parametrize("name", CASES)
def test_on_a_cable(spaces, made, name, tmp_path):
    """pysoem brings what `drive-env serve ./x --interface ethercat` serves to Op and moves it; Wireshark reads it."""
    folder, log = made[name].folder, tmp_path / "bus.pcap"
    device = find_device(str(folder))
    axes, cycles = device.num_axes, 300
    seen = seen_by(
        spaces, "--lockstep", "ethercat_new_master.py", axes, 1200, cycles, device=str(folder), load=LOADS[axes],
        options=("--motor", MOTOR, "--pcap", str(log)),
    )  # fmt: skip
    outputs, inputs = mapped(device)
    assert seen["slaves"] == 1 and seen["outputs"] == list(outputs) and seen["inputs"] == list(inputs)
    assert seen["sizes"] and seen["safe_op"] and seen["op"]
    assert seen["enabled"] == [True] * axes
    assert seen["moved"] == pytest.approx([1200] * axes, abs=60)
    esi, content = again(folder, tmp_path), bytes.fromhex(seen["eeprom"])
    assert seen["identity"] == [esi.vendor, esi.product, esi.revision]
    assert content[: len(sii_content(device))] == sii_content(device, serial=1)[: len(content)]
    if CASES[name].get("esi"):
        check_eeprom(content, esi)
    if TSHARK is not None:
        done = subprocess.run([TSHARK, "-r", log, "-Y", "_ws.malformed"], capture_output=True, text=True, timeout=120.0)
        assert done.returncode == 0 and done.stdout == "", done.stdout[:500]


# --- files that cannot be ---------------------------------------------------------------------------------------------
HARBOR = (ESIS / "harbor_hx2.xml").read_text(encoding="utf-8")
BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>\n<EtherCATInfo'


@pytest.mark.parametrize(("before", "after", "said"), [
    ("<EtherCATInfo ", BOMB + " ", "it has a document type (<!DOCTYPE ...>), which is not read; delete"),
    ("<Vendor>", "<Vendor><", "it is not XML: not well-formed"),
    ("EtherCATInfo", "EtherCATModule", "it is no ESI: its outermost element is <EtherCATModule>"),
    ("<Id>#x00000B0A</Id>", "<Id>HM</Id>", "Vendor/Id is 'HM', which is not a number; write it as 0 or #x0"),
    ("<Id>#x00000B0A</Id>", "<Id>#x100000B0A</Id>", "Vendor/Id is #x100000B0A; it must be 0 to 4294967295"),
    ('ProductCode="#x48583230" ', "", "Type/@ProductCode is '', which is not a number"),
    ("<BitLen>32</BitLen>", "<BitLen>0</BitLen>", "entry 4/BitLen is 0; it must be 1 to 11888"),
    ("<Index>#x1601</Index><Name>CSV", "<Index>#x1a01</Index><Name>CSV", "RxPdo 2/Index is #x1a01; it must be 5632"),
    ("<Index>#x1601</Index><Name>CSV", "<Index>#x1600</Index><Name>CSV", "RxPdo 1600h stands twice; leave one of them"),
    ('Fixed="1" Sm="2"', 'Fixed="1" Sm="3"', "RxPdo 1600h/@Sm is 3; RxPdo lie in sync manager 2"),
    ('Fixed="1" Sm="2"', 'Fixed="1"', "the images of sync manager 2 lack a controlword or a cyclic target of an axis"),
    ('DefaultSize="128" StartAddress="#x1000"', 'DefaultSize="16" StartAddress="#x1000"',
     "Sm MBoxOut/@DefaultSize is 16; it must be 32 to 8192"),
    ('StartAddress="#x1080"', 'StartAddress="#x1040"', "MBoxIn takes 128 bytes from 1040h on, and MBoxOut 128"),
    ('StartAddress="#x1400"', 'StartAddress="#x1110"', "Inputs takes 72 bytes from 1110h on, and Outputs 42"),
    ('StartAddress="#x1400"', 'StartAddress="#x2FF0"', "the memory ends at 3000h; lower its start"),
    ('StartAddress="#x1400"', 'StartAddress="#x3400"', "Sm Inputs/@StartAddress is #x3400; it must be 4096 to 12287"),
    ('ControlByte="#x64"', 'ControlByte="#x60"', "@ControlByte is 60h; as Outputs its lower four bits must be 4h"),
    ('Enable="1">MBoxOut</Sm>', 'Enable="1">Outputs</Sm>', "its sync managers are Outputs, MBoxIn, Outputs, Inputs; a"),
    ("<Index>#x3100</Index>", "<Index>#x13100</Index>", "/Index is #x13100; it must be 0 to 65535"),
    ("<Elements>6</Elements>", "<Elements>70000</Elements>", "ArrayInfo/Elements is 70000; it must be 1 to 254"),
    ("<Index>#x6041</Index>", "<Index>#x5041</Index>", "describes no CiA 402 drive: it has no statusword 6041h"),
    ("<CoE ", "<VoE ", "it is not XML: mismatched tag"),
    ("Dictionary>", "Dictionaries>", "has no dictionary (Profile/Dictionary), and nothing else says which"),
    ("<ByteSize>2048", "<ByteSize>64", "Eeprom/ByteSize is 64; it must be 128 to 1048576"),
    ("<ConfigData>", "<BootStrap>0010</BootStrap><ConfigData>", "Eeprom/BootStrap is '0010'; it must be 16"),
    ("<Entry>", "<a>" * 40 + "</a>" * 40 + "<Entry>", "its elements lie more than 40 deep in one another"),
    pytest.param("<Vendor>", "<a/>" * 500_001 + "<Vendor>", "it has more than 500000 elements", marks=pytest.mark.slow),
])  # fmt: skip
def test_a_file_that_cannot_be_is_told_and_nothing_is_written(tmp_path, before, after, said):
    path = tmp_path / "vendor.xml"
    assert before in HARBOR
    everywhere = -1 if before in ("Dictionary>", "EtherCATInfo") else 1
    path.write_text(HARBOR.replace(before, after, everywhere), encoding="utf-8")
    done = CliRunner().invoke(app, ["new", "--esi", str(path), "--out", str(tmp_path / "device")])
    assert done.exit_code == 2 and done.exception.__class__ is SystemExit
    assert done.stderr.startswith(f"drive-env: {path}") and said in done.stderr, done.stderr
    assert sorted(tmp_path.iterdir()) == [path]


def made_of(tmp_path, text):
    path = tmp_path / "vendor.xml"
    path.write_text(text, encoding="utf-8")
    device = new_device(None, tmp_path / "device", find_motor(MOTOR), esi=path)
    return find_device(str(device.folder)), {note.what: note.why for note in device.repairs}


def test_an_image_of_broken_bytes_is_filled_up(tmp_path):
    at = HARBOR.index("<Index>#x3100</Index><SubIndex>2</SubIndex><BitLen>16<")
    device, told = made_of(tmp_path, HARBOR[:at] + HARBOR[at:].replace(">16<", ">13<", 1))
    assert mapped(device)[1][0x1A01] == [0x60F40020, 0x60FD0020, 13, 3]
    assert told["[1A01]"] == "has 77 bits, and a gap of 3 up to whole bytes"


def test_without_pdo_config_no_mapping_can_be_written(tmp_path):
    device, _ = made_of(tmp_path, HARBOR.replace(' Fixed="1"', ""))
    assert device.new_dictionary().find((0x1601, 1)).access == "ro"
    (tmp_path / "free").mkdir()
    device, _ = made_of(tmp_path / "free", HARBOR.replace(' Fixed="1"', "").replace('PdoConfig="0"', 'PdoConfig="1"'))
    assert device.new_dictionary().find((0x1601, 1)).access == "rw"


def test_of_several_images_that_would_do_the_first_is_assigned(tmp_path):
    text = put((FOLDER / "alpina_ax40.eds").read_text(encoding="utf-8"), "1603sub2", DefaultValue="0x607A0020")
    path = tmp_path / "vendor.eds"
    path.write_text(text, encoding="utf-8")
    device = new_device(path, tmp_path / "device", find_motor(MOTOR), on_ethercat=True)
    assert list(mapped(find_device(str(device.folder)))[0]) == [0x1602]


def test_a_folder_that_cannot_be_used_does_not_stay(tmp_path):
    """Increments of a revolution of 8 bits: no encoder's counts fit in."""
    path = tmp_path / "vendor.xml"
    text = (ESIS / "jura_j4.xml").read_text(encoding="utf-8-sig")
    path.write_text(
        text.replace("<Name>Increments</Name><Type>UDINT</Type>", "<Name>Increments</Name><Type>USINT</Type>"),
        encoding="utf-8",
    )
    done = CliRunner().invoke(app, ["new", "--esi", str(path), "--out", str(tmp_path / "device")])
    assert done.exit_code == 2 and "make 0 units of position in a turn" in done.stderr, done.stderr
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_of_many_megabytes_and_a_pipe(tmp_path):
    path = tmp_path / "vendor.xml"
    path.write_bytes(b" " * 16_000_001)
    with pytest.raises(ValueError, match="has 16 MB, and 16 MB are read"):
        read_esi(path)


@pytest.mark.parametrize(("arguments", "said"), [
    ([], "no file is given; name the drive's EDS, its ESI, or both: --eds drive.eds --esi drive.xml"),
    (["--esi", "nowhere.xml"], "there is no ESI at nowhere.xml; give the path of the drive's .xml file"),
    (["--esi", ESIS / "harbor_hx2.xml", "--fieldbus", "can"], "--esi is a file of EtherCAT; leave --fieldbus can out"),
    (["--eds", FOLDER / "alpina_ax40.eds", "--fieldbus", "profibus"], "--fieldbus profibus must be can or ethercat"),
    (["--eds", FOLDER / "alpina_ax40.eds", "--product", "X"], "--product X is one device of an ESI; name the"),
    (["--esi", ESIS / "isar_i7.xml"], "it describes 2 devices: I7-A (#x1B59:#x10001), I9-A (#x2329:#x10004); name one"),
    (["--esi", ESIS / "isar_i7.xml", "--product", "I8-A"], "it describes no device 'I8-A'; did you mean"),
    (["--esi", ESIS / "isar_i7.xml", "--product", "0x1b59"], "has no dictionary (Profile/Dictionary)"),
    (["--esi", FOLDER / "alpina_ax40.eds"], "alpina_ax40.eds: it is not XML"),
    (["--esi", ESIS / "harbor_hx2.xml", "--eds", "nowhere.eds"], "there is no EDS at nowhere.eds"),
])  # fmt: skip
def test_wrong_arguments(tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["new", *map(str, arguments), "--out", "device"])
    assert done.exit_code == 2 and said in done.stderr, done.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_command_says_how_to_serve_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["new", "--esi", str(ESIS / "harbor_hx2.xml")])
    assert done.exit_code == 0, done.stderr
    assert done.stdout.endswith("serve it: drive-env serve harbor_hx2 --interface ethercat --channel veth1\n")
    assert find_device("harbor_hx2").title == "Harbor Motion HX2 servo drive"
