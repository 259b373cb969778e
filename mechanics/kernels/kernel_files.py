"""Compiled kernels on disk: a file is taken only if it is whole, and each kernel has a file of its own.

Numba's own cache unpickles whatever its files hold: one torn by a kill, a full disk or a power cut ends every program
with an UnpicklingError until somebody removes it, and one with another byte in its machine code does anything at all.
Its index numbers the kernels of a function, so that two processes may give one number to two signatures, and one then
runs the other's machine code. Here a file holds one kernel behind its hash, and is named after all that it depends on.
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

# What is logged of each kernel that is not there, with its name, before and after it is compiled; at level DEBUG.
COMPILING, COMPILED = "compiling the kernel %s", "compiled the kernel %s"


class KernelCache(FunctionCache):  # type: ignore[misc]  # Numba has no types
    """Numba's cache of a function's kernels, with files of ours.

    Args:
        function: What is compiled.
        folder: Where its kernels are; it exists.
        stamp: Of all sources that it is compiled from.
    """

    def __init__(self, function: Any, folder: Path, stamp: str) -> None:
        super().__init__(function)
        self._cache_path = str(folder)
        # Without the function that composes it: its name is the module's and its own.
        name = re.sub(r"\w+\.locals\.", "", self._impl.filename_base)
        self._cache_file = KernelFiles(folder, name, stamp)

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        # What a composed kernel closes over are stages, whose pickles are others in each process; the stamp knows them.
        return signature, codegen.magic_tuple(), hashlib.sha256(self._py_func.__code__.co_code).hexdigest()

    def _save_overload(self, signature: Any, kernel: Any) -> None:
        # Numba's own makes a folder besides, named after where the source lies.
        if self._enabled and self._impl.check_cachable(kernel):
            self._cache_file.save(self._index_key(signature, kernel.codegen), self._impl.reduce(kernel))


class KernelFiles:
    """The kernels of one function, by what each depends on; it is what Numba asks for one and gives one to.

    Args:
        folder: Where they are; it exists.
        name: Of the function, with place and Python version.
        stamp: Of the function's sources.
    """

    def __init__(self, folder: Path, name: str, stamp: Any) -> None:
        self._folder, self._name, self._stamp = folder, name, stamp

    def load(self, key: Any) -> Any:
        """Return what was saved under a key; None if nothing was, or if its file is not whole any more."""
        path = self._path(key)
        try:
            content = path.read_bytes()
        except OSError:
            return self._missing()
        digest, data = content[:_DIGEST], content[_DIGEST:]
        if hashlib.sha256(data).digest() == digest:
            with suppress(Exception):  # whole and ours, but perhaps of another version of what Numba stands on
                found, kernel = pickle.loads(data)
                if found == self._identity(key):
                    return kernel
        logger.warning("the compiled kernel %s is damaged or of another version; it is compiled again", path)
        _remove(path)
        return self._missing()

    def save(self, key: Any, kernel: Any) -> None:
        """Keep a kernel; where that is impossible (disk full, folder gone), say so once and go on without."""
        logger.debug(COMPILED, self._name)
        data = dumps((self._identity(key), kernel))
        path = self._path(key)
        beside = path.with_name(f"{path.name}.{uuid.uuid4().hex[:16]}")  # two processes may write the same kernel
        try:
            beside.write_bytes(hashlib.sha256(data).digest() + data)
            beside.replace(path)
        except OSError as error:
            if not (os.name == "nt" and error.errno == errno.EACCES):  # another process reads the same kernel there
                _tell_not_kept(str(self._folder), error.strerror)
            _remove(beside)

    def flush(self) -> None:
        """Forget what was kept."""
        for path in self._folder.glob(f"{self._name}.*.kernel"):
            _remove(path)

    def _missing(self) -> None:
        _tell_compiling()
        logger.debug(COMPILING, self._name)

    def _identity(self, key: Any) -> str:
        """Return all that a kernel depends on besides the sources in the folder's name, as text."""
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
