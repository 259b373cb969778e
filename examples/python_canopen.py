"""python-canopen as master: find the node, read and write objects, map a PDO, turn the motor by the CiA 402 automaton.

drive-env export eds tmcm1636.eds
drive-env serve tmcm1636 --load inertia &
python examples/python_canopen.py --eds tmcm1636.eds

Nothing of drive-env is imported: with `--interface socketcan --channel can0` it is the program for a real drive.
The drive watches over this program by its heartbeats, and Ctrl-C ends in a quick stop. No safety envelope watches
limits here: a real motor must be free to turn, and an emergency stop in reach.
"""

import argparse
import sys
import time

import can
import canopen
from canopen.profiles.p402 import BaseNode402
from canopen.sdo.exceptions import SdoError

TURN = 65536  # increments of a revolution
MASTER, SILENCE = 0x7D, 500  # node-ID of our heartbeats; ms without them after which the drive stops


def switch_off(node: BaseNode402) -> None:
    """Bring the motor to rest by a quick stop, take its voltage, and give up the watchdog where 6041h shows it off."""
    node.sdo[0x6040].raw = 0x02
    end = time.monotonic() + 2.0
    while node.sdo[0x6041].raw & 0x6F == 0x07 and time.monotonic() < end:  # quick stop active
        time.sleep(0.02)
    node.sdo[0x6040].raw = 0x00
    if node.sdo[0x6041].raw & 0x4F == 0x40:  # switch on disabled
        node.sdo[0x1016][1].raw = 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--interface", default="slcan", help="python-can interface")
    parser.add_argument("--channel", default="socket://127.0.0.1:29636", help="channel")
    parser.add_argument("--node", type=int, default=1, help="node-ID")
    parser.add_argument("--eds", required=True, help="the drive's EDS")
    options = parser.parse_args()
    network = canopen.Network()
    # slcan over TCP needs no pause after opening, which python-can makes for serial adapters.
    extra = {"sleep_after_open": 0} if options.interface == "slcan" else {"bitrate": 1_000_000}
    network.connect(interface=options.interface, channel=options.channel, **extra)
    node = None
    try:
        network.scanner.search()
        time.sleep(0.5)
        print("nodes:", network.scanner.nodes)
        node = network.add_node(BaseNode402(options.node, options.eds))
        node.sdo.RESPONSE_TIMEOUT = 2.0
        print("device:", node.sdo[0x1008].raw)
        node.nmt.state = "OPERATIONAL"

        # TPDO 1: statusword and speed, every 20 ms; RPDO 1: the controlword alone.
        node.tpdo.read()
        node.rpdo.read()
        node.tpdo[1].clear()
        node.tpdo[1].add_variable(0x6041)
        node.tpdo[1].add_variable(0x606C)
        node.tpdo[1].trans_type, node.tpdo[1].event_timer, node.tpdo[1].enabled = 255, 20, True
        node.nmt.state = "PRE-OPERATIONAL"
        node.tpdo.save()
        node.nmt.state = "OPERATIONAL"
        node.setup_402_state_machine(read_pdos=False)

        # Before a frame that enables: the drive's own watchdog, and the heartbeats that it waits for.
        network.send_periodic(0x700 + MASTER, b"\x05", 1e-3 * SILENCE / 3)
        node.sdo[0x1016][1].raw = MASTER << 16 | SILENCE
        if node.sdo[0x6061].raw != 3:  # a TMCM-1636 refuses the mode that it has
            node.sdo[0x6060].raw = 3  # profile velocity
        for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
            node.state = state
        print("state:", node.state)
        node.sdo[0x60FF].raw = 10 * TURN  # pps: 10 revolutions per second
        time.sleep(1.0)
        node.tpdo[1].wait_for_reception(timeout=2.0)
        print(f"speed: {node.tpdo[1][0x606C].raw * 60 / TURN:.0f} rpm")
        node.sdo[0x60FF].raw = 0
        time.sleep(1.0)
        switch_off(node)
        print("state:", node.state)
    finally:
        try:
            if node is not None:
                switch_off(node)
        finally:
            network.disconnect()


if __name__ == "__main__":
    try:
        main()
    except (OSError, ValueError, can.CanError, SdoError) as error:
        sys.exit(f"{sys.argv[0]}: {error}; check --channel, --node, and that --eds is the drive's (`drive-env scan`)")
