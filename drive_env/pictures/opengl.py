"""Chooses the OpenGL library for drawing: that of MUJOCO_GL if set, EGL without a display, else the system's own.

MuJoCo chooses its library when it is imported, and fails there in many ways; here each failure is an error of one line.
"""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from typing import Any

# Names of MUJOCO_GL -> module of MuJoCo, by system; the first is taken with a display, or where none is needed.
_LIBRARIES = {
    "linux": {"glfw": "mujoco.glfw", "glx": "mujoco.glfw", "egl": "mujoco.egl", "osmesa": "mujoco.osmesa"},
    "win32": {"glfw": "mujoco.glfw", "wgl": "mujoco.glfw"},
    "darwin": {"cgl": "mujoco.cgl", "glfw": "mujoco.glfw"},
}
_UNSET = ("", "enable", "enabled", "on", "true", "1")
_OFF = ("disable", "disabled", "off", "false", "0")
_PACKAGES = "EGL needs a driver with libEGL (Debian: libegl1), OSMesa the package libosmesa6"


class OpenGLError(RuntimeError):
    """No picture can be drawn; the message is one line with the reason and the remedy."""


def has_display() -> bool:
    """Return whether windows can be opened; on Windows and macOS always."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def choose_library() -> str:
    """Return the name of the OpenGL library to draw with, as in MUJOCO_GL.

    Raises:
        OpenGLError: If MUJOCO_GL names no library of this system, switches drawing off, or needs a missing display.
    """
    system = "linux" if sys.platform.startswith("linux") else sys.platform
    known = _LIBRARIES.get(system, _LIBRARIES["linux"])
    name = os.environ.get("MUJOCO_GL", "").lower().strip()
    if name in _OFF:
        raise OpenGLError(f"MUJOCO_GL={name} switches drawing off; unset it, or set it to one of {', '.join(known)}")
    if name in _UNSET:
        return next(iter(known)) if has_display() else "egl"
    if name not in known:
        raise OpenGLError(
            f"MUJOCO_GL={name} is not an OpenGL platform of this system; set it to one of {', '.join(known)}"
        )
    if known[name] == "mujoco.glfw" and not has_display():
        raise OpenGLError(f"MUJOCO_GL={name} needs a display and there is none; set MUJOCO_GL=egl or MUJOCO_GL=osmesa")
    return name


def import_mujoco() -> Any:
    """Import `mujoco` with the chosen OpenGL library, and return it.

    Raises:
        OpenGLError: As choose_library, and if the library is not installed.
    """
    name = choose_library()
    if "mujoco" not in sys.modules:
        os.environ["MUJOCO_GL"] = name
    try:
        return importlib.import_module("mujoco")
    except (ImportError, AttributeError, RuntimeError, OSError) as error:  # each of them seen, by library
        raise _missing(name, error) from None


def new_context(width: int, height: int) -> Any:
    """Return a current OpenGL context for pictures of a size [pixels], with `make_current` and `free`.

    Raises:
        OpenGLError: If there is no OpenGL to draw with.
    """
    import_mujoco()
    name = choose_library()
    system = "linux" if sys.platform.startswith("linux") else sys.platform
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of glfw, which says twice what the error says
            module = importlib.import_module(_LIBRARIES.get(system, _LIBRARIES["linux"])[name])
            context = module.GLContext(width, height)
            context.make_current()
    except Exception as error:
        # The libraries' bindings raise what they like: an AttributeError of None where a library is missing.
        raise _missing(name, error) from None
    return context


def _missing(name: str, error: Exception) -> OpenGLError:
    reason = (str(error).strip() or type(error).__name__).splitlines()[0]
    others = " or ".join(f"MUJOCO_GL={other}" for other in ("egl", "osmesa") if other != name)
    return OpenGLError(f"no picture can be drawn with MUJOCO_GL={name} ({reason}); set {others}, and install its "
                       f"library: {_PACKAGES}")  # fmt: skip
