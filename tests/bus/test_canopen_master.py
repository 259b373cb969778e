"""python-canopen as an independent master: SDO, PDO, NMT, EMCY, heartbeat, 402.

Over python-can's virtual bus, and over SocketCAN where there is one.
"""

from __future__ import annotations

from itertools import pairwise

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402
from rigs.pump import NODE, PATIENCE, BootUps, Pump, until
from rigs.socketcan import CHANNEL, SOCKETCAN

from drive_env import EmulatedDrives
from drive_env.devices import find_device

EDS = str(find_device("tmcm1636").eds)


def emergency(node, code):
    """Wait for an emergency with a code and return it."""
    until(lambda: code in [heard.code for heard in node.emcy.log])
    return next(heard for heard in node.emcy.log if heard.code == code)


def boots(node, command):
    """Give an NMT command and wait for the boot-up."""
    heard = BootUps(node.network)
    node.nmt.send_command(command)
    heard.wait()


@pytest.fixture(scope="module", params=["virtual", SOCKETCAN])
def served(request):
    """A served node, and python-canopen's view of it."""
    where = {"interface": request.param, "channel": CHANNEL}
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        pump = Pump(drives, **where)
        network = canopen.Network()
        network.connect(**where)
        try:
            yield pump, network
        finally:
            network.disconnect()
            pump.close()


@pytest.fixture
def remote(served):
    """A RemoteNode whose drive has just been reset."""
    pump, network = served
    node = canopen.RemoteNode(NODE, EDS)
    network.add_node(node)
    pump.drives.machine.enable_input = True
    node.sdo.RESPONSE_TIMEOUT = PATIENCE
    heard = BootUps(network)
    pump.power_on()
    heard.wait()
    yield node
    network.nmt.send_command(0x80)
    del network[NODE]


def test_the_scanner_finds_the_node(served, remote):
    _, network = served
    network.scanner.reset()
    network.scanner.search(10)
    until(lambda: network.scanner.nodes)
    assert network.scanner.nodes == [NODE]


def test_sdo_by_name(remote):
    assert remote.sdo["Device type"].raw == 0xFFFC0192
    assert remote.sdo["Identity object"]["Vendor ID"].raw == 0x286
    assert remote.sdo["Manufacturer device name"].raw == "TMCM-1636"  # segmented
    assert remote.sdo["Manufacturer software version"].raw == "1.09"
    remote.sdo["Profile velocity"].raw = 123_456
    assert remote.sdo[0x6081].raw == 123_456
    remote.sdo["Target position"].raw = -1
    assert remote.sdo[0x607A].raw == -1
    remote.sdo["Interpolation time period"]["Interpolation time index"].raw = -3
    assert remote.sdo[0x60C2][2].raw == -3


def test_every_object_by_its_own_type(remote):
    for item in remote.object_dictionary.values():
        members = [item] if isinstance(item, canopen.objectdictionary.ODVariable) else item.values()
        for member in members:
            raw = remote.sdo.upload(member.index, member.subindex)
            if member.data_type in canopen.objectdictionary.datatypes.INTEGER_TYPES:
                assert len(raw) * 8 == len(member), f"{member.index:04X}h:{member.subindex}"


def test_segmented_download(remote):
    # python-canopen sends four bytes expedited; forced, they come in segments.
    with remote.sdo["Profile velocity"].open("wb", size=4, buffering=0) as stream:
        stream.write(b"\x01\x02\x03\x04")
    remote.sdo.download(0x6083, 0, b"\x05\x06\x07\x08", force_segment=True)
    assert remote.sdo[0x6081].raw == 0x0403_0201
    assert remote.sdo[0x6083].raw == 0x0807_0605


@pytest.mark.parametrize(
    ("index", "sub", "data", "code"),
    [
        (0x6041, 0, b"\0\0", 0x0601_0002),
        (0x9999, 0, b"\0", 0x0602_0000),
        (0x6081, 1, b"\0\0\0\0", 0x0609_0011),
        (0x6081, 0, b"\0\0", 0x0607_0013),
        (0x6081, 0, b"\0\0\0\0\0", 0x0607_0012),
        (0x2003, 0, b"\xff\xff\0\0", 0x0609_0031),
        (0x6060, 0, b"\x02", 0x0609_0030),
        (0x6060, 0, b"\0", 0x0800_0022),
    ],
)
def test_aborts_arrive_with_their_code(remote, index, sub, data, code):
    with pytest.raises(canopen.SdoAbortedError) as aborted:
        remote.sdo.download(index, sub, data)
    assert aborted.value.code == code


def test_block_transfer_is_refused(remote):
    with pytest.raises(canopen.SdoAbortedError) as aborted:
        remote.sdo["Profile velocity"].open("wb", block_transfer=True, size=4, buffering=0)
    assert aborted.value.code == 0x0504_0001
    with pytest.raises(canopen.SdoAbortedError) as aborted:
        remote.sdo["Manufacturer device name"].open("rb", block_transfer=True, buffering=0)
    assert aborted.value.code == 0x0504_0001
    assert remote.sdo["Device type"].raw == 0xFFFC0192


@pytest.mark.parametrize(("state", "number"), [("OPERATIONAL", 5), ("STOPPED", 4), ("PRE-OPERATIONAL", 127)])
def test_nmt_and_heartbeat(remote, state, number):
    remote.sdo[0x1017].raw = 20
    remote.nmt.state = state
    beats = []
    remote.network.subscribe(0x700 + NODE, lambda can_id, data, timestamp: beats.append(data[0]))
    until(lambda: len(beats) >= 3)
    assert beats[-1] == number
    assert remote.nmt.state == state
    if state != "STOPPED":
        assert remote.sdo[0x1017].raw == 20
    else:
        remote.sdo.RESPONSE_TIMEOUT = 0.1
        with pytest.raises(canopen.SdoCommunicationError):
            _ = remote.sdo[0x1017].raw


def test_node_guarding(remote):
    seen = []
    remote.network.subscribe(0x700 + NODE, lambda can_id, data, timestamp: seen.append(data[0]))
    remote.nmt.start_node_guarding(0.02)
    until(lambda: len(seen) > 3)
    remote.nmt.stop_node_guarding()
    assert {a ^ b for a, b in pairwise(seen)} == {0x80}, "the toggle alternates"
    assert {byte & 0x7F for byte in seen} == {127}


def test_resets_boot(remote):
    remote.sdo["Profile velocity"].raw = 1
    remote.sdo[0x1017].raw = 500
    boots(remote, 0x82)
    assert remote.sdo[0x1017].raw == 0
    assert remote.sdo["Profile velocity"].raw == 1
    boots(remote, 0x81)
    assert remote.sdo["Profile velocity"].raw != 1


def test_pdo_configuration_is_read_and_written(served, remote):
    _, network = served
    remote.rpdo.read()
    remote.tpdo.read()
    assert [variable.name for variable in remote.tpdo[3].map] == ["Statusword", "Position actual value"]
    assert remote.rpdo[2].cob_id == 0x300 + NODE
    assert remote.tpdo[3].trans_type == 1
    remote.tpdo[4].clear()
    for name in ("Statusword", "Modes of operation display", "Velocity actual value"):
        remote.tpdo[4].add_variable(name)
    remote.tpdo[4].trans_type = 1
    remote.tpdo[4].enabled = True
    remote.rpdo[4].clear()
    remote.rpdo[4].add_variable("Controlword")
    remote.rpdo[4].add_variable("Target velocity")
    remote.rpdo[4].trans_type = 0
    remote.rpdo[4].enabled = True
    remote.tpdo.save()
    remote.rpdo.save()
    remote.nmt.state = "OPERATIONAL"
    remote.rpdo[4]["Controlword"].raw = 6
    remote.rpdo[4]["Target velocity"].raw = -77
    remote.rpdo[4].transmit()
    network.sync.transmit()
    until(lambda: remote.tpdo[4]["Statusword"].raw & 0x6F == 0x21)
    assert remote.sdo["Target velocity"].raw == -77


def test_a_motor_turns_by_pdo(served, remote):
    _, network = served
    remote.tpdo.read()
    remote.rpdo.read()
    remote.nmt.state = "OPERATIONAL"
    remote.rpdo[2]["Modes of operation"].raw = 3
    for word in (6, 7, 15):
        remote.rpdo[2]["Controlword"].raw = word
        remote.rpdo[2].transmit()
    remote.rpdo[4]["Controlword"].raw = 15
    remote.rpdo[4]["Target velocity"].raw = 300_000
    remote.rpdo[4].transmit()

    def turns():
        network.sync.transmit()
        return remote.tpdo[4]["Velocity actual value"].raw > 250_000

    until(turns)
    assert remote.tpdo[4]["Statusword"].raw & 0x6F == 0x27


def test_emergencies(served, remote):
    pump, _ = served
    remote.nmt.state = "OPERATIONAL"
    remote.network.send_message(0x200 + NODE, b"\x06")
    message = emergency(remote, 0x8210)
    assert (message.register, bytes(message.data)) == (0x11, b"\x00\xff\x00\x00\x00")
    remote.emcy.reset()
    remote.sdo["Modes of operation"].raw = 3
    for word in (6, 7, 15):
        remote.sdo["Controlword"].raw = word
    with pump.lock:
        pump.drives.machine.enable_input = False
    emergency(remote, 0x5441)
    with pump.lock:
        pump.drives.machine.enable_input = True
    mended = pump.now
    until(lambda: pump.now > mended + 0.01)  # the drive looks at its inputs once a cycle
    remote.sdo["Controlword"].raw = 0x80
    emergency(remote, 0x0000)
    assert remote.emcy.active == []


def test_a_lost_master_is_noticed(remote):
    remote.sdo[0x1016][1].raw = 0x007F_0032  # node 127, 50 ms
    remote.network.send_message(0x77F, b"\x05")
    emergency(remote, 0x8130)


def test_store_and_restore(served, remote):
    remote.sdo["Profile velocity"].raw = 4711
    remote.store()
    remote.sdo["Profile velocity"].raw = 1
    boots(remote, 0x81)
    assert remote.sdo["Profile velocity"].raw == 4711
    remote.restore(3)
    assert remote.sdo["Profile velocity"].raw == 4711
    boots(remote, 0x81)
    assert remote.sdo["Profile velocity"].raw == 0


def test_the_402_profile_of_python_canopen(served):
    """Its state machine works; its homing and its operation modes are left out, being single-purpose."""
    pump, network = served
    node = BaseNode402(NODE, EDS)
    for name in (
        "TIMEOUT_SWITCH_OP_MODE",
        "TIMEOUT_SWITCH_STATE_FINAL",
        "TIMEOUT_SWITCH_STATE_SINGLE",
        "TIMEOUT_CHECK_TPDO",
    ):
        assert hasattr(node, name)
        setattr(node, name, PATIENCE)
    network.add_node(node)
    node.sdo.RESPONSE_TIMEOUT = PATIENCE
    try:
        heard = BootUps(network)
        pump.power_on()
        heard.wait()
        node.nmt.state = "PRE-OPERATIONAL"
        node.sdo[0x1801][5].raw = 20  # python-canopen takes a PDO that came twice for periodic, and waits for it
        node.setup_402_state_machine()
        node.nmt.state = "OPERATIONAL"
        network.sync.start(0.005)  # TPDOs 3 and 4 tell the statusword too; python-canopen listens to the last
        until(lambda: node.state == "SWITCH ON DISABLED")
        node.op_mode = "PROFILED VELOCITY"
        assert node.op_mode == "PROFILED VELOCITY"
        for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED", "SWITCHED ON", "SWITCH ON DISABLED"):
            node.state = state
            assert node.state == state
    finally:
        network.sync.stop()
        network.nmt.send_command(0x80)
        del network[NODE]
