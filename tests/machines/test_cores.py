"""Threads for the cores that a process may use, not for those of its machine."""

from __future__ import annotations

import os

import pytest

from drive_env import EmulatedDrives
from drive_env.cores import usable_cores

MANY = 64


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine of 64 cores whose control groups are files: returns what writes them."""
    monkeypatch.setattr(os, "cpu_count", lambda: MANY)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(MANY)), raising=False)

    def write(files):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        return tmp_path

    return write


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, MANY),  # no Linux
        ({"proc/self/cgroup": "0::/\n"}, MANY),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "200000 100000\n"}, 2),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "150000 100000\n"}, 2),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "10000 100000\n"}, 1),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "max 100000\n"}, MANY),
        # The tightest of the groups around it counts.
        ({"proc/self/cgroup": "0::/pod/box\n", "sys/fs/cgroup/pod/box/cpu.max": "max 100000\n",
          "sys/fs/cgroup/pod/cpu.max": "300000 100000\n"}, 3),
        # Version 1.
        ({"proc/self/cgroup": "7:memory:/box\n3:cpu,cpuacct:/box\n",
          "sys/fs/cgroup/cpu/box/cpu.cfs_quota_us": "400000\n",
          "sys/fs/cgroup/cpu/box/cpu.cfs_period_us": "100000\n"}, 4),
        ({"proc/self/cgroup": "1:cpu:/\n", "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1\n",
          "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000\n"}, MANY),
        # What cannot be understood is no quota.
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "\n"}, MANY),
    ],
)  # fmt: skip
def test_a_container_s_quota_counts(machine, files, cores):
    assert usable_cores(machine(files)) == cores


def test_the_affinity_counts(machine, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5, 9}, raising=False)
    assert usable_cores(machine({})) == 3


def test_drives_have_a_thread_for_each(monkeypatch):
    monkeypatch.setattr("drive_env.emulator.emulated_drives.usable_cores", lambda: 3)
    with EmulatedDrives(load="inertia", num_machines=2) as drives:
        assert drives._threads == 3
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as drives:
        assert drives._threads == 1
