"""Pictures of lanes: the machine beside its scope, as a film shows them, while an episode runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from drive_env.recording import Recorder
    from drive_env.render import Picture

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


class Pictures:
    """Draws lanes of emulated drives; "human" shows them in a window.

    Args:
        drives: The drives.
        num_envs: Lanes.
        mode: "rgb_array" or "human".

    Raises:
        ValueError: For drives on a bus, whose machine no one sees.
    """

    def __init__(self, drives: Any, num_envs: int, mode: str) -> None:
        if getattr(drives, "machine", None) is None:
            raise ValueError("pictures need emulated machines; leave render_mode out on a bus")
        self._drives = drives
        self._num_envs = num_envs
        self._human = mode == "human"
        self._recorders: dict[int, Recorder] = {}
        self._picture: Picture | None = None
        self._window: Any = None

    def begin(self, lanes: Mask) -> None:
        """Begin a new recording of the lanes where the mask is true."""
        for lane in [lane for lane in self._recorders if lanes[lane]]:
            self._record(lane)

    def look(self) -> None:
        """Remember where the lanes that are shown are now."""
        for recorder in self._recorders.values():
            recorder.look()
        if self._human:
            self.draw(0)

    def draw(self, lane: int) -> Image | None:
        """Return the picture of a lane, uint8 of shape (height, width, 3); with "human" show it and return None."""
        from drive_env.render import Picture

        if lane not in self._recorders:
            self._record(lane)
        if self._picture is None:
            self._picture = Picture(self._drives.load)
        image = self._picture.frame(self._recorders[lane].recording())
        if not self._human:
            return image
        self._show(image)
        return None

    def close(self) -> None:
        """Close window and picture."""
        if self._window is not None:
            import matplotlib.pyplot as plt

            plt.close(self._window.figure)
            self._window = None
        if self._picture is not None:
            self._picture.close()
            self._picture = None

    def _record(self, lane: int) -> None:
        from drive_env.recording import Recorder

        self._recorders[lane] = Recorder(self._drives, lane)
        self._recorders[lane].look()

    def _show(self, image: Image) -> None:
        import matplotlib.pyplot as plt

        if self._window is None:
            figure, axes = plt.subplots(figsize=(image.shape[1] / 100, image.shape[0] / 100), frameon=False)
            axes.set_axis_off()
            axes.set_position((0.0, 0.0, 1.0, 1.0))
            self._window = axes.imshow(image)
            figure.show()
        self._window.set_data(image)
        self._window.figure.canvas.draw_idle()
        self._window.figure.canvas.flush_events()
