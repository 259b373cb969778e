"""KickCAT, a master that shares no line with SOEM, in another network namespace than the drives that it moves."""

from __future__ import annotations

import pytest
from rigs.namespaces import needs_namespaces, seen_by, spaces  # noqa: F401

CYCLES = 400
STEP = 4  # increments in a cycle of the first axis; the others k times as many


@pytest.mark.slow
@needs_namespaces
@pytest.mark.parametrize(
    ("device", "load", "identity", "size"),
    [
        ("tmcm3313", "portal", [0x286, 3313, 0x10009], 30),
        ("tgz_d", "gantry", [0, int.from_bytes(b"TGZD"), 0x10000], 40),
    ],
)
def test_kickcat_moves_all_axes_in_csp(spaces, device, load, identity, size):  # noqa: F811
    program = "ethercat_kickcat_master.py"
    seen = seen_by(spaces, "--lockstep", program, device, CYCLES, device=device, load=load, library="kickcat")
    assert seen["identity"] == identity
    # ETG.1000.6, 5.6.2: sub-index 0 has two bytes. An identity without a serial number has 14, or 0 for it.
    whole = bytes.fromhex(seen["whole"])
    assert [int.from_bytes(whole[k : k + 4], "little") for k in (2, 6, 10)] == identity
    name, description = seen["object"]
    assert name == "Statusword" and "unsigned 16" in description and "VAR" in description
    default_and_name, description = seen["entry"]
    assert default_and_name == "\0\0Statusword", "the default value that was asked for comes before the name"
    assert "bit length:    16" in description and "TxPDO" in description
    assert set(seen["configured"]) == {0}
    assert seen["sizes"] == [size, size] and seen["safe_op"] and seen["op"]
    axes = len(seen["words"])
    assert seen["words"] == [0x27] * axes, "operation enabled"
    assert seen["wrong"] <= 50  # of 700, on a machine that others use, too
    assert seen["moved"] == pytest.approx([CYCLES * STEP * (axis + 1) for axis in range(axes)], abs=200)
    assert seen["safe_op_again"] and seen["stopped"] == [0x08] * axes, (
        "who leaves Op has its motors stopped, by a fault"
    )
    assert seen["init"] and seen["wrong_in_init"] == 5, "KickCAT sees that nobody takes process data"
