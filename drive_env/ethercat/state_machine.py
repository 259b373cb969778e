"""The EtherCAT state machine: allowed transitions, and reasons of refusals (ETG.1000.6, 6.4).

After a refusal the old state stays, with the error bit and a code for the reason. While the error bit is set, only a
request with the acknowledge bit leads upwards.
"""

from __future__ import annotations

from collections.abc import Callable

from drive_env.ethercat.application import (
    AlState,
    AlStatusCode,
    Application,
    ClockSetting,
    MailboxPlace,
    SyncManagerSetting,
)
from drive_env.ethercat.controller import SlaveController

S, Code = AlState, AlStatusCode
STATE, ACKNOWLEDGE, IDENTIFY = 0x0F, 0x10, 0x20  # of AL control
ERROR, IDENTIFIED = 0x10, 0x20  # of AL status
TRANSITIONS = frozenset((
    (S.INIT, S.PRE_OP), (S.INIT, S.BOOTSTRAP), (S.BOOTSTRAP, S.INIT),
    (S.PRE_OP, S.INIT), (S.PRE_OP, S.SAFE_OP),
    (S.SAFE_OP, S.INIT), (S.SAFE_OP, S.PRE_OP), (S.SAFE_OP, S.OP),
    (S.OP, S.INIT), (S.OP, S.PRE_OP), (S.OP, S.SAFE_OP),
))  # fmt: skip
WITH_MAILBOX = frozenset((S.PRE_OP, S.SAFE_OP, S.OP))
WITH_INPUTS = frozenset((S.SAFE_OP, S.OP))
RECEIVE, SEND, OUTPUTS, INPUTS = range(4)  # sync managers
# Sync managers that the device keeps active in a state that it enters; by the working counter a master notices that it
# has left Op. At power-on the registers have their reset values, and nothing is deactivated.
ACTIVE = {
    S.INIT: (), S.BOOTSTRAP: (RECEIVE, SEND), S.PRE_OP: (RECEIVE, SEND),
    S.SAFE_OP: (RECEIVE, SEND, OUTPUTS, INPUTS), S.OP: (RECEIVE, SEND, OUTPUTS, INPUTS),
}  # fmt: skip


class StateMachine:
    """The states of one slave.

    Args:
        controller: Has AL status and the sync managers.
        application: The device, which may refuse a state.
        changed: Called after each change, before the application is notified.

    Attributes:
        state: The state.
        has_error: Whether the last request was refused, or an error has forced the state.
        code: The reason.
    """

    def __init__(
        self, controller: SlaveController, application: Application, changed: Callable[[AlState, float], None]
    ) -> None:
        self._controller = controller
        self._application = application
        self._changed = changed
        self.power_on()

    def power_on(self) -> None:
        """Enter Init."""
        self.state, self.has_error, self.code = S.INIT, False, Code.NO_ERROR
        self._identifies = False
        self._show()

    def request(self, control: int, now: float) -> None:
        """Act on the master's write to AL control."""
        wanted = control & STATE
        self._identifies = bool(control & IDENTIFY)
        if self.has_error and not control & ACKNOWLEDGE and wanted >= self.state:
            return
        if wanted not in AlState.__members__.values():
            self._refuse(Code.UNKNOWN_STATE)
            return
        new = AlState(wanted)
        if new is self.state:
            self.has_error, self.code = False, Code.NO_ERROR
            self._show()
            return
        code = self._check(new, now) if (self.state, new) in TRANSITIONS else Code.INVALID_CHANGE
        if code is Code.NO_ERROR:
            self._enter(new, Code.NO_ERROR, now)
        else:
            self._refuse(code)

    def force(self, new: AlState, code: AlStatusCode, now: float) -> None:
        """Fall back to a state with an error."""
        self._enter(new, code, now)

    def check_settings(self, now: float) -> None:
        """Fall back if the master has switched off a sync manager that the state needs."""
        state = self.state
        if state is S.BOOTSTRAP and self._mailboxes(is_bootstrap=True) is not Code.NO_ERROR:
            self.force(S.INIT, Code.BOOTSTRAP_MAILBOX, now)
        elif state in WITH_MAILBOX and self._mailboxes() is not Code.NO_ERROR:
            self.force(S.INIT, Code.MAILBOX, now)
        elif state in WITH_INPUTS and (code := self._process_data()) is not Code.NO_ERROR:
            self.force(S.PRE_OP, code, now)

    # --- inside -----------------------------------------------------------------------------------------------------
    def _enter(self, new: AlState, code: AlStatusCode, now: float) -> None:
        self.state, self.has_error, self.code = new, code is not Code.NO_ERROR, code
        self._activate()
        self._changed(new, now)
        self._application.state_changed(new, code, now)
        self._show()

    def _activate(self) -> None:
        for number in (RECEIVE, SEND, OUTPUTS, INPUTS):
            self._controller.deactivate(number, number not in ACTIVE[self.state])

    def _refuse(self, code: AlStatusCode) -> None:
        self.has_error, self.code = True, code
        self._show()

    def _show(self) -> None:
        number = self._application.identification
        if self._identifies and number and not self.has_error:  # ETG.1020: instead of a code
            self._controller.put_al_status(self.state | IDENTIFIED, number)
            return
        self._controller.put_al_status(self.state | (ERROR if self.has_error else 0), self.code)

    def _check(self, new: AlState, now: float) -> AlStatusCode:
        """Return why a transition is refused, or NO_ERROR; transitions downwards are never refused."""
        old = self.state
        if new is S.BOOTSTRAP:
            code = Code.NO_BOOTSTRAP
            if self._application.layout.bootstrap_receive is not None:
                code = self._mailboxes(is_bootstrap=True)
        elif new < old:
            return Code.NO_ERROR
        else:
            code = self._mailboxes()
            if code is Code.NO_ERROR and new in WITH_INPUTS:
                code = self._process_data()
        if code is not Code.NO_ERROR:
            return code
        clock = self._controller.clock
        return self._application.request_state(
            old, new, [manager.setting for manager in self._controller.managers],
            ClockSetting(clock.has_sync0, clock.cycle * 1e-9, clock.has_sync1, clock.sync1_cycle * 1e-9), now,
        )  # fmt: skip

    def _mailboxes(self, is_bootstrap: bool = False) -> AlStatusCode:
        layout, code = self._application.layout, Code.MAILBOX
        receive, send = layout.receive, layout.send
        if is_bootstrap:
            assert layout.bootstrap_receive is not None and layout.bootstrap_send is not None
            receive, send, code = layout.bootstrap_receive, layout.bootstrap_send, Code.BOOTSTRAP_MAILBOX
        good = self._lies(RECEIVE, receive, is_mailbox=True, is_written=True) and self._lies(
            SEND, send, is_mailbox=True, is_written=False
        )
        return Code.NO_ERROR if good else code

    def _process_data(self) -> AlStatusCode:
        layout, application = self._application.layout, self._application
        outputs = MailboxPlace(layout.outputs, application.output_size)
        inputs = MailboxPlace(layout.inputs, application.input_size)
        if not self._lies(OUTPUTS, outputs, is_mailbox=False, is_written=True):
            return Code.OUTPUT_CONFIGURATION
        if not self._lies(INPUTS, inputs, is_mailbox=False, is_written=False):
            return Code.INPUT_CONFIGURATION
        return Code.NO_ERROR

    def _lies(self, number: int, place: MailboxPlace, *, is_mailbox: bool, is_written: bool) -> bool:
        """Return whether a sync manager is set as it must be; one without bytes must be off."""
        setting: SyncManagerSetting = self._controller.managers[number].setting
        if place.length == 0:
            return not setting.is_enabled
        has_mode = setting.is_mailbox if is_mailbox else setting.control & 0x03 == 0
        return (
            setting.is_enabled
            and has_mode
            and setting.is_written_by_master == is_written
            and (setting.start, setting.length) == (place.start, place.length)
        )
