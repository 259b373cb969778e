"""The objects of a process image without drives behind it: assignment, mapping, complete access, ready-made images."""

from __future__ import annotations

import pytest

from drive_env.devices import find_device
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.ethercat.ethercat_objects import ethercat_objects
from drive_env.node.axis import ObjectPort
from drive_env.node.process_image import ASSIGNMENTS, INPUTS, OUTPUTS, ImageObjects

MAPPED = {
    OUTPUTS: [
        0x60400010, 0x607A0020, 0x60FF0020, 0x68400010, 0x687A0020, 0x68FF0020, 0x70400010, 0x707A0020, 0x70FF0020,
    ],
    INPUTS: [
        0x60410010, 0x60640020, 0x606C0020, 0x68410010, 0x68640020, 0x686C0020, 0x70410010, 0x70640020, 0x706C0020,
    ],
}  # fmt: skip


class Image:
    """The image of a device whose other objects have their defaults, or what a test gives them."""

    def __init__(self, name, **values):
        self.device, self.values, self.allows = find_device(name), {}, True
        self.entries = self.device.new_dictionary()
        if self.device.ethercat is not None:  # of what it has there, what can be written there alone
            written = ethercat_objects(self.device)
            self.entries = self.entries.including(written[index] for index in self.device.ethercat.writable)
        self.objects = ImageObjects(self.device, self.entries, lambda: self.allows)
        self.objects.connect(self.port)

    def port(self, index, sub):
        entry = self.entries.find((index, sub))
        if self.objects.owns(entry):
            return self.objects.port(entry)
        key = (index, sub)
        return ObjectPort(entry, lambda: self.values.get(key, entry.default), lambda raw: None,
                          lambda raw: self.values.__setitem__(key, raw))  # fmt: skip

    def write(self, index, sub, raw):
        port = self.port(index, sub)
        port.check(raw)
        port.write(raw)

    def read(self, index, sub):
        return self.port(index, sub).read()


@pytest.fixture
def image():
    return Image("tmcm3313")


@pytest.fixture
def tgz():
    return Image("tgz_d")


def refused(code, said):
    """The next access is refused with a code and a text."""
    return pytest.raises(ObjectAccessError, match=f"^{said}.*abort code {code[:4]} {code[4:]}h")


# --- what there is ----------------------------------------------------------------------------------------------------
def test_a_device_without_sync_managers_has_no_image():
    with pytest.raises(
        ValueError, match=r"^tmcm1636 has no process image: its dictionary lacks 1C12h; its process data"
    ):
        Image("tmcm1636")


@pytest.mark.every(2)
@pytest.mark.parametrize(("key", "owned"), [
    ((0x1C00, 0), True), ((0x1C12, 1), True), ((0x1C13, 0), True), ((0x1600, 9), True), ((0x1A00, 0), True),
    ((0x1640, 1), False), ((0x1A40, 1), False),  # of CANopen's PDOs, which have communication parameters
    ((0x6040, 0), False),
])  # fmt: skip
def test_it_owns_assignments_mappings_and_the_kinds_of_sync_managers(image, key, owned):
    assert image.objects.owns(image.entries.find(key)) is owned


def test_objects_of_synchronisation_are_of_the_image_too(tgz):
    assert tgz.objects.owns(tgz.entries.find((0x1C32, 1))) and tgz.objects.owns(tgz.entries.find((0x1C33, 1)))


def test_the_factory_s_image(image):
    assert image.objects.mapped(OUTPUTS) == [(0x1600, MAPPED[OUTPUTS])]
    assert image.objects.mapped(INPUTS) == [(0x1A00, MAPPED[INPUTS])]
    assert (image.objects.output_size, image.objects.input_size) == (30, 30)
    assert (OUTPUTS, INPUTS) == (0x1C12, 0x1C13)
    assert [(one[0], one[-1]) for one in ASSIGNMENTS.values()] == [(0x1600, 0x17FF), (0x1A00, 0x1BFF)]


def test_outputs_take_effect_and_inputs_are_as_they_are(image):
    image.values[0x6864, 0] = -2
    assert image.objects.read_inputs()[12:16].hex(" ") == "fe ff ff ff"
    assert image.objects.write_outputs(bytes(range(30)))
    assert image.values[0x6040, 0] == 0x0100 and image.values[0x707A, 0] == 0x19181716
    with pytest.raises(ValueError, match=r"^outputs have 30 bytes as they are mapped, not 29$"):
        image.objects.write_outputs(bytes(29))


# --- the rules --------------------------------------------------------------------------------------------------------
def test_an_assignment_names_a_mapping_of_its_own_way(image):
    image.write(0x1C12, 0, 0)
    with refused("06090030", "1C12h:01 .* cannot be 1A00h; there is 1600h "):
        image.write(0x1C12, 1, 0x1A00)
    image.write(0x1C12, 1, 0x1600)
    image.write(0x1C12, 0, 1)
    with refused("06010003", "1C12h:01 .* is one of 1 in use; set sub-index 0 to 0 before"):
        image.write(0x1C12, 1, 0x1600)


@pytest.mark.parametrize("is_assigned", [False, True], ids=["assignment away", "assigned"])
def test_a_mapping_is_changed_whether_or_not_it_is_assigned(image, is_assigned):
    with refused("06010003", "1A00h:01 .* is one of 9 in use; set sub-index 0 to 0 before"):
        image.write(0x1A00, 1, 0x60770010)
    if not is_assigned:
        image.write(0x1C13, 0, 0)
        assert image.objects.input_size == 0 and image.objects.mapped(INPUTS) == []
    image.write(0x1A00, 0, 0)
    assert image.objects.mapped(INPUTS) == ([(0x1A00, [])] if is_assigned else [])
    image.write(0x1A00, 1, 0x60770010)
    image.write(0x1A00, 2, 0)
    image.write(0x1A00, 0, 1)
    with pytest.raises(ObjectAccessError, match="cannot map 0000h:00"):
        image.port(0x1A00, 0).check(2)
    assert image.objects.input_size == (2 if is_assigned else 0)
    image.write(0x1C13, 0, 0)
    image.write(0x1C13, 1, 0x1A00)
    image.write(0x1C13, 0, 1)
    assert image.objects.mapped(INPUTS) == [(0x1A00, [0x60770010])] and image.objects.input_size == 2


def test_what_gaps_cannot_be_is_told(image):
    image.write(0x1600, 0, 0)
    for sub, raw in enumerate((0x00000004, 0x60400010, 0x00000041), 1):
        image.write(0x1600, sub, raw)
    with refused("06040041", "1600h:00 .*: 1 entries make 4 bits; fill gaps up to whole bytes"):
        image.write(0x1600, 0, 1)
    with refused("06040041", "1600h:00 .*: entry 2 would begin within a byte; fill gaps up to whole bytes"):
        image.write(0x1600, 0, 2)
    image.write(0x1600, 1, 0x00000008)
    with refused("06040042", "1600h:00 .*: entry 3 is a gap of 65 bits; one gap has 64 at most"):
        image.write(0x1600, 0, 3)


def test_of_an_image_s_directions_each_maps_its_own(image):
    image.write(0x1C12, 0, 0)
    image.write(0x1600, 0, 0)
    with refused("06040041", "1600h:01 .* cannot map 6041h:00 "):
        image.write(0x1600, 1, 0x60410010)
    image.write(0x1600, 1, 0x60400010)
    image.write(0x1C13, 0, 0)
    image.write(0x1A00, 0, 0)
    image.write(0x1A00, 1, 0x60410010)


def test_it_stays_as_it_is_while_the_node_says_so(image):
    image.allows = False
    with refused("08000022", "1C12h:00 .* can only be written in pre-operational"):
        image.write(0x1C12, 0, 0)
    with refused("06090030", "1C00h:03"):
        image.write(0x1C00, 3, 4)
    assert image.objects.mapped(OUTPUTS) == [(0x1600, MAPPED[OUTPUTS])]


# --- complete access --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("index", "whole"), [(0x1C12, True), (0x1600, True), (0x1A00, True), (0x1C00, False), (0x6040, False)]
)
def test_assignments_and_mappings_are_written_whole(image, index, whole):
    assert image.objects.writes_whole(index) is whole


def test_an_object_is_replaced_as_a_whole(image):
    image.objects.write_whole(0x1C12, [])
    assert image.objects.output_size == 0
    image.objects.write_whole(0x1600, [0x60400010, 0x60710010])
    assert [image.read(0x1600, sub) for sub in (0, 1, 2, 3)] == [2, 0x60400010, 0x60710010, MAPPED[OUTPUTS][2]]
    image.objects.write_whole(0x1C12, [0x1600])
    assert image.objects.output_size == 4 and image.objects.mapped(OUTPUTS) == [(0x1600, [0x60400010, 0x60710010])]


def test_where_one_entry_is_refused_all_stay(image):
    image.objects.write_whole(0x1C12, [])
    with pytest.raises(ObjectAccessError):
        image.objects.write_whole(0x1600, [0x60710010, 0x60410010])
    assert [image.read(0x1600, sub) for sub in (0, 1, 2)] == [9, *MAPPED[OUTPUTS][:2]]
    with refused("06090011", ""):
        image.objects.write_whole(0x1600, [0x60710010] * 10)
    with refused("06090030", "1C00h:00"):
        image.objects.write_whole(0x1C00, [1, 2, 3, 4])


# --- ready-made images ------------------------------------------------------------------------------------------------
def test_a_ready_made_image_is_assigned_and_has_no_entries(tgz):
    assert tgz.objects.mapped(OUTPUTS) == [(0x1701, [])]
    assert tgz.objects.output_size == 40 and tgz.objects.input_size == 40
    tgz.write(0x1C12, 0, 0)
    assert tgz.objects.output_size == 0
    with refused("06090030", "1C12h:01 .* cannot be 1B01h; there is 1701h, 1702h, 1703h, 1721h "):
        tgz.write(0x1C12, 1, 0x1B01)
    with refused("06090030", "1C12h:01 .* cannot be 1600h; there is 1701h"):
        tgz.write(0x1C12, 1, 0x1600)
    tgz.write(0x1C12, 1, 0x1703)
    tgz.write(0x1C12, 0, 1)
    assert tgz.objects.mapped(OUTPUTS) == [(0x1703, [])]
    assert tgz.objects.write_outputs(bytes(12) + b"\x0f\0" + bytes(26)) and tgz.values[0x6040, 0] == 15


def test_switching_on_brings_the_factory_s_image(image):
    image.objects.write_whole(0x1C13, [])
    image.objects.write_whole(0x1A00, [0x60770010])
    image.objects.restart()
    assert image.objects.mapped(INPUTS) == [(0x1A00, MAPPED[INPUTS])] and image.objects.input_size == 30


def test_a_register_of_the_device_says_with_which_ready_made_image_it_begins(tgz):
    tgz.values[0x25C0, 0], tgz.values[0x25C1, 0] = 0x1702, 0x1B21
    tgz.objects.restart()
    assert tgz.objects.mapped(OUTPUTS) == [(0x1702, [])] and tgz.objects.mapped(INPUTS) == [(0x1B21, [])]


def test_an_image_that_the_register_names_and_that_is_none_cannot_be_used(tgz):
    tgz.values[0x25C0, 0] = 0x1FFF
    tgz.objects.restart()
    assert tgz.objects.output_size == 0 and tgz.objects.mapped(OUTPUTS) == [(0x1FFF, [])]
    tgz.write(0x1C12, 0, 0)
    with refused("06090030", "1C12h:00 .* cannot be 1FFFh; there is 1701h"):
        tgz.write(0x1C12, 0, 1)
