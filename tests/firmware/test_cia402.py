"""The standard, once: its state coding and commands, and nobody else who writes them down."""

from __future__ import annotations

import re

import pytest
from rigs import ROOT

from drive_env import cia402
from drive_env.cia402 import State

PACKAGES = ("drive_env", "mechanics", "tuning", "agents", "research")


@pytest.mark.every(3)
@pytest.mark.parametrize(
    ("bits", "state"),  # bits 6 5 3 2 1 0 of 6041h (IEC 61800-7-201, state coding); x is either
    [
        ("0x0000", State.NOT_READY_TO_SWITCH_ON),
        ("1x0000", State.SWITCH_ON_DISABLED),
        ("010001", State.READY_TO_SWITCH_ON),
        ("010011", State.SWITCHED_ON),
        ("010111", State.OPERATION_ENABLED),
        ("000111", State.QUICK_STOP_ACTIVE),
        ("0x1111", State.FAULT_REACTION_ACTIVE),
        ("0x1000", State.FAULT),
    ],
)
def test_every_statusword_of_the_standards_table_is_its_state(bits, state):
    positions = (6, 5, 3, 2, 1, 0)
    for rest in range(0x10000):
        if all(bit == "x" or rest >> place & 1 == int(bit) for bit, place in zip(bits, positions, strict=True)):
            assert cia402.state_of(rest) is state


@pytest.mark.parametrize(
    ("bits", "command"),  # bits 7 3 2 1 0 of 6040h (IEC 61800-7-201, device control commands)
    [
        ("0x110", "shutdown"),
        ("00111", "switch on"),
        ("01111", "enable operation"),
        ("0xx0x", "disable voltage"),
        ("0x01x", "quick stop"),
        ("00111", "disable operation"),
    ],
)
def test_every_controlword_of_the_standards_table_is_its_command(bits, command):
    for word in range(0x100):
        fits = all(
            bit == "x" or word >> place & 1 == int(bit) for bit, place in zip(bits, (7, 3, 2, 1, 0), strict=True)
        )
        assert cia402.matches(word, cia402.COMMANDS[command]) == fits


def test_the_words_that_enable_are_commands_one_after_the_other():
    names = ("shutdown", "switch on", "enable operation")
    for word, name in zip(cia402.ENABLING, names, strict=True):
        assert cia402.matches(word, cia402.COMMANDS[name])


@pytest.mark.parametrize(("index", "first"), [(0x6041, 0x6041), (0x6841, 0x6041), (0x9841, 0x6041), (0x2003, 0x2003)])
def test_an_object_of_a_further_axis_is_the_first_axis_object_800h_higher(index, first):
    assert cia402.of_first_axis(index) == first


def test_nobody_else_writes_an_index_of_the_profile():
    written = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if path.name == "cia402.py":
                continue
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                found = re.findall(r"\b0x6[0-9A-Fa-f]{3}\b", line.split("#")[0])
                written += [
                    f"{path.relative_to(ROOT)}:{number} {word}" for word in found if word != "0x6320"
                ]  # an EMCY
    assert written == []
