"""The moving picture of the emulated machine: drawn in its own thread, and only while a page shows it.

Without a graphics card a picture takes some milliseconds of CPU time; the interval between pictures is adapted, so that
drawing takes at most a set share of a core. A machine at rest is not drawn again.
"""

from __future__ import annotations

import io
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from mechanics.arrays import Floats

if TYPE_CHECKING:
    from drive_env.studio.session import Session


PERIOD = 0.1  # s, least interval between two pictures
SHARE = 0.15  # greatest share of a core for drawing
WIDTH, HEIGHT = 640, 480  # pixels
QUALITY = 80  # of the JPEG
STILL = 1e-4  # rad or m: a smaller motion is invisible


class MachineCamera:
    """Draws the first machine of a session.

    Args:
        session: The drives.

    Attributes:
        period: Time until the next picture is due [s].
        cost: CPU time of the last picture [s].
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._scene: Any = None
        self._failure: Exception | None = None
        self._joints: Floats | None = None
        self._picture = b""
        self._number = 0
        self._next = 0.0
        self.period = PERIOD
        self.cost = 0.0
        # OpenGL can only be used in the thread that opened it.
        self.thread = ThreadPoolExecutor(1, thread_name_prefix="studio camera")

    def picture(self, seen: int) -> tuple[int, bytes]:
        """Return number and JPEG of the newest picture, b"" if it is number `seen`; call it in the camera's thread.

        Raises:
            RuntimeError: If drawing is impossible; the message has the reason and the remedy.
        """
        if self._failure is not None:
            raise self._failure
        now = time.monotonic()
        if now >= self._next:
            joints = self._session.glimpse(lambda machine: machine.joint_positions[0])
            if joints is not None and not self._is_drawn(joints):
                self._draw(joints)
            self._next = now + self.period
        return self._number, b"" if self._number == seen else self._picture

    def close(self) -> None:
        """Close OpenGL."""
        self.thread.submit(self._close)
        self.thread.shutdown(wait=False)

    def _is_drawn(self, joints: Floats) -> bool:
        return self._joints is not None and bool(np.all(np.abs(joints - self._joints) < STILL))

    def _draw(self, joints: Floats) -> None:
        from PIL import Image

        begun = time.thread_time()
        if self._scene is None:
            self._open()
        pixels = self._scene.draw(joints)
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, "JPEG", quality=QUALITY)
        self._picture, self._joints = file.getvalue(), joints
        self._number += 1
        if self._number > 1:  # the first one opens OpenGL
            self.cost = time.thread_time() - begun
            self.period = max(PERIOD, self.cost / SHARE)

    def _open(self) -> None:
        from drive_env.pictures.opengl import OpenGLError
        from drive_env.pictures.render import reachable_poses
        from drive_env.pictures.scene import Scene

        load = self._session.glimpse(lambda machine: machine.load)
        assert load is not None, "there was a machine to draw"
        try:
            self._scene = Scene(load.mjcf, WIDTH, HEIGHT, reachable_poses(load), quick=True)
        except (OpenGLError, ValueError) as error:
            self._failure = error
            raise

    def _close(self) -> None:
        if self._scene is not None:
            self._scene.close()
            self._scene = None
