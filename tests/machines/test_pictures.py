"""render_mode: pictures of every environment with machine and scope, and the window that shows them to people."""

from __future__ import annotations

import sys
import warnings
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from rigs.drawing import needs_gl

from drive_env import EmulatedDrives
from drive_env.devices import device_names
from drive_env.envs.gain_scheduling import GainScheduling
from drive_env.envs.gain_tuning import GainTuning
from drive_env.envs.pictures import Pictures
from drive_env.envs.tracking import Tracking
from drive_env.pictures import opengl, window
from drive_env.pictures.opengl import OpenGLError, has_display
from drive_env.pictures.scene import Scene
from drive_env.pictures.scope_picture import COLORS, panels
from mechanics.loads import LOADS

KINDS = {
    "Tracking": (Tracking, {"load": "belt", "duration": 0.5}, 60),
    "GainScheduling": (GainScheduling, {"load": "belt", "duration": 0.5}, 8),
    "GainTuning": (GainTuning, {"load": "belt", "trials": 3}, 1),
}
EVERY_KIND = pytest.mark.parametrize("kind", KINDS)
HEIGHT, WIDTH = 540, 960
TRACE = np.array([int(COLORS[0][k : k + 2], 16) for k in (1, 3, 5)])  # the first axis's


def of_trace(picture):
    """Return how many pixels of a picture have the colour of the first axis's trace."""
    return int(np.all(np.abs(picture.astype(int) - TRACE) < 12, axis=-1).sum())


def machine_of(picture):
    """Return the machine's part of a picture, without the texts above and below."""
    return picture[40 : HEIGHT - 30, : WIDTH // 2]


# --- rgb_array --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@needs_gl
@EVERY_KIND
def test_a_picture_shows_the_machine_and_the_scope(kind):
    environment, options, steps = KINDS[kind]
    lanes = environment(2, num_threads=1, render_mode="rgb_array", **options)
    lanes.reset(seed=0)
    at_rest = lanes.render_environment(0)
    lanes._pictures._record(1)
    assert at_rest.shape == (HEIGHT, WIDTH, 3) and at_rest.dtype == np.uint8
    rng = np.random.default_rng(3)
    for _ in range(steps):
        lanes.step(0.5 * rng.uniform(lanes.action_space.low, lanes.action_space.high).astype(np.float32))
    first, second = lanes.render()
    assert len(np.unique(machine_of(first).reshape(-1, 3), axis=0)) > 100  # a lit machine
    scope = slice(WIDTH // 2, None)
    if kind == "GainTuning":  # a reset has made a trial with the gains of the beginning, and this is another
        assert of_trace(at_rest[:, scope]) > 1000 and not np.array_equal(first[:, scope], at_rest[:, scope])
        assert of_trace(first[:, scope]) > 1000
    else:
        assert of_trace(first[:, scope]) > 3 * of_trace(at_rest[:, scope])  # the traces have grown
    assert of_trace(machine_of(first)) == 0
    assert not np.array_equal(first[:, scope], second[:, scope])  # every environment its own
    # The carriage is drawn where it is.
    assert np.ptp(lanes.drives.machine.joint_positions[:, 0]) > 0.0
    assert not np.array_equal(machine_of(first), machine_of(second))
    lanes.close()


@pytest.mark.slow
@needs_gl
@EVERY_KIND
def test_the_single_environment_renders_and_who_looks_changes_nothing(kind):
    _, options, steps = KINDS[kind]
    found = []
    for mode in (None, "rgb_array"):
        env = gymnasium.make(f"ServoDrive/{kind}-v0", render_mode=mode, num_threads=1, **options)
        rows = [env.reset(seed=1)[0]]
        for k in range(steps):
            rows.append(env.step(env.action_space.low * 0.3)[0])
            if mode and k == 0:
                assert env.render().shape == (HEIGHT, WIDTH, 3)
        assert mode or env.unwrapped.render() is None
        found.append(np.array(rows))
        env.close()
    np.testing.assert_array_equal(*found)


@pytest.mark.every(9)
@pytest.mark.parametrize("device", [pytest.param(name, marks=needs_gl) for name in device_names()])
def test_every_device_is_drawn(device):
    """A stepper tells no torque current; its third panel has how far it is behind its steps, which is its torque."""
    stepper = device == "tmcm6212"
    options = {"device": device, "load": "inertia", "render_mode": "rgb_array", "trajectory": "sines"}
    lanes = Tracking(1, num_threads=1, **options | ({"action": "offset", "offset": 0.001} if stepper else {}))
    lanes.reset(seed=0)
    for _ in range(50):
        lanes.step(0.3 * lanes.action_space.high)
    assert of_trace(lanes.render()[0][:, WIDTH // 2 :]) > 100
    recording = lanes._pictures._recorders[0].recording()
    third = panels(recording)[2]
    assert (third.name, third.unit) == (("lag", "full steps") if stepper else ("current", "A"))
    assert np.isfinite(third.actual).all() and 0.0 < np.abs(third.actual).max() < 20.0
    if stepper:
        lanes.step(lanes.action_space.high)
        sampled = lanes._episodes.sampled[:, 0, 0]  # before that step's cycle: what was looked at last
        assert third.actual[-1, 0] == pytest.approx((sampled[3] - sampled[1]) / lanes._episodes.scales[0, 2])
    lanes.close()


@EVERY_KIND
def test_the_scope_s_time_is_the_environment_s(kind):
    """A sample of the scope per look: every cycle, or every step of a Tracking at 500 Hz."""
    environment, options, _ = KINDS[kind]
    at_500_hz = {"rate": 500} if kind == "Tracking" else {}
    lanes = environment(1, num_threads=1, render_mode="rgb_array", **options, **at_500_hz)
    pictures = lanes._pictures
    pictures._record(0)
    lanes.reset(seed=0)
    lanes.step(lanes.action_space.low * 0.0)
    t = pictures._recorders[0].recording().t
    passed = {"Tracking": 0.002, "GainScheduling": 0.010, "GainTuning": 0.750}[kind]
    assert t[-1] == pytest.approx(passed)
    assert t[1] == pytest.approx(0.002 if kind == "Tracking" else 0.001)
    lanes.close()


def test_what_is_looked_at_first_after_60_steps_are_those_steps():
    lanes = Tracking(2, num_threads=1, render_mode="rgb_array", load="belt", duration=0.5)
    lanes.reset(seed=0)
    for _ in range(60):
        lanes.step(lanes.action_space.high * 0.1)
    for lane in range(2):
        shown = lanes._pictures._recorders[lane].recording()
        assert shown.t[-1] == pytest.approx(0.060) and len(shown.t) >= 60
    lanes.close()


def test_on_a_bus_nobody_sees_the_machine():
    with pytest.raises(ValueError, match="pictures need emulated machines; leave render_mode out on a bus"):
        Pictures(SimpleNamespace(machine=None), "rgb_array")


@needs_gl
def test_a_machine_without_gravity_is_drawn_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Scene(LOADS["gantry"].mjcf, 32, 32).close()


# --- human ------------------------------------------------------------------------------------------------------------
class FakeWindow:
    """Stands in for the window: remembers what it is shown."""

    def __init__(self, width, height, title):
        self.size, self.title, self.shown, self.is_open, self.closed = (height, width, 3), title, [], True, False

    def show(self, image):
        self.shown.append(image)

    def close(self):
        self.is_open, self.closed = False, True


@pytest.mark.slow
@needs_gl
@EVERY_KIND
def test_human_shows_lane_0_while_time_passes(kind, monkeypatch):
    monkeypatch.setattr(window, "Window", FakeWindow)
    _, options, steps = KINDS[kind]
    env = gymnasium.make(f"ServoDrive/{kind}-v0", render_mode="human", num_threads=1, **options).unwrapped
    shown = env.vector._pictures._window
    assert shown.title == "drive-env: belt" and shown.size == (HEIGHT, WIDTH, 3)
    # Nobody calls render(): time that passes is shown. Drawing every picture would take long, so only the last is.
    drawn = env.vector._pictures._drawn()
    frame = drawn.frame
    drawn.frame = lambda recording: len(recording.t)
    env.reset(seed=0)
    before = len(shown.shown)
    for _ in range(steps):
        env.step(env.action_space.low * 0.3)
    passed = {"Tracking": 0.060, "GainScheduling": 0.080, "GainTuning": 0.750}[kind]
    assert abs(len(shown.shown) - before - passed * env.metadata["render_fps"]) <= 1.0
    assert env.metadata["render_fps"] == 50
    drawn.frame = frame
    assert env.render() is None  # shows it once more
    assert shown.shown[-1].shape == shown.size and of_trace(shown.shown[-1]) > 100
    # The user closes the window: the episode goes on unseen.
    shown.is_open = False
    count = len(shown.shown)
    env.step(env.action_space.low * 0.3)
    assert env.render() is None and len(shown.shown) == count
    env.close()
    assert shown.closed


def test_human_without_a_display_says_what_to_do(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(OpenGLError, match=r"needs a display and there is none .*; use render_mode='rgb_array'"):
        Tracking(1, render_mode="human", num_threads=1)


def test_human_with_an_off_screen_library_says_what_to_do(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("MUJOCO_GL", "egl")
    with pytest.raises(OpenGLError, match="MUJOCO_GL=egl draws off-screen only; unset it for render_mode 'human'"):
        Tracking(1, render_mode="human", num_threads=1)


# --- the window -------------------------------------------------------------------------------------------------------
class FakeLibrary(SimpleNamespace):
    """GLFW or OpenGL: constants are their names, calls are remembered in order."""

    def __init__(self, calls, **answers):
        super().__init__()
        self._calls, self._answers = calls, answers

    def __getattr__(self, name):
        if name.isupper() or name.startswith("GL_"):
            return name

        def call(*arguments):
            self._calls.append((name, arguments))
            return self._answers.get(name)

        return call


@pytest.fixture
def fakes(monkeypatch):
    """GLFW and OpenGL that remember; the framebuffer is twice as dense as the window."""
    calls = []
    glfw = FakeLibrary(calls, init=True, create_window="window", get_framebuffer_size=(8, 4), window_should_close=False)
    gl = FakeLibrary(calls)
    monkeypatch.setitem(sys.modules, "glfw", glfw)
    monkeypatch.setitem(sys.modules, "OpenGL", SimpleNamespace(GL=gl))
    monkeypatch.setattr(window, "has_display", lambda: True)
    monkeypatch.setattr(window, "choose_library", lambda: "glfw")
    monkeypatch.setattr(window, "import_mujoco", lambda: None)
    return glfw, calls


def test_a_window_shows_a_picture_from_its_upper_left_corner_on(fakes):
    glfw, calls = fakes
    shown = window.Window(4, 2, "drives")
    names = [name for name, _ in calls]
    # MuJoCo's contexts leave windows invisible: that hint goes before ours is made.
    assert names.index("default_window_hints") < names.index("create_window")
    assert ("create_window", (4, 2, "drives", None, None)) in calls
    assert ("swap_interval", (0,)) in calls
    calls.clear()
    picture = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    shown.show(picture)
    told = dict(calls)
    assert told["make_context_current"] == ("window",)  # the machine's picture was drawn in another
    assert told["glRasterPos2f"] == (-1.0, 1.0) and told["glPixelZoom"] == (2.0, -2.0)
    assert told["glDrawPixels"][:4] == (4, 2, "GL_RGB", "GL_UNSIGNED_BYTE")
    assert np.array_equal(told["glDrawPixels"][4], picture)
    assert [name for name, _ in calls][-3:] == ["swap_buffers", "poll_events", "window_should_close"]
    with pytest.raises(ValueError, match=r"pictures of shape \(2, 4, 3\), not \(4, 2, 3\)"):
        shown.show(picture.reshape(4, 2, 3))
    glfw._answers["window_should_close"] = True
    shown.show(picture)
    assert calls[-1] == ("destroy_window", ("window",)) and not shown.is_open
    calls.clear()
    shown.show(picture)
    shown.close()
    assert calls == []


@pytest.mark.parametrize("fails", ["init", "create_window"])
def test_a_display_that_opens_no_window_is_told_in_one_line(fakes, fails):
    fakes[0]._answers[fails] = None
    with pytest.raises(OpenGLError, match=r"the display opens no window .*use render_mode='rgb_array'"):
        window.Window(4, 2, "drives")


@pytest.mark.skipif(not has_display(), reason="there is no display")
@EVERY_KIND
def test_on_a_display_the_window_opens(kind):
    _, options, steps = KINDS[kind]
    env = gymnasium.make(f"ServoDrive/{kind}-v0", render_mode="human", num_threads=1, **options).unwrapped
    env.vector._pictures._drawn()
    env.reset(seed=0)
    for _ in range(min(steps, 20)):
        env.step(env.action_space.low * 0.3)
    assert env.vector._pictures._window.is_open
    env.close()


def test_a_picture_needs_no_display():
    """Nothing of the window is imported until it is asked for."""
    assert opengl.choose_library() in ("egl", "glfw", "osmesa", "glx", "wgl", "cgl")
    with EmulatedDrives(num_threads=1) as drives:
        assert Pictures(drives, "rgb_array")._window is None
