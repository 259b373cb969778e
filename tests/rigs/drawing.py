"""Skips what draws where there is no OpenGL."""

import pytest

from drive_env.pictures import opengl
from drive_env.pictures.opengl import OpenGLError


def why_nothing_can_be_drawn():
    try:
        opengl.new_context(16, 16).free()
    except OpenGLError as error:
        return str(error)
    return ""


NO_GL = why_nothing_can_be_drawn()
needs_gl = pytest.mark.skipif(bool(NO_GL), reason=NO_GL or "there is OpenGL")
