"""A window that shows pictures, one after the other, by GLFW, which is installed with MuJoCo.

It needs a display, and is used only in the thread that opened it (on macOS the main one).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drive_env.pictures.opengl import OpenGLError, choose_library, has_display, import_mujoco
from mechanics.arrays import Image

OFF_SCREEN = ("egl", "osmesa")  # libraries whose contexts do not share a thread with a window's


class Window:
    """Shows pictures until the user closes it.

    Args:
        width: Of the pictures [pixels].
        height: Of the pictures [pixels].
        title: Of the window.

    Raises:
        OpenGLError: If there is no display, or no window can be opened on it.
    """

    def __init__(self, width: int, height: int, title: str) -> None:
        _check_display()
        import glfw
        from OpenGL import GL  # type: ignore[import-untyped]

        self._glfw: Any = glfw
        self._gl: Any = GL
        self._window: Any = None
        self._size = width, height
        if not glfw.init():
            raise OpenGLError("the display opens no window (GLFW does not start); use render_mode='rgb_array'")
        glfw.default_window_hints()  # MuJoCo's off-screen contexts leave "invisible" behind
        glfw.window_hint(glfw.RESIZABLE, glfw.FALSE)
        self._window = glfw.create_window(width, height, title, None, None)
        if not self._window:
            raise OpenGLError("the display opens no window with OpenGL; use render_mode='rgb_array'")
        self.is_open = True
        glfw.make_context_current(self._window)
        glfw.swap_interval(0)  # time is the environment's: nothing waits for the screen

    def show(self, image: Image) -> None:
        """Show a picture, uint8 of shape (height, width, 3), else ValueError; in a closed window do nothing."""
        if not self.is_open:
            return
        glfw, gl = self._glfw, self._gl
        width, height = self._size
        if image.shape != (height, width, 3):
            raise ValueError(f"the window shows pictures of shape {(height, width, 3)}, not {image.shape}")
        glfw.make_context_current(self._window)
        across, down = glfw.get_framebuffer_size(self._window)  # more than the picture's on dense screens
        gl.glViewport(0, 0, across, down)
        gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
        gl.glRasterPos2f(-1.0, 1.0)  # from the upper left corner downwards: OpenGL counts rows from below
        gl.glPixelZoom(across / width, -down / height)
        gl.glDrawPixels(width, height, gl.GL_RGB, gl.GL_UNSIGNED_BYTE, np.ascontiguousarray(image))
        glfw.swap_buffers(self._window)
        glfw.poll_events()
        if glfw.window_should_close(self._window):
            self.close()

    def close(self) -> None:
        """Close the window; a second call does nothing."""
        self.is_open = False
        if self._window is not None:
            self._glfw.destroy_window(self._window)
            self._window = None


def _check_display() -> None:
    if not has_display():
        raise OpenGLError(
            "render_mode 'human' needs a display and there is none (DISPLAY and WAYLAND_DISPLAY are unset); use "
            "render_mode='rgb_array'"
        )
    name = choose_library()
    if name in OFF_SCREEN:
        raise OpenGLError(f"MUJOCO_GL={name} draws off-screen only; unset it for render_mode 'human'")
    import_mujoco()  # which fails in one line where the library is missing
