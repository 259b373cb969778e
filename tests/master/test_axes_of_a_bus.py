"""Several nodes of a bus: machines of their own, joints of one machine, or ends of one thing."""

from __future__ import annotations

import json

import numpy as np
import pytest
from rigs.commands import drive_tune

from drive_env import EmulatedDrives, SafetyError, motion
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from tuning.target import on_bus


@pytest.fixture
def gantry_on_a_bus(tmp_path, monkeypatch):
    """A gantry's two drives as nodes 1 and 2 of a hub, in lockstep: the options that name them."""
    monkeypatch.chdir(tmp_path)
    world = World(lockstep=True)
    machine = EmulatedDrives(load="gantry", num_threads=1)
    machine.advance(0.001)  # compiles
    world.add(machine, [1, 2])
    hub = Hub()
    with Server(world, hub):
        yield ["--bus", "--interface", "slcan", "--channel", hub.channel, "--node", "1", "--node", "2", "--lockstep",
               "--travel", "-3:3", "--yes"]  # fmt: skip
    world.close()


@pytest.mark.slow
def test_both_ends_of_a_gantry_on_a_bus_move_together(gantry_on_a_bus):
    done = drive_tune("identify", *gantry_on_a_bus, "--axes", "linked", "--json")
    assert done.exit_code == 0, done.output
    inertia = [axis["estimates"]["inertia"]["value"] for axis in json.loads(done.stdout)]
    with EmulatedDrives(load="gantry", num_threads=1) as drives:
        bridge = drives.inside.groups[0].load.mass_matrix()[0][0, 0] * (0.04 / (2.0 * np.pi)) ** 2
    assert sum(inertia) == pytest.approx(bridge, rel=0.05)
    assert inertia[0] == pytest.approx(inertia[1], rel=0.1)


def test_how_axes_belong_together_is_one_of_three_and_of_a_bus(gantry_on_a_bus):
    done = drive_tune("identify", *gantry_on_a_bus, "--axes", "welded")
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr == "drive-tune: --axes welded must be one of apart, coupled, linked\n"
    done = drive_tune("identify", "--axes", "linked")
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr == (
        "drive-tune: --axes linked is for drives on a bus; add --bus, or leave it out (an emulated load has its own "
        "coupling)\n"
    )


@pytest.mark.parametrize(("axes", "lanes", "linked"), [("apart", 1, False), ("coupled", 2, False), ("linked", 2, True)])
def test_axes_of_a_bus_are_machines_as_was_said(gantry_on_a_bus, axes, lanes, linked):
    channel = gantry_on_a_bus[gantry_on_a_bus.index("--channel") + 1]
    bus = {"interface": "slcan", "channel": channel, "nodes": (1, 2), "pace": "lockstep", "travel": (-1.0, 1.0)}
    with on_bus(axes=axes, **bus) as target:
        assert (target.axes_per_machine, target.linked) == (lanes, linked)


def test_each_node_has_its_own_travel_and_one_that_turns_freely_frees_no_other(gantry_on_a_bus):
    """A union of their ranges would let each go where only the other may."""
    channel = gantry_on_a_bus[gantry_on_a_bus.index("--channel") + 1]
    bus = {"interface": "slcan", "channel": channel, "nodes": (1, 2), "pace": "lockstep"}
    with on_bus(travel=[(-2.0 * np.pi, 2.0 * np.pi), (-np.inf, np.inf)], **bus) as target:
        low, high = target.drives.safety.limits.position
        here = target.drives.read(0x6064)
        assert high[0] - here[0] == pytest.approx(65536 * 1.1, rel=1e-3)  # and a twentieth of it to either side
        assert here[0] - low[0] == pytest.approx(65536 * 1.1, rel=1e-3)
        assert (low[1], high[1]) == (-np.inf, np.inf)
        motion.enable(target.drives, mode="csp")
        with pytest.raises(SafetyError, match=r"axis 0: .* beyond the limits"):
            target.drives.write(0x607A, here + 65536 * 2)
        target.drives.write(0x607A, here + np.array([0, 65536 * 2]))
