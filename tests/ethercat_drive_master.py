"""pysoem, an independent master (SOEM), moves a drive of three axes in csp; says what it saw as JSON."""

from __future__ import annotations

import json
import struct
import sys
import time

import pysoem

IMAGE = struct.Struct("<HiiHiiHii")  # tables 22 and 24 of the TMCM-3313's manual: word, position, speed of each axis
PATIENCE = 60.0  # s


def main(interface: str, cycles: int) -> None:
    """Bring the first slave on an interface to Op, and move its axes for that many cycles."""
    master = pysoem.Master()
    master.open(interface)
    seen = {"slaves": master.config_init()}
    drive = master.slaves[0]
    seen["identity"] = [drive.man, drive.id, drive.rev]
    seen["name"] = patiently(lambda: drive.sdo_read(0x1008, 0)).decode()
    seen["mapping"] = patiently(lambda: drive.sdo_read(0x1600, 0, ca=True)).hex()
    seen["refused"] = refusal(lambda: patiently(lambda: drive.sdo_write(0x1018, 1, b"\0\0\0\0")))
    objects = patiently(lambda: drive.od)
    seen["objects"] = len(objects)
    by_index = {one.index: one for one in objects}
    seen["described"] = [by_index[0x6041].name.decode(), by_index[0x6041].data_type, by_index[0x6041].bit_length]
    seen["entries"] = len(by_index[0x1018].entries)
    for axis in range(3):
        patiently(lambda axis=axis: drive.sdo_write(0x6060 + 0x800 * axis, 0, b"\x08"))
    master.config_map()
    seen["sizes"] = [len(drive.output), len(drive.input)]
    seen["safe_op"] = master.state_check(pysoem.SAFEOP_STATE, 5_000_000) == pysoem.SAFEOP_STATE
    master.state = pysoem.OP_STATE
    master.write_state()
    end = time.monotonic() + PATIENCE
    seen["op"] = False
    drive.output = bytes(30)
    while not seen["op"] and time.monotonic() < end:
        exchange(master)
        seen["op"] = master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE
    for word in (0x80, 0, 6, 7, 15):
        for _ in range(60):
            command(drive, word, IMAGE.unpack(drive.input)[1::3])
            exchange(master)
    seen["words"] = [word & 0x6F for word in IMAGE.unpack(drive.input)[::3]]
    start = IMAGE.unpack(drive.input)[1::3]
    seen["wrong"] = 0
    for k in range(cycles + 300):
        moved = [before + min(k, cycles) * 4 * (axis + 1) for axis, before in enumerate(start)]
        command(drive, 15, moved)
        seen["wrong"] += exchange(master) != master.expected_wkc
    seen["moved"] = [now - before for now, before in zip(IMAGE.unpack(drive.input)[1::3], start, strict=True)]
    master.state = pysoem.SAFEOP_STATE
    master.write_state()
    for _ in range(500):
        exchange(master)
    seen["stopped"] = [word & 0x4F for word in IMAGE.unpack(drive.input)[::3]]
    seen["error"] = refusal(lambda: drive.mbx_receive())
    master.state = pysoem.INIT_STATE
    master.write_state()
    master.close()
    print(json.dumps(seen))


def patiently(call):
    """Return what a call brings; SOEM waits 20 ms for room in a mailbox, a busy machine may do other things then."""
    end = time.monotonic() + PATIENCE
    while True:
        try:
            return call()
        except (pysoem.WkcError, pysoem.PacketError):
            if time.monotonic() > end:
                raise


def refusal(call):
    """Return the abort or emergency code with which something is answered, 0 for none."""
    try:
        call()
    except pysoem.SdoError as error:
        return error.abort_code
    except pysoem.Emergency as error:
        return error.error_code
    return 0


def command(drive, word: int, positions) -> None:
    """Write controlword and targets of all axes."""
    drive.output = IMAGE.pack(*(value for position in positions for value in (word, position, 0)))


def exchange(master: pysoem.Master) -> int:
    """Send process data and return the working counter of what came back."""
    master.send_processdata()
    return int(master.receive_processdata(50_000))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
