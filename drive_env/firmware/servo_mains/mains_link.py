"""The DC link of a module: a rectifier on mains, capacitors, a brake chopper, and the bridges of its axes.

    C u du/dt = u i_mains - sum of the bridges' power - idle power - u^2 / R_brake - u^2 G_short

The rectifier feeds whenever its voltage is above the link's, through the resistance of the supply, and through the
charging resistance until the link is charged; it does not feed back. Braking energy of one axis is used by another; the
rest charges the link until the chopper burns it. A tick is split: power of bridges and idling reduces the energy
exactly (u^2 falls by 2 P dt / C), then resistor, short circuit and rectifier act one after the other, each as the
exponential of its own time constant, and each counts the energy of its change of voltage: the sum is the change of the
link's energy.

Axes 2k and 2k + 1 of one machine share a link. Both compute it, with the same numbers, so that neither waits for the
other. Voltage of the rectifier: the greatest of the three line voltages; with a lost phase that of the remaining pair.
"""

from __future__ import annotations

import math

import numpy as np

from drive_env.firmware.common.arithmetic import TWO_PI, sine_cosine
from drive_env.firmware.common.dc_link import SMALLEST_RESISTANCE, SMALLEST_VOLTAGE
from drive_env.firmware.record import LANES, Field
from mechanics.kernels.compiled import inlined, stage

CHARGED = 0.9  # of the rectifier's voltage, above which the charging resistance is bridged
SIXTH = TWO_PI / 6.0

PARAMETERS = (
    Field("link_shared", "f8", "", "1: the axis has its link in common with the other one of its pair"),
    Field("mains_frequency", "f8", "Hz", "", 50.0),
    Field("mains_phase_lost", "f8", "", "1: one phase of the mains is missing"),
    Field("charging_resistance", "f8", "ohm", "through which an empty link is charged", 47.0),
    Field("idle_power", "f8", "W", "that logic and gate drivers take from the link"),
    Field("brake_power", "f8", "W", "that the brake resistor carries for ever", 100.0),
    Field("brake_thermal_time", "f8", "s", "of the brake resistor", 30.0),
)

STATE = (
    Field("mains_angle", "f8", "rad", "of the mains"),
    Field("rectifier_voltage", "f8", "V", "greatest line voltage now"),
    Field("link_charged", "f8", "", "1: the charging resistance is bridged", 1.0),
    Field("link_pull", "f8", "V^2/W", "square of voltage lost per watt in a tick"),
    Field("link_burn", "f8", "1", "what the brake resistor leaves of the voltage after a tick"),
    Field("idle_now", "f8", "W", "that logic and gate drivers of an axis take at the link's present voltage"),
    Field("half_capacitance", "f8", "F", "half the capacitance of the link"),
    Field("partner_power", "f8", "W", "what the bridge of the other axis takes"),
    Field("mains_energy", "f8", "J", "taken from the mains, from power-on; of the whole link"),
    Field("mains_loss", "f8", "J", "of it lost in the supply's and the charging resistance"),
    Field("brake_energy", "f8", "J", "burnt in the brake resistor"),
    Field("short_energy", "f8", "J", "burnt in a short circuit across the link"),
    Field("idle_energy", "f8", "J", "taken by logic and gate drivers"),
    Field("brake_energy_before", "f8", "J", "brake_energy a period ago"),
    Field("brake_heat", "f8", "1", "rise of the brake resistor's temperature, as a share of its greatest"),
    Field("brake_hot", "f8", "", "1: too hot, the chopper waits until it has cooled"),
)

BRAKE_COOLED = 0.8  # share of the greatest temperature rise below which the chopper may work again


@inlined
def find_rectifier_voltage(drive, h):
    """Advance the mains by a window of h [s]: writes rectifier_voltage, the greatest of the present line voltages."""
    for lane in range(LANES):
        angle = drive.mains_angle[lane] + TWO_PI * h * drive.mains_frequency[lane]
        angle = angle - TWO_PI if angle > TWO_PI else angle
        drive.mains_angle[lane] = angle
        # Rectified, the three line voltages repeat every sixth of a period; the greatest is within half of that.
        within = angle - SIXTH * np.floor(angle * (1.0 / SIXTH)) - 0.5 * SIXTH
        of_one = drive.mains_phase_lost[lane] > 0.5
        _, c = sine_cosine(angle if of_one else within)
        drive.rectifier_voltage[lane] = drive.supply_voltage[lane] * abs(c)


@inlined
def share_rectifier(drive):
    """Copy the rectifier's voltage from the first to the second axis of a pair that shares a link."""
    for pair in range(LANES // 2):
        first, second = 2 * pair, 2 * pair + 1
        own = drive.rectifier_voltage[second]
        drive.rectifier_voltage[second] = drive.rectifier_voltage[first] if drive.link_shared[second] > 0.5 else own


@stage
def owner(drive, lane):
    """Return the axis whose supply, capacitors and resistor a link has: the first one of a pair that shares it."""
    return lane - lane % 2 if drive.link_shared[lane] > 0.5 else lane


@stage
def derive_link(drive, dt):
    """Compute the constants of a tick of dt [s]: a division costs a tick as much as ten products.

    The logic's power is constant down to the under-voltage; below, it falls with the square of the voltage, since a
    constant power would prevent an empty link from charging.

    Writes tick_mobility, idle_now, half_capacitance, link_pull, link_share, link_burn, link_decay, and restores the
    link's voltage in the second axis of a pair, which may have been restarted alone.
    """
    for lane in range(LANES):
        first = owner(drive, lane)
        u, least = drive.u_dc[first], drive.undervoltage[first]
        drive.u_dc[lane] = u
        drive.idle_now[lane] = drive.idle_power[first] * ((u / least) ** 2 if u < least else 1.0)
        for_charging = 0.0 if drive.link_charged[first] > 0.5 else drive.charging_resistance[first]
        resistance = drive.supply_resistance[first] + for_charging + SMALLEST_RESISTANCE
        step = dt / drive.dc_capacitance[first]
        drive.tick_mobility[lane] = dt / drive.J_rotor[lane]
        drive.half_capacitance[lane] = 0.5 * drive.dc_capacitance[first]
        drive.link_pull[lane] = 2.0 * step
        drive.link_share[lane] = math.exp(-step / resistance)
        drive.link_burn[lane] = math.exp(-step / drive.chopper_resistance[first])
        drive.link_decay[lane] = math.exp(-step * drive.short_conductance[first])


@stage
def watch_link(drive, dt):
    """Bridge a charged link's charging resistance, and update the brake resistor's heat, once per period dt [s]."""
    for lane in range(LANES):
        u, mains = drive.u_dc[lane], drive.supply_voltage[owner(drive, lane)]
        if u >= CHARGED * mains:
            drive.link_charged[lane] = 1.0
        elif u < drive.undervoltage[lane]:
            drive.link_charged[lane] = 0.0
        burnt = drive.brake_energy[lane] - drive.brake_energy_before[lane]
        drive.brake_energy_before[lane] = drive.brake_energy[lane]
        rise = burnt / (dt * drive.brake_power[lane])
        heat = drive.brake_heat[lane]
        heat += (rise - heat) * dt / drive.brake_thermal_time[lane]
        drive.brake_heat[lane] = heat
        if heat > 1.0:
            drive.brake_hot[lane] = 1.0
        elif heat < BRAKE_COOLED:
            drive.brake_hot[lane] = 0.0


@inlined
def move_link(drive, dt):
    """Advance the link's voltage by a tick of dt [s]: writes u_dc, chopper and the energies."""
    for pair in range(LANES // 2):
        first, second = 2 * pair, 2 * pair + 1
        one, other = drive.bridge_power[first], drive.bridge_power[second]
        # A lane without an axis may hold any value, and 0 times nan is nan: it is selected, not multiplied.
        drive.partner_power[first] = other if drive.link_shared[first] > 0.5 else 0.0
        drive.partner_power[second] = one if drive.link_shared[second] > 0.5 else 0.0
    for lane in range(LANES):
        u = drive.u_dc[lane]
        limit = drive.chopper_voltage[lane]
        chopper = drive.chopper[lane]
        chopper = 0.0 if u < limit - drive.chopper_hysteresis[lane] else chopper
        chopper = drive.chopper_enable[lane] if u > limit else chopper
        chopper = 0.0 if drive.brake_hot[lane] > 0.5 else chopper
        drive.chopper[lane] = chopper
        shared = drive.link_shared[lane]
        idle = (1.0 + shared) * drive.idle_now[lane]
        # Both axes of a pair must compute the same sum: that of two terms does not depend on their order.
        bridges = drive.bridge_power[lane] + drive.partner_power[lane]
        square = u * u - drive.link_pull[lane] * (bridges + idle)
        square = square if square > SMALLEST_VOLTAGE * SMALLEST_VOLTAGE else SMALLEST_VOLTAGE * SMALLEST_VOLTAGE
        drawn = square**0.5
        left = drawn * drive.link_burn[lane] if chopper > 0.5 else drawn
        half = drive.half_capacitance[lane]
        drive.brake_energy[lane] += half * (drawn + left) * (drawn - left)
        kept = left * drive.link_decay[lane]
        drive.short_energy[lane] += half * (left + kept) * (left - kept)
        mains = drive.rectifier_voltage[lane]
        fed = mains + (kept - mains) * drive.link_share[lane]
        fed = fed if mains > kept else kept
        charge = 2.0 * half * (fed - kept)
        drive.mains_energy[lane] += charge * mains
        drive.mains_loss[lane] += charge * (mains - 0.5 * (fed + kept))
        drive.idle_energy[lane] += idle * dt
        drive.u_dc[lane] = fed


@stage
def forget_link(drive, lane):
    """Reset: a charged link, a cool resistor, energies of 0."""
    drive.chopper[lane] = 0.0
    drive.link_charged[lane] = 1.0
    drive.bridge_power[lane] = 0.0
    drive.mains_energy[lane] = 0.0
    drive.mains_loss[lane] = 0.0
    drive.brake_energy[lane] = 0.0
    drive.brake_energy_before[lane] = 0.0
    drive.short_energy[lane] = 0.0
    drive.idle_energy[lane] = 0.0
    drive.brake_heat[lane] = 0.0
    drive.brake_hot[lane] = 0.0
