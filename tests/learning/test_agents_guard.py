"""A policy that gives no number, sticks at its limit or stalls: the drive is quick-stopped and left disabled."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.world_bus import WorldBus

from agents.evaluation.evaluation import GivenDrives, as_on_a_bus, evaluate
from agents.policies.deadline import Deadline, DeadlineError
from agents.policies.guard import KEPT, GuardedPolicy, GuardLimits, PolicyStoppedError, stop, unchanged
from agents.policies.policy import PolicyError
from drive_env import CanDrives, EmulatedDrives, Limits, SafetyError, motion
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World

SWITCH_ON_DISABLED = (0x4F, 0x40)
TURN = 65536
OPTIONS = {"load": "inertia", "mode": "csv", "duration": 1.0}
LOW, HIGH = np.array([-1.0, -0.5]), np.array([1.0, 0.5])


# A busy computer answers late, too: only what is to be stopped for it may be.
PATIENCE = 30.0
PATIENT = GuardLimits(stall=PATIENCE)
IMPATIENT = GuardLimits(stall=2.0)


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


def no_number():
    raise PolicyError("the policy's output is not a number")


def fail():
    return [0.3][7]


def compute_for_ever():
    while True:
        pass


def deadlock():
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()


WRONGS = {
    "nan": (lambda: np.nan, PATIENT, r"entry 0 of the policy's action is nan, not a number"),
    "inf": (lambda: np.inf, PATIENT, r"entry 0 of the policy's action is inf, not a number"),
    "no number inside": (no_number, PATIENT, "the policy's output is not a number"),
    "fails": (fail, PATIENT, r"the policy failed: IndexError: list index out of range \(.*guard.py, line \d+\)"),
    "saturates": (lambda: 1.0, PATIENT, r"at the end of its range for 100 ms, and the limit is 100 ms; .*--saturation"),
    "saturates below": (lambda: -1.7, PATIENT, r"at the end of its range for 100 ms"),
    "computes for ever": (
        compute_for_ever,
        IMPATIENT,
        r"no answer for 2000 ms: it is too slow, or does not return at "
        r"all",
    ),
    "deadlock": (deadlock, IMPATIENT, r"no answer for 2000 ms: it is too slow, or does not return at all; .*--stall"),
}
wrong_policies = pytest.mark.parametrize(("wrong", "guard", "message"), WRONGS.values(), ids=WRONGS)


def is_disabled(drives):
    mask, value = SWITCH_ON_DISABLED
    return bool(np.all(drives.read(0x6041) & mask == value))


# --- on drives --------------------------------------------------------------------------------------------------------
@pytest.mark.every(18)
@wrong_policies
def test_over_can_the_drive_is_stopped_and_left_disabled(wrong, guard, message):
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
        evaluate(Scripted(wrong), "tracking", OPTIONS, on=GivenDrives(drives, guard=guard), episodes=1)
    assert max(speeds) > 2 * TURN  # it turned
    assert is_disabled(emulated) and abs(int(emulated.read(0x606C)[0])) < TURN // 4
    bus.shutdown()
    world.close()


@pytest.mark.every(8)
@wrong_policies
def test_drives_in_this_process_are_stopped_too(wrong, guard, message):
    with EmulatedDrives(load="inertia", num_threads=1) as emulated:
        with pytest.raises(PolicyStoppedError, match=message):
            evaluate(
                Scripted(wrong), "tracking", OPTIONS, on=GivenDrives(as_on_a_bus(emulated), guard=guard), episodes=1
            )
        assert is_disabled(emulated) and abs(int(emulated.read(0x606C)[0])) < TURN // 4


@pytest.mark.parametrize("wrong", [lambda: np.nan, fail], ids=["nan", "fails"])
def test_on_emulated_machines_the_run_ends_as_well(wrong):
    with pytest.raises(PolicyStoppedError):
        evaluate(Scripted(wrong, after=5), "tracking", OPTIONS, episodes=2)


def test_a_policy_that_fails_at_once_enables_nothing():
    with EmulatedDrives(load="inertia", num_threads=1) as emulated:
        words = []
        write = emulated.write

        def watch(name, value, **options):
            words.append((name, value))
            write(name, value, **options)

        emulated.write = watch
        with pytest.raises(PolicyStoppedError, match="IndexError"):
            evaluate(Scripted(fail, after=0), "tracking", OPTIONS, on=GivenDrives(as_on_a_bus(emulated)), episodes=1)
        assert {value for name, value in words if name == 0x6040} <= {0x00, 0x02}  # disable voltage, quick stop


def test_a_first_answer_may_take_its_time():
    """What a policy loads or compiles for it; nothing is enabled yet."""
    policy = Scripted(lambda: 0.3, after=0)

    def load_first():
        if policy.steps == 1:
            time.sleep(0.5)
        return 0.3

    policy.then = load_first
    with EmulatedDrives(load="inertia", num_threads=1) as emulated:
        on = GivenDrives(as_on_a_bus(emulated), guard=GuardLimits(stall=0.4))
        found = evaluate(policy, "tracking", OPTIONS | {"duration": 0.01}, on=on, episodes=1)
    assert len(found.seeds) == 1


@pytest.mark.slow
def test_the_command_ends_though_the_policy_never_does(tmp_path):
    (tmp_path / "hangs.py").write_text(
        "import numpy as np\nasked = 0\n\n\ndef policy(observation):\n    global asked\n    asked += 1\n"
        "    while asked > 200:\n        pass\n    return np.full((len(observation), 1), 0.3)\n"
    )
    (tmp_path / "tracking.toml").write_text('load = "inertia"\nmode = "csv"\n')
    world = World(lockstep=True)
    emulated = EmulatedDrives(load="inertia", num_threads=1)
    world.add(emulated, [1])
    hub = Hub()
    with Server(world, hub):
        command = ("evaluate", "hangs:policy", "-e", "tracking", "--config", "tracking.toml", "--lockstep", "--stall",
                   "2", "--interface", "slcan", "--channel", hub.channel)  # fmt: skip
        ended = subprocess.run(
            [sys.executable, "-m", "agents.commands.cli", *command],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=300,
        )
    assert ended.returncode == 1, ended.stderr
    assert "drive-agent: the policy gave no answer for 2000 ms" in ended.stderr and "Traceback" not in ended.stderr
    assert is_disabled(emulated)
    world.close()


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
        found = evaluate(
            Scripted(None, after=10**6),
            "tracking",
            OPTIONS,
            on=GivenDrives(as_on_a_bus(emulated), guard=PATIENT),
            episodes=2,
        )
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
            evaluate(policy, environment, options, on=GivenDrives(as_on_a_bus(emulated), guard=PATIENT), episodes=1)
        assert [int(emulated.read(name)[0]) for name in KEPT] == before and is_disabled(emulated)


def test_an_interrupt_stops_the_drive_too():
    def interrupt():
        raise KeyboardInterrupt

    with EmulatedDrives(load="inertia", num_threads=1) as emulated:
        with pytest.raises(KeyboardInterrupt):
            evaluate(
                Scripted(interrupt),
                "tracking",
                OPTIONS,
                on=GivenDrives(as_on_a_bus(emulated), guard=PATIENT),
                episodes=1,
            )
        assert is_disabled(emulated)


def test_in_real_time_the_drive_stops_while_the_policy_still_stalls():
    """A policy that comes back after all finds the drive disabled."""
    world = World(lockstep=False)
    emulated = EmulatedDrives(load="inertia", num_threads=1)
    world.add(emulated, [1])
    hub = Hub()
    stopped = threading.Event()
    policy = Scripted(lambda: stopped.wait(PATIENCE) and 0.3, after=50)
    try:
        with (
            Server(world, hub),
            CanDrives(channel=hub.channel, safety=Limits(velocity=100 * TURN, stall=1.0)) as drives,
        ):
            with pytest.raises((PolicyStoppedError, SafetyError), match=r"gave no answer|quick-stopped"):
                evaluate(policy, "tracking", OPTIONS, on=GivenDrives(drives, guard=GuardLimits(stall=1.0)), episodes=1)
            assert is_disabled(emulated) and not stopped.is_set()
    finally:
        stopped.set()
        world.close()


# --- the watch alone --------------------------------------------------------------------------------------------------
OBSERVATION = np.zeros((1, 3))


def watched(actions, limits=PATIENT, step=0.01):
    rows = iter(actions)

    class Listed:
        def act(self, observation):
            return np.atleast_2d(next(rows)).astype(np.float32)

        def reset(self, mask=None):
            pass

    return GuardedPolicy(Listed(), LOW, HIGH, step, limits)


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
                policy.act(OBSERVATION)
            return
        policy.act(OBSERVATION)


def test_a_new_episode_counts_anew():
    policy = watched([[1.0, 0.0]] * 18)
    for k in range(18):
        if k == 9:
            policy.reset(None)
        policy.act(OBSERVATION)


def test_one_action_is_no_sticking_however_long_its_step():
    policy = watched([[1.0, 0.0], [0.0, 0.0], [1.0, 0.0]], step=0.75)
    for _ in range(3):
        policy.act(OBSERVATION)


def test_limits_can_be_lifted_and_are_checked():
    policy = watched([[1.0, 0.5]] * 500, GuardLimits(saturation=None, stall=None))
    for _ in range(500):
        policy.act(OBSERVATION)
    with pytest.raises(ValueError, match="stall must be above 0 s, not 0 s; None for no limit"):
        GuardLimits(stall=0.0)


def test_an_answer_that_takes_just_the_limit_is_late():
    policy = GuardedPolicy(Scripted(lambda: time.sleep(0.1) or 0.3, after=0), LOW[:1], HIGH[:1], 0.001, GuardLimits())
    with pytest.raises(PolicyStoppedError, match="no answer for 100 ms"):
        policy.act(OBSERVATION)
    patient = GuardedPolicy(Scripted(lambda: time.sleep(0.1) or 0.3, after=0), LOW[:1], HIGH[:1], 0.001, PATIENT)
    assert patient.act(OBSERVATION) == np.float32(0.3)
    patient.close()


def test_an_answer_that_is_taken_late_is_late_whoever_was_slow(monkeypatch):
    clock = iter([0.0, 0.099, 1.0, 1.1])
    monkeypatch.setattr("agents.policies.guard.time", SimpleNamespace(perf_counter=lambda: next(clock)))
    policy = GuardedPolicy(Scripted(None, after=9), LOW[:1], HIGH[:1], 0.001, GuardLimits(stall=0.1))
    monkeypatch.setattr(policy._deadline, "call", lambda function, argument, within: function(argument))
    policy.act(OBSERVATION)
    with pytest.raises(PolicyStoppedError, match="no answer for 100 ms"):
        policy.act(OBSERVATION)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.zeros((1, 3)), r"has shape \(1, 3\); 1 environments take \(1, 2\)"),
        ("left", "is a str, not an array of numbers"),
        (None, "is a NoneType, not an array of numbers"),
        ([[0.1], [0.2, 0.3]], "is a list, not an array of numbers"),
    ],
)
def test_an_action_of_another_kind_is_told(answer, message):
    class Odd:
        def act(self, observation):
            return answer

        def reset(self, mask=None):
            pass

    with pytest.raises(PolicyStoppedError, match=message):
        GuardedPolicy(Odd(), LOW, HIGH, 0.01, PATIENT).act(OBSERVATION)


# --- the deadline -----------------------------------------------------------------------------------------------------
@pytest.fixture
def threads():
    """Returns the threads of policies that this test began."""
    before = set(threading.enumerate())
    return lambda: [thread for thread in set(threading.enumerate()) - before if thread.name == "policy"]


def wait_for(condition):
    until = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < until:
        time.sleep(0.01)
    return condition()


def test_a_call_returns_what_it_returns_and_raises_what_it_raises(threads):
    deadline = Deadline()
    with np.errstate(divide="raise"):
        assert deadline.call(divmod, 7, 2, within=PATIENCE) == (3, 1)
        with pytest.raises(ZeroDivisionError):
            deadline.call(divmod, 7, 0, within=PATIENCE)
        with pytest.raises(FloatingPointError):  # the thread's handling of errors is the caller's
            deadline.call(np.divide, np.ones(1), np.zeros(1), within=PATIENCE)
    assert len(threads()) == 1
    deadline.close()
    assert not threads()


def test_a_call_that_is_late_is_given_up_and_what_it_says_then_is_no_answer_to_the_next(threads):
    deadline, go = Deadline(), threading.Event()
    with pytest.raises(DeadlineError, match=r"no answer within 0\.05 s"):
        deadline.call(lambda: go.wait(PATIENCE) and "late", within=0.05)
    go.set()
    assert wait_for(lambda: not threads())
    assert deadline.call(lambda: "next", within=PATIENCE) == "next"
    deadline.close()


def test_a_thread_that_computes_for_ever_does_not(threads):
    deadline = Deadline()
    with pytest.raises(DeadlineError):
        deadline.call(compute_for_ever, within=0.05)
    assert wait_for(lambda: not threads())


def test_a_policy_that_nobody_holds_any_more_leaves_no_thread(threads):
    policy = GuardedPolicy(Scripted(None, after=9), LOW[:1], HIGH[:1], 0.001, PATIENT)
    policy.act(OBSERVATION)
    assert len(threads()) == 1
    del policy
    assert wait_for(lambda: not threads())


def test_what_must_stay_of_a_stepper_is_what_it_has():
    """It has no torque offset; its run current and the other offsets are put back."""
    with EmulatedDrives("tmcm6212", "inertia", num_threads=1) as drives:
        before = drives.read("Maximum current"), drives.read(0x60B1)
        with unchanged(drives):
            drives.write("Maximum current", 100)
            drives.write(0x60B1, 7)
        assert (drives.read("Maximum current"), drives.read(0x60B1)) == before
