"""The two sequences of the TGZ's maker, by our frame master and by SOEM: Op, and both axes move."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest
from rigs.ethercat_segment import EmulatedSegment
from rigs.namespaces import needs_namespaces, seen_by
from rigs.namespaces import spaces as spaces
from rigs.tgz_sequences import SEQUENCES, move

from drive_env.ethercat.application import AlState
from drive_env.ethercat.pcap_log import PcapLog
from drive_env.master.ethercat.ethercat_master import ImageSizes, Sync0

TSHARK = shutil.which("tshark")
MOVED = pytest.approx([0.25, 0.25], abs=0.003)  # turns


@pytest.fixture(scope="module")
def segment():
    with EmulatedSegment("tgz_d", load="gantry") as made:
        yield made


@pytest.mark.every(24)
@pytest.mark.parametrize("clock", [None, Sync0(0.001, True), Sync0(0.001, True, True)], ids=["free", "sync0", "sync1"])
@pytest.mark.parametrize("name", SEQUENCES)
def test_our_frame_master_moves_both_axes(segment, name, clock, tmp_path):
    segment.drives.machine.reset()
    sequence, master, path = SEQUENCES[name], segment.master(), tmp_path / "sequence.pcap"
    log = PcapLog(path)
    segment.world.segment.listeners[:] = [log.add]
    assert master.begin() == 1
    for index, sub, data in sequence.rows:
        master.download(0, index, sub, data, 5.0)
    master.clock = clock
    master.map({0: ImageSizes(sequence.size, sequence.size)})
    held = bytes(sequence.size)
    master.operate([0], lambda: master.exchange([held], 1.0), 20.0)
    assert segment.slaves[0].state is AlState.OP
    before = segment.drives.machine.rotor_angle.copy()
    seen = move(sequence, lambda outputs: master.exchange([outputs], 1.0)[0])
    turned = (segment.drives.machine.rotor_angle - before) / (2.0 * np.pi)
    assert (seen.moved, seen.was_on, seen.is_on, seen.errors) == (MOVED, [True] * 2, [False] * 2, [False] * 2)
    assert list(turned) == pytest.approx([0.25, 0.25], abs=0.01)
    assert segment.slaves[0].state is AlState.OP
    master.close()
    segment.world.segment.listeners.clear()
    log.close()
    if TSHARK is not None and clock is None:
        read = [TSHARK, "-r", path, "-Y", "ecat"]
        assert len(subprocess.run(read, capture_output=True, check=True).stdout.splitlines()) > 1000
        assert subprocess.run([*read[:-1], "_ws.malformed"], capture_output=True, check=True).stdout == b""


@pytest.mark.slow
@needs_namespaces
@pytest.mark.parametrize("delay", [None, 0, 250_000], ids=["free", "together", "later"])
@pytest.mark.parametrize("name", SEQUENCES)
def test_soem_moves_both_axes(spaces, name, delay):
    options = () if delay is None else (delay,)
    seen = seen_by(spaces, "--lockstep", "ethercat_tgz_master.py", name, *options, device="tgz_d", load="gantry")
    size = SEQUENCES[name].size
    assert (seen["slaves"], seen["sizes"], seen["safe_op"], seen["op"]) == (1, [size, size], True, True)
    assert seen["type"] == (1 if delay is None else 3)
    assert seen["pulses"] == pytest.approx(0 if delay is None else 1000, abs=3)
    assert (seen["moved"], seen["was_on"], seen["is_on"], seen["errors"]) == (
        MOVED, [True] * 2, [False] * 2, [False] * 2
    )  # fmt: skip
    assert seen["still_op"]
