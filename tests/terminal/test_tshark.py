"""A second opinion on our frames: Wireshark's CANopen dissector reads a recorded conversation of every service."""

from __future__ import annotations

import shutil
import subprocess

import can
import pytest

from drive_env import EmulatedDrives
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.commands.frame_files import FrameFile, FrameLines

TSHARK = shutil.which("tshark")
pytestmark = pytest.mark.skipif(TSHARK is None, reason="tshark is not installed (Debian: apt install tshark)")

SERVICES = """
000  81 05                      # NMT: reset node, boot-up
605  40 00 10 00 00 00 00 00    # SDO: expedited upload
605  40 08 10 00 00 00 00 00    # segmented upload
605  60 00 00 00 00 00 00 00
605  70 00 00 00 00 00 00 00
605  2B 17 10 00 05 00 00 00    # expedited download: heartbeat every 5 ms
605  21 81 60 00 04 00 00 00    # segmented download
605  07 01 02 03 04 00 00 00
605  40 99 99 00 00 00 00 00    # abort
605  A0 08 10 00 00 00 00 00    # no block transfer
605  80 08 10 00 00 00 04 05    # abort of the client
605  2F 00 18 02 01 00 00 00    # TPDO 1 goes with SYNC
000  01 05                      # start
205  06 00                      # RPDO 1 to 4
305  06 00 01
405  0F 00 00 00 01 00
505  0F 00 00 00 01 00
080
080  07                         # SYNC with a counter
080
205  06                         # too short: EMCY 8210h
205  06 00 00                   # too long: EMCY 8220h
305  06 00 0B                   # a mode that is none: EMCY 6320h
080
080
605  2B 17 10 00 00 00 00 00    # no heartbeat: guarding
705  RTR
705  RTR
000  80 05
000  82 05
000  02 05
"""


def frames_of(text):
    for line in text.strip().splitlines():
        identifier, _, rest = line.partition("#")[0].strip().partition(" ")
        rest = rest.strip()
        yield (
            Frame(int(identifier, 16), b"", True, 1)
            if rest == "RTR"
            else Frame(int(identifier, 16), bytes.fromhex(rest))
        )


def log_line(number, frame):
    data = "R" if frame.rtr else frame.data.hex().upper()
    return f"({1e9 + number * 1e-4:.6f}) can0 {frame.can_id:03X}#{data}"


def dissected(path, lines, *arguments):
    """Return what tshark prints of a log in candump's format."""
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return read_by_tshark(path, *arguments)


def read_by_tshark(path, *arguments):
    done = subprocess.run(
        [TSHARK, "-r", path, "-d", "can.subdissector,canopen", *arguments], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def conversation():
    """All frames of the bus, as lines of a log."""
    world = World(lockstep=True)
    world.add(EmulatedDrives(load="inertia", num_threads=1), [5])
    frames = []
    world.listeners.append(lambda ended: frames.append(ended.frame))
    world.power_on()
    for frame in frames_of(SERVICES):
        world.receive(frame)
    world.close()
    return [log_line(k, frame) for k, frame in enumerate(frames)]


@pytest.mark.slow
def test_no_frame_is_malformed(conversation, tmp_path):
    log = tmp_path / "session.log"
    assert len(dissected(log, conversation)) == len(conversation) > 60
    # Remote frames Wireshark shows as plain CAN.
    wrong = "(!canopen && !can.flags.rtr) || _ws.malformed || _ws.expert.severity >= warning"
    assert dissected(log, conversation, "-Y", wrong) == []


def test_it_would_be_found(conversation, tmp_path):
    bad = [*conversation, log_line(len(conversation), Frame(0x585, bytes.fromhex("43 00")))]
    found = dissected(tmp_path / "bad.log", bad, "-Y", "_ws.malformed")
    assert len(found) == 1


@pytest.mark.every(3)
@pytest.mark.parametrize("ending", [".log", ".pcap", ".pcapng"])
def test_a_remote_frame_has_the_length_that_is_shown_for_it(ending, tmp_path, capsys):
    frame = can.Message(arbitration_id=0x705, is_remote_frame=True, dlc=3, is_extended_id=False)
    with FrameFile(tmp_path / f"a{ending}") as file, FrameLines(as_json=False) as lines:
        file(frame)
        lines(frame)
    shown = read_by_tshark(tmp_path / f"a{ending}", "-T", "fields", "-e", "can.flags.rtr", "-e", "can.len")
    assert [line.split() for line in shown] == [["1", "3"]]
    assert "[3]  remote request" in capsys.readouterr().out


SHOWN = {
    "NMT": 4, "Boot-up": 3, "SYNC": 5, "EMCY": 3, "PDO1 (tx)": 5, "PDO1 (rx)": 3, "Initiate upload response": 2,
    "Upload segment response": 2, "Initiate download response": 3, "Download segment response": 1, "Abort": 3,
    "NMT Error Control": 3,
}  # fmt: skip


@pytest.mark.every(4)
def test_each_service_is_taken_for_what_it_is(conversation, tmp_path):
    lines = dissected(tmp_path / "session.log", conversation)
    for service, least in SHOWN.items():
        assert sum(service in line for line in lines) >= least, (service, "\n".join(lines))
