"""How many cores this process may use: those that affinity and a container's quota leave of the machine's."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path


def usable_cores(root: Path = Path("/")) -> int:
    """Return how many threads of this process can compute at the same time, at least one.

    A quota of 1.5 cores counts as two: the third thread of three would wait half of its time.

    Args:
        root: Where /proc and /sys are found.
    """
    cores = float(os.cpu_count() or 1)
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        cores = len(os.sched_getaffinity(0))
    return max(1, math.ceil(min([cores, *_quotas(root)])))


def _quotas(root: Path) -> Iterator[float]:
    """Yield the quotas [cores] of the control groups around this process, of Linux' version 2 and 1."""
    lines: list[str] = []
    with suppress(OSError):
        lines = (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    for line in lines:
        _, controllers, path = line.split(":", 2)
        top = root / "sys/fs/cgroup"
        if "cpu" in controllers.split(","):
            top /= "cpu"
        elif controllers:
            continue
        group = top / path.lstrip("/")
        for one in (group, *group.parents):
            with suppress(OSError, ValueError):
                yield _quota(one)
            if one == top:
                break


def _quota(group: Path) -> float:
    """Return the quota [cores] of one control group; raises OSError or ValueError where it has none."""
    if (group / "cpu.max").exists():
        quota, period = (group / "cpu.max").read_text(encoding="utf-8").split()
        return float(quota) / float(period)  # "max" is no number
    quota, period = ((group / f"cpu.cfs_{name}_us").read_text(encoding="utf-8") for name in ("quota", "period"))
    if float(quota) <= 0.0:
        raise ValueError(f"a quota of {quota} is no limit")
    return float(quota) / float(period)
