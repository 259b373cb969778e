"""Deliberate faults of the wire."""

from __future__ import annotations

from dataclasses import dataclass, fields

LONGEST_DELAY = 3600.0  # s


@dataclass(frozen=True)
class Faults:
    """Shares of frames, 0 to 1, hit by each fault; drawn for each frame with the wire's seed.

    Attributes:
        drop: No node receives the frame; it still takes its time on the bus.
        delay: The sender holds this frame and its later ones back, for up to `delay_max` [s].
        duplicate: The frame is sent twice, as CAN does when the last bit of end of frame is disturbed.
        reorder: The sender's next frame goes first; without a next frame within 1 ms there is no effect.
        corrupt: Every receiver finds the CRC wrong: an error frame, and the frame is sent again. This is how a
            disturbed CAN bus behaves. Up to a share of 1/9 it only costs time; beyond that, error counters rise until
            the sender is bus-off.
        corrupt_undetected: One to three bits of the data are changed and the CRC fits. On CAN this is nearly impossible
            (every error of up to five bits is detected); it is for masters that must survive anything.
        delay_max: Longest delay [s].
        only: Identifiers that faults hit; empty: all.
    """

    drop: float = 0.0
    delay: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    corrupt_undetected: float = 0.0
    delay_max: float = 0.005
    only: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "only":
                continue
            if field.name == "delay_max":
                if not 0.0 <= value <= LONGEST_DELAY:
                    raise ValueError(
                        f"faults: delay_max = {value!r} must be a time of 0 s or more, {LONGEST_DELAY:g} s at most"
                    )
            elif not 0.0 <= value <= 1.0:
                raise ValueError(f"faults: {field.name} = {value!r} must be a share of all frames, 0 to 1")

    def __bool__(self) -> bool:
        return any((self.drop, self.delay, self.duplicate, self.reorder, self.corrupt, self.corrupt_undetected))
