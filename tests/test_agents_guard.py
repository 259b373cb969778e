"""A policy that gives no number, sticks at its limit or stalls: the drive is quick-stopped and left disabled."""

from __future__ import annotations

import contextlib
import time

import numpy as np
import pytest
from test_parity import WorldBus

from agents.evaluation import AsOnABus, evaluate
from agents.guard import KEPT, GuardedPolicy, GuardLimits, PolicyStoppedError, stop
from agents.policy import PolicyError
from drive_env import CanDrives, EmulatedDrives, Limits, SafetyError, motion
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World

SWITCH_ON_DISABLED = (0x4F, 0x40)
TURN = 65536
OPTIONS = {"load": "inertia", "mode": "csv", "duration": 1.0}
LOW, HIGH = np.array([-1.0, -0.5]), np.array([1.0, 0.5])


class Scripted:
    """A policy that does something else from some step on."""

    def __init__(self, then, after=200, first=0.3):
        self.then, self.after, self.first, self.steps = then, after, first, 0

    def act(self, observation):
        self.steps += 1
        value = self.first if self.steps <= self.after else self.then()
        return np.full((len(observation), 1), value, np.float32)

    def reset(self, mask=None):
        pass


def stall(seconds):
    def then():
        time.sleep(seconds)
        return 0.3

    return then


def fail():
    raise PolicyError("the policy's output is no number")


WRONGS = [
    (lambda: np.nan, r"entry 0 of the policy's action is nan, no number"),
    (lambda: np.inf, r"entry 0 of the policy's action is inf, no number"),
    (fail, "the policy's output is no number"),
    (lambda: 1.0, r"at the end of its range for 100 ms, and the limit is 100 ms; .*--saturation"),
    (lambda: -1.7, r"at the end of its range for 100 ms"),
    (stall(0.12), r"the policy took 1\d\d ms for an action, and its limit is 100 ms; use a smaller network"),
]
NAMES = ["nan", "inf", "no number inside", "saturates", "saturates below", "stalls"]


def is_disabled(drives):
    mask, value = SWITCH_ON_DISABLED
    return bool(np.all(drives.read(0x6041) & mask == value))


# --- on drives --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("wrong", "message"), WRONGS, ids=NAMES)
def test_over_can_the_drive_is_stopped_and_left_disabled(wrong, message):
    world = World(lockstep=True)
    emulated = EmulatedDrives(load="inertia", num_threads=1)
    world.add(emulated, [1])
    bus = WorldBus(world)
    speeds = []
    world.listeners.append(lambda ended: speeds.append(int(emulated.read(0x606C)[0])))
    with (
        CanDrives(bus=bus, pace="lockstep", safety=Limits(velocity=100 * TURN)) as drives,
        pytest.raises(PolicyStoppedError, match=message),
    ):
        evaluate(Scripted(wrong), "tracking", OPTIONS, drives=drives, episodes=1)
    assert max(speeds) > 2 * TURN  # it turned
    assert is_disabled(emulated) and abs(int(emulated.read(0x606C)[0])) < TURN // 4
    bus.shutdown()
    world.close()


@pytest.mark.parametrize(("wrong", "message"), WRONGS[::3], ids=NAMES[::3])
def test_drives_without_an_envelope_are_stopped_too(wrong, message):
    with EmulatedDrives(load="inertia", num_threads=1) as emulated:
        with pytest.raises(PolicyStoppedError, match=message):
            evaluate(Scripted(wrong), "tracking", OPTIONS, drives=AsOnABus(emulated), episodes=1)
        assert is_disabled(emulated) and abs(int(emulated.read(0x606C)[0])) < TURN // 4


def test_the_stop_is_a_ramp_and_not_a_coasting():
    """Disabled at once the axis would coast; the quick stop brings it to rest with 6085h first."""
    found = {}
    for how in ("stop", "disable"):
        with EmulatedDrives(load="inertia", num_threads=1) as drives:
            motion.enable(drives, mode="pv")
            drives.write("Target velocity", 10 * TURN)
            drives.advance(0.4)
            (stop if how == "stop" else motion.disable)(*([drives, "a test"] if how == "stop" else [drives]))
            found[how] = abs(int(drives.read(0x606C)[0]))
            assert is_disabled(drives)
    assert found["stop"] < TURN // 4 < 5 * TURN < found["disable"]


def test_after_the_evaluation_the_drive_is_at_rest_and_disabled():
    with EmulatedDrives(load="inertia", num_threads=1) as emulated:
        found = evaluate(Scripted(None, after=10**6), "tracking", OPTIONS, drives=AsOnABus(emulated), episodes=2)
        assert is_disabled(emulated) and len(found.seeds) == 2 and not found.violations


@pytest.mark.parametrize("then", [None, lambda: np.nan], ids=["to its end", "stopped"])
@pytest.mark.parametrize(
    ("environment", "options"), [("gain_scheduling", {}), ("tracking", {"mode": "csp", "action": "offset"})]
)
def test_gains_offsets_and_mode_are_as_before(environment, options, then):
    class Acting(Scripted):
        def act(self, observation):
            entries = 3 if environment == "gain_scheduling" else 1
            return np.repeat(super().act(observation), entries, axis=1)

    with EmulatedDrives(load="inertia", num_threads=1) as emulated:
        motion.select_mode(emulated, "pv")
        before = [int(emulated.read(name)[0]) for name in KEPT]
        policy = Acting(then, after=10**6 if then is None else 5)
        options = {"load": "inertia", "duration": 0.1, **options}
        with contextlib.nullcontext() if then is None else pytest.raises(PolicyStoppedError):
            evaluate(policy, environment, options, drives=AsOnABus(emulated), episodes=1)
        assert [int(emulated.read(name)[0]) for name in KEPT] == before and is_disabled(emulated)


def test_an_interrupt_stops_the_drive_too():
    def interrupt():
        raise KeyboardInterrupt

    with EmulatedDrives(load="inertia", num_threads=1) as emulated:
        with pytest.raises(KeyboardInterrupt):
            evaluate(Scripted(interrupt), "tracking", OPTIONS, drives=AsOnABus(emulated), episodes=1)
        assert is_disabled(emulated)


def test_while_a_policy_stalls_in_real_time_the_envelope_has_stopped_the_drive_already():
    """Not when it comes back: a policy may never do so."""
    world = World(lockstep=False)
    emulated = EmulatedDrives(load="inertia", num_threads=1)
    world.add(emulated, [1])
    hub = Hub()
    seen = []

    def then():
        before = time.monotonic()
        while time.monotonic() - before < 5.0:  # long: a busy computer's threads come late
            time.sleep(0.05)
            if is_disabled(emulated) and time.monotonic() - before > 0.3:
                break
        seen.append(is_disabled(emulated))
        return 0.3

    limits = GuardLimits(saturation=None, stall=0.1)
    try:
        with (
            Server(world, hub),
            CanDrives(channel=hub.channel, safety=Limits(velocity=100 * TURN, stall=0.1)) as drives,
            pytest.raises((PolicyStoppedError, SafetyError)) as told,
        ):
            evaluate(Scripted(then, after=50), "tracking", OPTIONS, drives=drives, episodes=1, guard=limits)
        assert seen in ([True], []), "the drive went on while the policy stalled"
        assert "quick-stopped" in str(told.value) or "the policy took" in str(told.value)
        assert is_disabled(emulated)
    finally:
        world.close()


# --- the watch alone --------------------------------------------------------------------------------------------------
def watched(actions, limits=None, step=0.01):
    rows = iter(actions)

    class Listed:
        def act(self, observation):
            return np.atleast_2d(next(rows)).astype(np.float32)

        def reset(self, mask=None):
            pass

    return GuardedPolicy(Listed(), LOW, HIGH, step, limits or GuardLimits())


@pytest.mark.parametrize(
    ("actions", "steps"),
    [
        ([[1.0, 0.0]] * 20, 10),  # 10 steps of 10 ms
        ([[0.0, -0.5]] * 20, 10),  # each entry has its own ends
        ([[1.0, 0.0]] * 9 + [[0.9, 0.0]] + [[1.0, 0.0]] * 9 + [[0.0, 0.0]], None),  # nine, a pause, nine
        ([[-1.0, 0.0], [1.0, 0.0]] * 10, 10),  # from one end to the other is no relief
        ([[0.99, 0.49]] * 20, None),
    ],
)
def test_saturation_is_counted_in_steps(actions, steps):
    policy = watched(actions)
    for k in range(20):
        if steps is not None and k == steps - 1:
            with pytest.raises(PolicyStoppedError, match="end of its range"):
                policy.act(None)
            return
        policy.act(None)


def test_a_new_episode_counts_anew():
    policy = watched([[1.0, 0.0]] * 18)
    for k in range(18):
        if k == 9:
            policy.reset(None)
        policy.act(None)


def test_one_action_is_no_sticking_however_long_its_step():
    policy = watched([[1.0, 0.0], [0.0, 0.0], [1.0, 0.0]], step=0.75)
    for _ in range(3):
        policy.act(None)


def test_limits_can_be_lifted_and_are_checked():
    policy = watched([[1.0, 0.5]] * 500, GuardLimits(saturation=None, stall=None))
    for _ in range(500):
        policy.act(None)
    with pytest.raises(ValueError, match="stall must be above 0 s, not 0 s; None for no limit"):
        GuardLimits(stall=0.0)
