"""The finite state automaton of CiA 402: controlword to state, state to statusword.

States, commands and transitions are the manual's figure 4 and tables 142, 143 and 149. Further effects of a transition
are in `_enter`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.cia402 import STATE_CODING, Pattern, State
from drive_env.firmware.common import brake, start_up
from drive_env.firmware.record import EMERGENCY_QUEUE
from mechanics.kernels.compiled import stage

SHUTDOWN = cia402.COMMANDS["shutdown"]
SWITCH_ON = cia402.COMMANDS["switch on"]
ENABLE_OPERATION = cia402.COMMANDS["enable operation"]
DISABLE_VOLTAGE = cia402.COMMANDS["disable voltage"]
QUICK_STOP = cia402.COMMANDS["quick stop"]
DISABLE_OPERATION = cia402.COMMANDS["disable operation"]
FAULT_RESET = cia402.COMMANDS["fault reset"]  # on the rising edge only


class Transition(NamedTuple):
    """A row of figure 4; number as there."""

    number: int
    start: State
    command: Pattern
    end: State


TRANSITIONS = (
    Transition(2, State.SWITCH_ON_DISABLED, SHUTDOWN, State.READY_TO_SWITCH_ON),
    Transition(3, State.READY_TO_SWITCH_ON, SWITCH_ON, State.SWITCHED_ON),
    # "Switch on & enable operation" makes transitions 3 and 4: after this row the controlword is evaluated again.
    Transition(3, State.READY_TO_SWITCH_ON, ENABLE_OPERATION, State.SWITCHED_ON),
    Transition(4, State.SWITCHED_ON, ENABLE_OPERATION, State.OPERATION_ENABLED),
    Transition(5, State.OPERATION_ENABLED, DISABLE_OPERATION, State.SWITCHED_ON),
    Transition(6, State.SWITCHED_ON, SHUTDOWN, State.READY_TO_SWITCH_ON),
    Transition(7, State.READY_TO_SWITCH_ON, DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    Transition(7, State.READY_TO_SWITCH_ON, QUICK_STOP, State.SWITCH_ON_DISABLED),
    Transition(8, State.OPERATION_ENABLED, SHUTDOWN, State.READY_TO_SWITCH_ON),
    Transition(9, State.OPERATION_ENABLED, DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    Transition(10, State.SWITCHED_ON, DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    Transition(10, State.SWITCHED_ON, QUICK_STOP, State.SWITCH_ON_DISABLED),
    Transition(11, State.OPERATION_ENABLED, QUICK_STOP, State.QUICK_STOP_ACTIVE),
    Transition(12, State.QUICK_STOP_ACTIVE, DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    Transition(15, State.FAULT, FAULT_RESET, State.SWITCH_ON_DISABLED),
    Transition(16, State.QUICK_STOP_ACTIVE, ENABLE_OPERATION, State.OPERATION_ENABLED),
)

_ROWS = np.array([(t.number, t.start, t.command.mask, t.command.value, t.end) for t in TRANSITIONS], np.int32)
_CODING = np.array([STATE_CODING[state][1] for state in State], np.int32)

# Plain integers: the compiler treats an IntEnum member in a kernel as an object.
NOT_READY = int(State.NOT_READY_TO_SWITCH_ON)
DISABLED = int(State.SWITCH_ON_DISABLED)
SWITCHED = int(State.SWITCHED_ON)
ENABLED = int(State.OPERATION_ENABLED)
STOPPING = int(State.QUICK_STOP_ACTIVE)
REACTING = int(State.FAULT_REACTION_ACTIVE)
FAULTED = int(State.FAULT)
ENABLE_MASK, ENABLE_VALUE = int(ENABLE_OPERATION.mask), int(ENABLE_OPERATION.value)

WARNING_BIT, REMOTE_BIT = cia402.WARNING.value, cia402.REMOTE.value

# Rows of every device's emergency table that the automaton itself sends.
EMERGENCY_RESET = 0

LONGEST_STOP = 1.0  # s after the ramp's end; the loops cannot hold a motor that still turns then
STANDSTILL_NOISE = 2.0  # the unfiltered velocity at rest, as a multiple of the standstill threshold

# Option codes of 605Ah that end in switch on disabled, and those whose ramp is 6085h.
STOP_AND_STAY = 5
# Transitions that keep a current which waits for the brake; all others cut it.
KEEPS_HOLDING = (2, 3, 6, 15)


@stage
def push_emergency(drive, lane, row):
    """Queue a row of the device's emergency table; a full queue loses the newest, as a transmit buffer does."""
    count = drive.emergency_count[lane]
    if count < EMERGENCY_QUEUE:
        # With the present error register, which a reset may clear before the message is fetched.
        drive.emergency[count, lane] = (row + 1) | drive.error_register[lane] << 8
        drive.emergency_count[lane] = count + 1


@stage
def has_drive_function(state):
    """Return whether current is available to the motor in this state."""
    return state in (ENABLED, STOPPING, REACTING)


@stage
def _enter(drive, lane, number, end):
    """Make transition `number` to the state `end`, with its effects on the axis."""
    drive.fsa[lane] = end
    drive.transition_pending[lane] = 0
    if number not in KEEPS_HOLDING:
        drive.holding[lane] = 0
    if number == 4:
        drive.position_demand[lane] = drive.theta_meas[lane]
        # A turning axis is enabled at its present speed.
        turns = abs(drive.omega_slow[lane]) > drive.standstill[lane]
        drive.velocity_demand[lane] = drive.omega_meas[lane] if turns else 0.0
        drive.torque_demand[lane] = 0.0
        drive.velocity_sum[lane] = 0.0
    if number == 4 or number == 16:
        # Earlier set-points do not move the axis: a new one must be given.
        drive.set_point_valid[lane] = 0
        drive.stopping[lane] = 0
    if number == 11 or number == 13:
        drive.stopping[lane] = 1
        drive.stop_time[lane] = 0.0
        drive.braking[lane] = 0  # the ramp of a halt under way is replaced: the stop begins with the present motion
    if number == 15:
        drive.fault[lane] = 0
        drive.error_register[lane] = 0
        push_emergency(drive, lane, EMERGENCY_RESET)
    if number == 3 and drive.init_state[lane] == start_up.FAILED:
        drive.init_state[lane] = start_up.NEEDED  # tried again
    drive.drive_function[lane] = 1.0 if has_drive_function(end) else 0.0
    if not has_drive_function(end):
        drive.stopping[lane] = 0
        drive.set_point_valid[lane] = 0


@stage
def _commands_operation(word):
    return word & ENABLE_MASK == ENABLE_VALUE


@stage
def command(drive, lane):
    """Process the controlword completely: make every transition that it commands from the present state.

    While a disable-operation ramp runs (transition 5) other commands wait until it has ended, as the manual's note
    demands; only disable voltage is obeyed at once, since it takes the energy away.
    """
    word = drive.controlword[lane]
    if drive.transition_pending[lane] == 4 and not _commands_operation(word):
        # Enabling is cancelled before the axis was enabled: the brake closes, and the stage waits for it.
        drive.transition_pending[lane] = 0
        drive.holding[lane] = 0
        brake.hold_until_closed(drive, lane)
    for _ in range(2):
        state = drive.fsa[lane]
        moved = False
        for k in range(_ROWS.shape[0]):
            number, start, mask, value, end = _ROWS[k, 0], _ROWS[k, 1], _ROWS[k, 2], _ROWS[k, 3], _ROWS[k, 4]
            if start != state or (word & mask) != value or number == 15:
                continue
            if number == 16 and (drive.quick_stop_option[lane] < STOP_AND_STAY or drive.velocity_demand[lane] != 0.0):
                continue
            if drive.transition_pending[lane] == 5 and number != 9:
                continue
            if number == 4 and brake.enabling_time(drive, lane) > 0.0:
                if drive.transition_pending[lane] != 4:
                    drive.transition_pending[lane] = 4
                    drive.holding[lane] = 1
                    drive.switching_time[lane] = 0.0
            elif number == 5:
                drive.transition_pending[lane] = 5
                drive.stopping[lane] = 1
                drive.stop_time[lane] = 0.0
            else:
                _enter(drive, lane, number, end)
                if number == 8:
                    brake.hold_until_closed(drive, lane)
                moved = True
            break
        if not moved:
            break


@stage
def reset_fault(drive, lane, causes_gone):
    """Leave fault by the rising edge of controlword bit 7 (transition 15) if the cause is gone."""
    if drive.fsa[lane] == FAULTED and causes_gone:
        _enter(drive, lane, 15, DISABLED)


@stage
def has_stopped(drive, lane, dt):
    """Return whether a stop ramp has ended and the motor stands; for a motor that does not stop the wait is limited.

    The power goes off only after the stop: at the ramp's end a soft axis would still coast.
    """
    if drive.velocity_demand[lane] != 0.0:
        drive.stop_time[lane] = 0.0
        return False
    drive.stop_time[lane] += dt
    stands = abs(drive.omega_slow[lane]) <= drive.standstill[lane] and abs(drive.omega_meas[lane]) <= (
        STANDSTILL_NOISE * drive.standstill[lane]
    )
    return stands or drive.stop_time[lane] > LONGEST_STOP


@stage
def automatic_transitions(drive, lane, dt):
    """Make the transitions that need no command, once per period of dt [s]: 1, and those that waited for standstill."""
    if drive.fsa[lane] == NOT_READY:
        _enter(drive, lane, 1, DISABLED)
    if drive.transition_pending[lane] == 4 and drive.switching_time[lane] + 0.5 * dt > brake.enabling_time(drive, lane):
        _enter(drive, lane, 4, ENABLED)
    if drive.fsa[lane] == STOPPING and drive.quick_stop_option[lane] >= STOP_AND_STAY:
        command(drive, lane)  # enable operation, commanded while the ramp ran
    if drive.stopping[lane] == 1 and has_stopped(drive, lane, dt):
        if drive.fsa[lane] == REACTING:
            _enter(drive, lane, 14, FAULTED)
            brake.hold_until_closed(drive, lane)
        elif drive.fsa[lane] == STOPPING and drive.quick_stop_option[lane] < STOP_AND_STAY:
            _enter(drive, lane, 12, DISABLED)
            brake.hold_until_closed(drive, lane)
        elif drive.transition_pending[lane] == 5:
            _enter(drive, lane, 5, SWITCHED)
            brake.hold_until_closed(drive, lane)
            command(drive, lane)  # what was commanded while the ramp ran


@stage
def fault(drive, lane, cut):
    """Take transition 13; with `cut` the stage is switched off at once, and 14 follows."""
    if drive.fsa[lane] == FAULTED or (drive.fsa[lane] == REACTING and not cut):
        return
    if cut or not has_drive_function(drive.fsa[lane]):
        _enter(drive, lane, 14, FAULTED)
    else:
        _enter(drive, lane, 13, REACTING)


@stage
def update_statusword(drive, lane, mode_bits):
    """Write 6041h and the status flags from the state; `mode_bits` are bits 11 to 13.

    Bit 4 shows that the supply is present; bit 9 (remote) is set here and cleared by drives that also take commands
    from elsewhere. Bit 15 is set while the motor turns in the negative direction (the manual does not say which).
    """
    state = drive.fsa[lane]
    word = _CODING[state]
    if drive.u_dc[lane] > drive.undervoltage[lane]:
        word |= 0x0010
    if state in (DISABLED, FAULTED, REACTING, NOT_READY) and drive.controlword[lane] & 0x0004:
        word |= 0x0020  # bit 5 is 1 in these states: it shows that no quick stop is commanded
    word |= REMOTE_BIT
    if drive.target_reached[lane]:
        word |= 0x0400
    if drive.internal_limit[lane]:
        word |= 0x0800
    word |= mode_bits
    if drive.warning[lane]:
        word |= WARNING_BIT
    rotates = abs(drive.omega_slow[lane]) > drive.standstill[lane]
    if rotates:
        word |= 0x4000
        if drive.omega_slow[lane] < 0.0:
            word |= 0x8000
    drive.statusword[lane] = word & ~drive.absent_status_bits[lane]
