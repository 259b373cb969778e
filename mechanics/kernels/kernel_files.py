"""Compiled kernels on disk: a file is used only if it is complete, and each kernel has its own file.

Numba's own cache unpickles any file: one truncated by a kill, a full disk or a power cut ends every program with an
UnpicklingError until it is removed, and a changed byte in machine code has arbitrary effects. Its index numbers the
kernels of a function, so two processes may give one number to two signatures, and one then runs the other's machine
code. Here a file holds one kernel after its hash, and is named after everything that it depends on.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import pickle
import re
import uuid
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

logger = logging.getLogger(__name__)

_DIGEST = hashlib.sha256().digest_size

# Log texts of a missing kernel, with its name, before and after it is compiled; at level DEBUG.
COMPILING, COMPILED = "compiling the kernel %s", "compiled the kernel %s"


class KernelCache(FunctionCache):  # type: ignore[misc]  # Numba has no types
    """Numba's cache of a function's kernels, with our files.

    Args:
        function: The function.
        folder: Existing folder of its kernels.
        stamp: Hash of all sources that it depends on.
    """

    def __init__(self, function: Any, folder: Path, stamp: str) -> None:
        super().__init__(function)
        self._cache_path = str(folder)
        # Without the composing function: the name is that of the module and its own.
        name = re.sub(r"\w+\.locals\.", "", self._impl.filename_base)
        self._cache_file = KernelFiles(folder, name, stamp)

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        # A composed kernel's closure contains stages, whose pickles differ between processes; the stamp covers them.
        return signature, codegen.magic_tuple(), hashlib.sha256(self._py_func.__code__.co_code).hexdigest()

    def _save_overload(self, signature: Any, kernel: Any) -> None:
        # Numba's own class would make a folder named after the source's path.
        if self._enabled and self._impl.check_cachable(kernel):
            self._cache_file.save(self._index_key(signature, kernel.codegen), self._impl.reduce(kernel))


class KernelFiles:
    """The kernels of one function, by their dependencies; Numba loads and saves through it.

    Args:
        folder: Their existing folder.
        name: Name of the function, with module and Python version.
        stamp: Hash of the function's sources.
    """

    def __init__(self, folder: Path, name: str, stamp: Any) -> None:
        self._folder, self._name, self._stamp = folder, name, stamp

    def load(self, key: Any) -> Any:
        """Return the kernel saved under a key; None if there is none, or its file is damaged."""
        path = self._path(key)
        try:
            content = path.read_bytes()
        except OSError:
            return self._missing()
        digest, data = content[:_DIGEST], content[_DIGEST:]
        if hashlib.sha256(data).digest() == digest:
            with suppress(Exception):  # complete and ours, but perhaps of another version of a package that Numba uses
                found, kernel = pickle.loads(data)
                if found == self._identity(key):
                    return kernel
        logger.warning("the compiled kernel %s is damaged or of another version; it is compiled again", path)
        _remove(path)
        return self._missing()

    def save(self, key: Any, kernel: Any) -> None:
        """Save a kernel; if that is impossible (disk full, folder gone), warn once and continue without."""
        logger.debug(COMPILED, self._name)
        data = dumps((self._identity(key), kernel))
        path = self._path(key)
        beside = path.with_name(f"{path.name}.{uuid.uuid4().hex[:16]}")  # two processes may write the same kernel
        try:
            beside.write_bytes(hashlib.sha256(data).digest() + data)
            beside.replace(path)
        except OSError as error:
            if not (os.name == "nt" and error.errno == errno.EACCES):  # another process is reading the same kernel
                _tell_not_kept(str(self._folder), error.strerror)
            _remove(beside)

    def flush(self) -> None:
        """Delete the function's kernels from the disk."""
        for path in self._folder.glob(f"{self._name}.*.kernel"):
            _remove(path)

    def _missing(self) -> None:
        _tell_compiling()
        logger.debug(COMPILING, self._name)

    def _identity(self, key: Any) -> str:
        """Return a kernel's dependencies as text, except the sources, which are in the folder's name."""
        return repr((self._stamp, key))

    def _path(self, key: Any) -> Path:
        digest = hashlib.sha256(self._identity(key).encode()).hexdigest()[:24]
        return self._folder / f"{self._name}.{digest}.kernel"


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink()


@cache
def _tell_compiling() -> None:
    logger.info("compiling the kernels: once for this installation, half a minute (ahead: `drive-env compile`)")


@cache
def _tell_not_kept(folder: str, reason: str | None) -> None:
    logger.warning(
        "compiled kernels cannot be stored in %s: %s; every program compiles them again. Make room, or set "
        "DRIVE_ENV_CACHE to another folder",
        folder,
        reason,
    )
