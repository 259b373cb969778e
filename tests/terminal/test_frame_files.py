"""Files of frames for Wireshark, byte by byte: candump's lines, and pcap with link type 227 (SocketCAN)."""

from __future__ import annotations

import contextlib
import gzip
import json
import os
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
import time

import can
import pytest
from typer.testing import CliRunner

from drive_env.commands import recorded_frames
from drive_env.commands.captures import frames_of_capture
from drive_env.commands.cli import app
from drive_env.commands.frame_files import FrameFile, FrameLines
from drive_env.master.can import port

pytestmark = pytest.mark.usefixtures("files_read_here")
FRAMES = {
    "data": can.Message(timestamp=1.5, arbitration_id=0x181, data=b"\x37\x02", is_extended_id=False),
    "sent by this program": can.Message(
        timestamp=1.5, arbitration_id=0x601, data=bytes(8), is_extended_id=False, is_rx=False, channel=0
    ),
    "empty": can.Message(timestamp=1_700_000_000.000001, arbitration_id=0x080, is_extended_id=False, channel="vcan0"),
    "remote": can.Message(timestamp=2.9999999, arbitration_id=0x701, is_remote_frame=True, dlc=1, is_extended_id=False),
    "extended": can.Message(timestamp=0, arbitration_id=0x123, data=b"\xff", is_extended_id=True),
    "error": can.Message(timestamp=3, is_error_frame=True),
    "FD": can.Message(
        timestamp=3, arbitration_id=0x181, data=bytes(12), is_fd=True, bitrate_switch=True, is_extended_id=False
    ),
    "before the clock was set": can.Message(timestamp=-1, arbitration_id=0x181, data=b"\1", is_extended_id=False),
}
LINES = {
    "data": "(0000000001.500000) can0 181#3702",
    "sent by this program": "(0000000001.500000) can0 601#0000000000000000",
    "empty": "(1700000000.000001) vcan0 080#",
    "remote": "(0000000003.000000) can0 701#R1",
    "extended": "(0000000000.000000) can0 00000123#FF",
    "error": "(0000000003.000000) can0 20000080#0000000000000000",
    "FD": "(0000000003.000000) can0 181##1" + 24 * "0",
    "before the clock was set": "(0000000000.000000) can0 181#01",
}
# Seconds, microseconds; identifier with its flags, length, FD flags; data.
PACKETS = {
    "data": (1, 500_000, 0x181, 2, 0, "3702"),
    "sent by this program": (1, 500_000, 0x601, 8, 0, 16 * "0"),
    "empty": (1_700_000_000, 1, 0x080, 0, 0, ""),
    "remote": (3, 0, 0x4000_0701, 1, 0, ""),
    "extended": (0, 0, 0x8000_0123, 1, 0, "ff"),
    "error": (3, 0, 0x2000_0080, 8, 0, 16 * "0"),
    "FD": (3, 0, 0x181, 12, 0x05, 24 * "0"),
    "before the clock was set": (0, 0, 0x181, 1, 0, "01"),
}


SHOWN = {
    "data": "    0.000000  181   [2]  37 02                     TPDO 1, node 1",
    "sent by this program": "    0.000000  601   [8]  00 00 00 00 00 00 00 00   SDO request, node 1",
    "empty": "    0.000000  080   [0]                           SYNC",
    "remote": "    0.000000  701   [1]  remote request           heartbeat, node 1",
    "extended": "    0.000000  123   [1]  FF                        extended",
    "error": "    0.000000  000   [0]                           error frame",
}


@pytest.mark.parametrize("name", SHOWN)
def test_a_frame_on_the_screen_has_its_service(name, capsys):
    with FrameLines(as_json=False) as lines:
        lines(FRAMES[name])
    assert " ".join(capsys.readouterr().out.split()) == " ".join(SHOWN[name].split())


def test_a_frame_as_json_is_a_line_of_its_own_with_the_time_from_the_first(capsys):
    with FrameLines(as_json=True) as lines:
        lines(FRAMES["data"])
        lines(FRAMES["remote"])
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["t"] for row in rows] == [0.0, 1.5] and rows[0]["data"] == "3702"
    assert [row["service"] for row in rows] == ["TPDO 1, node 1", "heartbeat, node 1"]
    assert [(row["remote"], row["length"]) for row in rows] == [(False, 2), (True, 1)]


def packets(content):
    """Read a pcap as its specification has it (draft-ietf-opsawg-pcap; tcpdump.org, LINKTYPE_CAN_SOCKETCAN)."""
    magic, major, minor, _, _, longest, link = struct.unpack_from("<IHHiIII", content)
    assert (magic, major, minor, link) == (0xA1B2C3D4, 2, 4, 227)
    place, found = 24, []
    while place < len(content):
        seconds, microseconds, kept, length = struct.unpack_from("<IIII", content, place)
        assert kept == length <= longest and microseconds < 1_000_000
        packet = content[place + 16 : place + 16 + kept]
        assert len(packet) == kept
        can_id, size, flags, reserved, raw_dlc = struct.unpack_from(">IBBBB", packet)
        assert (reserved, raw_dlc) == (0, 0)
        found.append((seconds, microseconds, can_id, size, flags, packet[8:].hex()))
        place += 16 + kept
    return found


def write(path, messages):
    with FrameFile(path) as file:
        for message in messages:
            file(message)
    return path.read_bytes()


@pytest.mark.parametrize("name", FRAMES)
def test_a_line_is_candump_s(tmp_path, name):
    assert write(tmp_path / "a.log", [FRAMES[name]]).decode() == LINES[name] + "\n"


@pytest.mark.parametrize("name", FRAMES)
def test_a_packet_is_socketcan_s(tmp_path, name):
    assert packets(write(tmp_path / "a.pcap", [FRAMES[name]])) == [PACKETS[name]]


def blocks(content):
    """Read the blocks of a pcapng as its specification has it (draft-ietf-opsawg-pcapng): kind and content."""
    found = []
    while content:
        kind, length = struct.unpack_from("<II", content)
        assert length % 4 == 0 and struct.unpack_from("<I", content, length - 4) == (length,)
        found.append((kind, content[8 : length - 4]))
        content = content[length:]
    return found


@pytest.mark.parametrize("name", FRAMES)
def test_a_pcapng_has_the_packet_and_the_time_of_the_pcap(tmp_path, name):
    section, interface, packet = blocks(write(tmp_path / "a.pcapng", [FRAMES[name]]))
    assert section == (0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    assert interface == (1, struct.pack("<HHI", 227, 0, 65_535))
    kind, content = packet
    number, high, low, kept, length = struct.unpack_from("<IIIII", content)
    assert (kind, number, kept) == (6, 0, length)
    seconds, microseconds = divmod((high << 32) + low, 1_000_000)
    (of_pcap,) = packets(write(tmp_path / "a.pcap", [FRAMES[name]]))
    assert (seconds, microseconds) == of_pcap[:2]
    assert content[20 : 20 + kept] == (tmp_path / "a.pcap").read_bytes()[24 + 16 :]
    assert len(content) == 20 + kept + -kept % 4


def test_python_can_reads_the_lines(tmp_path):
    write(tmp_path / "a.log", FRAMES.values())
    with can.LogReader(str(tmp_path / "a.log")) as reader:
        for wrote, read in zip(FRAMES.values(), reader, strict=True):
            assert wrote.equals(read, timestamp_delta=1.1, check_channel=False, check_direction=False)


def told(path):
    with path.open("rb") as content:
        return [
            (round(x.timestamp, 6), x.arbitration_id, x.is_extended_id, x.is_remote_frame, x.is_error_frame, x.is_fd,
             x.dlc, bytes(x.data)) for x in frames_of_capture(path.suffix, content)
        ]  # fmt: skip


@pytest.mark.parametrize("kinds", [("pcap",), ("nsecpcap",), ("pcapng",), ("nsecpcap", "pcapng")])
def test_captures_are_read_as_wireshark_writes_them(tmp_path, kinds):
    """Wireshark's editcap writes them anew, with its own blocks; a .pcapng of nanoseconds keeps that unit."""
    if shutil.which("editcap") is None:
        pytest.skip("needs editcap (Debian: wireshark-common)")
    path = tmp_path / "ours.pcap"
    write(path, FRAMES.values())
    for kind in kinds:
        made = tmp_path / f"{kind}.{'pcapng' if kind == 'pcapng' else 'pcap'}"
        subprocess.run(["editcap", "-F", kind, path, made], check=True)
        path = made
    assert told(path) == [
        (seconds + microseconds / 1e6, can_id & 0x1FFF_FFFF, bool(can_id >> 31), bool(can_id & 1 << 30),
         bool(can_id & 1 << 29), bool(flags), size, bytes.fromhex(data))
        for seconds, microseconds, can_id, size, flags, data in PACKETS.values()
    ]  # fmt: skip


@pytest.mark.every(2)
@pytest.mark.parametrize("ending", [".pcap", ".pcapng"])
def test_a_capture_of_ours_comes_back_and_one_that_is_cut_off_is_refused(tmp_path, ending):
    whole = write(tmp_path / f"a{ending}", [FRAMES["data"], FRAMES["empty"]])
    frames, left_out = recorded_frames.read_frames(tmp_path / f"a{ending}", everything=True)
    assert [(x.timestamp, x.arbitration_id, x.data) for x in frames] == [
        (1.5, 0x181, b"\x37\x02"), (pytest.approx(1_700_000_000.000001, abs=1e-6), 0x080, b"")
    ]  # fmt: skip
    assert left_out == 0
    path = tmp_path / f"cut{ending}"
    for content, why in (
        (whole[:-3], "it ends within a block, and may be cut off"),
        (b"\0" * 64, f"it does not begin as a {ending} does"),
        (whole.replace(struct.pack("<I", 227), struct.pack("<I", 113), 1).replace(
            struct.pack("<HH", 227, 0), struct.pack("<HH", 113, 0), 1), "its link type is 113, not 227"),
    ):  # fmt: skip
        path.write_bytes(content)
        with pytest.raises(ValueError, match=why):
            recorded_frames.read_frames(path, everything=True)


@pytest.mark.parametrize("packed", ["", ".gz"])
def test_a_blf_that_is_cut_off_is_refused(tmp_path, in_process, packed):
    """python-can reads as many whole containers as there are, and says nothing of the rest."""
    with can.Logger(str(tmp_path / "a.blf")) as writer:
        for _ in range(3000):
            writer(can.Message(timestamp=1.5, arbitration_id=0x601, data=os.urandom(8), is_extended_id=False))
    whole = (tmp_path / "a.blf").read_bytes()
    for size, count in ((len(whole), 3000), (len(whole) - 1, None), (len(whole) // 2, None)):
        path = tmp_path / f"{size}.blf{packed}"
        path.write_bytes(gzip.compress(whole[:size]) if packed else whole[:size])
        if count:
            assert len(recorded_frames.read_frames(path, everything=False)[0]) == count
            continue
        with pytest.raises(ValueError, match=f"it has {size} of {len(whole)} bytes, and was cut off"):
            recorded_frames.read_frames(path, everything=False)


def test_a_database_has_all_frames_that_came_in_a_burst(tmp_path, monkeypatch):
    """python-can's own end writes one batch of those that wait, 501 at most."""
    waiting = [FRAMES["data"]] * 2000

    class Bus:
        def recv(self, _):
            if not waiting:
                signal.raise_signal(signal.SIGINT)
            return waiting.pop() if waiting else None

        def shutdown(self):
            pass

    monkeypatch.setattr(port, "open_bus", lambda *_, **__: Bus())
    done = CliRunner().invoke(app, ["frames", "log", str(tmp_path / "a.db")])
    assert done.exit_code == 0 and done.stdout.startswith("2000 frames written"), done.output
    with contextlib.closing(sqlite3.connect(tmp_path / "a.db")) as written:
        assert written.execute("SELECT COUNT(*) FROM messages").fetchone() == (2000,)


def test_a_channel_has_no_blanks(tmp_path):
    frame = can.Message(timestamp=1, arbitration_id=1, is_extended_id=False, channel="CAN 1")
    assert write(tmp_path / "a.log", [frame]) == b"(0000000001.000000) CAN1 001#\n"


def test_replay_names_the_formats_that_it_reads(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"")
    done = CliRunner().invoke(app, ["frames", "replay", str(tmp_path / "a.txt")])
    assert done.exit_code == 2 and "'.txt' is not one of .log, .blf, .asc" in done.stderr


GOOD = b"(1.0) can0 601#2B40600000000000\n"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (GOOD + b"(1.5) can0 201#0F", "a.log: its last line has no end, and may be cut off; take it out"),
        (GOOD + bytes(500), "a.log: its last line has no end"),  # as after a power cut
        (GOOD + b"(1.5) can0 " + b"z" * 1_000_000 + b"#00\n", "..., near frame 2; is it complete?"),
        (GOOD + b"(1.5) can0 601#R" + b"9" * 5_000 + b"\n", "value has 5000 digits, near frame 2; is it complete?"),
        (GOOD + b"(1.5) can0 201#" + b"00" * 9 + b"\n", "frame 2 of a master has the identifier 201h and 9 bytes; "),
        (GOOD + b"(1.5) can0 FFF#R\n", "identifier FFFh and 0 bytes; classic CAN has up to 7FFh and 8"),
    ],
    ids=["cut", "zeros", "endless word", "endless number", "9 bytes", "identifier"],
)
def test_what_no_master_has_sent_is_refused_before_the_first_frame(tmp_path, in_process, content, told):
    """A frame that was cut was sent as another one; those that no bus takes ended a replay with the motor on."""
    (tmp_path / "a.log").write_bytes(content)
    done = CliRunner().invoke(app, ["frames", "replay", str(tmp_path / "a.log"), "--dry-run"])
    assert (done.exit_code, done.stdout) == (2, "") and told in done.stderr
    assert len(done.stderr.splitlines()) == 1 and len(done.stderr) < 500


# A log's name and content, and the frames that it holds: time, identifier, data or how many bytes are asked for.
BUSMASTER = """***BUSMASTER Ver 3.2.2***
***PROTOCOL CAN***
***{base}***
***SYSTEM MODE***
***<Time><Tx/Rx><Channel><CAN ID><Type><DLC><DataBytes>***
"""
TRC_EPOCH = -2_209_161_600.0  # 1899-12-30 [s]
TRC = ";$FILEVERSION=1.1\n;$STARTTIME=0\n"
SDO = (0x601, "2b40600000000000")
FOREIGN = {
    "asc without a line of internal events": (
        "a.asc",
        "date Wed Dec 7 12:23:39 pm 2011\nbase dec timestamps absolute\n\n"
        "0.5 1 1537 Rx d 8 43 64 96 0 0 0 0 0\n0.75 1 1793 Rx r 4\n",
        [(0.5, *SDO), (0.75, 0x701, 4)],
    ),
    "asc with that line": (
        "a.asc",
        "date Wed Dec 7 12:23:39 pm 2011\nbase hex timestamps absolute\ninternal events logged\n// version 9.0.0\n"
        "Begin Triggerblock Wed Dec 7 12:23:39 pm 2011\n   0.000000 Start of measurement\n"
        "   0.5 1 601 Tx d 8 2B 40 60 00 00 00 00 00\nEnd TriggerBlock\n",
        [(0.5, *SDO)],
    ),
    "candump -ta": (
        "a.log",
        " (1.500000)  can0  601   [8]  2B 40 60 00 00 00 00 00   '+@`.....'\n"
        " (1.750000)  can0  701   [4]  remote request\n (2.0)  can0  12345678   [1]  00\n"
        " (2.1)  can0  20000088   [8]  00 00 00 00 00 00 00 00   ERRORFRAME\n (2.2)  can0  080   [0]\n",
        [(1.5, *SDO), (1.75, 0x701, 4), (2.2, 0x080, "")],
    ),
    "candump -x": ("a.log", " (1.5)  can0  TX - -  601   [8]  2B 40 60 00 00 00 00 00\n", [(1.5, *SDO)]),
    "BUSMASTER": (
        "a.log",
        BUSMASTER.format(base="HEX") + "23:59:59:9990 Rx 1 0x601 s 8 2B 40 60 00 00 00 00 00\n"
        "00:00:00:0010 Tx 1 0x701 sr 1 00\n00:00:00:0020 Tx 1 0x12345678 x 1 00\n",
        [(86_399.999, *SDO), (86_400.001, 0x701, 1)],
    ),
    "BUSMASTER with decimal numbers": (
        "a.LOG", BUSMASTER.format(base="DEC") + "0:0:1:5000 Rx 1 1537 s 8 43 64 96 0 0 0 0 0\n", [(1.5, *SDO)]
    ),
    "SavvyCAN": (
        "a.csv",
        "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
        "1500000,00000601,false,Tx,0,8,2B,40,60,00,00,00,00,00,\n1750000,00000080,false,Rx,0,0,\n",
        [(1.5, *SDO), (1.75, 0x080, "")],
    ),
    "PCAN-View": (
        "a.trc",
        TRC + "1) 1.5 Tx 0601 8 2B 40 60 00 00 00 00 00\n2) 1.75 Warng FFFFFFFF 4 00 00 00 04\n3) 2 Tx 0701 3 RTR\n",
        [(TRC_EPOCH + 0.0015, *SDO), (TRC_EPOCH + 0.002, 0x701, 3)],
    ),
    "candump -L, packed": ("a.b.log.gz", "(1.5) can0 601#2B40600000000000\n(1.75) can0 701#R4\n", [
        (1.5, *SDO), (1.75, 0x701, 4)
    ]),
}  # fmt: skip


@pytest.fixture
def in_process(monkeypatch):
    """Logs are read here instead of in a process with limits, which takes a second to start."""
    monkeypatch.setattr(recorded_frames, "call_limited", lambda _, function, *arguments, **__: function(*arguments))


@pytest.mark.parametrize("name", FOREIGN)
def test_logs_of_other_tools_are_read(tmp_path, in_process, name):
    ending, content, frames = FOREIGN[name]
    path = tmp_path / ending
    (gzip.open if ending.endswith(".gz") else open)(path, "wb").write(content.encode())
    read, left_out = recorded_frames.read_frames(path, everything=True)
    assert left_out == 0
    assert [
        (pytest.approx(frame.timestamp, abs=1e-9), frame.arbitration_id, frame.dlc if frame.is_remote_frame else
         frame.data.hex()) for frame in read
    ] == frames  # fmt: skip


@pytest.mark.parametrize(("name", "content", "told"), [
    ("a.log", "  can0  601   [1]  00\n", "candump's screen has no time stamps in seconds; record with candump -L"),
    ("a.log", " (2026-01-01 10:00:00.0)  can0  601   [1]  00\n", "has no time stamps in seconds; record"),
    ("a.log", " (0.002)  can0  601   [1]  00\n (0.001)  can0  601   [1]  00\n", "go back, as those of candump -td do"),
    ("a.log", " (1.5)  can0  601   [8]  2B 40 60\n", "a frame of 8 bytes has 3"),
    ("a.log", BUSMASTER.format(base="HEX") + "***RELATIVE MODE***\n", "log in system or absolute mode"),
    ("a.log", BUSMASTER.format(base="HEX") + "Rx\n", "'Rx' is no line of BUSMASTER (near frame 1)"),
    ("a.asc", "base hex  timestamps relative\n0.5 1 601 Rx d 0\n", "save it with absolute ones"),
    ("a.asc", "base hex  timestamps absolute\n0.5 1 601 Rx d 8 2B", "its last line has no end"),
    ("a.asc", "base hex  timestamps absolute\n0.5 1 601 Rx d 8 2B\n", "a frame of 8 bytes has 1"),
    ("a.trc", TRC + "1)  0.5 Tx 0601 8 2B 40 60\n", "'1)  0.5 Tx 0601 8 2B 40 60' is no line of a .trc (near frame 1)"),
    ("a.csv", "Time Stamp,ID,Extended,Dir,Bus,LEN\n1,601,false,Tx,0,2,2B\n", "a frame of 2 bytes has 1"),
    ("a.log.gz", "no gzip\n", "cannot be read as .gz: Not a gzipped file"),
    ("a.db.gz", "\n", "unpack it with gzip -d"),
    ("a.txt", "\n", "'.txt' is not one of .log, .blf"),
])  # fmt: skip
def test_what_cannot_be_sent_in_its_time_is_refused(tmp_path, in_process, name, content, told):
    (tmp_path / name).write_text(content)
    done = CliRunner().invoke(app, ["frames", "replay", str(tmp_path / name), "--all", "--dry-run"])
    assert (done.exit_code, done.stdout) == (2, "") and told in done.stderr and len(done.stderr.splitlines()) == 1


def test_frames_of_can_fd_are_named_and_left_out(tmp_path, in_process):
    (tmp_path / "a.log").write_bytes(GOOD + b"(1.5) can0 601##1" + b"00" * 64 + b"\n(1.5) can0 602##100\n" + GOOD)
    done = CliRunner().invoke(app, ["frames", "replay", str(tmp_path / "a.log"), "--dry-run"])
    assert done.exit_code == 0 and done.stdout.splitlines()[-1] == "2 frames shown"
    assert done.stderr == "drive-env: 2 frames of CAN FD are left out: drives have classic CAN\n"


@pytest.mark.parametrize(("ending", "left_out"), [
    (".trc", "drive-env: .trc has no remote frames and no CAN FD: 2 frames are left out\n"),
    (".csv", "drive-env: .csv has no CAN FD: 1 frames are left out\n"), (".log", ""),
])  # fmt: skip
def test_a_log_names_what_its_format_has_no_room_for(tmp_path, monkeypatch, ending, left_out):
    """python-can's .trc drops remote frames, and its .csv makes classic frames of those of CAN FD."""

    waiting = [FRAMES["data"], FRAMES["remote"], FRAMES["FD"]]

    class Bus:
        def recv(self, _):
            if not waiting:
                signal.raise_signal(signal.SIGINT)
            return waiting.pop(0) if waiting else None

        def shutdown(self):
            pass

    monkeypatch.setattr(port, "open_bus", lambda *_, **__: Bus())
    done = CliRunner().invoke(app, ["frames", "log", str(tmp_path / f"a{ending}")])
    kept = 3 - int("".join(filter(str.isdigit, left_out)) or 0)
    assert (done.exit_code, done.stderr) == (0, left_out) and done.stdout.startswith(f"{kept} frames written to")
    with can.LogReader(str(tmp_path / f"a{ending}")) as reader:
        assert len(list(reader)) == kept


@pytest.mark.every(2)
@pytest.mark.skipif(os.name != "posix", reason="signals are otherwise there")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_log_in_the_background_of_a_script_ends_by_a_signal(tmp_path, number):
    """Such a one begins with SIGINT ignored."""
    program = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); from drive_env import programs; "
    file = tmp_path / "frames.pcap"
    process = subprocess.Popen(
        [sys.executable, "-c", program + "programs.drive_env()", "frames", "log", file, "-i", "virtual", "-c", "none"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        while not file.exists():
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.01)
        process.send_signal(number)
        out, error = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert (process.returncode, out, error) == (0, f"0 frames written to {file}\n", "")
    assert packets(file.read_bytes()) == []
