"""A run as a film: the machine on the left, the scope on the right, drawn as time goes on; or in MuJoCo's viewer.

recorder = Recorder(drives)                   # stands in for the drives
motion.enable(recorder, mode="pp")
motion.move_to(recorder, 500_000)
render_run(recorder.recording(), "move.gif")
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drive_env.drives.interface import CYCLE
from drive_env.pictures.demonstration import PictureFormat
from drive_env.pictures.opengl import OpenGLError, has_display, import_mujoco
from drive_env.pictures.picture_files import check_out, write_film
from drive_env.pictures.scene import Scene
from drive_env.pictures.scope_picture import ScopePicture
from mechanics.arrays import Floats, Image

if TYPE_CHECKING:
    from drive_env.pictures.recording import Recording
    from mechanics.load import Load

Progress = Callable[[float], None]

FILM_LENGTH = 8.0  # s, which the slow-motion factor approaches
PACES = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
HEADER, FOOTER, EDGE = 34, 26, 14  # pixels of a frame of NORMAL size; others are scaled
NORMAL = (960, 540)
INK, SOFT_INK, PALE = (25, 25, 25), (95, 95, 95), (226, 229, 233)
VIEWER_FRAME = 1.0 / 60.0  # s


def pace(duration: float, picture: PictureFormat) -> tuple[float, int]:
    """Return the slow-motion factor of a run [s], and the communication cycles between two frames.

    A frame shows whole communication cycles: the factor is exact, and the frame rate is adapted to it.
    """
    slow = picture.slow
    if slow is None:
        slow = min(PACES, key=lambda p: abs(np.log(p * max(duration, CYCLE) / FILM_LENGTH)))
    return slow, max(1, round(1.0 / (picture.frames_per_second * slow * CYCLE)))


class Layout(NamedTuple):
    """Sizes in a frame [pixels], and how much larger everything is than in a frame of 960 x 540."""

    header: int
    footer: int
    edge: int
    scale: float

    @classmethod
    def of(cls, width: int, height: int) -> Layout:
        """Return the layout of a frame [pixels]."""
        scale = min(width / NORMAL[0], height / NORMAL[1])
        return cls(round(HEADER * scale), round(FOOTER * scale), round(EDGE * scale), scale)


class Picture:
    """Draws frames of one machine beside its scope; stays open, for films and for environments alike.

    Args:
        load: What is drawn.
        picture: Size; the pace does not matter here.
        poses: Joint positions [rad or m] that the camera must hold, shape (n, D); by default all that the load can
            reach.

    Raises:
        OpenGLError: If there is no OpenGL to draw with.
        ValueError: If the load has nothing to draw.
    """

    def __init__(self, load: Load, picture: PictureFormat | None = None, poses: ArrayLike | None = None) -> None:
        form = picture or PictureFormat()
        self._size = form.width, form.height
        self._left = form.width // 2
        self._layout = Layout.of(form.width, form.height)
        self.scene = Scene(
            load.mjcf,
            self._left,
            form.height - self._layout.header - self._layout.footer,
            reachable_poses(load) if poses is None else poses,
        )
        self._scope: tuple[Recording, ScopePicture] | None = None

    def frame(self, recording: Recording, k: int = -1, slow: float | None = None) -> Image:
        """Return the frame of sample k of a recording, uint8 of shape (height, width, 3).

        The traces of a recording are drawn once: for its later frames only the machine is drawn.

        Args:
            recording: The run so far.
            k: Number of the sample; the last by default.
            slow: Slow-motion factor to be written in the frame; None: no factor is written.
        """
        width, height = self._size
        layout = self._layout
        if self._scope is None or self._scope[0] is not recording:
            scope = ScopePicture(recording, width - self._left, height - layout.header, layout.scale)
            self._scope = recording, scope
        t = float(recording.t[k])
        frame = np.full((height, width, 3), 255, np.uint8)
        frame[layout.header : height - layout.footer, : self._left] = self.scene.draw(recording.joints[k])
        frame[layout.header :, self._left :] = self._scope[1].until(t)
        return _with_text(frame, layout, recording, t, slow, self.scene.grid)

    def close(self) -> None:
        """Release the OpenGL context."""
        self.scene.close()

    def __enter__(self) -> Picture:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def frames(recording: Recording, picture: PictureFormat | None = None) -> Iterator[Image]:
    """Draw a run frame by frame, uint8 of shape (height, width, 3).

    Raises:
        OpenGLError: If there is no OpenGL to draw with.
        ValueError: If the load has nothing to draw.
    """
    form = picture or PictureFormat()
    slow, cycles = pace(_duration(recording), form)
    with Picture(recording.load, form, recording.joints) as open_picture:
        for k in _samples(recording, cycles):
            yield open_picture.frame(recording, k, slow)


def render_run(
    recording: Recording, out: str | Path, picture: PictureFormat | None = None, progress: Progress | None = None
) -> int:
    """Write a run as a film and return how many frames it has.

    Args:
        recording: The run, from Recorder.recording() or perform().
        out: A file that ends in .gif, .webp, .apng, .png or .mp4, or a folder for a sequence of PNGs.
        picture: Size and pace.
        progress: Called with the share of frames that are drawn.

    Raises:
        PictureFileError: If it cannot be written there.
        OpenGLError: If there is no OpenGL to draw with.
    """
    form = picture or PictureFormat()
    path = check_out(out)
    slow, cycles = pace(_duration(recording), form)
    count = len(_samples(recording, cycles))

    def told() -> Iterator[Image]:
        for k, frame in enumerate(frames(recording, form), 1):
            yield frame
            if progress:
                progress(k / count)

    write_film(path, told(), cycles * CYCLE * slow)
    return count


def view(recording: Recording, slow: float = 1.0) -> None:
    """Show a run in MuJoCo's viewer, over and over in real time or `slow` times slower, until its window is closed.

    Raises:
        OpenGLError: If there is no display, or the viewer cannot open.
    """
    if not has_display():
        raise OpenGLError(
            "the viewer needs a display and there is none (DISPLAY and WAYLAND_DISPLAY are unset); leave --view out, "
            "and a film is written"
        )
    mujoco = import_mujoco()
    with Scene(recording.load.mjcf, poses=recording.joints) as scene:
        model, data, camera = scene.model, scene.data, scene.camera
    try:
        import mujoco.viewer as viewer

        window = viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
    except Exception as error:  # no OpenGL for windows, or macOS without mjpython: each raises its own
        raise OpenGLError(f"the viewer cannot open ({error}); leave --view out, and a film is written") from None
    with window:
        for name in ("lookat", "distance", "azimuth", "elevation"):
            value: Any = getattr(camera, name)
            if name == "lookat":
                window.cam.lookat[:] = value
            else:
                setattr(window.cam, name, value)
        start = time.monotonic()
        while window.is_running():
            passed = (time.monotonic() - start) / slow
            k = round(passed / CYCLE) % len(recording.t)
            with window.lock():
                data.qpos[:] = recording.joints[k]
                data.time = float(recording.t[k])
                mujoco.mj_forward(model, data)
            window.sync()
            time.sleep(VIEWER_FRAME)


# --- the frame --------------------------------------------------------------------------------------------------------
def _duration(recording: Recording) -> float:
    return float(recording.t[-1]) + CYCLE


def _samples(recording: Recording, cycles: int) -> range:
    return range(0, len(recording.t), cycles)


def reachable_poses(load: Load) -> Floats:
    """Return the rest position, and one pose for either end of each axis that has one, shape (n, D)."""
    from mechanics.shaft import one, way

    alone = one(load)
    found = way(alone)
    ends = zip([*found.low, *found.high], [*found.joints, *found.joints], strict=True)
    return np.array([alone.start, *(alone.start + end * joints for end, joints in ends if np.isfinite(end))])


def _with_text(frame: Image, layout: Layout, recording: Recording, t: float, slow: float | None, grid: float) -> Image:
    """Return the frame with the run's name, time and pace above, and the remarks and the grid's size below."""
    from PIL import Image as Pillow
    from PIL import ImageDraw

    picture = Pillow.fromarray(frame)
    draw = ImageDraw.Draw(picture)
    height, width = frame.shape[:2]
    large, small = _font(round(15 * layout.scale)), _font(round(13 * layout.scale))
    edge, middle = layout.edge, layout.header // 2
    clock = width - round(206 * layout.scale)
    draw.text((edge, middle), _fitting(recording.title, large, clock - 2 * edge), fill=INK, font=large, anchor="lm")
    draw.text((clock, middle), f"t = {t:.3f} s", fill=INK, font=large, anchor="lm")
    draw.text((width - edge, middle), _pace_text(slow), fill=SOFT_INK, font=small, anchor="rm")
    draw.line((0, layout.header - 1, width, layout.header - 1), fill=PALE)
    below, right = height - layout.footer // 2, width // 2 - edge
    scale = f"grid {_length(grid)}"
    draw.text((right, below), scale, fill=SOFT_INK, font=small, anchor="rm")
    now = [text for start, text in recording.events if start <= t + 1e-9]
    if now:
        room = right - 2 * edge - small.getlength(scale)
        draw.text((edge, below), _fitting(now[-1], small, room), fill=INK, font=small, anchor="lm")
    return np.asarray(picture)


def _pace_text(slow: float | None) -> str:
    if slow is None:
        return ""
    if slow == 1.0:
        return "real time"
    return f"{slow:g}x slower" if slow > 1.0 else f"{1.0 / slow:.3g}x faster"


def _fitting(text: str, font: Any, room: float) -> str:
    """Return the text, cut with an ellipsis where it is wider than the room [pixels]."""
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(text + "…") > room:
        text = text[:-1]
    return text.rstrip() + "…"


def _length(metres: float) -> str:
    for factor, unit in ((1.0, "m"), (1e3, "mm"), (1e6, "µm")):
        if metres * factor >= 0.9999:
            return f"{metres * factor:g} {unit}"
    return f"{metres:g} m"


@cache
def _font(size: int) -> Any:
    from matplotlib import font_manager
    from PIL import ImageFont

    return ImageFont.truetype(font_manager.findfont("DejaVu Sans"), size)  # it comes with matplotlib
