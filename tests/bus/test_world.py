"""A world: lockstep and virtual time, what a bus full of traffic loses, how faults reach nodes."""

import random
from collections import Counter
from contextlib import contextmanager

import pytest

from drive_env import EmulatedDrives, motion
from drive_env.bus.bits import frame_bits
from drive_env.bus.faults import Faults
from drive_env.bus.wire import Wire
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.canopen.nmt import NmtState

SYNC = Frame(0x080)


class Echo:
    """A node that answers requests with their data and each SYNC with two PDOs that hold the number of cycles."""

    def __init__(self, node_id, send):
        self.node_id, self.send = node_id, send
        self.cycles, self.log = 0, []

    def power_on(self, now):
        self.send(Frame(0x700 + self.node_id, b"\x00"))

    def receive(self, frame, now):
        self.log.append((frame, now))
        if frame.can_id == 0x600 + self.node_id:
            self.send(Frame(0x580 + self.node_id, frame.data))
        elif frame == SYNC:
            for function in (0x280, 0x180):
                self.send(Frame(function + self.node_id, self.cycles.to_bytes(4, "little")))

    def before_cycle(self, now):
        self.log.append(("before", now))

    def after_cycle(self, now):
        self.cycles += 1
        self.log.append(("after", now))

    def error_passive(self, now):
        self.log.append(("error passive", now))

    def bus_off(self, now):
        self.log.append(("bus off", now))

    def bus_on(self, now):
        self.log.append(("bus on", now))


def echo_world(*node_ids, **options):
    """A world of echoes, and the list of what its bus carries."""
    world, carried = World(**options), []
    for node_id in node_ids:
        world.attach(node_id, lambda send, node_id=node_id: Echo(node_id, send))
    world.listeners.append(lambda ended: carried.append(ended.frame))
    return world, carried


def request(node_id, k):
    return Frame(0x600 + node_id, k.to_bytes(8, "little"))


# --- lockstep -------------------------------------------------------------------------------------------------------
def test_in_lockstep_a_sync_lets_one_cycle_pass_and_nothing_else_does():
    world, _ = echo_world(1)
    world.receive(request(1, 7))
    world.receive(Frame(0x081))
    world.receive(Frame(0x080, b"", rtr=True, dlc=0))
    world.receive(Frame(0x080), extended=True)
    assert world.time == world.cycles == 0
    world.receive(SYNC)
    assert (world.time, world.cycles) == (0.001, 1)


def test_the_order_of_a_cycle_is_sync_pdos_before_after():
    world, carried = echo_world(1)
    world.receive(SYNC)
    assert world.nodes[1].log == [(SYNC, 0.0), ("before", 0.0), ("after", 0.001)]
    assert carried == [SYNC, Frame(0x281, bytes(4)), Frame(0x181, bytes(4))]  # a controller keeps its node's order


def test_what_a_frame_sets_off_is_sent_before_the_next_is_looked_at():
    world, carried = echo_world(1, 2)
    for frame in (SYNC, SYNC, request(1, 5), request(2, 6)):
        world.receive(frame)
    numbers = [0, 0, 0, 0, 1, 1, 1, 1]
    pdos = [Frame(can_id, n.to_bytes(4, "little")) for can_id, n in zip([0x281, 0x181, 0x282, 0x182] * 2, numbers,
                                                                         strict=True)]  # fmt: skip
    assert carried == [
        SYNC, *pdos[:4], SYNC, *pdos[4:],
        request(1, 5), Frame(0x581, request(1, 5).data), request(2, 6), Frame(0x582, request(2, 6).data),
    ]  # fmt: skip


def test_what_a_cycle_brings_is_sent_before_the_next_frame():
    world, carried = echo_world(1)
    world.nodes[1].after_cycle = lambda now: world.nodes[1].send(Frame(0x701, b"\x05"))
    world.receive(SYNC)
    assert carried[-1] == Frame(0x701, b"\x05")


def test_nodes_hear_each_other_but_not_themselves():
    world, _ = echo_world(1, 2)
    world.power_on()
    assert [frame for frame, _ in world.nodes[1].log] == [Frame(0x702, b"\x00")]
    assert [frame for frame, _ in world.nodes[2].log] == [Frame(0x701, b"\x00")]


def test_no_node_sees_an_extended_frame():
    world, _ = echo_world(1)
    world.receive(Frame(0x601, bytes(8)), extended=True)
    assert world.nodes[1].log == []


def test_a_sync_that_is_lost_lets_time_pass_without_the_nodes():
    world, carried = echo_world(1, wire=Wire(instant=True, faults=Faults(drop=1.0, only=(0x080,))))
    world.receive(SYNC)
    assert world.cycles == 1
    assert carried == []
    assert world.nodes[1].log == [("before", 0.0), ("after", 0.001)]


def test_a_delayed_frame_arrives_cycles_later():
    world, carried = echo_world(1, wire=Wire(instant=True, faults=Faults(delay=1.0, delay_max=0.003, only=(0x581,))))
    world.receive(request(1, 1))
    assert carried == [request(1, 1)]
    for _ in range(4):
        world.receive(SYNC)
    assert Frame(0x581, request(1, 1).data) in carried


def test_the_sync_that_advances_time_is_the_one_of_1005h():
    world, carried = World(), []
    world.listeners.append(lambda ended: carried.append(ended.frame))
    world.add(EmulatedDrives(load="inertia", num_threads=1), [1])
    world.power_on()
    world.receive(Frame(0x601, bytes.fromhex("23 05 10 00 85 00 00 00")))
    assert carried[-1] == Frame(0x581, bytes.fromhex("60 05 10 00 00 00 00 00"))
    world.receive(SYNC)
    assert world.cycles == 0
    world.receive(Frame(0x085))
    world.receive(Frame(0x085, b"\x01"))  # with a counter
    assert world.cycles == 2
    world.close()


def conversation(seed):
    """Everything on the bus and every byte of drives' state after a random talk in lockstep."""
    drives = [EmulatedDrives(load=load, num_threads=1) for load in ("inertia", "two_mass")]
    world, carried = World(wire=Wire(instant=True, faults=Faults(drop=0.05, reorder=0.1, corrupt=0.05), seed=seed)), []
    world.listeners.append(lambda ended: carried.append((ended.frame, ended.sender, ended.end)))
    for k, one in enumerate(drives, 1):
        world.add(one, [k])
    world.power_on()
    numbers = random.Random(7)
    for k in range(200):
        world.receive(Frame(0x601 + k % 2, bytes.fromhex("40 64 60 00 00 00 00 00")), "master")
        world.receive(Frame(0x201 + k % 2, numbers.randbytes(2)), "other master")
        world.receive(SYNC)
    states = [one.inside.records.tobytes() for one in drives]
    world.close()
    return carried, states


def test_lockstep_gives_the_same_bytes_twice():
    first, second = conversation(4), conversation(4)
    assert first == second
    assert len(first[0]) > 400


# --- time -----------------------------------------------------------------------------------------------------------
def test_cycles_and_frames_happen_in_the_order_of_their_times():
    world, carried = echo_world(1, lockstep=False)
    world.run_until(0.0005)
    world.receive(SYNC)
    took = frame_bits(SYNC) * 1e-6
    world.run_until(0.0025)
    log = world.nodes[1].log
    assert [what for what, _ in log] == [SYNC, "before", "after", "before", "after"]
    assert [when for what, when in log if what != "before"] == pytest.approx([0.0005 + took, 0.001, 0.002])
    assert (world.time, world.cycles, world.next_cycle) == pytest.approx((0.0025, 2, 0.003))
    assert len(carried) == 3


def test_a_frame_that_ends_after_a_cycle_is_received_after_it():
    world, _ = echo_world(1, lockstep=False)
    world.run_until(0.00098)
    world.receive(SYNC)  # 51 bits
    world.run_until(0.0019)
    assert [what for what, _ in world.nodes[1].log] == ["before", "after", SYNC]


def test_the_beginning_of_each_cycle_is_told_with_its_time():
    world, _ = echo_world(1, lockstep=False)
    begun = []
    world.run_until(0.0049, begun.append)
    assert begun == pytest.approx([0.001, 0.002, 0.003, 0.004])


@contextmanager
def world_of_a_drive(until=0.01, lockstep=False):
    """A world whose node 5 is an emulated drive that has booted, and the drive."""
    world = World(lockstep=lockstep)
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        world.add(drives, [5])
        world.power_on()
        if not lockstep:
            world.run_until(until)
        yield world, drives
        world.close()


def test_drives_advance_with_the_world():
    world = World(lockstep=False)
    drives = EmulatedDrives(load="inertia", num_threads=1)
    world.add(drives, [1])
    world.run_until(0.0105)
    twin = EmulatedDrives(load="inertia", num_threads=1)
    twin.advance(0.010)
    assert drives.inside.records.tobytes() == twin.inside.records.tobytes()
    world.close()
    twin.close()


class Writer:
    """A master that writes a number to a node's target position, reads it back, and so on, without pause."""

    def __init__(self, world, name, node_id):
        self.world, self.name, self.node_id = world, name, node_id
        self.asked, self.answered = 0, 0
        world.listeners.append(self.hear)

    def ask(self):
        self.asked += 1
        number = self.asked // 2
        write = f"23 7A 60 00 {number.to_bytes(4, 'little').hex()}"
        data = bytes.fromhex("40 7A 60 00 00 00 00 00" if self.asked % 2 else write)
        self.world.receive(Frame(0x600 + self.node_id, data), self.name)

    def hear(self, ended):
        if ended.frame.can_id == 0x580 + self.node_id:
            self.answered += 1
            number = ((self.answered - 1) // 2).to_bytes(4, "little").hex()
            answer = f"43 7A 60 00 {number}" if self.answered % 2 else "60 7A 60 00 00 00 00 00"
            assert ended.frame.data == bytes.fromhex(answer)
            self.ask()


def busy_drives(node_ids, num_tpdos):
    """Operational drives in virtual time whose first TPDOs come with every SYNC, the others never."""
    world = World(lockstep=False)
    for node_id in node_ids:
        world.add(EmulatedDrives(load="inertia", num_threads=1), [node_id])
    world.power_on()
    for node_id in node_ids:
        for k in range(4):
            sync = "02 01 00 00 00"  # sub-index 2, transmission type: 1
            off = f"01 {0x80 + node_id:02X} {0x01 + k:02X} 00 80"  # sub-index 1, identifier: bit 31
            data = f"2F {k:02X} 18 {sync}" if k < num_tpdos else f"23 {k:02X} 18 {off}"
            world.receive(Frame(0x600 + node_id, bytes.fromhex(data)))
    world.receive(Frame(0x000, b"\x01\x00"))
    world.run_until(0.02)
    return world


def check_full_bus_of_drives(duration):
    """Four drives with two synchronous TPDOs each, two masters that read and write without pause."""
    node_ids = (1, 2, 3, 4)
    world = busy_drives(node_ids, 2)
    counts = Counter()
    world.listeners.append(lambda ended: counts.update((ended.frame.can_id,)))
    clients = [Writer(world, f"master {node_id % 2}", node_id) for node_id in node_ids]
    for client in clients:
        client.ask()
    bits, start = world.wire.statistics.bits, world.time
    cycles = round(duration * 1000)
    for k in range(1, cycles + 1):
        world.receive(SYNC, "producer")
        world.run_until(start + k * 0.001)
    assert (world.wire.statistics.bits - bits) / (duration * 1e6) == pytest.approx(1.0, abs=0.01)
    assert counts[0x080] == cycles
    for node_id in node_ids:
        assert counts[0x180 + node_id] == counts[0x280 + node_id] == cycles
    for client in clients:
        assert client.asked == client.answered + 1
    assert sum(client.answered for client in clients) > 100 * duration
    assert world.wire.statistics.lost == world.wire.statistics.errors == 0
    world.close()


def test_a_full_bus_of_drives_loses_nothing():
    check_full_bus_of_drives(1.0)


@pytest.mark.slow
def test_a_full_bus_of_drives_loses_nothing_in_a_minute():
    check_full_bus_of_drives(60.0)


def test_what_the_bus_cannot_carry_is_lost_and_told():
    world = busy_drives((1, 2, 3, 4), 4)  # 16 TPDOs and SYNC in a millisecond: about 1.2 Mbit/s
    heard = []
    world.listeners.append(lambda ended: heard.append(ended.frame))
    for k in range(1, 401):
        world.receive(SYNC, "producer")
        world.run_until(0.02 + k * 0.001)
    assert world.wire.statistics.lost > 0
    assert all(world.wire.waiting(("node", node_id)) <= 64 for node_id in world.nodes)
    world.run_until(0.6)
    # Manual, table 303: 8110h, CAN overrun; byte 3 is 2 for the transmit buffer.
    told = [frame.data.hex() for frame in heard if 0x081 <= frame.can_id <= 0x084]
    assert told
    assert {(data[:4], data[6:8]) for data in told} == {("1081", "02"), ("0000", "00")}  # and that it is over
    world.close()


def flood(world, can_id, count):
    """Send frames without data, as fast as the bus carries them; return node 5's emergencies until they are over."""
    heard = []
    world.listeners.append(lambda ended: heard.append(ended.frame))
    for _ in range(count):
        world.receive(Frame(can_id, b""), "flood")
    world.run_until(world.time + 0.2)
    assert world.wire.waiting("flood") == 0
    return [frame.data.hex(" ") for frame in heard if frame.can_id == 0x085]


def test_what_a_node_does_not_take_in_time_fills_its_buffer_and_is_told():
    """Table 303: 8110h with 3. A full bus of SYNC has 20 frames a millisecond, and the firmware takes 16."""
    with world_of_a_drive() as (world, _):
        assert flood(world, 0x080, 300) == [], "64 may wait"
        assert flood(world, 0x123, 2000) == [], "frames of others do not pass its controller's filters"
        # Told once until it has caught up, and that it is over.
        assert flood(world, 0x080, 2000) == ["10 81 11 03 ff 00 00 00", "00 00 00 00 00 00 00 00"]
        answers = []
        world.listeners.append(lambda ended: answers.append(str(ended.frame)))
        world.receive(Frame(0x605, bytes.fromhex("40 01 10 00 00 00 00 00")))
        world.run_until(world.time + 0.01)
        assert answers == ["605  40 01 10 00 00 00 00 00", "585  4F 01 10 00 00 00 00 00"]


@pytest.mark.parametrize("command", [0x81, 0x82])
def test_a_node_that_is_reset_boots_after_its_time_and_is_deaf_until_then(command):
    """A master that sends the command and then begins to wait hears the boot-up message."""
    world = World(lockstep=False)
    drives = EmulatedDrives(load="inertia", num_threads=1)
    (node,) = world.add(drives, [5])
    world.power_on()
    world.run_until(0.01)
    heard = []
    world.listeners.append(lambda ended: heard.append((world.time, str(ended.frame))))
    read = Frame(0x605, bytes.fromhex("40 01 10 00 00 00 00 00"))
    world.receive(Frame(0x000, bytes((command, 5))))
    for k in range(1, 5):  # nobody answers
        world.run_until(0.01 + 0.01 * k)
        world.receive(read)
    world.run_until(0.2)
    world.receive(read)
    world.run_until(0.21)
    answers = [(time, frame) for time, frame in heard if not frame.startswith(("605", "000"))]
    assert [frame for _, frame in answers] == ["705  00", "585  4F 01 10 00 00 00 00 00"]
    assert answers[0][0] == pytest.approx(0.01 + drives.device.canopen.boot_time, abs=0.002)
    assert node.state is NmtState.PRE_OPERATIONAL
    world.close()


READ, SAVE = "40 01 10 00 00 00 00 00", "23 10 10 01 73 61 76 65"  # 1001h; 1010h:01 = "save"


def answered(world, *requests):
    """Send SDO requests; return each answer, and the time [s] to it from when its request was on the bus."""
    ends, answers = [], []

    def listen(ended):
        if ended.frame.can_id == 0x585:
            answers.append((world.time, ended.frame.data.hex(" ").upper()))
        elif ended.frame.can_id == 0x605:
            ends.append(world.time)

    world.listeners.append(listen)
    for request in requests:
        world.receive(Frame(0x605, bytes.fromhex(request)))
    if not world.lockstep:
        world.run_until(world.time + 0.1)
    world.listeners.remove(listen)
    return [(time - end, data) for (time, data), end in zip(answers, ends, strict=True)]


@pytest.mark.parametrize(("request_", "role"), [(READ, "sdo_time"), (SAVE, "store_time")])
def test_an_sdo_answer_takes_the_time_of_the_device(request_, role):
    with world_of_a_drive(until=0.0101) as (world, drives):
        ((took, data),) = answered(world, request_)
        assert data[:2] in ("4F", "60")
        frame = 130e-6  # s on the wire at 1 Mbit/s, for the answer itself
        assert took == pytest.approx(getattr(drives.device.canopen, role) + frame, abs=30e-6)


def test_requests_are_answered_one_after_the_other():
    with world_of_a_drive() as (world, drives):
        (_, saved), (took, read) = answered(world, SAVE, READ)
        assert (saved[:2], read[:2]) == ("60", "4F")
        assert took > drives.device.canopen.store_time


@pytest.mark.parametrize("command", [0x02, 0x81, 0x82])
def test_an_answer_that_is_under_way_ends_with_its_service(command):
    """Stopped has no SDO, and a node that boots has forgotten what it was asked."""
    with world_of_a_drive() as (world, _):
        heard = []
        world.listeners.append(lambda ended: heard.append(ended.frame.can_id))
        world.receive(Frame(0x605, bytes.fromhex(SAVE)))
        world.run_until(0.015)
        world.receive(Frame(0x000, bytes((command, 5))))
        world.run_until(0.2)
        assert 0x585 not in heard and {0x605, 0x000} <= set(heard)


def test_in_lockstep_an_sdo_answer_takes_no_time():
    with world_of_a_drive(lockstep=True) as (world, _):
        assert [(took, data[:2]) for took, data in answered(world, SAVE, READ)] == [(0.0, "60"), (0.0, "4F")]


def test_a_reset_switches_the_motor_off_at_once_however_long_the_node_boots():
    with world_of_a_drive() as (world, drives):
        motion.enable(drives, mode="pv")
        assert drives.read(0x6041)[0] & 0x6F == 0x27
        world.receive(Frame(0x000, b"\x81\x05"))
        world.run_until(0.012)
        assert drives.read(0x6041)[0] & 0x6F == 0x40  # switch on disabled
        assert drives.inside.records["stage_on"][0, 0] == 0.0


def test_in_lockstep_frames_take_no_time_and_none_is_lost():
    with world_of_a_drive(lockstep=True) as (world, _):
        answers = []
        world.listeners.append(lambda ended: answers.append(ended.frame.can_id))
        for _ in range(500):
            world.receive(Frame(0x605, bytes.fromhex("40 01 10 00 00 00 00 00")))
        assert answers.count(0x585) == 500
        assert 0x085 not in answers


def test_of_two_masters_the_lower_identifiers_have_the_bus():
    world, _ = echo_world(1, 2, lockstep=False)
    order = []
    world.listeners.append(lambda ended: order.append(ended.frame.can_id))
    for k in range(100):
        world.receive(request(1, k), "left")
        world.receive(request(2, k), "right")
    world.run_until(0.05)
    assert Counter(order) == {0x601: 100, 0x602: 100, 0x581: 100, 0x582: 100}
    # Answers win over requests, 581h over 582h, 601h over 602h: each request is answered before the next leaves.
    assert order == [0x601, 0x581] * 100 + [0x602, 0x582] * 100


def test_a_node_learns_of_its_bus_off():
    world, _ = echo_world(1, lockstep=False, wire=Wire(faults=Faults(corrupt=1.0, only=(0x581,))))
    world.receive(request(1, 1))
    world.run_until(0.02)
    told = [(what, when) for what, when in world.nodes[1].log if what in ("error passive", "bus off", "bus on")]
    assert [what for what, _ in told] == ["error passive", "bus off", "bus on"]
    assert 0.001408 <= told[2][1] - told[1][1] <= 0.0024  # 128 times 11 bits, seen with the next cycle


# --- joining --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("node_id", "message"), [
    (0, "node 0 is out of range; identifiers are 1 to 127"),
    (128, "node 128 is out of range"),
    (5, "node 5 is on the bus already; give each its own identifier, 1 to 127"),
])  # fmt: skip
def test_an_identifier_that_cannot_be_is_refused(node_id, message):
    world, _ = echo_world(5)
    with pytest.raises(ValueError, match=message):
        world.attach(node_id, lambda send: Echo(node_id, send))


def test_a_machine_with_two_axes_has_two_nodes():
    drives = EmulatedDrives(load="inertia", num_machines=2, num_threads=1)
    world = World()
    nodes = world.add(drives, [3, 4])
    assert list(world.nodes) == [3, 4]
    assert [node.first_axis for node in nodes] == [0, 1]
    with pytest.raises(ValueError, match=r"2 axes .* take 2 nodes .* 1 node identifiers were given"):
        World().add(drives, [1])
    world.close()
