"""The slcan protocol (Lawicel's ASCII commands), adapter's side: converts lines and frames.

python-can's slcan interface waits for no answer; reading one costs it a turn without a frame. Commands are answered as
in Lawicel's manual; sent frames are not (nor does a CANable answer them), since every frame of a burst would cost the
client a turn.

One command is our own: K followed by a token. A channel that requires a token sends "K" when its client connects
(through the hub), and ignores everything until it has received the token.
"""

from __future__ import annotations

import re
import secrets

from drive_env.canopen.frames import Frame

OK, BELL = b"\r", b"\a"
MAX_LINE = 64  # bytes; the longest command, an extended frame with eight bytes, has 26
BIT_RATES = {b"0": 10_000, b"1": 20_000, b"2": 50_000, b"3": 100_000, b"4": 125_000, b"5": 250_000, b"6": 500_000,
             b"7": 750_000, b"8": 1_000_000, b"9": 83_300}  # fmt: skip
VERSION = b"V1013\r"  # hardware 1.0, software 1.3
SERIAL_NUMBER = b"NDE01\r"
CLOCK = 8_000_000  # Hz, of the SJA1000's bit timing registers
TOKEN_WANTED = b"K\r"
TOKEN = re.compile(r"[A-Za-z0-9_-]{8,48}")  # lines are short, and eight characters withstand one guess a second

_STANDARD = re.compile(rb"[tr]([0-7][0-9A-Fa-f]{2})([0-8])((?:[0-9A-Fa-f]{2})*)")
_EXTENDED = re.compile(rb"[TR]([01][0-9A-Fa-f]{7})([0-8])((?:[0-9A-Fa-f]{2})*)")
# Commands without effect here: acceptance filters, polling, serial speed, start-up, data bit rate.
_ACCEPTED = re.compile(rb"[Mm][0-9A-Fa-f]{8}|[XQW][0-2]|U[0-6]|[AP]|Y[0-9]")


def parse_frame(line: bytes) -> tuple[Frame, bool]:
    """Return the frame of a line t, T, r or R, and whether it is extended.

    Raises:
        ValueError: If the line is not a frame of classical CAN.
    """
    extended = line[:1] in (b"T", b"R")
    match = (_EXTENDED if extended else _STANDARD).fullmatch(line)
    if match is None:
        raise ValueError(f"{line[:MAX_LINE]!r} is not a frame")
    can_id, length, data = int(match[1], 16), int(match[2]), bytes.fromhex(match[3].decode())
    if line[:1] in (b"r", b"R"):
        if data:
            raise ValueError(f"{line!r}: a remote frame has no data")
        return Frame(can_id, b"", rtr=True, dlc=length), extended
    if len(data) != length:
        raise ValueError(f"{line!r}: {length} bytes are announced, {len(data)} follow")
    return Frame(can_id, data), extended


def format_frame(frame: Frame, extended: bool = False, timestamp_ms: int | None = None) -> bytes:
    """Return the line of a frame, with a time stamp [ms, 0 to 59,999] unless None."""
    length = (frame.dlc or 0) if frame.rtr else len(frame.data)
    kind = (b"R" if extended else b"r") if frame.rtr else (b"T" if extended else b"t")
    can_id = b"%08X" % frame.can_id if extended else b"%03X" % frame.can_id
    stamp = b"" if timestamp_ms is None else b"%04X" % (timestamp_ms % 60_000)
    return b"%b%b%d%b%b\r" % (kind, can_id, length, frame.data.hex().upper().encode(), stamp)


def check_token(token: str) -> None:
    """Raise ValueError for a token that is too short or does not fit into a line; the message does not repeat it."""
    if TOKEN.fullmatch(token) is None:
        raise ValueError(f"a token has 8 to 48 letters, digits, - and _; this one has {len(token)} characters")


class Channel:
    """An adapter's channel as its client has set it.

    Attributes:
        bit_rate: [bit/s].
        is_open: It takes part in the bus.
        listen_only: It sends nothing.
        time_stamps: Frames come with the time of their reception.
        refused: Its client tried to open it with another bit rate than that of the bus.
        locked: Its token has not been received yet.
        wrong_token: A wrong token was received; everything after it is ignored.

    Args:
        bit_rate: Bit rate of the bus [bit/s].
        token: The token that its client must present first; None: no token.
    """

    def __init__(self, bit_rate: float, token: str | None = None) -> None:
        self._bus_bit_rate = bit_rate
        self.bit_rate = bit_rate
        self.is_open = False
        self.listen_only = False
        self.time_stamps = False
        self.refused = False
        self.locked = token is not None
        self.wrong_token = False
        self._token = (token or "").encode()
        self._line = b""
        self._overlong = False

    def feed(self, data: bytes) -> tuple[list[tuple[Frame, bool]], bytes]:
        """Parse bytes of the client; return its frames, each extended or not, and the answer to its commands."""
        frames: list[tuple[Frame, bool]] = []
        answer = bytearray()
        *lines, rest = (self._line + data).replace(b"\n", b"\r").split(b"\r")
        for line in lines:
            if self.locked:
                answer += b"" if self._overlong else self._unlock(line)
            else:
                answer += BELL if self._overlong else self._take(line, frames)
            self._overlong = False
        if len(rest) > MAX_LINE:  # too long for a command: skip it to its end
            self._overlong, rest = True, b""
        self._line = b"" if self._overlong else rest
        return frames, bytes(answer)

    def format(self, frame: Frame, extended: bool, time: float) -> bytes:
        """Return the line that reports a frame received at `time` [s] to the client."""
        return format_frame(frame, extended, int(time * 1e3) if self.time_stamps else None)

    # --- inside ---------------------------------------------------------------------------------------------------
    def _unlock(self, line: bytes) -> bytes:
        if line[:1] != b"K" or self.wrong_token:
            return b""
        # Compared in constant time, so that the duration does not show how many characters were right.
        if not secrets.compare_digest(line[1:], self._token):
            self.wrong_token = True
            return b""
        self.locked = False
        return OK

    def _take(self, line: bytes, frames: list[tuple[Frame, bool]]) -> bytes:
        kind = line[:1]
        if kind in (b"t", b"T", b"r", b"R"):
            try:
                frame = parse_frame(line)
            except ValueError:
                return BELL
            if not self.is_open or self.listen_only:
                return BELL
            frames.append(frame)
            return b""
        return self._command(kind, line[1:])

    def _command(self, kind: bytes, argument: bytes) -> bytes:
        if kind == b"":  # an empty line; python-can sends one for "no data bit rate"
            return b""
        if kind in (b"O", b"L", b"C") and not argument:
            return self._open(listen_only=kind == b"L") if kind != b"C" else self._close()
        if kind in (b"S", b"s"):
            return self._set_bit_rate(kind, argument)
        if kind in (b"V", b"v") and not argument:
            return VERSION
        if kind == b"N" and not argument:
            return SERIAL_NUMBER
        if kind == b"F" and not argument and self.is_open:
            return b"F00\r"  # no error: a client that is too slow is dropped, not told of an overrun
        if kind == b"Z" and argument in (b"0", b"1") and not self.is_open:
            self.time_stamps = argument == b"1"
            return OK
        return OK if _ACCEPTED.fullmatch(kind + argument) else BELL

    def _open(self, listen_only: bool) -> bytes:
        # A controller with another bit rate would understand nothing and destroy every frame: it stays closed.
        if self.bit_rate != self._bus_bit_rate:
            self.refused = True
            return BELL
        self.is_open, self.listen_only = True, listen_only
        return OK

    def _close(self) -> bytes:
        self.is_open = False
        return OK

    def _set_bit_rate(self, kind: bytes, argument: bytes) -> bytes:
        if self.is_open:
            return BELL
        if kind == b"S" and argument in BIT_RATES:
            self.bit_rate = BIT_RATES[argument]
        elif kind == b"s" and re.fullmatch(rb"[0-9A-Fa-f]{4}", argument):
            btr0, btr1 = bytes.fromhex(argument.decode())
            quanta = 3 + (btr1 & 0x0F) + (btr1 >> 4 & 0x07)
            self.bit_rate = CLOCK / ((btr0 & 0x3F) + 1) / quanta
        else:
            return BELL
        return OK
