"""Pictures of environments: the machine beside its scope while an episode runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drive_env.drives.interface import CYCLE
from drive_env.emulator.emulated_drives import emulated_of
from mechanics.arrays import Floats, Image, Mask

if TYPE_CHECKING:
    from drive_env.drives.interface import Drives
    from drive_env.pictures.recording import Recorder
    from drive_env.pictures.render import Picture
    from drive_env.pictures.window import Window


HUMAN = "human"
FRAME = 0.02  # s of emulated time between two pictures in a window: one takes a tenth of a second to draw


class Pictures:
    """Draws environments of emulated drives; "human" shows environment 0 in a window while time passes.

    Args:
        drives: The drives.
        mode: "rgb_array" or "human".
        period: Time between two looks [s].

    Raises:
        ValueError: For drives on a bus, whose machine is not visible.
        OpenGLError: With "human", if there is no display.
    """

    def __init__(self, drives: Drives, mode: str, period: float = CYCLE) -> None:
        if drives.machine is None:
            raise ValueError("pictures need emulated machines; leave render_mode out on a bus")
        self._drives = emulated_of(drives)
        self._period = period
        self._recorders: dict[int, Recorder] = {}
        self._picture: Picture | None = None
        self._window: Window | None = None
        self._looks = 0  # since the last picture in the window
        if mode == HUMAN:
            self._open_window()

    @property
    def is_looking(self) -> bool:
        """Whether an environment is recorded: only then `look` need be called."""
        return bool(self._recorders)

    def begin(self, lanes: Mask) -> None:
        """Begin a new recording of the environments where the mask is true; a window shows environment 0 alone."""
        shown = [0] if self._window is not None else range(len(lanes))
        for lane in [lane for lane in shown if lanes[lane]]:
            self._record(lane)

    def look(self, wanted: tuple[Floats, Floats] | None = None) -> None:
        """Record position and set-point of the shown environments, with the argument of `Recorder.look`."""
        for recorder in self._recorders.values():
            recorder.look(wanted)
        if self._window is not None and self._recorders:
            self._looks += 1
            if self._looks * self._period >= FRAME - 1e-9:
                self.draw(0)

    def draw(self, lane: int) -> Image | None:
        """Return an environment's picture, uint8 of shape (height, width, 3); with "human" show it and return None."""
        if self._window is not None and not self._window.is_open:
            return None
        if lane not in self._recorders:
            self._record(lane)
        image = self._drawn().frame(self._recorders[lane].recording())
        if self._window is None:
            return image
        self._looks = 0
        self._window.show(image)
        return None

    def close(self) -> None:
        """Close the window and the picture."""
        if self._window is not None:
            self._window.close()
        if self._picture is not None:
            self._picture.close()
            self._picture = None
        self._recorders.clear()

    def _open_window(self) -> None:
        from drive_env.pictures.demonstration import PictureFormat
        from drive_env.pictures.window import Window

        form = PictureFormat()
        self._window = Window(form.width, form.height, f"drive-env: {self._drives.load.name}")

    def _drawn(self) -> Picture:
        if self._picture is None:
            from drive_env.pictures.render import Picture

            self._picture = Picture(self._drives.load)
        return self._picture

    def _record(self, lane: int) -> None:
        from drive_env.pictures.recording import Recorder

        self._recorders[lane] = Recorder(self._drives, lane, self._period)
        self._recorders[lane].look()
