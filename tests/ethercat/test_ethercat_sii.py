"""The EEPROM interface (ETG.1000.4, 6.5; ET1100, 0500h and on) as transcripts, and what the controller reads of it."""

from __future__ import annotations

import struct

import pytest
from rigs.ethercat_rig import ALIAS, EchoDevice, Rig, sii

from drive_env.ethercat.sii_interface import READ_TIME, WRITE_TIME, checksum
from drive_env.ethercat.slave import EtherCatSlave


@pytest.fixture
def rig():
    rig = Rig()
    rig.address()
    return rig


def test_the_crc_of_the_configuration():
    """Of zeros: the remainder of FFh and them by x^8 + x^2 + x + 1, by long division."""
    zeros = bytes(14)
    remainder = int.from_bytes(b"\xff" + bytes(14), "big")  # a register that begins with FFh is a message that does
    for shift in range(remainder.bit_length() - 9, -1, -1):
        if remainder >> shift + 8 & 1:
            remainder ^= 0x107 << shift
    assert checksum(zeros) == remainder


def test_eight_bytes_at_a_word_address(rig):
    rig.play("""
        tx FPRD 1001 0502  00 00
        rx FPRD 1001 0502  C0 00  wkc 1                      # reads 8 bytes, has 2 address bytes
        tx FPWR 1001 0502  00 01 08 00 00 00                 # read word 8: vendor, product
        rx FPWR 1001 0502  00 01 08 00 00 00  wkc 1
        tx FPRD 1001 0502  00 00 00 00 00 00 00 00 00 00 00 00 00 00
        rx FPRD 1001 0502  C0 00 08 00 00 00 34 12 00 00 78 56 00 00  wkc 1
    """)


def test_a_word_is_written_where_it_is_allowed(rig):
    rig.play("""
        tx FPWR 1001 0508  CD AB
        rx FPWR 1001 0508  CD AB  wkc 1
        tx FPWR 1001 0502  00 02 0E 00 00 00                 # without write enable
        rx FPWR 1001 0502  00 02 0E 00 00 00  wkc 1
        tx FPRD 1001 0502  00 00
        rx FPRD 1001 0502  C0 40  wkc 1                      # error write enable
        tx FPWR 1001 0502  01 02 0E 00 00 00
        rx FPWR 1001 0502  01 02 0E 00 00 00  wkc 1
        tx FPRD 1001 0502  00 00
        rx FPRD 1001 0502  C0 00  wkc 1
        tx FPWR 1001 0502  00 01 0E 00 00 00
        rx FPWR 1001 0502  00 01 0E 00 00 00  wkc 1
        tx FPRD 1001 0508  00 00
        rx FPRD 1001 0508  CD AB  wkc 1
    """)
    assert rig.devices[0].content[28:30] == bytes.fromhex("CD AB")
    assert len(rig.devices[0].content) == 512


@pytest.mark.parametrize(("control", "address"), [(0x0201, 0x1000), (0x0300, 0), (0x0700, 0)])
def test_a_command_that_cannot_be(rig, control, address):
    rig.write(0x0502, struct.pack("<HI", control, address))
    assert rig.value(0x0502) == 0x20C0
    rig.write(0x0502, "00 00")  # no command acknowledges it
    assert rig.value(0x0502) == 0x00C0


def test_behind_its_end_an_eeprom_reads_as_erased(rig):
    rig.write(0x0502, struct.pack("<HI", 0x0100, 0xFF))
    assert rig.read(0x0508, 8) == bytes.fromhex("FF" * 8)


def test_while_the_device_has_it_a_master_has_not(rig):
    rig.write(0x0500, "01")
    rig.write(0x0502, struct.pack("<HI", 0x0100, 8))
    assert rig.read(0x0508, 4) == bytes(4)
    rig.write(0x0500, "00")
    rig.write(0x0502, struct.pack("<HI", 0x0100, 8))
    assert rig.read(0x0508, 4) == bytes.fromhex("34 12 00 00")


def test_the_alias_counts_from_power_on(rig):
    assert rig.value(0x0012) == ALIAS
    content = bytearray(sii(alias=0x0999))
    rig.devices[0].content = bytes(content)
    rig.slaves[0].power_on(0.0)
    rig.address()
    assert rig.value(0x0012) == 0x0999


def test_reload_takes_the_configuration_but_no_alias(rig):
    fresh = sii(alias=0x0999)
    for word in (1, 4, 7):
        rig.write(0x0508, b"\x42\x00" if word == 1 else fresh[2 * word : 2 * word + 2])
        rig.write(0x0502, struct.pack("<HI", 0x0201, word))
    rig.write(0x0502, "00 04")
    assert rig.value(0x0502) & 0x0800  # the CRC does not fit word 1
    content = rig.slaves[0].controller.sii.content
    rig.write(0x0508, bytes((checksum(content), 0)))
    rig.write(0x0502, struct.pack("<HI", 0x0201, 7))
    rig.write(0x0502, "00 04")
    assert rig.value(0x0502) & 0x0800 == 0
    assert rig.value(0x0150) == 0x0042
    assert rig.value(0x0012) == ALIAS


def test_an_eeprom_with_a_wrong_crc_has_no_alias():
    rig = Rig()
    rig.devices[0].content = b"\0\0\xff" + sii()[3:]
    rig.slaves[0].power_on(0.0)
    rig.address()
    assert rig.value(0x0012) == 0
    assert rig.value(0x0502) & 0x0800


def test_it_is_busy_as_long_as_an_eeprom_is():
    rig = Rig(takes_time=[True], lockstep=False)
    rig.address()
    rig.write(0x0502, struct.pack("<HI", 0x0100, 8))
    assert rig.value(0x0502) & 0x8000
    rig.write(0x0502, struct.pack("<HI", 0x0100, 0))  # lost: it is busy
    rig.world.run_until(READ_TIME)
    assert rig.value(0x0502) == 0x00C0
    assert rig.read(0x0508, 4) == bytes.fromhex("34 12 00 00")
    rig.write(0x0502, struct.pack("<HI", 0x0201, 9))
    rig.world.run_until(READ_TIME + 0.9 * WRITE_TIME)
    assert rig.value(0x0502) & 0x8000
    rig.world.run_until(READ_TIME + WRITE_TIME)
    assert rig.value(0x0502) & 0x8000 == 0


def test_the_content_lasts_over_a_reset():
    device = EchoDevice()
    slave = EtherCatSlave(device)
    slave.power_on(0.0)
    slave.controller.write(0x0508, b"\x11\x22", 0)
    slave.controller.write(0x0502, struct.pack("<HI", 0x0201, 0x0E), 0)
    slave.after_frame(0.0)
    slave.power_on(1.0)
    assert slave.controller.sii.content[28:30] == b"\x11\x22"
