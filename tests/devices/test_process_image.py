"""The process image: its layout by the tables of the TMCM-3313's manual, and the rules by which it is changed."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.process_image import ProcessImage, write

from drive_env import EmulatedDrives, motion
from drive_env.dictionary.aborts import (
    CANNOT_BE_MAPPED,
    NO_SUCH_OBJECT,
    SUB_INDEX_ZERO_IN_USE,
    VALUE_RANGE,
    VALUE_TOO_HIGH,
)

# Tables 22 and 24; entry 2 of the second is printed 60640008h, and 6064h has 32 bits.
OUTPUTS = """
60400010h 607A0020h 60FF0020h
68400010h 687A0020h 68FF0020h
70400010h 707A0020h 70FF0020h
"""
INPUTS = """
60410010h 60640020h 606C0020h
68410010h 68640020h 686C0020h
70410010h 70640020h 706C0020h
"""


def layout(table):
    """Return index, first byte and length of each entry: one behind the other, without gaps."""
    rows, start = [], 0
    for word in table.split():
        size = int(word[6:8], 16) // 8
        rows.append((int(word[:4], 16), start, size))
        start += size
    return rows


def of_axis(index):
    """Return the axis and the index on axis 0: section 2.4.1."""
    return (index - 0x6000) // 0x800, (index - 0x6000) % 0x800 + 0x6000


@pytest.fixture
def drives():
    with EmulatedDrives("tmcm3313", load="portal", num_threads=1) as made:
        yield made


@pytest.fixture
def image(drives):
    return ProcessImage(drives)


def packed(values):
    """Return outputs with values at the places of their objects, 0 elsewhere."""
    rows = {index: (start, size) for index, start, size in layout(OUTPUTS)}
    data = bytearray(30)
    for index, value in values.items():
        start, size = rows[index]
        data[start : start + size] = value.to_bytes(size, "little", signed=True)
    return bytes(data)


# --- layout -----------------------------------------------------------------------------------------------------------
def test_both_images_have_nine_objects_and_thirty_bytes(image):
    assert (image.output_size, image.input_size) == (30, 30)
    for table, index in ((OUTPUTS, 0x1600), (INPUTS, 0x1A00)):
        words = [image.dictionary.port(index, sub).read() for sub in range(10)]
        assert words == [9, *(int(word[:8], 16) for word in table.split())]
        assert sum(size for _, _, size in layout(table)) == 30


@pytest.mark.parametrize(("index", "start", "size"), layout(OUTPUTS))
def test_an_output_lies_at_its_bytes_and_no_other(drives, image, index, start, size):
    value = 6 if size == 2 else -0x01020304  # shut down: a command whatever the mode
    data = bytearray(30)
    data[start : start + size] = value.to_bytes(size, "little", signed=True)
    assert image.write_outputs(bytes(data))
    axis, base = of_axis(index)
    for other in (0x6040, 0x607A, 0x60FF):
        expected = np.zeros(3, int)
        if other == base:
            expected[axis] = value
        np.testing.assert_array_equal(drives.read(other), expected)


def test_inputs_lie_at_their_bytes(drives, image):
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, [40_000, -30_000, 20_000])
    drives.advance(0.2)
    data = image.read_inputs()
    assert len(data) == 30
    for index, start, size in layout(INPUTS):
        axis, base = of_axis(index)
        raw = int.from_bytes(data[start : start + size], "little", signed=size == 4)
        assert raw == drives.read(base)[axis]
    assert len({*drives.read(0x6064), *drives.read(0x606C)}) == 6, "each is another one"


def test_an_image_takes_effect_at_once_on_all_axes(drives, image):
    """The set-points before the controlword that starts them, whatever the order of the entries."""
    motion.enable(drives, mode="pp")
    here = drives.read(0x6064)
    targets = {0x607A: 5000, 0x687A: -6000, 0x707A: 7000}
    assert image.write_outputs(packed(targets | dict.fromkeys((0x6040, 0x6840, 0x7040), 0x1F)))
    np.testing.assert_array_equal(drives.read(0x6041) & 0x1000, 0x1000)
    trace = drives.record((0x6062,), 0.5)
    begun = np.argmax(trace[0x6062] != here, axis=0)
    assert begun.min() == begun.max() > 0
    np.testing.assert_array_equal(trace[0x6062][-1], [5000, -6000, 7000])


def test_the_image_of_a_second_module_is_its_own():
    with EmulatedDrives("tmcm3313", load="portal", num_machines=2, num_threads=1) as drives:
        assert ProcessImage(drives, first_axis=3).write_outputs(packed({0x687A: 77}))
        np.testing.assert_array_equal(drives.read(0x607A), [0, 0, 0, 0, 77, 0])


# --- rules ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("before", "step", "code"),
    [
        ([], (0x1600, 0, 0), 0),  # though sync manager 2 carries it
        ([], (0x1600, 1, 0x60400010), SUB_INDEX_ZERO_IN_USE),
        ([], (0x1C12, 1, 0x1600), SUB_INDEX_ZERO_IN_USE),
        ([], (0x1C12, 0, 2), VALUE_TOO_HIGH),  # table 29: one at most
        ([(0x1C12, 0, 0)], (0x1600, 0, 10), VALUE_TOO_HIGH),  # table 22: nine at most
        ([(0x1C12, 0, 0)], (0x1600, 1, 0x60400010), SUB_INDEX_ZERO_IN_USE),
        ([(0x1C12, 0, 0)], (0x1C12, 1, 0x1A00), VALUE_RANGE),  # what the drive sends
        ([(0x1C12, 0, 0)], (0x1C12, 1, 0x1640), VALUE_RANGE),  # a PDO of the extension for CAN
        ([(0x1C12, 0, 0), (0x1C12, 1, 0)], None, VALUE_RANGE),
        ([(0x1C12, 0, 0), (0x1600, 0, 0)], (0x1600, 1, 0x60640020), CANNOT_BE_MAPPED),  # read only
        ([(0x1C12, 0, 0), (0x1600, 0, 0)], (0x1600, 1, 0x60830020), CANNOT_BE_MAPPED),  # table 238: no
        ([(0x1C13, 0, 0), (0x1A00, 0, 0)], (0x1A00, 2, 0x60640008), CANNOT_BE_MAPPED),  # as table 24 prints it
        ([(0x1C13, 0, 0), (0x1A00, 0, 0)], (0x1A00, 1, 0x78410010), NO_SUCH_OBJECT),  # there is no fourth axis
        ([], (0x1C00, 3, 4), VALUE_RANGE),  # section 3.1.9: fixed
        ([], (0x1C00, 3, 3), 0),
    ],
)
def test_what_is_refused(image, before, step, code):
    results = [write(image, *one) for one in before]
    if step is not None:
        assert results == [0] * len(before)
        results = [write(image, *step)]
    assert results[-1] == code


def remap(image, words, mapping=0x1600):
    """Write the entries of a mapping that stays assigned; return the answer to their number."""
    assert write(image, mapping, 0, 0) == 0
    for sub, word in enumerate(words, 1):
        assert write(image, mapping, sub, word) == 0
    return write(image, mapping, 0, len(words))


def test_gaps_are_bytes_that_nobody_reads(drives, image):
    """Entries without an object: before, between (8 bits as 1 and 7) and behind the objects."""
    assert remap(image, (0x00000010, 0x60600008, 0x00000001, 0x00000007, 0x607A0020, 0x00000008)) == 0
    assert image.output_size == 2 + 1 + 1 + 4 + 1
    assert image.write_outputs(b"\xaa\xaa\x08\xaa\x78\x56\x34\x12\xaa")
    assert (drives.read(0x6060)[0], drives.read(0x607A)[0]) == (8, 0x12345678)
    assert remap(image, (0x60610008, 0x00000018, 0x60410010), 0x1A00) == 0
    word = drives.read(0x6041)[0]
    assert image.read_inputs() == b"\x08" + bytes(3) + int(word).to_bytes(2, "little")
    assert remap(image, (0x00000040, 0x00000040)) == 0
    assert image.output_size == 16 and image.write_outputs(bytes(range(16)))
