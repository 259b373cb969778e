"""Faults of a bus, its nodes and the machines behind them, as they are given to a world that is served."""

from __future__ import annotations

import json

import pytest

from drive_env import EmulatedDrives, motion
from drive_env.bus.bus_faults import DISTURBANCES, OF_ONE_NODE, BusFaults
from drive_env.bus.wire import Wire
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.faults.schedule import Order, parse_order
from drive_env.faults.table import FAULTS
from drive_env.firmware.record import get_lanes
from drive_env.node.store import Store

NODE, MASTER = 5, 0x7F
HEARTBEAT = Frame(0x700 + MASTER, b"\x05")
SAVE = 0x65766173
FAST = 500_000  # pps: 458 rpm


class Bus:
    """A world in virtual real time with one node, its faults, and a master that asks by SDO and sends heartbeats."""

    def __init__(
        self, load="inertia", nodes=(NODE,), store=None, lockstep=False, seed=0, machines=1, device="tmcm1636"
    ):
        self.world = World(lockstep=lockstep, wire=Wire(instant=lockstep, seed=seed))
        self.drives = EmulatedDrives(device, load=load, num_machines=machines, num_threads=1)
        self.node = self.world.add(self.drives, nodes, store)[0]
        self.faults = BusFaults(self.world)
        self.carried: list[Frame] = []
        self.world.listeners.append(lambda ended: self.carried.append(ended.frame))
        self.world.power_on()
        self.beats = False
        self.wait(0.01)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.world.close()

    def fault(self, text):
        return self.faults.add(parse_order(text))

    def wait(self, duration):
        for _ in range(round(duration * 1000)):
            if self.world.lockstep:
                self.world.receive(Frame(0x080))
                continue
            if self.beats and self.world.cycles % 50 == 0:
                self.send(HEARTBEAT)
            self.world.run_until(self.world.time + 0.001)

    def send(self, frame):
        self.world.receive(frame)

    def write(self, index, sub, value, size, patience=50):
        """Write an object by expedited SDO; return the answer's data, None where none came."""
        data = bytes([0x23 | (4 - size) << 2]) + index.to_bytes(2, "little") + bytes([sub])
        self.carried.clear()
        self.send(Frame(0x600 + self.node.node_id, data + value.to_bytes(4, "little", signed=value < 0)))
        for _ in range(patience):
            found = [frame.data for frame in self.carried if frame.can_id == 0x580 + self.node.node_id]
            if found:
                return found[0]
            self.wait(0.001)
        return None

    def ask(self, index, sub, value, size):
        assert self.write(index, sub, value, size)[0] == 0x60

    def start(self, watch=False):
        """Start the node, with a master that it watches, and turn at 458 rpm."""
        if watch:
            self.ask(0x1016, 1, MASTER << 16 | 100, 4)
            self.beats = True
        self.send(Frame(0x000, bytes((1, self.node.node_id))))
        self.wait(0.1)
        self.turn()

    def turn(self):
        if self.drives.read(0x6060)[0] != 3:
            self.ask(0x6060, 0, 3, 1)
        for word in (0x06, 0x07, 0x0F):
            self.ask(0x6040, 0, word, 2)
        self.ask(0x60FF, 0, FAST, 4)
        self.wait(0.3)
        assert self.state == 0x27
        assert self.drives.machine.rotor_speed[0] == pytest.approx(47.9, rel=0.05)
        self.carried.clear()

    @property
    def state(self):
        return int(self.drives.read(0x6041)[0]) & 0x6F

    def emergencies(self):
        return [frame.data[0] | frame.data[1] << 8 for frame in self.carried if frame.can_id == 0x80 + NODE]

    def until_emergency(self, code, within):
        start = self.world.time
        while code not in self.emergencies():
            assert self.world.time - start <= within, f"not detected: {self.emergencies()}"
            self.wait(0.001)
        return self.world.time - start

    def until_noted(self, within):
        """Let time pass until 1001h shows a communication error: a bus that is down carries no emergency."""
        start = self.world.time
        while not self.node.dictionary.port(0x1001, 0).read() & 0x10:
            assert self.world.time - start <= within, "not detected"
            self.wait(0.001)

    def come_back(self):
        """The way back of the rows: start the node, reset the fault, turn again."""
        self.send(Frame(0x000, bytes((1, self.node.node_id))))
        self.wait(0.01)
        for word in (0x00, 0x80, 0x00):
            self.ask(0x6040, 0, word, 2)
        self.wait(0.01)
        self.turn()


def test_every_fault_of_bus_and_node_has_an_effect():
    of_bus = {row.name for row in FAULTS.values() if row.group in ("bus", "node")}
    assert {*DISTURBANCES, *OF_ONE_NODE, "babbling_node"} == of_bus


# --- the bus ----------------------------------------------------------------------------------------------------------
def test_a_bus_that_loses_all_frames_stops_the_drive_by_its_heartbeat():
    with Bus() as bus:
        bus.start(watch=True)
        bus.wait(0.5)
        assert bus.emergencies() == []
        bus.fault("bus_loss duration=0.3 share=1")
        bus.until_noted(FAULTS["bus_loss"].detection)
        assert bus.emergencies() == []  # it was sent, and lost
        bus.wait(0.5)
        assert bus.state & 0x4F == 0x08
        assert abs(bus.drives.machine.rotor_speed[0]) < 0.5
        assert bus.faults.listing() == []
        bus.come_back()


@pytest.mark.parametrize("name", DISTURBANCES)
def test_bus_faults_do_to_frames_what_their_rows_say(name):
    """A thousand numbered frames of one sender: how many come, how often, when and in which order."""
    with Bus() as bus:
        # Of bit errors less than one in nine: beyond, the sender's error counter takes it off the bus.
        share = 0.05 if name == "bus_bit_errors" else 0.2
        number = bus.fault(f"{name} at=0.002 share={share}")
        bus.wait(0.003)
        bus.carried.clear()
        arrived = []
        bus.world.listeners.append(
            lambda ended: arrived.append((int.from_bytes(ended.frame.data, "little"), ended.end))
        )
        sent = []
        for k in range(1000):
            sent.append(bus.world.time)
            bus.send(Frame(0x400, k.to_bytes(8, "little")))
            if k % 2:  # two in a millisecond: the second may overtake the first
                bus.wait(0.001)
        bus.wait(0.05)
        numbers = [n for n, _ in arrived]
        late = [end - sent[n] for n, end in arrived]
        frame_time = 200e-6
        if name == "bus_loss":
            assert 1000 - len(numbers) == pytest.approx(200, abs=50)
        else:
            assert set(numbers) == set(range(1000))
        if name == "bus_doubling":
            assert len(numbers) - 1000 == pytest.approx(200, abs=50)
        elif name != "bus_loss":
            assert len(numbers) == 1000
        assert (numbers != sorted(numbers)) == (name == "bus_reorder")
        assert (max(late) > 5 * frame_time) == (name in ("bus_delay", "bus_reorder"))
        assert max(late) < 0.03
        assert (bus.world.wire.statistics.errors > 20) == (name == "bus_bit_errors")
        bus.faults.clear(number)
        bus.wait(0.002)
        assert bus.world.wire.injected == []


def test_bit_errors_make_a_node_error_passive_and_in_the_end_bus_off():
    with Bus() as bus:
        bus.ask(0x1017, 0, 5, 2)  # something to send
        bus.start()
        bus.fault("bus_bit_errors share=0.6")
        bus.until_emergency(0x8120, FAULTS["bus_bit_errors"].detection)


def test_bus_off_stops_and_disables_the_drive_and_says_so_afterwards():
    with Bus() as bus:
        bus.ask(0x1029, 1, 1, 1)  # no change of the NMT state
        bus.start()
        bus.fault("bus_off duration=0.01")
        bus.wait(0.005)
        assert bus.write(0x6060, 0, 3, 1, patience=3) is None
        assert bus.state & 0x4F in (0x08, 0x0F)
        bus.until_emergency(0x8140, FAULTS["bus_off"].detection)
        bus.wait(0.3)
        assert bus.state & 0x4F == 0x08
        assert bus.faults.listing() == []
        bus.come_back()


def test_a_node_that_bus_off_has_stopped_says_so_when_it_is_started():
    with Bus() as bus:
        bus.start()
        bus.fault("bus_off duration=0.01")
        bus.wait(0.5)
        assert bus.emergencies() == []
        bus.send(Frame(0x000, bytes((1, NODE))))
        bus.until_emergency(0x8140, 0.002)
        bus.come_back()


def test_bus_off_without_a_duration_recovers_after_128_times_11_bits():
    with Bus() as bus:
        bus.ask(0x1029, 1, 1, 1)
        bus.start()
        bus.fault("bus_off")
        # Looked at once a cycle: off as the next one begins, back as the first begins after 1.408 ms.
        assert bus.until_emergency(0x8140, 0.02) == pytest.approx(0.003, abs=0.0005)


def test_a_bus_off_that_is_cleared_ends():
    with Bus() as bus:
        bus.ask(0x1029, 1, 1, 1)
        bus.start()
        number = bus.fault("bus_off duration=100")
        bus.wait(0.5)
        assert bus.emergencies() == []
        bus.faults.clear(number)
        bus.until_emergency(0x8140, 0.02)


def test_a_babbling_node_starves_the_bus_in_real_time():
    with Bus() as bus:
        bus.start(watch=True)
        bus.fault("babbling_node duration=0.3")
        bus.until_noted(FAULTS["babbling_node"].detection)
        assert bus.write(0x6060, 0, 3, 1, patience=20) is None
        assert bus.state & 0x4F in (0x08, 0x0F)
        bus.wait(0.3)
        assert bus.faults.listing() == []
        bus.wait(0.1)
        bus.come_back()


def test_a_slow_babbler_leaves_room():
    with Bus() as bus:
        bus.start()
        bus.fault("babbling_node duration=1 rate=500 identifier=0x7FF".replace("0x7FF", str(0x7FF)))
        bus.wait(1.1)
        assert len([frame for frame in bus.carried if frame.can_id == 0x7FF]) == 500
        bus.ask(0x60FF, 0, FAST, 4)


def test_a_second_master_takes_the_node_out_of_operational():
    with Bus() as bus:
        bus.ask(0x1017, 0, 10, 2)
        bus.start()
        bus.fault("second_master duration=0.1 period=0.02")
        bus.wait(0.05)
        states = {frame.data[0] for frame in bus.carried if frame.can_id == 0x700 + NODE}
        assert states == {0x7F}
        assert bus.state == 0x27  # the axis goes on as it was told last
        bus.wait(0.1)
        assert len([frame for frame in bus.carried if frame.can_id == 0x000]) == 5
        bus.send(Frame(0x000, bytes((1, NODE))))
        bus.carried.clear()
        bus.wait(0.02)
        assert {frame.data[0] for frame in bus.carried if frame.can_id == 0x700 + NODE} == {0x05}


def test_a_second_master_that_stops_the_node_stops_the_axis():
    with Bus() as bus:
        bus.start()
        bus.fault("second_master duration=0.005 command=2")
        bus.wait(0.3)
        assert bus.emergencies() == []  # a stopped node is silent
        assert bus.state & 0x4F == 0x08
        bus.come_back()


# --- nodes ------------------------------------------------------------------------------------------------------------
def test_a_reset_in_motion_sends_the_boot_up_message():
    with Bus() as bus:
        bus.start()
        bus.fault("node_reset at=0.01")
        bus.wait(0.02)
        assert [frame.data for frame in bus.carried if frame.can_id == 0x700 + NODE] == [b"\x00"]
        assert bus.state & 0x4F == 0x40
        assert bus.drives.machine.rotor_speed[0] > 40.0
        assert bus.faults.listing() == []
        bus.come_back()


def test_a_save_that_power_interrupts_leaves_what_was_stored_before(tmp_path):
    with Bus(store=tmp_path) as bus:
        bus.ask(0x6081, 0, 111, 4)
        bus.ask(0x1010, 1, SAVE, 4)
        bus.ask(0x6081, 0, 222, 4)
        bus.fault("store_interrupted duration=0.1")
        bus.wait(0.002)
        assert bus.write(0x1010, 1, SAVE, 4) is None
        assert [frame.data for frame in bus.carried if frame.can_id == 0x700 + NODE] == [b"\x00"]
        assert bus.drives.read(0x6081)[0] == 111
        file = tmp_path / f"node-{NODE}-tmcm1636.json"
        assert Store(file, "tmcm1636").sections["profile"][0x6081, 0] == 111
        with pytest.raises(json.JSONDecodeError):  # what was being written is cut off
            json.loads((tmp_path / f"{file.name}.new").read_text(encoding="utf-8"))
        bus.wait(0.2)
        bus.ask(0x6081, 0, 333, 4)
        bus.ask(0x1010, 1, SAVE, 4)
        assert Store(file, "tmcm1636").sections["profile"][0x6081, 0] == 333


# --- machines behind nodes --------------------------------------------------------------------------------------------
def test_a_fault_of_a_machine_is_of_its_node_alone():
    with Bus(nodes=(5, 6), machines=2) as bus:
        number = bus.fault("supply_dip node=6 at=0.005 duration=0.01 voltage=6")
        seen = []
        for _ in range(20):
            bus.wait(0.001)
            seen.append(bus.drives.machine.supply.tolist())
            if len(seen) == 3:
                assert bus.faults.listing() == [
                    (number, Order("supply_dip", 0.005, "", 0.01, 6, parameters={"voltage": 6.0}), 6, False)
                ]
        assert seen == [[24.0, 24.0]] * 5 + [[24.0, 6.0]] * 10 + [[24.0, 24.0]] * 5
        assert bus.faults.listing() == []


@pytest.mark.parametrize("lockstep", [False, True])
def test_a_machine_s_fault_trips_on_the_bus_and_is_cleared(lockstep):
    with Bus(lockstep=lockstep) as bus:
        bus.start()
        number = bus.fault("enable_lost when='speed > 20'")
        bus.until_emergency(0x5441, 0.01)
        assert bus.faults.listing()[0].is_active
        bus.faults.clear(number)
        bus.wait(0.5)
        assert bus.faults.listing() == []
        bus.come_back()


def test_an_axis_of_a_machine_with_two_nodes_fails_alone():
    with Bus(load="gantry", nodes=(5, 6)) as bus:
        bus.fault("supply_surge node=6 voltage=30")
        bus.wait(0.002)
        assert bus.drives.machine.supply.tolist() == [24.0, 30.0]


@pytest.mark.parametrize("machines", ["inertia", "portal"])
def test_a_fault_reaches_an_axis_of_a_module_with_several(machines):
    """Three machines of one axis, or one machine of three: what is asked for of axis 1 is of axis 1 alone."""
    count = 3 if machines == "inertia" else 1
    with Bus(device="tmcm3313", load=machines, machines=count) as bus:
        bus.fault("open_phase phase=1 axis=1")
        bus.wait(0.002)
        broken = get_lanes(bus.drives.inside.records, "open_b", 3)
        assert broken.tolist() == [0, 1, 0]
        number = bus.fault("supply_dip voltage=12 axis=2 duration=0.5")
        bus.fault("open_phase phase=0")
        bus.wait(0.002)
        supply = bus.drives.machine.supply
        assert (supply < 13.0).tolist() == [False, False, True]
        assert get_lanes(bus.drives.inside.records, "open_a", 3).tolist() == [1, 1, 1], "without an axis: all"
        assert [one.order.axis for one in bus.faults.listing()] == [1, 2, None]
        bus.faults.clear(number)
        bus.wait(0.002)
        assert (bus.drives.machine.supply > 20.0).all()


def test_an_axis_of_a_module_is_jammed_and_the_others_turn():
    with Bus(device="tmcm3313", machines=3) as bus:
        motion.enable(bus.drives, mode="pv")
        bus.fault("jam axis=0")
        bus.wait(0.01)
        bus.drives.write(0x60FF, 51_200)
        bus.wait(0.5)
        turned = bus.drives.machine.rotor_angle
        assert abs(turned[0]) < 0.05 and (turned[1:] > 1.0).all()


def test_conditions_of_bus_faults_look_at_the_axes():
    with Bus() as bus:
        bus.fault("second_master when='speed > 40' at=0.4 duration=0.005 command=2")
        bus.start()
        bus.wait(0.5)
        assert bus.state & 0x4F == 0x08


def test_the_same_seed_disturbs_the_same_frames():
    def lost(seed):
        with Bus(seed=seed) as bus:
            bus.fault("bus_loss share=0.3")
            bus.wait(0.002)
            bus.carried.clear()
            for k in range(100):
                bus.send(Frame(0x400, bytes((k,))))
                bus.wait(0.001)
            return [frame.data[0] for frame in bus.carried]

    assert lost(1) == lost(1) != lost(2)


# --- mistakes ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("text", "message"), [
    ("bus_los", "no fault is named 'bus_los'"),
    ("bus_loss share=2", "share=2 must be 0 to 1$"),
    ("bus_loss node=9", "there is no node 9 on the bus; there are 5, 6"),
    ("bus_off", "fault bus_off is a fault of one node; give it: node=5, of 5, 6"),
    ("encoder_stuck", "fault encoder_stuck is a fault of one node"),
    ("encoder_stuck node=5 angle=3", "has no parameter 'angle'; it has none"),
    ("broken_coupling node=5", "load 'inertia' has no coupling"),
    ("node_reset node=5 duration=1", "is a moment and has no duration"),
    ("bus_loss at=-1", "is not a whole number of communication cycles"),
    ("bus_loss duration=0.0001", "is not a whole number of communication cycles"),
    ("second_master node=5 command=1.5", "command=1.5 must be a whole number"),
    ("encoder_stuck node=5 axis=1", "fault encoder_stuck: axis=1 must be 0 to 0 of node 5"),
    ("encoder_stuck node=5 axis=0.5", "axis must be a whole number, not 0.5"),
    ("node_reset node=5 axis=0", "is a fault of a bus or a node, not of an axis; leave axis out"),
])  # fmt: skip
def test_a_mistake_is_told_and_schedules_nothing(text, message):
    with Bus(nodes=(5, 6), machines=2) as bus:
        with pytest.raises(ValueError, match=message):
            bus.fault(text)
        assert bus.faults.listing() == []
        with pytest.raises(ValueError, match="there is no fault 3; there are none"):
            bus.faults.clear(3)


def test_a_load_that_cannot_be_so_calls_the_fault_off_and_the_bus_goes_on(caplog):
    with Bus(load="two_mass") as bus:
        bus.drives.machine.set("load.stiffness", 3.9 * bus.drives.machine.parameters["load.stiffness"])
        bus.fault("payload_jump factor=0.05")
        bus.wait(0.01)
        assert bus.faults.listing() == []
        assert "fault 1 is called off: " in caplog.text
        bus.ask(0x6060, 0, 3, 1)
