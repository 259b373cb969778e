"""`drive-env render`: what is filmed, what is drawn, where it goes, and what is said where nothing can be drawn.

Machines are told apart from floor and scope by their colours: the belt's carriage and a disc's mark are orange.
"""

import dataclasses
import os
import stat
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import typer
from PIL import Image
from rigs.drawing import needs_gl
from typer.testing import CliRunner

from drive_env import EmulatedDrives, motion
from drive_env.commands.render import render as render_command
from drive_env.pictures import opengl, picture_files, render
from drive_env.pictures.demonstration import (
    Demonstration,
    DemonstrationError,
    PictureFormat,
    load_demonstration,
    perform,
)
from drive_env.pictures.opengl import OpenGLError
from drive_env.pictures.picture_files import PictureFileError, write_film
from drive_env.pictures.recording import Recorder, Recording
from drive_env.pictures.scene import Scene, load_model
from drive_env.pictures.scope_picture import ScopePicture, panels
from mechanics.load import Load, Switch
from mechanics.loads import LOADS, find_load
from mechanics.shaft import one, way

pytestmark = pytest.mark.usefixtures("files_read_here")
SMALL = PictureFormat(width=640, height=360)


ARM = """
<mujoco>
  <worldbody>
    <geom type="cylinder" size="0.1 0.05"/>
    <body pos="0 0 0.1">
      <joint name="a" type="hinge" axis="0 0 1"/>
      <geom type="capsule" size="0.05" fromto="0 0 0 0 0 0.3" rgba="0.2 0.4 0.8 1"/>
      <body pos="0 0 0.3">
        <joint name="b" type="hinge" axis="0 1 0" range="-90 60" limited="true"/>
        <geom type="capsule" size="0.04" fromto="0 0 0 0 0 0.3" rgba="0.2 0.4 0.8 1"/>
        <body pos="0 0 0.3">
          <joint name="c" type="slide" axis="0 0 1" range="-0.1 0.2" limited="true"/>
          <geom type="box" size="0.03 0.03 0.1" rgba="0.8 0.45 0.1 1"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


FREE = [(-np.inf, np.inf), (-np.pi / 2, np.pi / 3), (-0.1, 0.2)]  # of its joints, by their ranges


@pytest.fixture
def arm(tmp_path):
    """Three axes of a machine that none of the shipped loads resembles."""
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    return find_load(Load(path, joints=("a", "b", "c"), gear=(10.0, 20.0, -500.0), meaning="two hinges, one slide"))


def a_recording(load, joints=2, axes=1, n=400):
    """Return a made-up run: every motor turns to 10 rad and stays; the load pushes from 0.2 s to 0.3 s."""
    t = np.arange(n) * 1e-3
    turned = np.tile(np.minimum(100.0 * t, 10.0)[:, None], (1, axes))
    nothing = np.full_like(turned, np.nan)
    found = way(one(load))
    gears = np.resize(1.0 / found.position, axes)
    at = np.tile((turned[:, :1] / gears[0]), (1, joints)) * np.eye(joints)[0]
    pushes = np.where((t >= 0.2) & (t < 0.3), 1.0, 0.0)
    events = ((0.0, "enable"), (0.1, "pp: to 1.59 turns"))
    return Recording(
        load,
        "made up",
        gears,
        np.resize(found.linear, axes),
        t,
        at,
        turned,
        turned,
        nothing,
        10 * turned,
        nothing,
        turned,
        pushes,
        events,
    )


def orange(image):
    """Return rows and columns of the orange pixels."""
    red, green, blue = (image[..., k].astype(int) for k in range(3))
    return np.nonzero((red > green + 40) & (green > blue + 20))


def alike(one, other):
    """Return whether two drawings are the same, but for the few pixels that OpenGL rounds one way or the other."""
    return (np.abs(one.astype(int) - other).max(-1) > 8).mean() < 1e-3


@pytest.fixture(scope="module")
def belt_run():
    return perform(Demonstration(load="belt"))


# --- what is filmed ---------------------------------------------------------------------------------------------------
@pytest.mark.every(15)
@pytest.mark.parametrize("load", LOADS)
def test_default_run_moves_there_and_back_and_then_the_load_pushes(load):
    run = perform(Demonstration(load=load))
    assert np.isfinite(run.joints).all()
    turns = run.position[:, 0] / (2 * np.pi)
    assert np.abs(turns).max() > 0.5
    pushed = np.flatnonzero(run.load_torque)
    assert abs(turns[pushed[0]]) < 0.05 * np.abs(turns).max(), "it is back before the load pushes"
    assert len(pushed) == 400
    assert [text.split()[0] for _, text in run.events] == ["enable", "pp:", "pp:", "load", "load"]


def test_belt_stays_between_its_limit_switches(belt_run):
    carriage = belt_run.joints.sum(1)
    assert carriage.max() == pytest.approx(0.8 * 0.23, abs=2e-3)
    assert carriage.min() > -0.02


def test_joints_and_motor_agree(belt_run):
    assert belt_run.joints[:, 0] * belt_run.gears[0] == pytest.approx(belt_run.position[:, 0], abs=0.1)


@pytest.mark.parametrize(
    ("mode", "has_position_demand", "demand"),
    [
        ("pp", True, None),
        ("pv", False, 0.5 * 4000.0 * np.pi / 30),  # half of the rated speed
        ("csv", False, 0.5 * 4000.0 * np.pi / 30),
        ("cst", False, None),
    ],
)
def test_demands_of_each_mode(mode, has_position_demand, demand):
    run = perform(Demonstration(load="inertia", mode=mode))
    moving = run.t > 0.06
    assert np.isfinite(run.position_demand[moving]).all() == has_position_demand
    assert np.isfinite(run.current_demand[moving]).all() == (mode == "cst")
    if demand is not None:
        assert np.nanmax(run.velocity_demand) == pytest.approx(demand, rel=1e-3)
        assert run.velocity.max() == pytest.approx(demand, rel=0.2)
    if mode == "cst":
        assert np.nanmax(run.current_demand) == pytest.approx(0.7)  # A, a fifth of the rated current
        assert not run.load_torque.any(), "nothing would hold against a load"


def test_given_setpoints_load_and_objects_rule(tmp_path):
    config = tmp_path / "run.toml"
    config.write_text(
        'load = "inertia"\nmode = "pv"\nsetpoints = [300, [-300.0]]\nload_torque = 0\nhold = 0.05\n'
        '[objects]\n"Profile acceleration" = 10000000\n[picture]\nslow = 2\n'
    )
    row = load_demonstration(config, seed=3)
    assert (row.seed, row.load, row.picture.slow, row.setpoints) == (3, "inertia", 2.0, (300.0, (-300.0,)))
    run = perform(row)
    assert [text for _, text in run.events] == ["enable", "pv: to 300 rpm", "pv: to -300 rpm"]
    rise = np.nanmax(np.diff(run.velocity_demand[:, 0])) / 1e-3
    assert rise == pytest.approx(1e7 / 65536 * 2 * np.pi, rel=0.02)


def test_shipped_run_is_the_default():
    assert load_demonstration() == Demonstration()


def test_a_fault_is_filmed_with_its_cause():
    run = perform(Demonstration(load="inertia", objects={"Following error window": 100}))
    assert "following error" in run.events[-1][1]
    assert run.t[-1] - run.events[-1][0] == pytest.approx(0.2, abs=2e-3)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('mode = "hm"', "mode = 'hm' cannot be filmed; there are pp, pv, csv, cst"),
        ("speed = 3", "key 'speed' is unknown; there are device, motor"),
        ("seed = -1", "seed = -1 lies outside"),
        ("hold = 0.0005", "hold = 0.0005 s must be whole milliseconds"),
        ("seed = true", "seed = True must be a whole number"),
        ("setpoints = 3", "setpoints = 3 must be an array"),
        ("setpoints = [nan]", "nan is not a finite number"),
        ("[objects]\nx = 1.5", "objects: x = 1.5 is not a whole number"),
        ("[picture]\nwidth = 641", "width = 641 pixels must be an even number within 640...4096"),
        ("[picture]\nslow = 0", "slow = 0 lies outside 0.1...1000"),
        ("x", "is not valid TOML"),
    ],
)
def test_mistakes_in_the_run_are_told(tmp_path, text, says):
    config = tmp_path / "run.toml"
    config.write_text(text)
    with pytest.raises(DemonstrationError) as error:
        load_demonstration(config)
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("row", "says"),
    [
        (Demonstration(load="lorry"), "no load is named 'lorry'"),
        (Demonstration(load="inertia", setpoints=((1.0, 2.0),)), "has 2 numbers; load 'inertia' has 1 axes"),
        (Demonstration(load="inertia", objects={"Statusword": 1}), "the drive refuses the run"),
    ],
)
def test_mistakes_that_the_drive_finds_are_told(row, says):
    with pytest.raises(DemonstrationError) as error:
        perform(row)
    assert says in str(error.value)


@pytest.mark.every(4)
@pytest.mark.parametrize(
    ("travel", "switches", "expected"),
    [
        ((), (), FREE),
        ((None, None, (-0.05, 0.15)), (), [*FREE[:2], (-0.05, 0.15)]),
        ((), (Switch("left", 0, -9.0, -2.0), Switch("right", 0, 3.0, 9.0)), [(-2.0, 3.0), *FREE[1:]]),
        ((), (Switch("home", 0, -1.0, 1.0),), FREE),
    ],
)
def test_travel_ends_at_range_end_stop_and_limit_switch(arm, travel, switches, expected):
    found = way(one(dataclasses.replace(arm, travel=travel, switches=switches)))
    ends = np.sort(np.array(expected) * np.array(arm.gears)[:, None], axis=1)
    assert np.stack([found.low, found.high], -1) == pytest.approx(ends)


# --- the recorder -----------------------------------------------------------------------------------------------------
def test_recording_changes_nothing():
    with EmulatedDrives(load="belt", num_machines=2, randomise=True) as plain:
        motion.enable(plain, mode="pp")
        motion.move_to(plain, [50_000, -20_000])
        with EmulatedDrives(load="belt", num_machines=2, randomise=True) as drives:
            recorder = Recorder(drives, machine=1)
            motion.enable(recorder, mode="pp")
            motion.move_to(recorder, [50_000, -20_000])
            run = recorder.recording()
            assert (drives.read(0x6064) == plain.read(0x6064)).all()
            assert (drives.machine.joint_positions == plain.machine.joint_positions).all()
            assert run.position[-1, 0] == pytest.approx(-20_000 / 65536 * 2 * np.pi, rel=0.02)
            assert run.joints[-1, 0] * run.gears[0] == pytest.approx(run.position[-1, 0], rel=0.02)


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (lambda drives: Recorder(drives, 1), "there is no machine 1; there are 0...0"),
        (lambda drives: Recorder(drives).recording(), "nothing was recorded"),
        (lambda drives: Recorder(drives).advance(0.0015), "not a whole number of communication cycles"),
    ],
)
def test_mistakes_in_recording_are_told(axis, mistake, says):
    with pytest.raises(ValueError, match=says):
        mistake(axis)


# --- the machine ------------------------------------------------------------------------------------------------------
@pytest.mark.every(3)
@needs_gl
@pytest.mark.parametrize("load", ["inertia", "two_mass", "belt"])  # those with orange parts
def test_machine_fills_its_picture_and_stays_inside(load):
    run = a_recording(LOADS[load], joints=load_model(LOADS[load].mjcf).nq)
    with Scene(LOADS[load].mjcf, 300, 300, run.joints) as scene:
        images = np.stack([scene.draw(joints) for joints in run.joints[:120:20]]).astype(int)
    floor = images[0, 5, 5]
    machine = (np.abs(images - floor).max(-1) > 60).any(0)
    rows, columns = np.nonzero(machine)
    assert max(np.ptp(rows), np.ptp(columns)) > 150, "small parts are shown large"
    seen = orange(images[-1].astype(np.uint8))
    assert len(seen[0]) > 30
    assert min(seen[0].min(), seen[1].min()) > 3
    assert max(seen[0].max(), seen[1].max()) < 296


@needs_gl
def test_carriage_is_drawn_where_it_is():
    ends = [[-0.2, 0.0], [0.2, 0.0]]
    with Scene(LOADS["belt"].mjcf, 400, 300, ends) as scene:
        at = [orange(scene.draw([x, 0.0]))[1].mean() for x in (-0.2, 0.0, 0.2)]
        stretched = orange(scene.draw([0.1, 0.1]))[1].mean()
    assert abs(at[2] - at[0]) > 150
    assert at[0] < at[1] < at[2], "x points to the right"
    assert stretched == pytest.approx(at[2], abs=0.5), "both joints move the carriage"


@needs_gl
def test_up_is_up(arm):
    with Scene(arm.mjcf, 200, 200) as scene:
        low, high = (orange(scene.draw([0.0, 0.0, lifted]))[0].mean() for lifted in (0.1, 0.2))
    assert high < low - 5, "rows count from above"


@pytest.mark.slow
@needs_gl
def test_scenes_do_not_disturb_each_other(arm):
    with Scene(LOADS["belt"].mjcf, 200, 160) as one:
        alone = one.draw([0.1, 0.0])
        with Scene(arm.mjcf, 320, 240) as other:
            drawn = other.draw([0.0, 0.5, 0.1])
            assert alike(one.draw([0.1, 0.0]), alone)
            assert alike(other.draw([0.0, 0.5, 0.1]), drawn)
        assert alike(one.draw([0.1, 0.0]), alone)


@needs_gl
def test_mistakes_in_what_is_drawn_are_told(tmp_path):
    path = tmp_path / "bare.xml"
    path.write_text('<mujoco><worldbody><body><joint name="a"/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>'
                    "</body></worldbody></mujoco>")  # fmt: skip
    with pytest.raises(ValueError, match="no geom that can be seen"):
        Scene(path)
    with Scene(LOADS["belt"].mjcf, 100, 100) as scene, pytest.raises(ValueError, match="has 2 joint coordinates"):
        scene.draw([0.0])


# --- the scope --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("load", "axes", "unit", "end"),
    [
        ("inertia", 1, "°", np.degrees(10.0)),
        ("belt", 1, "mm", 10.0 * 6.366),  # 40 mm per turn
    ],
)
def test_positions_are_those_of_the_load(load, axes, unit, end):
    position, velocity, current = panels(a_recording(LOADS[load], axes=axes))
    assert position.unit == unit
    assert position.actual.max() == pytest.approx(end, rel=1e-4)
    assert (velocity.unit, velocity.actual.max()) == ("rpm", pytest.approx(100 * 30 / np.pi))
    assert (current.unit, current.actual.max()) == ("A", 10.0)


def test_positions_of_hinges_and_slides_together_are_motor_turns(arm):
    position = panels(a_recording(arm, joints=3, axes=3))[0]
    assert (position.unit, position.actual.max()) == ("turns", pytest.approx(10 / (2 * np.pi)))


def test_traces_appear_up_to_the_time_and_no_further():
    scope = ScopePicture(a_recording(LOADS["belt"]), 320, 300)
    empty, half, full = (scope.until(t).astype(int) for t in (0.0, 0.2, 0.4))
    trace = np.abs(full - empty).max(-1) > 60
    columns = np.flatnonzero(trace.any(0))
    shown = np.flatnonzero((np.abs(half - empty).max(-1) > 60).any(0))
    assert np.ptp(shown) == pytest.approx(0.5 * np.ptp(columns), abs=3)
    middle = shown.max()
    assert (half[:, : middle - 1] == full[:, : middle - 1])[:, columns.min() + 3 :].all()
    assert (half[:, middle + 2 :] == empty[:, middle + 2 :]).all()


@pytest.mark.every(9)
@pytest.mark.parametrize(("width", "height", "scale"), [(480, 506, 1.0), (320, 337, 0.67), (960, 1012, 2.0)])
@pytest.mark.parametrize("axes", [1, 6, 8])
def test_nothing_of_the_scope_is_cut_off(width, height, scale, axes):
    load = dataclasses.replace(LOADS["inertia"], gear=1e-3)
    run = a_recording(load, joints=1, axes=axes)
    image = ScopePicture(run, width, height, scale).until(0.4)
    for edge in (image[0], image[-1], image[:, 0], image[:, -1]):
        assert (edge == 255).all()


# --- the film ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("duration", "slow", "expected"),
    [
        (2.0, None, (5.0, 8)),  # 25 frames per second, five times slower: a frame every 8 ms
        (20.0, None, (1.0, 40)),
        (0.1, None, (100.0, 1)),  # never more than a frame per millisecond
        (2.0, 1.0, (1.0, 40)),
        (2.0, 0.5, (0.5, 80)),
    ],
)
def test_pace(duration, slow, expected):
    assert render.pace(duration, PictureFormat(slow=slow)) == expected


@pytest.mark.slow
@needs_gl
def test_frames_show_the_machine_beside_the_scope(belt_run):
    frames = list(render.frames(belt_run, SMALL))
    assert len(frames) == -(-len(belt_run.t) // 8)
    assert {frame.shape for frame in frames} == {(360, 640, 3)}
    assert {frame.dtype for frame in frames} == {np.dtype("uint8")}
    carriage = [orange(frame[:, :320])[1].mean() for frame in frames]
    along = [belt_run.joints[8 * k].sum() for k in range(len(frames))]
    assert np.corrcoef(carriage, along)[0, 1] ** 2 > 0.99
    blue = [((frame[:, 320:, 2].astype(int) - frame[:, 320:, 0]) > 60).sum() for frame in frames]
    assert blue[-1] > 1.5 * blue[len(blue) // 2] > 2 * blue[0]
    assert all(later >= earlier - 25 for earlier, later in pairwise(blue))  # the cursor hides a few


@pytest.mark.slow
@needs_gl
def test_a_picture_draws_any_machine_again_and_again(arm):
    run = a_recording(arm, joints=3, axes=3)
    with render.Picture(arm, SMALL) as picture:
        first, last = picture.frame(run, 0), picture.frame(run)
        assert first.shape == (360, 640, 3)
        assert (first != last).any()
        assert alike(picture.frame(run, 0), first)


@pytest.mark.slow
@needs_gl
@pytest.mark.parametrize("name", ["run.gif", "run.webp", "run.apng", "run.png"])
def test_animations_last_as_long_as_they_tell(tmp_path, name):
    run = a_recording(LOADS["inertia"], joints=1)
    shares = []
    count = render.render_run(run, tmp_path / name, PictureFormat(640, 360, 30.0, 3.0), shares.append)
    with Image.open(tmp_path / name) as film:
        assert (film.size, film.n_frames, count) == ((640, 360), 37, 37)  # one every 11 ms of 400
        times = []
        for k in range(film.n_frames):
            film.seek(k)
            film.load()
            times.append(film.info["duration"])
    assert sum(times) == pytest.approx(37 * 33, abs=10)
    assert (len(shares), shares[-1]) == (37, 1.0)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def three_frames():
    return (np.full((36, 64, 3), shade, np.uint8) for shade in (0, 100, 200))


def test_a_folder_gets_a_sequence(tmp_path):
    write_film(tmp_path / "run", three_frames(), 0.04)
    found = sorted((tmp_path / "run").iterdir())
    assert [path.name for path in found] == ["frame_00000.png", "frame_00001.png", "frame_00002.png"]
    assert [int(np.asarray(Image.open(path)).mean()) for path in found] == [0, 100, 200]


def test_shown_times_add_up():
    assert picture_files.milliseconds(6, 0.033, 10) == [30, 40, 30, 30, 30, 40]


def fake_ffmpeg(folder, monkeypatch, body):
    program = folder / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text(f"#!{sys.executable}\nimport sys\n{body}\n")
    program.chmod(program.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setenv("PATH", str(program.parent))


posix = pytest.mark.skipif(os.name != "posix", reason="the stand-in for ffmpeg is a script with a shebang")


@posix
def test_ffmpeg_gets_the_frames(tmp_path, monkeypatch):
    fake_ffmpeg(tmp_path, monkeypatch, "open(sys.argv[-1], 'wb').write(' '.join(sys.argv).encode() + "
                                       "b' got %d' % len(sys.stdin.buffer.read()))")  # fmt: skip
    write_film(tmp_path / "run.mp4", three_frames(), 0.04)
    text = (tmp_path / "run.mp4").read_text()
    assert "-s 64x36 -r 25.000000" in text
    assert text.endswith(f"got {3 * 64 * 36 * 3}")


@posix
def test_what_ffmpeg_says_is_told_and_nothing_is_left(tmp_path, monkeypatch):
    fake_ffmpeg(tmp_path, monkeypatch, "sys.exit('no encoder')")
    with pytest.raises(PictureFileError, match=r"ffmpeg could not write the film: no encoder; use \.webp"):
        write_film(tmp_path / "run.mp4", three_frames(), 0.04)
    assert [path.name for path in tmp_path.iterdir()] == ["bin"]


@pytest.mark.parametrize("name", ["run.gif", "run"])
def test_a_film_broken_off_leaves_nothing(tmp_path, name):
    def broken():
        yield from three_frames()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(tmp_path / name, broken(), 0.04)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("run.avi", r"no film ends in .avi; use one of .gif, .webp, .apng, .png, .mp4"),
        ("run.mp4", "an MP4 needs the program ffmpeg, which is not on PATH; install it, or use .webp"),
        ("full", "exists already; give a folder that is new or empty"),
        ("folder.gif", "is a folder; give a name that is free"),
        ("nowhere/run.gif", "does not exist; create it"),
    ],
)
def test_where_no_film_can_go_is_told(tmp_path, monkeypatch, name, says):
    monkeypatch.setenv("PATH", "")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "frame.png").touch()
    (tmp_path / "folder.gif").mkdir()
    with pytest.raises(PictureFileError) as error:
        write_film(tmp_path / name, three_frames(), 0.04)
    assert says in str(error.value)


# --- where nothing can be drawn ---------------------------------------------------------------------------------------
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems have one OpenGL only")


@linux
@pytest.mark.parametrize(
    ("asked", "display", "library", "says"),
    [
        (None, None, "egl", ""),
        (None, ":0", "glfw", ""),
        ("EGL", None, "egl", ""),
        ("osmesa", ":0", "osmesa", ""),
        ("glfw", ":0", "glfw", ""),
        ("glfw", None, "", "MUJOCO_GL=glfw needs a display and there is none; set MUJOCO_GL=egl or MUJOCO_GL=osmesa"),
        ("off", None, "", "MUJOCO_GL=off switches drawing off; unset it"),
        (
            "vulkan",
            None,
            "",
            "MUJOCO_GL=vulkan is not an OpenGL platform of this system; set it to one of glfw, glx, egl, osmesa",
        ),
    ],
)
def test_which_opengl_draws(monkeypatch, asked, display, library, says):
    for name, value in (("MUJOCO_GL", asked), ("DISPLAY", display), ("WAYLAND_DISPLAY", None)):
        monkeypatch.delenv(name, raising=False)
        if value is not None:
            monkeypatch.setenv(name, value)
    if says:
        with pytest.raises(OpenGLError) as error:
            opengl.choose_library()
        assert says in str(error.value)
    else:
        assert opengl.choose_library() == library


@pytest.fixture
def command():
    """Call `drive-env render` and return what it ended with."""
    app = typer.Typer()
    app.callback()(lambda: None)
    app.command("render")(render_command)
    return lambda *words: CliRunner().invoke(app, ["render", *map(str, words)])


@pytest.fixture
def no_display(monkeypatch):
    if not sys.platform.startswith("linux"):
        pytest.skip("this system always has a display")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


def test_missing_opengl_is_one_line_with_the_remedy(command, no_display, monkeypatch, tmp_path):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setitem(opengl._LIBRARIES["linux"], "osmesa", "mujoco.not_installed")
    result = command("--load", "inertia", "--out", tmp_path / "run.gif")
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert "no picture can be drawn with MUJOCO_GL=osmesa" in result.stderr
    assert "set MUJOCO_GL=egl, and install its library" in result.stderr


def test_viewer_without_display_is_refused(command, no_display, belt_run):
    result = command("--view")
    assert result.exit_code == 2
    assert "--view needs a display and there is none" in result.stderr
    assert result.stderr.count("\n") == 1
    with pytest.raises(OpenGLError, match="the viewer needs a display and there is none"):
        render.view(belt_run)


@needs_gl
def test_viewer_plays_the_run(monkeypatch, belt_run):
    import mujoco.viewer

    shown = []

    class Window:
        cam = mujoco.MjvCamera()

        def __init__(self, model, data, **_):
            self.data = data

        def is_running(self):
            return len(shown) < 3

        def sync(self):
            shown.append(self.data.qpos.copy())

        def lock(self):
            return self

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

    clock = iter([10.0, 10.0, 10.2, 11.0])
    monkeypatch.setattr(render, "has_display", lambda: True)
    monkeypatch.setattr(render.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(render.time, "sleep", lambda _: None)
    monkeypatch.setattr(mujoco.viewer, "launch_passive", Window)
    render.view(belt_run, slow=2.0)
    assert np.array(shown) == pytest.approx(belt_run.joints[[0, 100, 500]])


# --- the command ------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@needs_gl
def test_command_films_and_tells_what_happened(command, tmp_path):
    config = tmp_path / "run.toml"
    config.write_text('load = "belt"\nhold = 0.02\nload_time = 0.05\n[picture]\nwidth = 640\nheight = 360\n')
    out = tmp_path / "run.gif"
    result = command("--config", config, "--load", "inertia", "--slow", 1, "--out", out)
    assert result.exit_code == 0, result.output
    assert "pp: to 1 turns" in result.stdout
    assert "load pushes with -0.0375 N·m" in result.stdout
    assert f"written to {out}" in result.stdout.replace("\n", "")
    with Image.open(out) as film:
        assert film.size == (640, 360)


def test_shown_config_is_the_run_with_its_overrides(command, tmp_path):
    result = command("--load", "belt", "--seed", 7, "--show-config")
    config = tmp_path / "run.toml"
    config.write_text(result.stdout)
    assert load_demonstration(config) == Demonstration(load="belt", seed=7)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--load", "lorry", "--out", "run.gif"), "no load is named 'lorry'; there are"),
        (("--out", "run.avi"), "no film ends in .avi"),
        (("--config", "none.toml"), "cannot read the run none.toml"),
        (("--slow", "0"), "slow = 0 lies outside 0.1...1000"),
    ],
)
@needs_gl
def test_mistakes_are_one_line_and_exit_code_2(command, monkeypatch, tmp_path, words, says):
    monkeypatch.chdir(tmp_path)
    result = command(*words)
    assert result.exit_code == 2
    assert says in result.stderr
    assert result.stderr.count("\n") == 1
    assert not list(Path().iterdir())
