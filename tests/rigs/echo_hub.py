"""A hub with a node that echoes."""

from contextlib import contextmanager

from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame


class Echo:
    """A node that answers 601h with 581h, and a remote request for 701h with its state."""

    def __init__(self, send):
        self.send = send

    def power_on(self, now):
        pass

    def receive(self, frame, now):
        if frame.rtr and frame.can_id == 0x701:
            self.send(Frame(0x701, b"\x7f"))
        elif frame.can_id == 0x601:
            self.send(Frame(0x581, frame.data))

    before_cycle = after_cycle = power_on


@contextmanager
def serving(token=None, **options):
    """A hub with an echo as node 1, in a thread; yields the server."""
    world = World(**options)
    world.attach(1, Echo)
    with Server(world, Hub(bit_rate=world.wire.bit_rate, token=token)) as server:
        yield server
