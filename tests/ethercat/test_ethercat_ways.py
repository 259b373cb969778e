"""Ways in: UDP, a raw socket with a real master in another network namespace, and the log that Wireshark reads."""

from __future__ import annotations

import json
import os
import shutil
import socket
import struct
import subprocess

import pytest
from rigs import TESTS
from rigs.ethercat_rig import EchoDevice, Rig
from rigs.namespaces import inside, needs_namespaces
from typer.testing import CliRunner

from drive_env.commands.cli import app
from drive_env.ethercat import datagrams
from drive_env.ethercat.application import AlState
from drive_env.ethercat.datagrams import DatagramCommand, at_station, build
from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.namespaces import Namespaces, existing
from drive_env.ethercat.pcap_log import PcapLog
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.ways import RawSocket, UdpSocket
from drive_env.ethercat.world import EtherCatWorld

TSHARK = shutil.which("tshark")
PATIENCE = 60.0  # s


# --- UDP --------------------------------------------------------------------------------------------------------------
def ask(sock, port, *asked):
    sock.sendto(build(asked), ("127.0.0.1", port))
    return datagrams.read(sock.recv(2048), 0)


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_master_over_udp(lockstep):
    world = EtherCatWorld(lockstep=lockstep)
    world.add(EtherCatSlave(EchoDevice(), takes_time=not lockstep))
    with EtherCatServer(world, UdpSocket(0)) as server, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.settimeout(PATIENCE)
        port = server.way.port
        assert ask(sock, port, at_station(DatagramCommand.BRD, 0, 0x0130, b"\0\0"))[0] == (
            7,
            0x01300001,
            b"\1\0",
            1,
            0,
            0,
        )
        sock.sendto(b"rubbish", ("127.0.0.1", port))  # is not answered, and harms nothing
        answers = ask(
            sock, port, at_station(DatagramCommand.APWR, 0, 0x10, b"\1\x10"),
            at_station(DatagramCommand.FPRD, 0x1001, 0x10, b"\0\0"),
        )  # fmt: skip
        assert [answer.counter for answer in answers] == [1, 1]
    assert server.way.answered == 2
    assert world.segment.slaves[0].controller.register(0x030C, 1) == 1


def test_a_port_that_is_taken_is_told():
    way = UdpSocket(0)
    with pytest.raises(OSError, match=rf"UDP port 127.0.0.1:{way.port} cannot be opened: .*; choose another"):
        UdpSocket(way.port)
    way.close()


@pytest.mark.slow
def test_real_time_goes_on_without_frames():
    world = EtherCatWorld(lockstep=False)
    world.add(EtherCatSlave(EchoDevice()))
    server = EtherCatServer(world, UdpSocket(0))
    server.run(0.1)
    server.close()
    assert world.cycles >= 50
    assert server.lateness.count == world.cycles


# --- a log ------------------------------------------------------------------------------------------------------------
def conversation(path):
    """Record a session with every kind of frame; returns how many frames there are."""
    rig = Rig(2)
    with PcapLog(path) as log:
        rig.world.segment.listeners.append(log.add)
        count = [0]
        rig.world.segment.listeners.append(lambda *_: count.__setitem__(0, count[0] + 1))
        rig.address()
        rig.bring_to(AlState.OP)
        for command in DatagramCommand:
            rig.send(at_station(command, 0, 0x0F80, bytes(4)))
        rig.exchange(bytes(4))
        rig.mail(3, struct.pack("<HBHBI", 2 << 12, 0x40, 0x1000, 0, 0))  # SDO upload of 1000h
        rig.fetch()
        rig.send(at_station(DatagramCommand.BRD, 0, 0x0130, bytes(2)), at_station(DatagramCommand.BRD, 0, 0, bytes(8)))
    return count[0]


def test_a_log_has_every_frame(tmp_path):
    path = tmp_path / "session.pcap"
    number = conversation(path)
    content = path.read_bytes()
    assert struct.unpack_from("<IHHiIII", content) == (0xA1B23C4D, 2, 4, 0, 0, 65535, 1)
    at, frames = 24, []
    while at < len(content):
        seconds, nanoseconds, size, whole = struct.unpack_from("<IIII", content, at)
        assert size == whole >= datagrams.SHORTEST_FRAME and nanoseconds < 1_000_000_000 and seconds == 0
        frames.append(content[at + 16 : at + 16 + size])
        at += 16 + size
    assert len(frames) == number > 50
    assert all(datagrams.find(frame, datagrams.ETHERNET) for frame in frames)
    assert [frame[6] for frame in frames[:2]] == [0x01, 0x03]  # sent, and come back through a controller


def test_no_log_is_written_over(tmp_path):
    path = tmp_path / "session.pcap"
    path.write_text("mine", encoding="utf-8")
    with pytest.raises(FileExistsError):
        PcapLog(path)


@pytest.mark.skipif(TSHARK is None, reason="tshark is not installed (Debian: apt install tshark)")
def test_wireshark_reads_it_without_a_malformed_frame(tmp_path):
    path = tmp_path / "session.pcap"
    number = conversation(path)

    def dissected(*arguments):
        done = subprocess.run([TSHARK, "-r", path, *arguments], capture_output=True, text=True, timeout=PATIENCE)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    assert len(dissected("-Y", "ecat")) == number
    assert dissected("-Y", "_ws.malformed") == []
    assert dissected("-Y", "ecat_mailbox.coe")


# --- a real master ----------------------------------------------------------------------------------------------------
@pytest.fixture
def spaces():
    number = os.getpid() % 100_000
    spaces = Namespaces(f"slave-{number}", f"master-{number}", "veth1", "veth0")
    spaces.make()
    yield spaces
    spaces.remove()


@pytest.mark.slow
@needs_namespaces
def test_soem_brings_four_slaves_to_op(spaces, tmp_path):
    pytest.importorskip("pysoem", reason="pysoem is not installed: pip install -e '.[ethercat]'")
    log, number = tmp_path / "session.pcap", 4
    server = subprocess.Popen(
        inside(spaces.slave, TESTS / "ethercat_echo.py", spaces.slave_interface, number, log),
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert server.stdout.readline() == "ready\n"
        done = subprocess.run(
            inside(spaces.master, TESTS / "ethercat_master.py", spaces.master_interface, 200),
            capture_output=True, text=True, timeout=PATIENCE,
        )  # fmt: skip
    finally:
        server.communicate(timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout.splitlines()[-1])
    assert seen["slaves"] == number and seen["names"] == ["Echo"] * number
    assert seen["identities"] == [[0x1234, 0x5678, 1]] * number
    assert seen["clocks"] and seen["safe_op"] and seen["op"]
    assert seen["expected"] == 3 * number
    assert seen["cycles"] == 200
    assert seen["wrong"] <= 5  # a frame that was not answered in time, on a machine that others use, too
    assert log.stat().st_size > 10_000


@needs_namespaces
def test_the_command_makes_and_removes_them():
    run = CliRunner().invoke
    if Namespaces().slave in existing():
        pytest.skip("somebody uses the namespaces of drive-env on this machine")
    try:
        made = run(app, ["ethercat", "namespace"])
        assert made.exit_code == 0, made.output
        assert "ip netns exec drive-env-slave drive-env serve tmcm3313" in made.output
        assert {"drive-env-slave", "drive-env-master"} <= set(existing())
        again = run(app, ["ethercat", "namespace"])
        assert again.exit_code == 2 and "exists already; remove it with --remove" in again.output
    finally:
        removed = run(app, ["ethercat", "namespace", "--remove"])
    assert removed.exit_code == 0 and "removed" in removed.output
    assert "drive-env-slave" not in existing()
    assert "there was none" in run(app, ["ethercat", "namespace", "--remove"]).output


def test_without_the_right_it_says_which(monkeypatch):
    monkeypatch.setattr("drive_env.ethercat.namespaces.sys.platform", "linux")
    monkeypatch.setattr("drive_env.ethercat.namespaces.shutil.which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr("drive_env.ethercat.namespaces.os.geteuid", lambda: 1000)
    refused = CliRunner().invoke(app, ["ethercat", "namespace"])
    assert refused.exit_code == 2
    assert "CAP_NET_ADMIN" in refused.output and "sudo /usr/bin/drive-env ethercat namespace" in refused.output


@pytest.mark.skipif(not hasattr(socket, "AF_PACKET"), reason="this system has no raw sockets")
def test_a_raw_socket_without_the_right_says_how_to_give_it(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("drive_env.ethercat.ways.socket.socket", refuse)
    with pytest.raises(OSError, match=r"veth9 cannot be opened: .*CAP_NET_RAW.*sudo setcap cap_net_raw\+ep /.*python"):
        RawSocket("veth9")


@needs_namespaces
def test_an_interface_that_is_not_there():
    with pytest.raises(OSError, match=r"veth9 cannot be opened: No such device; there are lo"):
        RawSocket("veth9")
