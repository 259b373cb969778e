"""A slave: a controller, its firmware, and the device behind it (`application.py`)."""

from __future__ import annotations

import math

from drive_env.ethercat import registers
from drive_env.ethercat.application import AlState, AlStatusCode, Application
from drive_env.ethercat.controller import SlaveController
from drive_env.ethercat.distributed_clock import SYNC0
from drive_env.ethercat.mailbox import Mailbox, MailboxProtocol
from drive_env.ethercat.state_machine import INPUTS, OUTPUTS, WITH_INPUTS, WITH_MAILBOX, StateMachine

S = AlState
LOST_PULSES = 3  # cycles of SYNC0 without a pulse after which a slave leaves Op; our choice (ETG.1020 has none)


class EtherCatSlave:
    """One slave of a segment; it is off until `power_on`.

    Args:
        application: The device.
        takes_time: Whether the EEPROM takes time.
        drift: Share by which its oscillator is too fast: 50e-6 is 50 ppm.
        epoch: Local time [ns] of its clock at world time 0.

    Attributes:
        controller: Registers and memory.
        application: The device.
        mailbox: Its mailbox.
    """

    def __init__(
        self, application: Application, *, takes_time: bool = False, drift: float = 0.0, epoch: int = 0
    ) -> None:
        self.application = application
        self.controller = SlaveController(takes_time=takes_time, drift=drift, epoch=epoch)
        self.mailbox = Mailbox(self.controller, application.coe)
        self._machine = StateMachine(self.controller, application, self._state_changed)

    @property
    def state(self) -> AlState:
        """Its AL state."""
        return self._machine.state

    @property
    def code(self) -> AlStatusCode:
        """Its AL status code."""
        return self._machine.code

    def power_on(self, now: float) -> None:
        """Switch it on, or off and on, at `now` [s]."""
        self.controller.power_on(self.application.read_sii(), now)
        self.mailbox.open(is_bootstrap=False)
        self._machine.power_on()
        self.application.power_on(now)

    def after_frame(self, now: float) -> None:
        """Handle the changes made by a frame."""
        controller = self.controller
        if controller.reset_requested:
            self.power_on(now)
            return
        if controller.sii.is_changed:
            controller.sii.is_changed = False
            self.application.write_sii(bytes(controller.sii.content))
        if controller.settings_changed:
            controller.settings_changed = False
            self._machine.check_settings(now)
        if controller.al_control is not None:
            control, controller.al_control = controller.al_control, None
            self._machine.request(control, now)
        state = self._machine.state
        if (state in WITH_MAILBOX or state is S.BOOTSTRAP) and self.mailbox.work(now) and state in WITH_INPUTS:
            self._put_inputs(now)  # a message may have changed them
        outputs = controller.managers[OUTPUTS].take()
        if outputs is not None and state is S.OP:
            self.application.outputs(outputs, now)

    def before_cycle(self, now: float) -> None:
        """Run everything due before the drives advance by a communication cycle."""
        self.run_until(now)
        self.application.before_cycle(now)

    def after_cycle(self, now: float) -> None:
        """Let the master read the results of a cycle."""
        self.application.after_cycle(now)
        state = self._machine.state
        if state in WITH_MAILBOX:
            for message in self.application.pending_coe(now):
                self.mailbox.send(MailboxProtocol.COE, message)
            self.mailbox.work(now)
        if state in WITH_INPUTS:
            self._put_inputs(now)

    def next_event(self) -> float:
        """Return when `run_until` next has something to do [s]; inf if there is nothing."""
        pulse = self.controller.clock.next_pulse()
        deadline = self.controller.watchdog_deadline() if self._is_watched else None
        return min(float("inf") if pulse is None else pulse * 1e-9, float("inf") if deadline is None else deadline)

    def run_until(self, now: float) -> None:
        """Handle the pulses of SYNC0 and SYNC1 and the expiry of the watchdog that are due until `now` [s]."""
        clock = self.controller.clock
        while (pulse := clock.take_pulse(round(now * 1e9))) is not None:
            self._pulsed_at = now
            if self._machine.state in WITH_INPUTS:
                signal, at = pulse
                (self.application.sync0 if signal == SYNC0 else self.application.sync1)(at * 1e-9)
        if self._machine.state is S.OP and now - self._pulsed_at > LOST_PULSES * self._sync0_cycle:
            self._machine.force(S.SAFE_OP, AlStatusCode.FATAL_SYNC, now)  # outputs would never take effect
        deadline = self.controller.watchdog_deadline()
        if deadline is None or now < deadline or not self._is_watched:
            return
        self.controller.expire_watchdog()
        if self._machine.state is S.OP:
            self.application.watchdog_expired(now)
            self._machine.force(S.SAFE_OP, AlStatusCode.SM_WATCHDOG, now)

    # --- inside -----------------------------------------------------------------------------------------------------
    @property
    def _is_watched(self) -> bool:
        """Whether the watchdog has not expired yet."""
        return bool(self.controller.register(registers.WATCHDOG_STATUS, 2) & 1)

    def _state_changed(self, new: AlState, now: float) -> None:
        if new is S.BOOTSTRAP:
            self.mailbox.open(is_bootstrap=True)
        elif new is S.INIT or (new is S.PRE_OP and not self._had_mailbox):
            self.mailbox.open(is_bootstrap=False)
        self._had_mailbox = new in WITH_MAILBOX
        if new is S.SAFE_OP:
            clock = self.controller.clock
            self._sync0_cycle = clock.cycle * 1e-9 if clock.has_sync0 else math.inf
            self._pulsed_at = math.inf
        if new is S.OP:
            self.controller.trigger_watchdog(now)  # the first outputs have a full watchdog time
            if self.controller.clock.next_pulse() is None:
                self._pulsed_at = now
        if new in WITH_INPUTS:
            self._put_inputs(now)

    _had_mailbox = False
    _sync0_cycle = math.inf  # cycle [s] that the slave is synchronised to; inf without SYNC0
    _pulsed_at = math.inf  # time of the last pulse; infinite before the first

    def _put_inputs(self, now: float) -> None:
        manager = self.controller.managers[INPUTS]
        if manager.end:
            manager.put(self.application.inputs(now))
