"""Recorded moves of a machine whose parameters are known."""

import numpy as np

from drive_env import EmulatedDrives, motion
from drive_env.commands.scope import write_table
from drive_env.dictionary.entries import Entry
from drive_env.trials.replay import Log

TURN = 65536  # increments
TRUTH = {"load.inertia": 2.4e-5, "load.coulomb": 4e-3}
DEMAND, POSITION, VELOCITY, CURRENT = (0x6062, 0), (0x6064, 0), (0x606C, 0), (0x6077, 0)
TARGET, SPEED, TORQUE = (0x607A, 0), (0x60FF, 0), (0x6071, 0)


def machines(count=1, seed=5, load="two_mass", **options):
    return EmulatedDrives(load=load, num_machines=count, seed=seed, num_threads=1, **options)


def recorded(objects, mode, play, load="two_mass", parameters=TRUTH, period=0.001):
    """A log of the real machine, whose noise is another."""
    real = machines(seed=77, load=load, parameters=parameters)
    motion.enable(real, mode)
    trace = real.record(objects, len(next(iter(play.values()))) * 0.001, play=play, period=period)
    return Log(trace.t, {name: trace[name] for name in objects})


def a_move(seconds=0.4):
    t = np.arange(round(seconds * 1000)) * 1e-3
    return np.rint(TURN * (1.0 - np.cos(2.0 * np.pi * 5.0 * t))).astype(int)


def written(path, log, labels=("node 1",)):
    known = EmulatedDrives(load="inertia", num_threads=1).device.new_dictionary()
    entries = [known.find(name) for name in log.objects]
    assert all(isinstance(entry, Entry) for entry in entries)
    rows = {entry: log.objects[name] for entry, name in zip(entries, log.objects, strict=True)}
    write_table(path, entries, list(labels), log.t, rows)
