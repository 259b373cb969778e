"""MuJoCo's step and its parts, for calls from compiled code."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

import llvmlite.binding
import mujoco
from numba import types


def _load_mujoco() -> None:
    """Make `mj_step` known to the compiler by name; a name can be cached on disk, an address cannot."""
    folder = Path(mujoco.__file__).parent
    pattern = {"win32": "mujoco*.dll", "darwin": "libmujoco*.dylib"}.get(sys.platform, "libmujoco.so*")
    found = sorted(folder.glob(pattern))
    if not found:
        raise ImportError(f"no MuJoCo library ({pattern}) in {folder}; install the package mujoco 3 or later")
    llvmlite.binding.load_library_permanently(str(found[0]))
    ctypes.CDLL(str(found[0]))


_load_mujoco()
_call = types.void(types.uintp, types.uintp)
step = types.ExternalFunction("mj_step", _call)
# The two halves of mj_step: from positions and speeds, then from forces. The first takes 80 % of the time.
step1 = types.ExternalFunction("mj_step1", _call)
step2 = types.ExternalFunction("mj_step2", _call)
factor = types.ExternalFunction("mj_factorM", _call)
