"""A socket on loopback by which `drive-env fault` adds faults to a served bus and lists them.

One request a connection: a line of text, answered by a line of JSON. "fault NAME at=2 share=0.1" schedules one,
"faults" lists them, "clear 3" or "clear all" ends them.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from typing import Any

from drive_env.bus.bus_faults import BusFaults
from drive_env.faults.schedule import parse_order
from mechanics.reading.untrusted import parse_json

LOOPBACK = "127.0.0.1"
PORT = 29637  # beside the hub's
LONGEST_LINE = 4096  # bytes
PATIENCE = 1.0  # s that a client may take to send its line
ANSWER_TIME = 5.0  # s that the server may take to answer


class ControlError(RuntimeError):
    """No server answers at the address, or the answer is not that of a control socket."""


class Control:
    """The listening socket, served by a separate thread until `close`.

    Args:
        faults: The faults that requests act on.
        port: TCP port on loopback, 0 for a free one.

    Raises:
        OSError: If the port is not available.
    """

    def __init__(self, faults: BusFaults, port: int = PORT) -> None:
        self._faults = faults
        self._listener = socket.create_server((LOOPBACK, port))
        self.port = int(self._listener.getsockname()[1])
        self._thread = threading.Thread(target=self._serve, name="fault control", daemon=True)
        self._is_closed = False
        self._thread.start()

    def close(self) -> None:
        """Close the port and end the thread."""
        self._is_closed = True
        with contextlib.suppress(OSError):  # wakes the thread, which waits for a client
            socket.create_connection((LOOPBACK, self.port), PATIENCE).close()
        self._thread.join(2.0 * PATIENCE)
        self._listener.close()

    # --- inside ---------------------------------------------------------------------------------------------------
    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:  # a client that has already left, or no file number left
                if self._is_closed:
                    return
                continue
            with connection:
                if self._is_closed:
                    return
                try:
                    connection.settimeout(PATIENCE)
                    answer = self._answer(_line(connection))
                    connection.sendall(json.dumps(answer).encode() + b"\n")
                except OSError:  # a client that sends no line, or does not read the answer
                    continue

    def _answer(self, line: str) -> dict[str, Any]:
        request, _, rest = line.strip().partition(" ")
        try:
            if request == "fault":
                return {"number": self._faults.add(parse_order(rest))}
            if request == "faults":
                return {"faults": [_told(one) for one in self._faults.listing()]}
            if request == "clear":
                self._faults.clear(None if rest == "all" else _number(rest))
                return {}
            raise ValueError(f"{request!r} is not a request; there are fault, faults and clear")
        except ValueError as error:
            return {"error": str(error)}


def ask(port: int, request: str) -> dict[str, Any]:
    """Send a request to the control socket of a bus that is served, and return its answer.

    Raises:
        ControlError: If no server answers there.
        ValueError: With the server's message about an invalid request.
    """
    remedy = f"start it with drive-env serve --control {port}, or give another --control"
    try:
        with socket.create_connection((LOOPBACK, port), ANSWER_TIME) as connection:
            connection.sendall(request.encode() + b"\n")
            answer = parse_json(_line(connection))
    except OSError as error:
        raise ControlError(f"no bus takes faults at port {port} ({error.strerror or error}); {remedy}") from None
    except ValueError:
        raise ControlError(f"what answers at port {port} takes no faults; {remedy}") from None
    if not isinstance(answer, dict):
        raise ControlError(f"what answers at port {port} takes no faults; {remedy}")
    if "error" in answer:
        raise ValueError(answer["error"])
    return answer


def _line(connection: socket.socket) -> str:
    data = b""
    while b"\n" not in data and len(data) < LONGEST_LINE:
        more = connection.recv(LONGEST_LINE)
        if not more:
            break
        data += more
    return data.decode("utf-8", errors="replace").partition("\n")[0]


def _number(text: str) -> int:
    if not text.isdecimal():
        raise ValueError(f"clear takes the number of a fault, or all, not {text!r}")
    return int(text)


def _told(fault: Any) -> dict[str, Any]:
    order = fault.order
    return {
        "number": fault.number, "name": order.name, "node": fault.node, "axis": order.axis, "at": order.at,
        "when": order.when, "duration": order.duration, "parameters": order.parameters, "active": fault.is_active,
    }  # fmt: skip
