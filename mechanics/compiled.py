"""How our Numba kernels are compiled and where their machine code is kept."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba import config, njit

from mechanics.kernel_files import KernelCache

Function = TypeVar("Function", bound=Callable[..., Any])

# error_model="numpy" makes a division by zero give inf as the hardware does; Python's raises, which is a branch in
# every division and keeps LLVM from vectorising the loop around it.
OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True}

# Without Numba's runtime no references to arrays are counted. To count those of a load's many arrays, atomically, at
# each call of a stage took 0.2 to 1.3 us, half of what the emulator added to 64 steps of MuJoCo's.
UNCOUNTED: dict[str, Any] = {"_nrt": False}
# What kernels alone call needs no way in from Python or C: compiling those took a tenth of the whole.
UNWRAPPED: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def user_cache_folder() -> Path:
    """Return the folder in which compiled kernels are kept; `DRIVE_ENV_CACHE` overrides the platform's own."""
    if chosen := os.environ.get("DRIVE_ENV_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", str(Path.home()))) / "drive-env"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "drive-env"
    return Path(os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))) / "drive-env"


def source_hash(folders: Iterable[Path]) -> str:
    """Return a hash of all Python sources under the folders and of Numba's version.

    Numba's own cache looks at the file of the outermost function only, so an edit in a stage that is inlined from
    another file would go unseen; a folder per state of the sources cannot miss one.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.relative_to(folder).as_posix().encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cached(*folders: Path, allocates: bool = True) -> Callable[[Function], Function]:
    """Return a decorator that compiles an entry point and keeps its machine code on disk, keyed by the sources.

    Args:
        folders: The source folders of everything that the entry point calls.
        allocates: Whether it makes arrays; if not, it counts no references, see `stage`.
    """
    options = OPTIONS if allocates else OPTIONS | UNCOUNTED
    folder = user_cache_folder() / source_hash(folders)

    def decorate(function: Function) -> Function:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            return njit(**options)(function)  # type: ignore[no-any-return]
        kernel: Any = njit(**options)(function)
        before = config.CACHE_DIR
        config.CACHE_DIR = str(folder)
        try:
            kernel._cache = KernelCache(function)  # what cache=True does, with files that can be trusted
        except RuntimeError:  # Numba finds no folder that can be written
            return kernel  # type: ignore[no-any-return]
        finally:
            config.CACHE_DIR = before
        return kernel  # type: ignore[no-any-return]

    return decorate


def stage(function: Function) -> Function:
    """Compile a function that kernels call, and they alone: Python would crash. It cannot make arrays."""
    return njit(**OPTIONS, **UNCOUNTED, **UNWRAPPED)(function)  # type: ignore[no-any-return]


def inlined(function: Function) -> Function:
    """Compile a function whose body is put in place of each call; what a vectorised lane loop calls must be one."""
    return njit(inline="always", **OPTIONS)(function)  # type: ignore[no-any-return]
