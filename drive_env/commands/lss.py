"""`drive-env lss`: give nodes their node-ID and bit rate over the bus, also those that have none (CiA 305)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from drive_env.commands.options import (
    Bitrate,
    Channel,
    DryRun,
    Interface,
    Json,
    Yes,
    ask,
    check_time,
    errors_as_exit_codes,
    fail,
    print_result,
)

if TYPE_CHECKING:
    from drive_env.canopen.lss import LssIdentity
    from drive_env.master.can.lss import LssMaster
    from drive_env.master.can.port import Port

NOTHING_FOUND = 1
STORE_TIMEOUT = 5.0  # s: erasing flash takes up to seconds
BOOT_TIMEOUT = 5.0  # s: drives boot within one or two
LONGEST_DELAY = 60.0  # s, of the 65.535 that fit into a frame
RESET_COMMUNICATION = 0x82

lss_app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown")


@lss_app.callback()
def lss() -> None:
    """Node-ID and bit rate over the bus, for drives that have LSS (CiA 305); a node without a node-ID waits for one."""


Which = Annotated[
    str | None,
    typer.Option(
        "--identity", help="The node by its 1018h: vendor:product:revision:serial in hexadecimal.", show_default=False
    ),
]
Now = Annotated[
    int | None,
    typer.Option("--node", "-n", min=1, max=127, help="The node by its present node-ID.", show_default=False),
]
Wait = Annotated[float, typer.Option("--timeout", help="Longest wait for an answer, in a scan for each step [s].")]
Store = Annotated[bool, typer.Option("--store/--no-store", help="Let the node keep it after power-off.")]


@lss_app.command("scan")
def scan_lss(
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    timeout: Wait = 0.1,
    json: Json = False,
) -> None:
    """Find the nodes that have no node-ID, by fastscan, and print the identity of each. Nothing is changed.

    A node takes 133 steps; each without an answer waits for --timeout: 2 s, with large numbers up to 13 s.
    Nodes that have a node-ID are found by `drive-env scan`.
    """
    with errors_as_exit_codes():
        from drive_env.master.can.lss import show

        check_time("--timeout", timeout)
        with _open(interface, channel, bitrate, timeout) as (_, master), master.configuring():
            found = list(master.scan())
        rows = [{**one._asdict(), "identity": show(one)} for one in found]
        print_result(rows, [f"no node-ID  {_facts(one)}  --identity {show(one)}" for one in found], json)
        if not found:
            fail(
                "no node without a node-ID answered; those that have one are found by `drive-env scan`, and a drive "
                "without LSS by neither",
                NOTHING_FOUND,
            )


@lss_app.command("node-id")
def set_node_id(
    new: Annotated[int, typer.Argument(metavar="NODE-ID", help="The new node-ID, 1 to 127; 255 takes it away.")],
    identity: Which = None,
    node: Now = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    store: Store = True,
    reset: Annotated[
        bool, typer.Option("--reset", help="Reset the communication of --node, which stops its axes.")
    ] = False,
    timeout: Wait = 0.1,
    yes: Yes = False,
    dry_run: DryRun = False,
) -> None:
    """Give a node a node-ID: the one with --identity, the one that is --node now, or the only one that has none.

    A node that had none boots with it at once. Another one keeps its node-ID until its next reset: that of --reset, or
    power-off.
    """
    with errors_as_exit_codes():
        from drive_env.canopen.lss import UNCONFIGURED
        from drive_env.master.can.lss import await_node, is_taken

        check_time("--timeout", timeout)
        if not (1 <= new <= 127 or new == UNCONFIGURED):
            raise ValueError(f"node-ID {new} is impossible: CANopen has 1 to 127, and 255 takes it away")
        _check_choice(identity, node, dry_run)
        if reset and node is None:
            raise ValueError("--reset is for a node that has a node-ID; name it with --node")
        if new == node:
            raise ValueError(f"node {node} has the node-ID {new} already; give another one")
        with _open(interface, channel, bitrate, timeout, dry_run=dry_run) as (port, master):
            if not dry_run and new != UNCONFIGURED and is_taken(port, new, max(timeout, 0.3)):
                raise ValueError(f"node-ID {new} is taken: a node answers under it; choose a free one")
            chosen = _choose(port, master, identity, node, timeout)
            what = f"the node-ID {new}" if new != UNCONFIGURED else "no node-ID"
            if not dry_run:
                ask(f"Give {what} to {_name(chosen, node)}{', and reset it' if reset else ''}?", yes)
            with master.configuring():
                master.select(chosen)
                boots = reset or (not dry_run and master.node_id() == UNCONFIGURED)
                master.configure_node_id(new)
                if store:
                    master.store(STORE_TIMEOUT)
            if reset:
                port.send(0, bytes((RESET_COMMUNICATION, node or 0)))
            if not dry_run:
                kept = "" if store else "; it is lost with the power"
                when = "" if boots else "; it takes effect with the next reset (NMT, or power)"
                if boots:  # by SDO, which is not part of LSS
                    await_node(port, chosen, new, node, BOOT_TIMEOUT)
                print(f"{_name(chosen, node)} has {what}{when}{kept}")


@lss_app.command("bit-rate")
def set_bit_rate(
    new: Annotated[int, typer.Argument(metavar="BIT/S", help="The new bit rate: 1000000, 500000, 250000, ...")],
    identity: Which = None,
    node: Now = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    store: Store = True,
    activate: Annotated[
        float | None,
        typer.Option(
            "--activate",
            help="Change to it at once: silent for this time [s], and as long again. Enabled axes stop.",
            show_default=False,
        ),
    ] = None,
    timeout: Wait = 0.1,
    yes: Yes = False,
    dry_run: DryRun = False,
) -> None:
    """Give a node a bit rate: the one with --identity, the one that is --node now, or the only one without a node-ID.

    It takes effect with the next power-on. With --activate it does at once, and this bus no longer reaches the node:
    open it anew with the new bit rate.
    """
    with errors_as_exit_codes():
        from drive_env.master.can.lss import row_of

        check_time("--timeout", timeout)
        row_of(new)
        if activate is not None and not 0.001 <= activate <= LONGEST_DELAY:
            raise ValueError(f"--activate {activate:g} s must be 0.001 s to {LONGEST_DELAY:g} s")
        if activate is None and not store:
            raise ValueError("neither stored nor activated it would come to nothing; leave --no-store out")
        _check_choice(identity, node, dry_run)
        with _open(interface, channel, bitrate, timeout, dry_run=dry_run) as (port, master):
            chosen = _choose(port, master, identity, node, timeout)
            now = " now, which stops its axes" if activate is not None else ""
            if not dry_run:
                ask(f"Give {new} bit/s to {_name(chosen, node)}{now}?", yes)
            with master.configuring():
                master.select(chosen)
                master.configure_bit_rate(new)
                if store:
                    master.store(STORE_TIMEOUT)
                if activate is not None:
                    master.activate_bit_rate(activate)
            if not dry_run:
                kept = "" if store else "; it is lost with the power"
                if activate is None:
                    print(f"{_name(chosen, node)} has {new} bit/s with the next power-on")
                else:  # this bus cannot show it
                    print(f"{_name(chosen, node)} changes to {new} bit/s in {activate:g} s{kept}; open the bus with it "
                          "to see that it is there")  # fmt: skip


# --- what they share --------------------------------------------------------------------------------------------------
@contextmanager
def _open(
    interface: str | None, channel: str | None, bitrate: int | None, timeout: float, *, dry_run: bool = False
) -> Iterator[tuple[Port, LssMaster]]:
    from drive_env.master.can.dry_run import DryPort
    from drive_env.master.can.lss import LssMaster
    from drive_env.master.can.port import Port, open_bus

    if dry_run:
        port: Port = DryPort(print)
    else:
        port = Port(open_bus(interface, channel, **({"bitrate": bitrate} if bitrate else {})))
    try:
        yield port, LssMaster(port, timeout, is_dry=dry_run)
    finally:
        port.close()


def _check_choice(identity: str | None, node: int | None, dry_run: bool) -> None:
    from drive_env.master.can.lss import parse_identity

    if identity is not None and node is not None:
        raise ValueError("--identity and --node name a node both; give one of them")
    if identity is not None:
        parse_identity(identity)
    elif dry_run:
        raise ValueError("--dry-run cannot find out which node is there; name it with --identity")


def _choose(port: Port, master: LssMaster, identity: str | None, node: int | None, timeout: float) -> LssIdentity:
    """Return the identity of the chosen node; all slaves wait afterwards."""
    from drive_env.master.can.lss import LssError, identity_of, parse_identity, show

    if identity is not None:
        return parse_identity(identity)
    if node is not None:
        return identity_of(port, node, max(timeout, 0.3))
    with master.configuring():
        found = list(master.scan())
    if not found:
        raise LssError(
            "no node without a node-ID answered; name one that has one with --node, or by its 1018h with --identity"
        )
    if len(found) > 1:
        raise LssError(f"{len(found)} nodes have no node-ID; choose one with --identity: {', '.join(map(show, found))}")
    return found[0]


def _facts(identity: LssIdentity) -> str:
    return "  ".join(f"{name} {number:X}h" for name, number in identity._asdict().items())


def _name(identity: LssIdentity, node: int | None) -> str:
    from drive_env.master.can.lss import show

    return f"node {node}" if node is not None else f"the node {show(identity)}"
