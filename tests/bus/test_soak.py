"""Soak: machines under random faults that come and go, with what must always hold checked every communication cycle.

It is an hour of machine time: sixteen machines for 225 s each, side by side.
soak_cycle.py composes the stages of a cycle as firmware/cycle.py does, and sums energies tick by tick beside them.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
import warnings
from pathlib import Path

import numpy as np
import pytest
from rigs.soak_cycle import BRIDGE, CHOPPER, COPPER, IDLE, LEAP, OFF_CURRENT, SHAFT, SOURCE, SPEED, run_cycle
from rigs.thinning import part

from drive_env import EmulatedDrives, motion
from drive_env.bus.bus_faults import MOST_BABBLE, BusFaults
from drive_env.bus.wire import Wire
from drive_env.bus.world import TRANSMIT_BUFFER, World
from drive_env.canopen.frames import Frame
from drive_env.cia402 import STATE_CODING, State
from drive_env.faults.schedule import Order
from drive_env.faults.table import FAULTS
from drive_env.firmware.record import get_lanes

MACHINES = 16
OF_MACHINES = [row.name for row in FAULTS.values() if row.group != "bus" and row.name != "store_interrupted"]
COUNT = 2.0 * np.pi / 4096  # rad of the encoder
MASKS = np.array([STATE_CODING[state][0] for state in State])
CODES = np.array([STATE_CODING[state][1] for state in State])
DRIVING = [int(state) for state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)]


class Soak:
    """Machines under random faults and a random master; `cycle` lets one pass and checks it."""

    def __init__(self, load, seed):
        self.random = np.random.default_rng(seed)
        self.drives = EmulatedDrives(load=load, num_machines=MACHINES, seed=seed, randomise=True, num_threads=1)
        self.scratch = np.zeros((7, 8 * len(self.drives.inside.records)))
        self.sums = np.zeros((9, MACHINES))
        self.given = dict.fromkeys(OF_MACHINES, 0)
        self.called_off = 0
        self.moments = {}  # cycle -> machines whose counter leaps then
        self.energy = np.zeros(2)  # residual and throughput [J], added up
        self.change = np.zeros(MACHINES)
        self.worst = 0.0
        self.fastest = np.zeros(MACHINES)
        self.enabled_cycles = 0
        self.drives.write(0x6065, 20_000)
        motion.enable(self.drives, mode="pv")

    def lanes(self, name):
        return get_lanes(self.drives.inside.records, name, MACHINES).astype(float)

    def order_faults(self):
        """About two faults a second and machine, of all kinds, numbers from their whole ranges."""
        for machine in np.flatnonzero(self.random.random(MACHINES) < 0.002):
            row = FAULTS[str(self.random.choice(OF_MACHINES))]
            given = {}
            for key, parameter in row.parameters.items():
                if (row.name, key) == ("stage_short", "phase"):
                    continue  # a bridge of a stepper drive; a servo's short lies across the DC link
                drawn = self.random.uniform(parameter.low, parameter.high)
                given[key] = int(drawn) if isinstance(parameter.default, int) else float(drawn)
            delay = int(self.random.integers(1, 50))
            duration = None if row.once else float(self.random.integers(5, 300)) * 1e-3
            where = np.arange(MACHINES) == machine
            try:
                self.drives.machine.fault(row.name, at=delay * 1e-3, duration=duration, where=where, **given)
            except ValueError as error:
                assert "resonates at" in str(error)  # a payload that cannot be stepped
                self.called_off += 1
                continue
            self.given[row.name] += 1
            if row.once:
                self.moments.setdefault(self.drives.inside.cycle + delay, []).append(machine)

    def command(self):
        """Do what a master might: enable and reset, turn, halt, stop, switch off."""
        drives, word = self.drives, self.lanes("statusword").astype(int)
        chosen = self.random.random(MACHINES) < 0.3
        fault = chosen & (word & 0x4F == 0x08)
        if fault.any():
            drives.write(0x6040, 0x00, where=fault)
            drives.write(0x6040, 0x80, where=fault)
        for state, mask, value in ((0x40, 0x4F, 0x06), (0x21, 0x6F, 0x07), (0x23, 0x6F, 0x0F)):
            there = chosen & (word & mask == state)
            if there.any():
                drives.write(0x6040, value, where=there)
        running = chosen & (word & 0x6F == 0x27)
        if running.any():
            drives.write(0x60FF, self.random.integers(-1_500_000, 1_500_000, MACHINES), where=running)
            kind = self.random.random()
            if kind < 0.1:
                drives.write(0x6040, int(self.random.choice([0x00, 0x02, 0x06, 0x07, 0x10F])), where=running)

    def cycle(self):
        drives = self.drives
        if drives.inside.cycle % 20 == 0:
            self.command()
        self.order_faults()
        drives.faults.act(drives.inside.cycle)
        magnetic, capacitor, driven = self.stored()
        theta, measured, gain = self.lanes("theta_m"), self.lanes("theta_meas"), self.lanes("encoder_gain")
        wired, told = self.lanes("encoder_true_direction"), self.lanes("encoder_direction")
        gain = np.where(wired == told, gain, -gain)
        quiet = self.is_quiet()
        quiet[self.moments.pop(drives.inside.cycle, [])] = False
        group = drives.inside.groups[0]
        run_cycle(drives.inside.records, group.load.plant, group.rates, self.scratch, MACHINES, self.sums, self.change)
        drives.inside.cycle += 1
        drives.emergencies()
        self.check_state()
        self.check_position(theta, measured, gain, quiet)
        self.check_energy(magnetic, capacitor, driven)

    def check_state(self):
        fsa, word = self.lanes("fsa").astype(int), self.lanes("statusword").astype(int)
        assert np.all((fsa >= 0) & (fsa < len(CODES)))
        assert np.array_equal(word & MASKS[fsa], CODES[fsa]), "the statusword codes another state"
        on = self.lanes("stage_on") > 0.0
        assert not np.any(on & ~np.isin(fsa, DRIVING)), "the stage is on in a state without current"
        assert not self.sums[OFF_CURRENT].any(), "current while the stage is off"
        assert not self.lanes("tau_m")[~on].any(), "torque while the stage is off"
        assert not self.drives.machine.diverged.any()
        self.enabled_cycles += int(on.sum())

    def is_quiet(self):
        """Return where the encoder tells nothing but the rotor's angle."""
        return (self.lanes("encoder_noise") == 0.0) & (self.lanes("encoder_shake") == 0.0)

    def check_position(self, theta, measured, gain, quiet):
        assert self.sums[LEAP].max() < 5e-3, "the rotor leaps"
        told = self.lanes("theta_meas") - measured
        turned = gain * (self.lanes("theta_m") - theta)
        # What is measured lags the rotor by a window at either end, now and a cycle ago; a disc error is small.
        speed = np.maximum(self.sums[SPEED], np.abs(self.lanes("omega_m")))
        fastest = np.maximum(speed, self.fastest)
        lag = 2.0 * 2e-4 * fastest + 0.01 * np.abs(turned) + 4.0 * COUNT
        self.fastest = speed
        quiet = quiet & self.is_quiet()
        assert np.all(np.abs(told - turned)[quiet] < lag[quiet]), "6064h leaps"

    def stored(self):
        """Return magnetic and capacitor's energy [J], and which axes drive their motor."""
        magnetic = 0.75 * (self.lanes("L_d") * self.lanes("i_d") ** 2 + self.lanes("L_q") * self.lanes("i_q") ** 2)
        capacitor = 0.5 * self.lanes("dc_capacitance") * self.lanes("u_dc") ** 2
        return magnetic, capacitor, self.lanes("stage_on") > 0.0

    def check_energy(self, magnetic, capacitor, driven):
        magnetic_now, capacitor_now, driven_now = self.stored()
        given, copper, shaft = self.sums[BRIDGE], self.sums[COPPER], self.sums[SHAFT]
        residual = given - copper - shaft - (magnetic_now - magnetic)
        scale = np.abs(given) + copper + np.abs(shaft) + magnetic + magnetic_now
        # Not balanced: a short leaves a winding that is faster than the current loop, which then swings at the rate of
        # its ticks, and the matrices of the winding, made once in five, know the mean speed alone; and the current of
        # an open phase is taken out after the voltage of the tick has acted on it.
        left = np.minimum(self.lanes("L_q") / self.drives.machine.parameters["motor.L_q"], 1.0)
        swings = left < 0.3
        swings |= self.lanes("open_a") + self.lanes("open_b") + self.lanes("open_c") > 0.0
        # The less is left of a winding, the more it does between two makings of its matrices.
        assert np.all((residual > -0.03 / left * scale - 2e-5)[~swings]), "energy from nothing in the winding"
        both = driven & driven_now & ~swings
        self.energy += (np.abs(residual[both]).sum(), scale[both].sum())
        self.worst = max(self.worst, float((np.abs(residual) / (scale + 1e-4))[both].max(initial=0.0)))
        taken = given + self.sums[CHOPPER] + self.sums[IDLE] + capacitor_now - capacitor
        link = self.sums[SOURCE] - taken
        scale = self.sums[SOURCE] + np.abs(given) + capacitor
        assert np.all((link > -0.02 * scale - 2e-5)[~swings]), "energy from nothing in the DC link"


def threads():
    return {thread.name for thread in threading.enumerate()}


def files():
    return set(os.listdir("/proc/self/fd")) if sys.platform == "linux" else set()  # noqa: PTH208


def memory():
    """Return what the process holds [MB], 0 where it does not say."""
    gc.collect()
    if sys.platform != "linux":
        return 0.0
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def soak(load, seconds, seed):
    """Run a soak and return it; what it leaves behind is checked."""
    threads_before, files_before = threads(), files()
    run = Soak(load, seed)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "fault .* is called off", RuntimeWarning)
        for _ in range(200):
            run.cycle()
        held = memory()
        for _ in range(round(seconds * 1000) - 200):
            run.cycle()
    grown = memory() - held
    run.drives.machine.clear_fault()
    assert run.drives.machine.faults() == []
    assert np.all(run.lanes("encoder_gain") == 1.0)
    assert np.all(run.lanes("encoder_true_direction") == run.drives.machine.parameters["motor.encoder_direction"])
    assert not run.drives.inside.groups[0].load.plant.jam.any()
    psi = run.drives.machine.parameters["motor.psi_m"]
    np.testing.assert_array_equal(run.lanes("psi_nominal"), psi)  # nothing is left of any fault
    run.drives.close()
    assert grown < 8.0, f"{grown:.1f} MB more than at the beginning"
    assert threads() <= threads_before  # one that another test left may have ended meanwhile
    assert len(files()) <= len(files_before)
    assert run.energy[0] < 2e-3 * run.energy[1], "the energies do not balance"
    return run


@pytest.mark.slow
@pytest.mark.parametrize(("load", "seconds"), [("two_mass", 150), ("ball_screw", 75)])
def test_an_hour_of_machine_time_under_faults(load, seconds):
    seconds = part(seconds, 20)
    run = soak(load, seconds, 2)
    assert min(run.given.values()) > seconds / 3
    assert run.enabled_cycles > 0.1 * seconds * 1000 * MACHINES


# --- the bus ----------------------------------------------------------------------------------------------------------
def bus_soak(seconds, seed):
    """Four nodes under all faults, with a master that starts, resets and enables them; every cycle is checked."""
    nodes = (1, 2, 3, 4)
    rng = np.random.default_rng(seed)
    threads_before, files_before = threads(), files()
    world = World(lockstep=False, wire=Wire(seed=seed))
    drives = EmulatedDrives(load="two_mass", num_machines=len(nodes), num_threads=1, seed=seed)
    world.add(drives, nodes)
    faults = BusFaults(world)
    world.power_on()
    given = dict.fromkeys(FAULTS, 0)
    held = 0.0
    enabled = 0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "fault .* is called off", RuntimeWarning)
        for cycle in range(round(seconds * 1000)):
            if cycle % 25 == 0:
                world.receive(Frame(0x77F, b"\x05"))
                node = int(rng.choice(nodes))
                world.receive(Frame(0x000, bytes((1, node))))
                word = int(rng.choice([0x00, 0x80, 0x06, 0x07, 0x0F, 0x0F, 0x0F]))
                for data in (f"2F60600003{'00' * 3}", f"2B406000{word:02X}000000", "23FF6000A0860100"):
                    world.receive(Frame(0x600 + node, bytes.fromhex(data)))
            if rng.random() < 0.01:
                row = FAULTS[str(rng.choice(list(FAULTS)))]
                duration = None if row.once else float(rng.integers(2, 300)) * 1e-3
                faults.add(Order(row.name, 0.0, "", duration, int(rng.choice(nodes))))
                given[row.name] += 1
            world.run_until(world.time + 0.001)
            fsa = get_lanes(drives.inside.records, "fsa", len(nodes)).astype(int)
            words = get_lanes(drives.inside.records, "statusword", len(nodes)).astype(int)
            assert np.array_equal(words & MASKS[fsa], CODES[fsa])
            off = get_lanes(drives.inside.records, "stage_on", len(nodes)) == 0.0
            assert not get_lanes(drives.inside.records, "i_q", len(nodes))[off].any()
            assert all(world.wire.waiting(("node", node)) <= 2 * TRANSMIT_BUFFER for node in nodes)
            assert len(world.wire.injected) <= len(faults.listing()) + 1
            enabled += int((~off).sum())
            if cycle == 500:
                held = memory()
    grown = memory() - held
    faults.clear()
    world.run_until(world.time + 0.003)
    assert faults.listing() == []
    assert world.wire.injected == []
    assert world.wire.statistics.most_waiting < 5000 + MOST_BABBLE
    world.close()
    assert grown < 8.0
    assert threads() <= threads_before  # one that another test left may have ended meanwhile
    assert len(files()) <= len(files_before)
    assert enabled > 0.02 * seconds * 1000 * len(nodes)
    return given


@pytest.mark.slow
def test_a_bus_for_minutes_under_faults():
    seconds = part(300, 40)
    assert min(bus_soak(seconds, 2).values()) > seconds / 15
