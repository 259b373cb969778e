"""Scripts that drives run on an emulator and on a bus, and what they record."""

from __future__ import annotations

import numpy as np

from drive_env import EmulatedDrives, motion

WATCHED = [0x6041, 0x6061, 0x6062, 0x6064, 0x606C, 0x6077]
TURN = 65536  # increments


def watch(drives, seconds, play=None):
    trace = drives.record(WATCHED, seconds, play=play)
    return np.stack([trace[name] for name in WATCHED])


def pp(drives):
    motion.enable(drives, mode="pp")
    drives.write("Profile velocity", 1_500_000)
    motion.start_move(drives, 3 * TURN)
    yield watch(drives, 0.15)
    motion.start_move(drives, -TURN, relative=True)  # replans under way
    yield watch(drives, 0.35)
    motion.move_to(drives, 0)
    yield watch(drives, 0.1)  # an axis that is still turning would be braked by the envelope before its voltage goes
    motion.disable(drives)
    yield watch(drives, 0.02)


def pv(drives):
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 1_000_000)
    yield watch(drives, 0.1)
    drives.write("Velocity mode settings.P_Parameter", 600)
    drives.write("Target velocity", -500_000)
    yield watch(drives, 0.2)
    motion.quick_stop(drives)
    yield watch(drives, 0.2)


def csp(drives):
    motion.enable(drives, mode="csp")
    drives.write((0x60C2, 1), 2)
    targets = np.rint(TURN * (1 - np.cos(np.linspace(0, 2 * np.pi, 300)))).astype(int)
    yield watch(drives, 0.3, {0x607A: targets, 0x60B1: np.arange(300)})
    yield watch(drives, 0.03)


def csv(drives):
    motion.enable(drives, mode="csv")
    targets = np.rint(500_000 * np.sin(np.linspace(0, 6, 250))).astype(int)
    yield watch(drives, 0.25, {0x60FF: targets})
    for target in range(0, 100_000, 10_000):  # a policy, cycle by cycle, SDO and PDO
        drives.write(0x60FF, target)
        yield watch(drives, 0.002)
        yield watch(drives, 0.001, {0x60FF: [target + 5000]})


def cst(drives):
    motion.enable(drives, mode="cst")
    targets = np.where(np.arange(120) // 20 % 2, -700, 900)
    yield watch(drives, 0.12, {0x6071: targets, 0x60B2: np.full(120, 30)})
    drives.write(0x6071, 0)
    drives.advance(0.05)
    yield watch(drives, 0.01)


def handshake_in_pdos(drives):
    """The set-point handshake of pp cycle by cycle: controlword and target in one row."""
    motion.enable(drives, mode="pp")
    words = np.full(200, 0x0F)
    words[10:20] = words[100:110] = 0x1F
    targets = np.where(np.arange(200) < 90, TURN, -TURN)
    yield watch(drives, 0.2, {0x607A: targets, 0x6040: words})


def homing(drives):
    increments_per_metre = TURN / (0.006366 * 2 * np.pi)
    drives.write(0x6098, 21)
    drives.write((0x6099, 1), round(0.2 * increments_per_metre))
    drives.write((0x6099, 2), round(0.02 * increments_per_metre))
    drives.write(0x609A, round(4.0 * increments_per_metre))
    drives.write(0x607C, 1000)
    motion.enable(drives, mode="hm")
    drives.write(0x6040, 0x1F)
    yield watch(drives, 1.2)
    motion.wait_for(drives, (0x1400, 0x1400), 5.0, "homing attained")
    yield drives.read(0x6064)
    drives.write(0x607C, -2000)
    motion.home(drives)
    yield drives.read(0x6064)
    yield watch(drives, 0.01)


def run(script, drives):
    return [np.asarray(part) for part in script(drives)]


SCRIPTS = {script.__name__: script for script in (pp, pv, csp, csv, cst, handshake_in_pdos, homing)}
_emulated = {}


def emulated(name):
    """What the script gives on emulated drives; computed once."""
    if name not in _emulated:
        with EmulatedDrives(load="belt" if name == "homing" else "two_mass", num_threads=1) as drives:
            _emulated[name] = run(SCRIPTS[name], drives)
    return _emulated[name]
