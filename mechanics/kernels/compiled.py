"""Compilation of our Numba kernels, and the storage of their machine code."""

from __future__ import annotations

import gc
import hashlib
import os
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numba
from numba import config, njit, types
from numba.core import event

from mechanics.kernels.kernel_files import KernelCache
from mechanics.kernels.stage_compiler import StageCompiler, remembered_answers

Function = TypeVar("Function", bound=Callable[..., Any])

# error_model="numpy" makes a division by zero give inf as the hardware does; Python's raises, which is a branch in
# every division and keeps LLVM from vectorising the loop around it.
OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True}

_OURS = ("mechanics", "drive_env", "tuning", "agents")
# At the beginning of a line: imports in functions or under `if TYPE_CHECKING` are not used by kernels.
_IMPORT = re.compile(r"^(?:from ([\w.]+) import (\([^)]*\)|.*)|import (.*))$", re.MULTILINE)

# Without Numba's runtime no references to arrays are counted. Atomic counting for a load's many arrays at each call of
# a stage took 0.2 to 1.3 us, half of the emulator's overhead on 64 steps of MuJoCo.
UNCOUNTED: dict[str, Any] = {"_nrt": False}
# Functions called only by kernels need no wrappers for Python or C: compiling those took a tenth of the time.
UNWRAPPED: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


class _QuickCompilation(event.Listener):  # type: ignore[misc]  # Numba has no types
    """Caches Numba's repeated answers and pauses Python's cyclic garbage collector during a compilation.

    A compilation makes millions of objects that live until its end: searching them repeatedly took a sixth of the time.
    Numba compiles in one thread at a time.
    """

    def __init__(self) -> None:
        self._nested, self._changed = 0, ExitStack()

    def on_start(self, event: event.Event) -> None:
        """Begin at the outermost function."""
        if self._nested == 0:
            if gc.isenabled():
                gc.disable()
                self._changed.callback(gc.enable)
            self._changed.enter_context(remembered_answers())
        self._nested += 1

    def on_end(self, event: event.Event) -> None:
        """Restore everything, however the compilation ended."""
        self._nested -= 1
        if self._nested == 0:
            self._changed.close()


event.register("numba:compile", _QuickCompilation())


def call_after_each_function(count: Callable[[], None]) -> None:
    """Have a function called after Numba has compiled any function."""

    class Counter(event.Listener):  # type: ignore[misc]  # Numba has no types
        def on_start(self, _event: event.Event) -> None:
            pass

        def on_end(self, _event: event.Event) -> None:
            count()

    event.register("numba:compile", Counter())


def user_cache_folder() -> Path:
    """Return the folder in which compiled kernels are kept; `DRIVE_ENV_CACHE` overrides the platform's own."""
    if chosen := os.environ.get("DRIVE_ENV_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", str(Path.home()))) / "drive-env"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "drive-env"
    return Path(os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))) / "drive-env"


def sources(module: ModuleType) -> dict[str, Path]:
    """Return the files that a module's kernels depend on: the module's file and all project files that it imports.

    Imports under TYPE_CHECKING are not loaded, and do not count.

    Args:
        module: A loaded module, or one whose imports are loaded.
    """
    found: dict[str, Path] = {}
    waiting = [module]
    while waiting:
        one = waiting.pop()
        path = getattr(one, "__file__", None)
        if one.__name__ in found or path is None:
            continue
        found[one.__name__] = Path(path)
        waiting += [sys.modules[name] for name in _imports(Path(path)) if name in sys.modules]
    return found


@cache
def _imports(path: Path) -> frozenset[str]:
    """Return the project modules that a file imports when it is loaded; for `from a import b` both a and a.b."""
    names: set[str] = set()
    for line in _IMPORT.finditer(path.read_text(encoding="utf-8")):
        package, parts, plain = line.groups()
        whole = [name.split(" as ")[0].strip(" ()\n") for name in re.sub(r"#.*", "", parts or plain).split(",")]
        names |= {package, *(f"{package}.{name}" for name in whole)} if package else set(whole)
    return frozenset(name for name in names if name.split(".")[0] in _OURS)


def source_hash(files: Mapping[str, Path]) -> str:
    """Return a hash of the names and contents of modules and of Numba's version; independent of their folder.

    Numba's own cache checks only the file of the outermost function, and would miss an edit in a stage inlined from
    another file; a folder per state of the sources cannot.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for name, path in sorted(files.items()):
        digest.update(f"{name}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def cached(*, allocates: bool = True, source: str | None = None) -> Callable[[Function], Function]:
    """Return a decorator that compiles an entry point and keeps its machine code on disk, keyed by its sources.

    Args:
        allocates: Whether it creates arrays; if not, it counts no references, see `stage`.
        source: Name of the module whose sources it depends on, if not its own.
    """
    options = OPTIONS if allocates else OPTIONS | UNCOUNTED

    def decorate(function: Function) -> Function:
        stamp = source_hash(sources(sys.modules[source or function.__module__]))
        folder = user_cache_folder() / stamp
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            return njit(**options)(function)  # type: ignore[no-any-return]
        kernel: Any = njit(**options)(function)
        before = config.CACHE_DIR
        config.CACHE_DIR = str(folder)
        try:
            kernel._cache = KernelCache(function, folder, stamp)  # as cache=True does, but with verified files
        except RuntimeError:  # Numba finds no writable folder
            return kernel  # type: ignore[no-any-return]
        finally:
            config.CACHE_DIR = before
        return kernel  # type: ignore[no-any-return]

    return decorate


def stage(function: Function) -> Function:
    """Compile a function that only kernels call. It cannot create arrays."""
    kernel: Any = njit(**OPTIONS, **UNCOUNTED, **UNWRAPPED, pipeline_class=StageCompiler)(function)
    specialised = kernel.get_call_template

    # Numba would compile it once more for each constant argument: the automaton's transitions seven times. The
    # optimiser still sees the constant when it inlines the function.
    def of_any_number(args: Any, kws: Any) -> Any:
        return specialised(
            tuple(types.unliteral(one) for one in args), {name: types.unliteral(one) for name, one in kws.items()}
        )

    kernel.get_call_template = of_any_number
    return kernel  # type: ignore[no-any-return]


def inlined(function: Function) -> Function:
    """Compile a function that is inlined at each call, as all functions in a vectorised lane loop must be."""
    return njit(inline="always", **OPTIONS)(function)  # type: ignore[no-any-return]
