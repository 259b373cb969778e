"""python-canopen as master: find the node, read and write objects, map a PDO, turn the motor by the CiA 402 automaton.

drive-env eds tmcm1636 > tmcm1636.eds
drive-env serve tmcm1636 --load inertia &
python examples/python_canopen.py --eds tmcm1636.eds

Nothing of drive-env is imported: with `--interface socketcan --channel can0` it is the program for a real drive.
No safety envelope watches here: a real motor must be free to turn, and an emergency stop in reach.
"""

import argparse
import time

import canopen
from canopen.profiles.p402 import BaseNode402

TURN = 65536  # increments of a revolution


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
        node.state = "SWITCH ON DISABLED"
        print("state:", node.state)
    finally:
        network.disconnect()


if __name__ == "__main__":
    main()
