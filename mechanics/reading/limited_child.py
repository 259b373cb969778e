"""A call in a separate process with limits of memory and time: for libraries without limits of their own.

MuJoCo, onnxruntime and readers of logs have no limits: a short file may demand 10^9 bodies, 10^12 numbers or an endless
loop. Here the separate process ends, and the calling program continues. This limits the size of accidents and attacks,
but is not a sandbox: an exploited library has the user's rights.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from mechanics.reading.untrusted import UntrustedFileError

try:
    import resource
except ImportError:  # Windows: the time alone is limited there
    resource = None  # type: ignore[assignment]

MEMORY = 4_000_000_000  # bytes that a call may use in addition to its libraries
TIME = 60.0  # s of the processor
WAITING = 3.0  # times as long by the clock: other programs use the processor, too
_FOUND, _REFUSED, _MEMORY = b"+", b"-", b"m"  # first byte of a process' answer


def call_limited(
    what: str, function: Callable[..., bytes], *arguments: Any, memory: int | None = None, time: float | None = None
) -> bytes:
    """Return a function's result, computed in a process with limits.

    Args:
        what: Name of the file, for the message.
        function: A module's function that returns bytes, or raises ValueError about the file.
        arguments: Its arguments, which must be picklable.
        memory: Limit in bytes, if the system supports it (Linux); MEMORY by default.
        time: Processor time [s], TIME by default; by the clock three times as long.

    Raises:
        ValueError: As the function.
        UntrustedFileError: If a limit is exceeded, or the process ends in another way.
    """
    memory, time = MEMORY if memory is None else memory, TIME if time is None else time
    program = f"import sys; sys.path[:] = {sys.path!r}; from mechanics.reading.limited_child import answer; answer()"
    asked = pickle.dumps((function.__module__, function.__name__, arguments, memory, time))
    too_long = f"{what} takes more than {time:g} s to read, and no such file is read; make it smaller"
    try:
        found = subprocess.run(
            [sys.executable, "-c", program], input=asked, capture_output=True, timeout=WAITING * time, check=False
        )
    except subprocess.TimeoutExpired:
        raise UntrustedFileError(too_long) from None
    kind, content = found.stdout[:1], found.stdout[1:]
    if found.returncode == 0 and kind == _FOUND:
        return content
    if found.returncode == 0 and kind == _REFUSED:
        raise ValueError(content.decode("utf-8"))
    if resource is not None and found.returncode == -signal.SIGXCPU:
        raise UntrustedFileError(too_long)
    told = found.stderr.decode("utf-8", "replace").strip().splitlines()[-1:] if kind != _MEMORY else []
    raise UntrustedFileError(
        f"{what} takes more than {memory / 1e9:g} GB of memory to read, or ends the program that reads it, and no such "
        f"file is read; make it smaller{''.join(f' ({line[:200]})' for line in told)}"
    )


def answer() -> None:
    """Run the call read from standard input, and write its result to standard output."""
    module, name, arguments, memory, time = pickle.load(sys.stdin.buffer)
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of a library is not part of the answer
    function = getattr(import_module(module), name)
    _limit(memory, time)
    try:
        answered = _FOUND + function(*arguments)
    except MemoryError:
        answered = _MEMORY
    except ValueError as error:
        answered = _REFUSED + str(error).encode()
    out.write(answered)
    out.flush()
    os._exit(0)  # whatever a library's end would take


def _limit(memory: int, time: float) -> None:
    if resource is None:
        return
    rows = [(resource.RLIMIT_CORE, 0), (resource.RLIMIT_CPU, int(time) + 1)]
    with suppress(OSError, ValueError, IndexError), Path("/proc/self/statm").open() as file:
        rows.append((resource.RLIMIT_AS, int(file.read().split()[0]) * resource.getpagesize() + memory))
    for kind, most in rows:
        with suppress(OSError, ValueError):  # a system may have a lower limit, or none of this kind
            resource.setrlimit(kind, (most, resource.getrlimit(kind)[1]))
