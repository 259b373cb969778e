"""Optional services of a device's CANopen node, and its quirks: the tables `services` and `quirks` of `canopen`.

A missing table or key means that the device lacks the service, or follows the standard.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from mechanics.reading.near_names import did_you_mean

LSS_BIT_RATES = (1000, 800, 500, 250, 125, 50, 20, 10)  # kbit/s of CiA 305's table
# Optional causes in a device's table of emergencies: a SYNC of another length than 1019h gives, and PDOs later than
# 1007h allows.
OPTIONAL_EMERGENCIES = ("sync_length", "sync_window_missed")
BIT_30 = ("keep", "refuse", "store")


class NodeServices(NamedTuple):
    """Optional services of a node.

    Those of 1003h, 1007h, 1019h and 1012h with 1013h need no row here: the node has them if its EDS does.

    Attributes:
        block_size: Segments of a sub-block of SDO block transfers, 1 to 127; 0: no block transfers.
        longest_text: Longest string or domain that it accepts [bytes]; 0: only numbers can be written.
        sync_producer: Whether bit 30 of 1005h makes it produce SYNC with the period of 1006h.
        time_producer: Whether bit 30 of 1012h makes it produce TIME.
        time_period: Seconds between two TIME messages that it produces.
        lss: Whether it is a slave of the layer setting services (CiA 305).
        lss_bit_rates: Bit rates [kbit/s] that LSS may set.
        lss_stores: Whether it stores the settings of LSS.
    """

    block_size: int = 0
    longest_text: int = 0
    sync_producer: bool = False
    time_producer: bool = False
    time_period: float = 1.0
    lss: bool = False
    lss_bit_rates: tuple[int, ...] = LSS_BIT_RATES
    lss_stores: bool = True


class NodeQuirks(NamedTuple):
    """Deviations of a node from the standard.

    Attributes:
        rpdo_bit_30: Handling of bit 30 in the COB-ID of an RPDO, which CiA 301 does not define there. "keep": the
            factory's bit stays, whatever is written; "refuse": another bit than the factory's is refused with
            06090030h; "store": the written bit is stored.
        history_tells_number: Whether 1003h has the first additional byte of the emergency in bits 24 to 29.
        further_axis_bit: Bits of 1001h that are set while an axis other than the first has an error.
        unused_register_bits: Bits of 1001h that no error sets.
        empty_history_reads_0: Whether a sub-index of 1003h without an error yet reads 0; otherwise it is refused with
            08000024h.
        stores_mapped: Whether 1010h also stores mappable objects, except commands.
        pdo_changes_while_on: Whether a PDO's identifier and inhibit time can be written without setting its bit 31
            first.
    """

    rpdo_bit_30: str = "keep"
    pdo_changes_while_on: bool = False
    history_tells_number: bool = False
    further_axis_bit: int = 0
    unused_register_bits: int = 0
    empty_history_reads_0: bool = False
    stores_mapped: bool = False


def services_of(data: Mapping[str, Any]) -> NodeServices:
    """Return the services of a device's table `canopen`; ValueError for an invalid key or value."""
    row = _known(data.get("services", {}), NodeServices, "services")
    found = NodeServices(**{**row, "lss_bit_rates": tuple(row.get("lss_bit_rates", LSS_BIT_RATES))})
    if not 0 <= found.block_size <= 127:
        raise ValueError(f"canopen.services.block_size = {found.block_size} must be 1 to 127 segments, or 0 for none")
    if found.longest_text < 0:
        raise ValueError(f"canopen.services.longest_text = {found.longest_text} must be a number of bytes, or 0")
    if not found.time_period > 0.0:
        raise ValueError(f"canopen.services.time_period = {found.time_period:g} s must be above 0 s")
    unknown = [rate for rate in found.lss_bit_rates if rate not in LSS_BIT_RATES]
    if unknown:
        raise ValueError(
            f"canopen.services.lss_bit_rates: CiA 305 has no {', '.join(map(str, unknown))} kbit/s; it has "
            f"{', '.join(map(str, LSS_BIT_RATES))}"
        )
    return found


def node_quirks_of(data: Mapping[str, Any]) -> NodeQuirks:
    """Return the quirks of a device's table `canopen`; ValueError for an invalid key or value."""
    found = NodeQuirks(**_known(data.get("quirks", {}), NodeQuirks, "quirks"))
    if found.rpdo_bit_30 not in BIT_30:
        raise ValueError(f"canopen.quirks.rpdo_bit_30 = {found.rpdo_bit_30!r} must be {', '.join(BIT_30)}")
    return found


def _known(row: Mapping[str, Any], kind: Any, table: str) -> dict[str, Any]:
    """Check that a table's keys are fields of a class and its values of their defaults' types; return it."""
    for key, value in row.items():
        default = kind._field_defaults.get(key)
        if default is None:
            raise ValueError(f"canopen.{table} has no {key!r}{did_you_mean(key, kind._fields)}")
        number = isinstance(default, float) and type(value) in (int, float)
        if not number and type(value) is not (list if isinstance(default, tuple) else type(default)):
            raise ValueError(f"canopen.{table}.{key} = {value!r} must be as {default!r} is")
    return dict(row)
