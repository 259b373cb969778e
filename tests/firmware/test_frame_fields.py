"""Each field of process data acts by itself: no value beside a stop makes it void. CAN and EtherCAT, every device.

Whether an axis was stopped is read inside the emulator: its automaton, its stage, its rotor.
"""

from __future__ import annotations

import shutil
import struct
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rigs import INVENTED
from rigs.can_devices import give
from rigs.canopen_wire import Wire
from rigs.coe_rig import CoeRig
from rigs.fault_injection import REST
from rigs.tgz_images import SIZES, select, structure

from drive_env import EmulatedDrives
from drive_env.canopen.frames import Frame
from drive_env.cia402 import CONTROLWORD, DIGITAL_OUTPUTS, MODE, TARGET_TORQUE, TARGET_VELOCITY, State
from drive_env.devices import find_device
from drive_env.dictionary.access import fits_pdo
from drive_env.ethercat.application import AlState
from drive_env.firmware.record import get_lanes

NODE, FREE_ID = 5, 0x2F5
AXIS = 0x800  # from an object of CiA 402 to the next axis' one
D_MODE, LIMIT, OUTPUTS = 0x2303, 0x23C6, 0x4001
PP, PV, CSV = 1, 3, 9
NOT_ACCEPTED = b"\x20\x63"  # 6320h
TOO_HIGH, TOO_LOW, RANGE = 0x0609_0031, 0x0609_0032, 0x0609_0030
CAN_DEVICES = ("tmcm1636", "tmcm6212", "tmcm3313", "tgz_d", "tgz_s", INVENTED)


class Plant:
    """Axes with a machine each, and what they truly do."""

    def __init__(self, name):
        self.device = find_device(name)
        self.axes = range(self.device.num_axes)
        self.drives = EmulatedDrives(name, "inertia", num_machines=len(self.axes), num_threads=1)
        self.drives.write(TARGET_VELOCITY, "300 rpm")
        self.speeds = self.drives.read(TARGET_VELOCITY).tolist()

    def truth(self, name):
        return get_lanes(self.drives.inside.records, name, len(self.axes))

    @property
    def are_enabled(self):
        return (self.truth("fsa") == State.OPERATION_ENABLED).all()

    def is_off(self, axis):
        return self.truth("stage_on")[axis] == 0.0 and self.truth("fsa")[axis] == State.SWITCH_ON_DISABLED


class Bus:
    """What a master does with a plant's node. `fields` are what it receives, None for what it passes over."""

    def __init__(self, plant):
        self.plant = plant
        plant.drives.machine.reset()
        self.fields = []
        self.told = []

    def port(self, key):
        return self.node.dictionary.port(*key)

    def data(self, values):
        """Return what is sent: values by object, of the others what they have."""
        parts = []
        for key, size in self.fields:
            value = 0 if key is None else values.get(key, self.port(key).read() if key not in values else 0)
            parts.append((value % 256**size).to_bytes(size, "little"))
        return b"".join(parts)

    def command(self, word):
        """Give all axes a controlword, by process data where they have it."""
        words = {(CONTROLWORD + AXIS * axis, 0): word for axis in self.plant.axes}
        carried = {key for key, _ in self.fields}
        for key in words.keys() - carried:
            assert self.write(*key, word, 2) == 0
        self.send(words)

    def enable(self, mode=PV):
        """Let the axes turn, from rest or as they do already."""
        plant, gate = self.plant, self.plant.device.mode_gate
        for axis in plant.axes:
            if gate:
                assert self.write(D_MODE + 0x100 * axis, 0, gate[mode], 4) == 0
            if self.port((MODE + AXIS * axis, 0)).read() != mode:
                assert self.write(MODE + AXIS * axis, 0, mode, 1) == 0
        self.wait(2)
        self._wait_for(lambda: (plant.truth("fsa") != State.FAULT_REACTION_ACTIVE).all())
        for word in (0x00, 0x80, 0x06, 0x07, 0x0F):
            self.command(word)
            self.wait(1)
        self._wait_for(lambda: plant.are_enabled)
        speeds = {(TARGET_VELOCITY + AXIS * axis, 0): plant.speeds[axis] for axis in plant.axes}
        for key, speed in speeds.items():
            assert self.write(*key, speed, 4) == 0
        self.send(speeds)
        self.told.clear()

    def turn(self, mode=PV):
        self.enable(mode)
        self._wait_for(lambda: (np.abs(self.plant.truth("omega_m")) > 5.0 * REST).all())

    def come_to_rest(self):
        self._wait_for(lambda: (np.abs(self.plant.truth("omega_m")) < REST).all())

    def _wait_for(self, happens):
        for _ in range(500):
            if happens():
                return
            self.wait(10)
        raise AssertionError(f"{self.plant.truth('omega_m')} rad/s, states {self.plant.truth('fsa')} after 5 s")


class Can(Bus):
    """A node whose first RPDO carries what is asked for."""

    def __init__(self, plant):
        super().__init__(plant)
        self.wire = Wire(plant.drives, NODE)
        self.node = self.wire.node
        self.rpdo = min(e.index for e in self.node.dictionary.entries if 0x1400 <= e.index < 0x1600 and e.sub == 1)
        self.wire.start()

    def carry(self, entries):
        self.wait(0)
        give(self.wire, self.rpdo, FREE_ID, None, [one.index << 16 | one.sub << 8 | one.bits for one in entries])
        self.fields = [((one.index, one.sub), one.bits // 8) for one in entries]

    def write(self, index, sub, value, size):
        self.wait(0)
        return self.wire.download(index, sub, value, size)

    def send(self, values):
        self.wire.node.receive(Frame(FREE_ID, self.data(values)), self.wire.now)
        self.wait(1)

    def wait(self, cycles):
        self.wire.wait(cycles)
        self.told += [one.data for one in self.wire.take() if one.can_id == 0x80 + NODE]


class Coe(Bus):
    """A slave in Op, whose outputs are mapped or ready-made."""

    def __init__(self, plant):
        super().__init__(plant)
        self.rig = CoeRig(plant.drives)
        self.node = self.rig.node
        self.told = self.rig.emergencies
        self.rig.bring_to(AlState.PRE_OP)

    def carry(self, entries):
        self.rig.request(AlState.PRE_OP)
        for index, raws, letter in ((0x1C12, [], "H"), (0x1600, entries, "I"), (0x1C12, [0x1600], "H")):
            raws = [one if letter == "H" else one.index << 16 | one.sub << 8 | one.bits for one in raws]
            whole = struct.pack(f"<H{len(raws)}{letter}", len(raws), *raws)
            assert self.rig.download(index, 0, whole, complete=True) == 0
        self.begin([((one.index, one.sub), one.bits // 8) for one in entries])

    def take_image(self, number):
        self.rig.request(AlState.PRE_OP)
        assert select(self.rig, number) == [0, 0, 0]
        fields = []
        for name, _, size in structure(number)[0]:
            index, _, sub = name.partition(":")
            fields.append((None if name == "-" else (int(index, 16), int(sub or 0)), size))
        self.begin(fields)

    def begin(self, fields):
        self.fields = fields
        self.inputs = self.node.input_size
        self.rig.bring_to(AlState.OP, outputs=sum(size for _, size in fields), inputs=self.inputs)

    def write(self, index, sub, value, size):
        return self.rig.download(index, sub, (value % 256**size).to_bytes(size, "little"))

    def send(self, values):
        self.rig.exchange_image(self.data(values), self.inputs)
        self.rig.answers()

    def wait(self, cycles):
        for _ in range(cycles):
            self.send({})


def room(entry):
    half = 1 << entry.bits - 1
    return range(-half, half) if entry.signed else range(2 * half)


def extremes(entry):
    """Return the ends of an object's bits and range, one beyond each, 0, 1 and -1."""
    bits = room(entry)
    ends = (bits[0], bits[-1], 0, 1, -1, entry.low - 1, entry.low, entry.high, entry.high + 1)
    return sorted({value for value in ends if value in bits})


def void(bus, key, entry, axis):
    """Return the values of an object beside which a controlword that disables an axis is void."""
    before = bus.port(key).read()
    found = []
    for value in extremes(entry):
        bus.enable()
        bus.send({(CONTROLWORD + AXIS * axis, 0): 0, key: value})
        if not bus.plant.is_off(axis):
            truth = {name: bus.plant.truth(name).tolist() for name in ("fsa", "stage_on", "omega_m")}
            found.append((axis, value, truth, list(bus.told)))
        bus.port(key).write(before)
    return found


@cache
def plant_of(name):
    return Plant(name)


@pytest.fixture(scope="module", autouse=True)
def plants():
    yield
    plant_of.cache_clear()


def received(name):
    """Return what RPDOs of a device can carry: of each axis the same objects."""
    entries = find_device(name).new_dictionary()
    return [one for one in entries if one.bits and fits_pdo(one, transmit=False)]


def axes_beside(device, entry):
    """Return the axes whose stop travels with an object: its own, and another one."""
    own = device.locate(entry.index)[0]
    return sorted({own, (own + 1) % device.num_axes})


# --- no stop is void ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("beside", "value"), [(LIMIT, 0xFFFF), (TARGET_TORQUE, -32768)])
def test_both_axes_of_a_tgz_are_disabled_whatever_limit_or_current_travels_beside(beside, value):
    """1702h in csv at 300 rpm: a thousand such frames were ignored, and both axes turned on."""
    bus = Coe(plant_of("tgz_d"))
    bus.take_image(0x1702)
    bus.turn(CSV)
    words = {(CONTROLWORD + AXIS * axis, 0): 0 for axis in (0, 1)}
    bus.send({**words, **{(TARGET_VELOCITY + AXIS * axis, 0): 0 for axis in (0, 1)}, (beside, 0): value})
    assert all(bus.plant.is_off(axis) for axis in (0, 1))
    bus.come_to_rest()


def test_an_axis_of_a_tgz_is_disabled_by_the_factory_s_rpdo_whatever_outputs_travel_beside():
    """6040h, 607Ah, 6060h, 4001h = FFh: "only the first 6 bits are used"."""
    bus = Can(plant_of("tgz_d"))
    bus.turn()
    bus.wire.receive(0x200 + NODE, "00 00  00 00 00 00  03  FF")
    bus.wait(1)
    assert bus.plant.is_off(0)


@pytest.mark.every(36)
@pytest.mark.parametrize(
    ("name", "entry"),
    [
        pytest.param(name, entry, id=f"{Path(name).name}-{entry.index:04X}-{entry.sub}")
        for name in CAN_DEVICES
        for entry in received(name)
        if entry.bits <= 48
    ],
)
def test_no_value_in_an_rpdo_voids_a_stop_before_or_behind_it(name, entry):
    bus, key = Can(plant_of(name)), (entry.index, entry.sub)
    bus.carry([])
    bus.turn()
    for axis in axes_beside(bus.plant.device, entry):
        word = bus.node.dictionary.entries.find((CONTROLWORD + AXIS * axis, 0))
        if word.index == entry.index:
            continue
        for order in ([word, entry], [entry, word]):
            bus.carry(order)
            assert void(bus, key, entry, axis) == []
    bus.command(0)
    bus.come_to_rest()


@pytest.mark.every(60)
@pytest.mark.parametrize("entry", [pytest.param(one, id=f"{one.index:04X}-{one.sub}") for one in received("tmcm3313")])
def test_no_value_in_a_mapped_image_voids_a_stop_before_or_behind_it(entry):
    bus, key = Coe(plant_of("tmcm3313")), (entry.index, entry.sub)
    indices = [CONTROLWORD + AXIS * axis for axis in bus.plant.axes]
    words = [bus.node.dictionary.entries.find((one, 0)) for one in indices if one != entry.index]
    for order in ([*words, entry], [entry, *words]):
        bus.carry(order)
        bus.turn()
        for word in words:
            assert void(bus, key, entry, (word.index - CONTROLWORD) // AXIS) == []
        bus.command(0)
        bus.come_to_rest()


@pytest.mark.every(6)
@pytest.mark.parametrize("number", [n for n in SIZES if n < 0x1720], ids=lambda n: f"{n:04X}")  # with 6040h
@pytest.mark.parametrize("name", ["tgz_d", "tgz_s"])
def test_no_value_in_a_ready_made_image_voids_a_stop_of_either_axis(name, number):
    bus = Coe(plant_of(name))
    bus.take_image(number)
    bus.turn()
    for key, _ in bus.fields:
        for axis in bus.plant.axes:
            if key is not None and key != (CONTROLWORD + AXIS * axis, 0):
                entry = bus.node.dictionary.entries.find(key)
                assert void(bus, key, entry, axis) == [], f"{key[0]:04X}h"
    bus.command(0)
    bus.come_to_rest()


# --- the others act, too --------------------------------------------------------------------------------------------
# An object, a value that an RPDO brings, the one that it has then, and how an SDO with that value is refused.
TAKEN = [
    ("tgz_d", LIMIT, 0xFFFF, 32767, TOO_HIGH),  # "for full limitation": 32767
    ("tgz_d", LIMIT, 32768, 32767, TOO_HIGH),
    ("tgz_d", LIMIT + 0x100, 0xFFFF, 32767, TOO_HIGH),  # of the second axis
    ("tgz_s", LIMIT + 0x100, 0xFFFF, 32767, TOO_HIGH),
    ("tgz_d", OUTPUTS, 0xFF, 0x3F, TOO_HIGH),  # "only the first 6 bits are used"
    ("tgz_d", OUTPUTS, 0x41, 0x01, TOO_HIGH),
]  # fmt: skip
# Of these the manuals say nothing but the range, or the few values that there are.
LEFT = [
    ("tgz_d", TARGET_TORQUE, -32768, TOO_LOW),
    ("tgz_d", MODE, 2, RANGE),
    ("tgz_d", 0x6086, 2, TOO_HIGH),
    ("tmcm1636", MODE, 2, RANGE),
    ("tmcm6212", MODE, 10, TOO_HIGH),
    ("tmcm3313", MODE, 11, TOO_HIGH),
    ("tmcm3313", MODE, 2, RANGE),
    (INVENTED, MODE, 10, RANGE),
]


def beside_a_speed(name, index):
    """Return a bus whose RPDO carries an object and a speed of the first axis that it is not yet to have."""
    bus = Can(plant_of(name))
    find = bus.node.dictionary.entries.find
    bus.carry([find((index, 0)), find((TARGET_VELOCITY, 0))])
    bus.turn()
    return bus


@pytest.mark.parametrize(("name", "index", "sent", "had", "code"), TAKEN)
def test_what_a_manual_says_of_values_beyond_a_range_is_done_in_process_data_alone(name, index, sent, had, code):
    bus = beside_a_speed(name, index)
    bus.send({(index, 0): sent, (TARGET_VELOCITY, 0): 11})
    assert [bus.port((key, 0)).read() for key in (index, TARGET_VELOCITY)] == [had, 11]
    assert bus.told == []
    size = bus.fields[0][1]
    assert bus.write(index, 0, 0, size) == 0
    assert bus.write(index, 0, sent, size) == code
    assert bus.port((index, 0)).read() == 0


@pytest.mark.parametrize(("name", "index", "sent", "code"), LEFT)
def test_a_field_that_is_refused_stays_and_is_told_once_and_the_others_act(name, index, sent, code):
    bus = beside_a_speed(name, index)
    before = bus.port((index, 0)).read()
    for speed in range(100):
        bus.send({(index, 0): sent, (TARGET_VELOCITY, 0): speed})
        assert [bus.port((key, 0)).read() for key in (index, TARGET_VELOCITY)] == [before, speed]
    assert [data[:2] for data in bus.told] == [NOT_ACCEPTED]
    assert bus.plant.are_enabled
    assert bus.write(index, 0, sent, bus.fields[0][1]) == code
    bus.send({})
    bus.send({(index, 0): sent})
    assert [data[:2] for data in bus.told] == [NOT_ACCEPTED, b"\0\0", NOT_ACCEPTED], "it was good in between"


def test_outputs_on_ethercat_are_refused_field_by_field_and_told_once():
    bus = Coe(plant_of("tgz_d"))
    bus.take_image(0x1702)
    bus.turn(CSV)
    for limit in range(100):
        outputs = limit << 16
        bus.send({(TARGET_TORQUE, 0): -32768, (LIMIT + 0x100, 0): limit, (DIGITAL_OUTPUTS, 1): outputs})
        found = [bus.port(key).read() for key in ((TARGET_TORQUE, 0), (LIMIT + 0x100, 0), (DIGITAL_OUTPUTS, 1))]
        assert found == [0, limit, outputs]
    assert [data[:2] for data in bus.told] == [NOT_ACCEPTED]
    assert bus.plant.are_enabled


@pytest.mark.parametrize("name", CAN_DEVICES)
def test_a_move_finds_the_target_of_its_own_frame_and_a_stop_comes_before_it(name):
    """pp: the controlword that starts acts last, one that disables first."""
    bus = Can(plant_of(name))
    find = bus.node.dictionary.entries.find
    bus.carry([find((CONTROLWORD, 0)), find((0x607A, 0))])
    bus.enable(PP)
    bus.send({(CONTROLWORD, 0): 0x0F})
    target = bus.port((0x6064, 0)).read() + 1000
    bus.send({(CONTROLWORD, 0): 0x1F, (0x607A, 0): target})
    assert bus.port((0x6041, 0)).read() & 0x1000, "acknowledged"
    bus._wait_for(lambda: bus.port((0x6062, 0)).read() == target)
    bus.send({(CONTROLWORD, 0): 0x00, (0x607A, 0): target + 1000})
    assert bus.plant.is_off(0)


def test_a_rule_that_there_is_not_is_refused(tmp_path):
    path = shutil.copytree(INVENTED, tmp_path / "own") / "device.toml"
    path.write_text(path.read_text() + '\n[beyond_range]\n"6071:0" = "most"\n')
    with pytest.raises(ValueError, match=r"beyond_range: 6071:0 = 'most' must be 'highest' or 'mask'"):
        find_device(str(path.parent))
