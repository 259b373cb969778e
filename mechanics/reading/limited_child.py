"""A call in a process of its own, with limits of memory and time: for libraries that take what a file asks for.

MuJoCo, onnxruntime and readers of logs have no limits of their own: a short file may ask for 10^9 bodies, 10^12 numbers
or an end that never comes. Here that process ends, and the program that asked goes on. It limits accidents and malice
by size; it is no sandbox, and a fault in such a library runs with the user's rights.
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

MEMORY = 4_000_000_000  # bytes that a call may take more than its libraries do
TIME = 60.0  # s of the processor
WAITING = 3.0  # times as long by the clock: other programs take the processor, too
_FOUND, _REFUSED, _MEMORY = b"+", b"-", b"m"  # what the answer of a process begins with


def call_limited(
    what: str, function: Callable[..., bytes], *arguments: Any, memory: int | None = None, time: float | None = None
) -> bytes:
    """Return what a function makes of its arguments, in a process that may not take more than the limits.

    Args:
        what: What is read, for the message.
        function: Of a module; it returns bytes, and raises ValueError with what is wrong with the file.
        arguments: What it takes; they must pickle.
        memory: Bytes that it may take, where the system limits them (Linux); MEMORY by default.
        time: Of the processor [s], TIME by default; by the clock three times as long.

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
    """Make the call that stands on the standard input, and write its result to the standard output."""
    module, name, arguments, memory, time = pickle.load(sys.stdin.buffer)
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
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
