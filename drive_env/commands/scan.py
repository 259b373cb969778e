"""`drive-env scan`: find the nodes on the bus, and identify them."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import Annotated, Any

import typer

from drive_env.commands.options import (
    Bitrate,
    Channel,
    Interface,
    Json,
    check_time,
    errors_as_exit_codes,
    fail,
    print_json,
    print_result,
)
from drive_env.commands.tables import print_lines

NOTHING_FOUND = 1
LOWEST, HIGHEST = 1, 127  # node-IDs
GAP = 0.001  # between two requests [s]: 127 at once would overrun small controllers
STRINGS = {0x1008: "name", 0x1009: "hardware", 0x100A: "software"}
IDENTITY = {1: "vendor", 2: "product", 3: "revision", 4: "serial"}


def scan(
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    first: Annotated[
        int | None, typer.Option(min=1, max=127, help="First node-ID to ask, on CAN.", show_default="1")
    ] = None,
    last: Annotated[
        int | None, typer.Option(min=1, max=127, help="Last node-ID to ask, on CAN.", show_default="127")
    ] = None,
    timeout: Annotated[float, typer.Option(help="Longest wait for an answer [s].")] = 0.3,
    json: Json = False,
) -> None:
    """Find nodes and read their identification: 1000h, 1008h to 100Ah, 1018h. Nothing is written.

    Two nodes that answer as one node-ID are named.

    On EtherCAT: the slaves in their order, what their EEPROMs say, and their states; no state changes.
    """
    with errors_as_exit_codes():
        from drive_env.master.can.port import Port, open_bus
        from drive_env.master.open_drives import is_ethercat

        check_time("--timeout", timeout)
        if is_ethercat(interface):
            for name, value in (("bitrate", bitrate), ("first", first), ("last", last)):
                if value is not None:
                    raise ValueError(f"--{name} is for CAN; all slaves of a segment are found: leave it out")
            _scan_ethercat(interface, channel, json)
            return
        first, last = first or LOWEST, last or HIGHEST
        if last < first:
            raise ValueError(f"--last {last} is below --first {first}")
        options = {"bitrate": bitrate} if bitrate else {}
        port = Port(open_bus(interface, channel, **options))
        try:
            found = [_look(port, *one, timeout) for one in sorted(_find(port, first, last, timeout))]
        finally:
            port.close()
        if json:
            print_json(found)
        elif found:
            _print(found, timeout)
        if not found:
            fail(
                f"no node of {first} to {last} answered within {timeout:g} s; check power, bit rate, termination and "
                "the channel",
                NOTHING_FOUND,
            )


def _scan_ethercat(interface: str | None, channel: str | None, json: bool) -> None:
    from drive_env.devices import devices_of
    from drive_env.master.ethercat.state_names import state_name
    from drive_env.master.ethercat_drives import open_frames

    master = open_frames(interface, channel)
    try:
        found = master.look()
    finally:
        master.close()
    rows: list[dict[str, Any]] = []
    for position, (status, identity) in enumerate(found):
        device = _name(devices_of(0, identity.vendor, identity.product))
        state = state_name(status.state) + (f", error {status.code:04X}h" if status.has_error else "")
        rows.append({"position": position, "device": device, "state": state} | identity._asdict())
    lines = []
    for row in rows:
        numbers = "  ".join(f"{name} {row[name]:X}h" for name in ("vendor", "product", "revision", "serial"))
        known = row["device"] or "unknown device; give its EDS with --eds"
        lines.append(f"position {row['position']}  {known}  {numbers}  {row['state']}")
    print_result(rows, lines, json)


def _find(port: Any, first: int, last: int, timeout: float) -> set[tuple[int, str, int]]:
    """Return the nodes that answer or are heard, each with its state if known, and the number that answered as it."""
    from drive_env.canopen.frames import ERROR_CONTROL, SDO_REQUEST, SDO_RESPONSE

    answered: Counter[int] = Counter()
    heard: dict[int, str] = {}
    states = {4: "stopped", 5: "operational", 127: "pre-operational"}

    def hear(node: int, data: bytes) -> None:
        if data == bytes(1):  # it has booted, which does not show its present state
            heard.setdefault(node, "")
            return
        heard[node] = states.get(data[0] & 0x7F, "unknown") if data else "unknown"

    for node in range(first, last + 1):
        port.subscribe(SDO_RESPONSE + node, lambda _, node=node: answered.update((node,)))
        port.subscribe(ERROR_CONTROL + node, partial(hear, node))
    for node in range(first, last + 1):
        port.send(SDO_REQUEST + node, bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0)))
        port.wait(lambda: False, GAP)
    port.wait(lambda: False, timeout)
    return {(node, heard.get(node, ""), answered[node]) for node in set(answered) | set(heard)}


def _look(port: Any, node: int, state: str, answers: int, timeout: float) -> dict[str, Any]:
    from drive_env.devices import devices_of
    from drive_env.dictionary.aborts import ObjectAccessError
    from drive_env.fieldbus.errors import BusError, NoAnswerError
    from drive_env.master.can.sdo import TWICE, SdoClient

    sdo = SdoClient(port, node)
    row: dict[str, Any] = {"node": node, "state": state}
    if answers > 1:  # each object would be one's or the other's
        return row | {"answers": answers}

    def read(index: int, sub: int) -> bytes | None:
        label = f"{index:04X}h:{sub:02X}"
        try:
            return sdo.read(index, sub, label, timeout)
        except NoAnswerError:
            row.setdefault("timed out", []).append(label)
        except (ObjectAccessError, BusError):
            pass  # optional
        return None

    kind = read(0x1000, 0)
    if kind is None:
        return row
    row["device type"] = int.from_bytes(kind, "little")
    for index, name in STRINGS.items():
        text = read(index, 0)
        if text is not None:
            row[name] = text.decode("utf-8", "replace").rstrip("\0 ")
    for sub, name in IDENTITY.items():
        number = read(0x1018, sub)
        if number is not None:
            row[name] = int.from_bytes(number, "little")
    row["device"] = _name(devices_of(row["device type"], row.get("vendor"), row.get("product")))
    return row | ({"answers": 2} if sdo.answered_twice >= TWICE else {})


def _name(devices: list[str]) -> str | None:
    """Return the names of the devices that a node may be; None without one."""
    return " or ".join(devices) or None


def _print(found: list[dict[str, Any]], timeout: float) -> None:
    from drive_env.master.can.sdo import several_answer

    for row in found:
        if "answers" in row:
            print_lines([f"node {row['node']}  {several_answer(row['answers'], row['node'])}"])
            continue
        late = ", ".join(row.get("timed out", ()))
        late = f"no answer to {late} within {timeout:g} s; try a longer --timeout" if late else ""
        if "device type" not in row:
            why = late if late and row["state"] != "stopped" else "no SDO answer"  # a stopped node never answers
            print_lines([f"node {row['node']}  {why}" + (f" ({row['state']})" if row["state"] else "")])
            continue
        profile = row["device type"] & 0xFFFF
        facts = [row["device"] or "unknown device; give its EDS with --eds", row.get("name", "")]
        facts += [f"{name} {row[name]}" for name in ("hardware", "software") if name in row]
        facts += [f"{name} {row[name]:X}h" for name in ("vendor", "product", "revision", "serial") if name in row]
        facts += [f"CiA {profile}" if profile else "no profile", row["state"], late]
        print_lines([f"node {row['node']}  " + "  ".join(fact for fact in facts if fact)])
