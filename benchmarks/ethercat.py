"""Figures of EtherCAT: frames per second in process, and slaves over UDP whose axes all move in csp at 1 kHz.

`python -m benchmarks.ethercat 60` runs the second part alone, for so many seconds each.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drive_env import EmulatedDrives, Limits, motion
from drive_env.ethercat import datagrams
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.world import EtherCatWorld
from drive_env.master.ethercat.frame_master import FrameMaster
from drive_env.master.ethercat.frame_ways import CallWay, UdpWay
from drive_env.master.ethercat_drives import EtherCatDrives

SECONDS = 5.0  # of csp at 1 kHz
FRAMES = 2000
RATE = 1000  # Hz
SEGMENTS = (("tmcm3313", "portal", 1), ("tgz_d", "gantry", 1), ("tmcm3313", "portal", 4))
SERVE = "import typer; from drive_env.commands.serve import serve; typer.run(serve)"
LATENESS = re.compile(r"lateness of (\d+) (cycles|answers): p50 (\S+) ms, p99 (\S+) ms, max (\S+) ms")


class CountingMaster(FrameMaster):
    """Counts exchanges of which not every image came back: a frame was lost, or its working counter is another one."""

    incomplete = 0

    def exchange(self, outputs: Sequence[bytes], timeout: float) -> list[bytes | None]:
        """As that of `FrameMaster`."""
        found = super().exchange(outputs, timeout)
        self.incomplete += None in found
        return found


def frames_in_process() -> dict[str, float]:
    """Return how long a frame with process data takes in the slave, without the drives behind it [us]."""
    with EmulatedDrives("tmcm3313", "portal", num_threads=1) as drives:
        world = EtherCatWorld(lockstep=False)
        world.add(EtherCatSlave(CoeNode(drives)), drives)
        world.power_on()
        master = FrameMaster(CallWay(world.receive))
        with EtherCatDrives("tmcm3313", master=master, pace="lockstep", safety=False) as bus:
            bus.record([0x6041], 0.002)
            frame = datagrams.build_frame([datagrams.Datagram(datagrams.DatagramCommand.LRW, 0x10000, bytes(60))])
            start = time.perf_counter()
            for _ in range(FRAMES):
                world.receive(frame)
            return {"EtherCAT: frame of 60 bytes through a slave [us]": 1e6 * (time.perf_counter() - start) / FRAMES}


def csp(device: str, load: str, number: int, seconds: float) -> dict[str, float]:
    """Return figures of slaves in a process of their own, all of whose axes move in csp at 1 kHz over UDP.

    Args:
        device: Of all slaves.
        load: Of each.
        number: Slaves.
        seconds: How long they move [s].
    """
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "bus.toml"
        nodes = [f'[[machines]]\ndevice = "{device}"\nload = "{load}"\nnodes = [{k + 1}]\n' for k in range(number)]
        config.write_text("\n".join(nodes), encoding="utf-8")
        options = ["--config", str(config), "--interface", "ethercat-udp", "--channel", "0", "--stats"]
        process = subprocess.Popen([sys.executable, "-c", SERVE, *options], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        try:
            port = re.search(r"127\.0\.0\.1:(\d+)", process.stdout.readline())
            assert port is not None, "it serves"
            figures = _move(device, port[1], number, seconds)
        finally:
            process.send_signal(2)
            said, _ = process.communicate()
    name = f"EtherCAT, {number} x {device}, 1 kHz"
    for _, kind, p50, p99, _ in LATENESS.findall(said):
        figures |= {f"lateness of {kind}, p50 [ms]": float(p50), f"lateness of {kind}, p99 [ms]": float(p99)}
    return {f"{name}: {what}": value for what, value in figures.items()}


def _move(device: str, channel: str, number: int, seconds: float) -> dict[str, float]:
    rows = round(seconds * RATE)
    master = CountingMaster(UdpWay(int(channel)))
    with EtherCatDrives(device, master=master, nodes=range(number), timeout=5.0, safety=Limits(silence=5.0)) as drives:
        motion.enable(drives, mode="csp")
        start = drives.read(0x6064)
        path = np.rint(400.0 * (1.0 - np.cos(2.0 * np.pi * np.arange(rows) / RATE)))[:, None]
        targets = start + path.astype(int)
        before = master.incomplete
        begun = time.perf_counter()
        trace = drives.record([0x6041, 0x6064], seconds, {0x607A: targets})
        took = time.perf_counter() - begun
        assert (np.ptp(trace[0x6064], axis=0) > 400).all(), "every axis moved"
        figures = {
            "frames": float(rows),
            "frames without the right working counter": float(master.incomplete - before),
            "seconds taken": took,
            "frames sent more than a cycle late": float(drives.timing.late),
        }
        motion.disable(drives)
    return figures


def figures(seconds: float = SECONDS) -> dict[str, float]:
    """Return all figures of EtherCAT."""
    found = frames_in_process()
    for segment in SEGMENTS:
        found |= csp(*segment, seconds)
    return found


if __name__ == "__main__":
    for one in SEGMENTS:
        for what, value in csp(*one, float(sys.argv[1])).items():
            print(f"{what}: {value:.3f}")
