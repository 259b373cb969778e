"""Figures of the bus: SDO per second in-process, through the hub, beside a flood; PDO latency, lateness of cycles."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import can
import numpy as np

from drive_env import EmulatedDrives
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.master.can.slcan_socket import SlcanSocket

SECONDS = 5.0  # of 1 kHz SYNC
TRANSFERS = 2000
READ_STATUSWORD = bytes.fromhex("40 41 60 00 00 00 00 00")
FLOOD_SECONDS = 2.0  # of SDO beside a flood, and without it
FLOOD = """
import socket, sys, threading
connection = socket.create_connection((sys.argv[1], int(sys.argv[2])))
connection.sendall(b"O\\r")
def read():
    while connection.recv(65536):
        pass
threading.Thread(target=read, daemon=True).start()
print("it floods", flush=True)
while True:
    connection.sendall(b"t7FF81122334455667788\\r" * 500)
"""
SERVE = "import typer; from drive_env.commands.serve import serve; typer.run(serve)"


def sdo_in_process() -> float:
    """Return expedited uploads per second, called function to function."""
    world = World()
    world.add(EmulatedDrives(load="belt", num_threads=1), [1])
    world.power_on()
    answers = []
    world.listeners.append(lambda ended: answers.append(ended.frame))
    request = Frame(0x601, READ_STATUSWORD)
    start = time.perf_counter()
    for _ in range(TRANSFERS):
        world.receive(request)
    seconds = time.perf_counter() - start
    world.close()
    assert sum(frame.can_id == 0x581 for frame in answers) == TRANSFERS
    return TRANSFERS / seconds


@contextmanager
def served(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], can.BusABC]]:
    """Serve in a process of its own; yield the process and a stock python-can client."""
    process = subprocess.Popen(
        [sys.executable, "-c", SERVE, "--load", "belt", "--port", "0", "--stats", *arguments],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if match := re.search(r'channel="(socket://[^"]+)"', line):
                break
        else:
            raise RuntimeError("drive-env serve ended before it served")
        with can.Bus(interface="slcan", channel=match[1], sleep_after_open=0) as bus:
            yield process, bus
    finally:
        process.terminate()
        process.wait()


def send(bus: can.BusABC, can_id: int, data: bytes = b"") -> None:
    bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def wait_for(bus: can.BusABC, can_id: int, timeout: float = 1.0) -> bytes:
    """Return the data of the next frame with an identifier; TimeoutError if none comes in time [s]."""
    end = time.perf_counter() + timeout
    while time.perf_counter() < end:
        message = bus.recv(timeout)
        if message is not None and message.arbitration_id == can_id:
            return bytes(message.data)
    raise TimeoutError(f"no frame {can_id:03X} within {timeout:g} s")


def sdo_through_hub(*arguments: str) -> float:
    """Return expedited uploads per second by a stock python-can client of the hub."""
    with served(*arguments) as (_, bus):
        for _ in range(100):
            send(bus, 0x601, READ_STATUSWORD)
            wait_for(bus, 0x581)
        start = time.perf_counter()
        for _ in range(TRANSFERS):
            send(bus, 0x601, READ_STATUSWORD)
            wait_for(bus, 0x581)
        return TRANSFERS / (time.perf_counter() - start)


def sdo_beside_a_flood(*arguments: str) -> tuple[float, float]:
    """Return expedited uploads per second alone, and while another client sends frames 7FFh as fast as it can.

    The master is ours: python-can's own takes most of a processor to read a full bus, and would measure itself.
    """
    with served(*arguments) as (_, stock):
        host, port = stock.serialPortOrig._socket.getpeername()  # type: ignore[attr-defined]
        with SlcanSocket(f"socket://{host}:{port}") as bus:
            alone = transfers_per_second(bus)
            flood = subprocess.Popen([sys.executable, "-c", FLOOD, host, str(port)], stdout=subprocess.PIPE, text=True)
            try:
                assert flood.stdout is not None
                flood.stdout.readline()
                return alone, transfers_per_second(bus)
            finally:
                flood.kill()
                flood.wait()


def transfers_per_second(bus: can.BusABC) -> float:
    count, start = 0, time.perf_counter()
    while time.perf_counter() < start + FLOOD_SECONDS:
        send(bus, 0x601, READ_STATUSWORD)
        wait_for(bus, 0x581)
        count += 1
    return count / (time.perf_counter() - start)


def write(bus: can.BusABC, index: int, sub: int, value: int, size: int) -> None:
    request = bytes([0x23 | (4 - size) << 2]) + index.to_bytes(2, "little") + bytes([sub])
    send(bus, 0x601, request + value.to_bytes(4, "little"))
    if wait_for(bus, 0x581)[0] != 0x60:
        raise RuntimeError(f"{index:04X}h:{sub:02X} cannot be written")


def real_time() -> dict[str, float]:
    """Return lateness of the server's cycles and time from SYNC to the second TPDO, as a python-can master sees it.

    SYNC, two RPDO and two TPDO each millisecond, all synchronous.
    """
    with served() as (process, bus):
        for index, kind in ((0x1400, 0), (0x1401, 0), (0x1800, 1), (0x1801, 1)):
            write(bus, index, 2, kind, 1)
        send(bus, 0x000, b"\x01\x01")
        latency = []
        missed = 0
        start = time.perf_counter()
        for cycle in range(round(SECONDS * 1000)):
            due = start + cycle * 0.001
            while time.perf_counter() < due:  # a master's sleep would be late itself
                pass
            send(bus, 0x201, b"\x00\x00")
            send(bus, 0x301, b"\x00\x00\x00")
            sent = time.perf_counter()
            send(bus, 0x080)
            try:
                wait_for(bus, 0x281, 0.05)
                latency.append(time.perf_counter() - sent)
            except TimeoutError:
                missed += 1
        process.terminate()
        output = process.stdout.read() if process.stdout else ""
    figures = re.search(r"p50 ([\d.]+) ms, p99 ([\d.]+) ms, max ([\d.]+) ms", output)
    assert figures is not None, output
    latency.sort()
    return {
        "lateness of 1 ms cycles, p50 [ms]": float(figures[1]),
        "lateness of 1 ms cycles, p99 [ms]": float(figures[2]),
        "lateness of 1 ms cycles, max [ms]": float(figures[3]),
        "SYNC to second TPDO, p50 [ms]": 1e3 * latency[len(latency) // 2],
        "SYNC to second TPDO, p99 [ms]": 1e3 * latency[len(latency) * 99 // 100],
        "cycles without their TPDO": float(missed),
    }


def policy_loop() -> dict[str, float]:
    """Return what a shipped policy at 1 kHz takes over the hub: all of a step, and processor time of the loop's thread.

    A step is an action within a deadline, the envelope, an RPDO, SYNC, two TPDOs, observation and reward.
    """
    from agents.evaluation.on_the_bus import drives_for
    from agents.evaluation.served import in_real_time
    from agents.policies.guard import PATIENT, GuardedPolicy
    from agents.policies.policy import load_policy
    from agents.shipped import shipped
    from drive_env import motion
    from drive_env.bus.config import Machine
    from drive_env.envs.tracking import Tracking
    from drive_env.realtime_section import undisturbed

    policy = load_policy(shipped("tracking_two_mass"))
    options = {
        key: value for key, value in policy.bundle.configuration.items() if key not in ("distributions", "stage")
    }
    options["duration"] = SECONDS
    machine = Machine("tmcm1636", "two_mass", "qbl4208", (1,))
    name = "ServoDrive/Tracking-v0"
    with in_real_time(machine, 0) as there, drives_for(
        name, options, PATIENT, device="tmcm1636", interface="slcan", channel=there.channel, nodes=(1,), lockstep=False
    ) as drives:  # fmt: skip
        env = Tracking(drives=drives, autoreset_mode="Disabled", config=options)
        space = env.single_action_space
        watched = GuardedPolicy(policy, space.low, space.high, 1e-3, PATIENT)
        watched.warm_up(np.zeros(env.observation_space.shape, np.float32))
        observation, _ = env.reset(seed=1)
        times = []
        with undisturbed():
            for _ in range(round(SECONDS * 1000) - 1):
                begin = time.perf_counter(), time.thread_time()
                observation, *_ = env.step(watched.act(observation))
                times.append((time.perf_counter() - begin[0], time.thread_time() - begin[1]))
        watched.close()
        motion.disable(drives)
        env.close()
    wall, own = np.array(times).T
    return {
        "policy at 1 kHz over the hub, ms per step": 1e3 * float(wall.mean()),
        "policy at 1 kHz over the hub, steps beyond 1.1 ms [share]": float(np.mean(wall > 1.1e-3)),
        "policy at 1 kHz over the hub, processor time of its thread [us per step]": 1e6 * float(own.mean()),
    }


def figures() -> dict[str, float]:
    """Return all figures of the bus."""
    lockstep, real = sdo_beside_a_flood("--lockstep"), sdo_beside_a_flood()
    return {
        "SDO/s, in-process": sdo_in_process(),
        "SDO/s, hub, lockstep": sdo_through_hub("--lockstep"),
        "SDO/s, hub, real time (1 Mbit/s)": sdo_through_hub(),
        "SDO/s, hub, lockstep, our client": lockstep[0],
        "SDO/s, hub, lockstep, our client, beside a flood": lockstep[1],
        "SDO/s, hub, real time, our client": real[0],
        "SDO/s, hub, real time, our client, beside a flood": real[1],
        **real_time(),
        **policy_loop(),
    }
