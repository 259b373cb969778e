"""The DC link between supply and bridge: its fields, a tick's constants, and the effect of a tick on link and rotor."""

from __future__ import annotations

from drive_env.firmware.record import LANES, Field
from mechanics.kernels.compiled import inlined

SMALLEST_RESISTANCE = 1e-15  # ohm; a supply without resistance holds its voltage
SMALLEST_VOLTAGE = 1e-3  # V; avoids a division by an empty DC link's 0
ENDLESS = 1e300  # V

PARAMETERS = (
    Field("dc_capacitance", "f8", "F", "of the DC link", 1e-3),
    Field("idle_current", "f8", "A", "that logic, gate drivers and bleeder take from the DC link"),
    Field("supply_sinks", "f8", "", "1: a supply that takes power back; 0: fed through a diode"),
    Field("supply_resistance", "f8", "ohm", "resistance of supply and cables"),
    Field("short_conductance", "f8", "S", "short circuit across the DC link, in the stage"),
)

STATE = (
    Field("tick_mobility", "f8", "1/(kg*m^2*Hz)", "speed gained per torque in a tick"),
    Field("link_step", "f8", "V/A", "voltage lost per ampere in a tick"),
    Field("link_feed", "f8", "1", "charging constant of the supply in a tick"),
    Field("link_decay", "f8", "1", "what a short circuit leaves of the voltage after a tick"),
    Field("link_share", "f8", "1", "1 / (1 + link_feed), less with a short circuit"),
    Field("bridge_power", "f8", "W", "power that the bridge takes from the DC link"),
)


@inlined
def derive_link(drive, dt):
    """Compute the constants of DC link and rotor for ticks of dt [s]: a division costs a tick as much as ten products.

    Writes tick_mobility, link_step, link_feed, link_decay, link_share.
    """
    for lane in range(LANES):
        drive.tick_mobility[lane] = dt / drive.J_rotor[lane]
        step = dt / drive.dc_capacitance[lane]
        feed = step / (drive.supply_resistance[lane] + SMALLEST_RESISTANCE)
        drive.link_step[lane] = step
        drive.link_feed[lane] = feed
        short = step * drive.short_conductance[lane]
        drive.link_decay[lane] = 1.0 / (1.0 + short)
        drive.link_share[lane] = 1.0 / (1.0 + feed + short)


@inlined
def drain_link(drive, lane, drained):
    """Take a current [A] from the link for a tick: writes u_dc [V].

    The source feeds through a diode, so braking charges the link, unless the source also sinks current. A short circuit
    is implicit: it may empty the link within a tick.
    """
    left = drive.u_dc[lane] - drive.link_step[lane] * drained
    supply = drive.supply_voltage[lane]
    blocked = left * drive.link_decay[lane]
    fed = (left + drive.link_feed[lane] * supply) * drive.link_share[lane]
    floor = supply if drive.supply_sinks[lane] < 0.5 else ENDLESS
    link = fed if blocked < floor else blocked
    drive.u_dc[lane] = link if link > SMALLEST_VOLTAGE else SMALLEST_VOLTAGE


@inlined
def turn_rotor(drive, lane, torque, dt, progress):
    """Move the rotor on through a tick: writes omega_m and theta_m.

    Args:
        drive: The record.
        lane: Lane of the axis.
        torque: Torque of the motor [N*m], without the load's reaction.
        dt: Current-loop period [s].
        progress: Middle of this tick, as a share of the window, plus one half: the load's reaction is extrapolated
            from the middles of the last two windows to it.
    """
    reaction = drive.tau_reaction[lane] + progress * (drive.tau_reaction[lane] - drive.tau_reaction_before[lane])
    omega = drive.omega_m[lane]
    new_omega = omega + drive.tick_mobility[lane] * (torque - reaction)
    drive.omega_m[lane] = new_omega
    drive.theta_m[lane] += 0.5 * dt * (omega + new_omega)
