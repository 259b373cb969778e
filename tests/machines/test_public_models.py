"""Models in the layouts of public collections: each runs with drives on its joints, or is refused by the sentence.

The files of data/public_layouts are written for this test, in the manner of Gymnasium, the MuJoCo Menagerie, dm_control
and ROS packages.
"""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rigs import ROOT, TESTS
from typer.testing import CliRunner

from drive_env import EmulatedDrives, motion
from drive_env.commands.cli import app
from drive_env.devices import find_device
from drive_env.devices.gains import small_time_constants
from drive_env.emulator.sizing import LEADS, MARGIN, RATIOS, axis_proposal, demand, propose_drives
from drive_env.motors import find_motor
from mechanics import Load
from mechanics.joint_loads import JointLoad, Range, joint_loads
from mechanics.loads import find_load
from mechanics.model import compile_packed, read_model, with_motors
from mechanics.packed import PackedLoad
from mechanics.shaft import shaft_load
from tuning.auto.one_button import auto
from tuning.target import emulated

pytestmark = [pytest.mark.usefixtures("files_read_here"), pytest.mark.filterwarnings("ignore::UserWarning")]

LAYOUTS = TESTS / "data" / "public_layouts"
SCARA = ROOT / "examples" / "models" / "scara.xml"
NO_ACTUATOR = "no actuator of the file turns it: name it"
# File -> its joints: "" where a drive can be, else what is said.
JOINTS = {
    "pusher.xml": {"pan": "", "lift": "", "flex": "", "object_x": NO_ACTUATOR, "object_y": NO_ACTUATOR},
    "reacher.xml": {"joint0": "", "joint1": "", "target_x": NO_ACTUATOR},
    "so_arm.xml": {"Rotation": "", "Pitch": "", "Jaw": ""},
    "ur.xml": {"pan": "", "lift": "", "elbow": ""},
    "franka.xml": {
        "joint1": "", "joint2": "", "joint4": "",
        "finger_joint1": "it follows 'finger_joint2' by the equality 0: a drive on that one moves both",
        "finger_joint2": "the tendon 'split' pulls it",
    },
    "unitree.xml": {"joint1": "", "joint2": ""},
    "cartpole.xml": {"slider": "", "hinge_1": NO_ACTUATOR},
    "tendon_pendulum.xml": {"slider": "the tendon 'rope' pulls it", "hinge": NO_ACTUATOR},
    "mobile_base.xml": {
        "root": "a free joint moves in six directions", "left": "", "right": "", "caster": "a ball joint turns about",
    },
    "arm.urdf": {"shoulder": "", "elbow": "", "locked": "its range is 0 to 0, where nothing turns"},
}  # fmt: skip
RUN = [name for name in JOINTS if name not in ("tendon_pendulum.xml", "mobile_base.xml")]
TMCM1636 = find_device("tmcm1636")


@pytest.fixture
def ours(monkeypatch, tmp_path):
    """Let files of a folder count as ours: compiled here, in no process of its own."""
    monkeypatch.setattr("mechanics.model.MODELS", tmp_path)
    return tmp_path


@pytest.fixture
def layouts(monkeypatch):
    monkeypatch.setattr("mechanics.model.MODELS", LAYOUTS)
    return LAYOUTS


def run(*arguments):
    result = CliRunner().invoke(app, ["model", *(str(argument) for argument in arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


# --- the ten layouts --------------------------------------------------------------------------------------------------
@pytest.mark.every(3)
@pytest.mark.parametrize("name", JOINTS)
def test_every_joint_is_driven_or_refused_by_its_reason(name, layouts):
    found = {row.name: row for row in joint_loads(Load(layouts / name))}
    assert list(found) == list(JOINTS[name])
    for joint, says in JOINTS[name].items():
        refusal = found[joint].refusal
        assert refusal.startswith(says) if says else not refusal, joint
        assert math.isnan(found[joint].inertia.high) == bool(says)


@pytest.mark.every(27)
@pytest.mark.parametrize("name", RUN)
def test_what_is_proposed_is_written_and_moves_its_axes(name, tmp_path, monkeypatch):
    """The whole way of a user: file, proposal, the folder that is written, drives that turn its joints."""
    out = tmp_path / "machine"
    code, text, _ = run(LAYOUTS / name, "--out", out, "--json")
    told = json.loads(text)
    assert (code, told["fits"], told["folder"]) == (0, True, str(out))
    axes = [row for row in told["joints"] if "gear" in row]
    model = out / f"{Path(name).stem}.xml"
    monkeypatch.setattr("mechanics.model.MODELS", out)
    load = find_load(model)
    assert list(load.joints) == [row["joint"] for row in axes] == [k for k, says in JOINTS[name].items() if not says]
    assert load.gears == pytest.approx([row["gear"] for row in axes], rel=1e-5)
    assert all(row["torque_margin"] >= MARGIN and row["speed_margin"] >= MARGIN for row in axes)
    with EmulatedDrives(load=model, motor=told["motor"], num_threads=1) as drives:
        motion.enable(drives, mode="pp")
        dofs = [[str(j) for j in joint_names(model)].index(joint) for joint in load.joints]
        before = drives.machine.joint_positions[0, dofs]
        way = np.array([0.05 if row["kind"] == "hinge" else 0.02 for row in axes])  # rad or m
        way *= [-1.0 if middle(row) < at else 1.0 for row, at in zip(axes, before, strict=True)]
        rotor = np.round(way * load.gears / (2.0 * np.pi) * 65536).astype(int)
        motion.move_to(drives, drives.read(0x6064) + rotor)
        drives.advance(0.3)
        moved = drives.machine.joint_positions[0, dofs] - before
        assert moved == pytest.approx(way, rel=0.05)
        motion.disable(drives)


def joint_names(model):
    loaded = read_model(Load(model))
    return [loaded.joint(k).name for k in range(loaded.njnt)]


def middle(row):
    return sum(row["range"]) / 2.0 if row["range"] else math.inf


@pytest.mark.every(2)
@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("tendon_pendulum.xml", "has no joint that a drive can turn; slider: the tendon 'rope' pulls it, and how"),
        ("mobile_base.xml", "has free or ball joints ('root', 'caster'); .*take a free joint out, so that its body"),
    ],
)
def test_what_cannot_run_is_refused_in_one_line_and_nothing_is_written(name, says, tmp_path):
    import re

    code, out, error = run(LAYOUTS / name, "--out", tmp_path / "machine")
    assert (code, out) == (2, "") and re.search(says.replace("(", r"\(").replace(")", r"\)"), error), error
    assert error.count("\n") == 1 and not (tmp_path / "machine").exists()


def test_without_its_free_joint_the_mobile_base_turns_its_wheels(ours):
    text = (LAYOUTS / "mobile_base.xml").read_text()
    for taken in ('<freejoint name="root"/>', '<joint name="caster" type="ball"/>'):
        assert taken in text
        text = text.replace(taken, "")
    (ours / "base.xml").write_text(text)
    assert find_load(ours / "base.xml").joints == ("left", "right")


# --- inertia from shapes that are only seen ---------------------------------------------------------------------------
SEEN = """<mujoco>{compiler}<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1 1 1 1"/></asset>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="arm"><joint name="axle" axis="0 0 1"/>{inertial}
    <geom type="{shape}" {size} pos=".1 .02 .3" group="2"/><geom size=".05" pos=".3 0 0" group="1" mass="1"/>
    <body name="tip" pos=".5 0 0"><geom size=".1" group="2"/></body></body></worldbody></mujoco>"""
COMPILERS = ["", '<compiler inertiafromgeom="true"/>', '<compiler inertiagrouprange="2 2"/>',
             '<compiler inertiafromgeom="true" inertiagrouprange="1 1"/>', '<compiler settotalmass="5"/>',
             '<compiler boundmass="3" boundinertia="1" balanceinertia="true"/>']  # fmt: skip
ARRAYS = ("body_mass", "body_inertia", "body_ipos", "body_iquat")


@pytest.mark.every(7)
@pytest.mark.parametrize("inertial", ["", '<inertial pos="0 .1 0" mass="2" diaginertia=".1 .1 .1"/>'])
@pytest.mark.parametrize(("shape", "size"), [("box", 'size=".1 .2 .3"'), ("mesh", 'mesh="m"')])
@pytest.mark.parametrize("compiler", COMPILERS)
def test_copies_and_what_is_written_have_the_inertia_of_the_file(compiler, shape, size, inertial, ours):
    """Shapes that are only seen are left out of copies; MuJoCo refused that, or made other masses of it."""
    (ours / "m.xml").write_text(SEEN.format(compiler=compiler, shape=shape, size=size, inertial=inertial))
    load = find_load(ours / "m.xml")
    alone, packed = mujoco.MjModel.from_xml_path(str(ours / "m.xml")), compile_packed(load, 8)
    (ours / "written.xml").write_text(with_motors(load, {"axle": 30.0}))
    written = read_model(Load(ours / "written.xml"))
    assert find_load(ours / "written.xml").gears == (30.0,)
    for name in ARRAYS:
        one = getattr(alone, name)[1:]
        copies = getattr(packed, name)[1:].reshape(8, *one.shape)
        assert np.array_equal(copies, np.broadcast_to(one, copies.shape)), name
        assert getattr(written, name)[1:] == pytest.approx(one, rel=1e-5, abs=1e-6), name
    assert packed.ngeom == 0  # no copy carries what is only seen


# --- numbers of the proposal, against closed forms --------------------------------------------------------------------
ONE, TWO = (0.7, 0.25, 0.4, 3.1e-3), (0.5, 0.15, 0.3, 1.9e-3)  # mass, centre of mass, length, inertia about it
ARM = """<mujoco><compiler angle="radian"/><worldbody><body>
  <joint name="shoulder" axis="0 1 0" armature="0.2" damping="0.3" frictionloss="0.1"{limits}/>
  <inertial pos="{a[1]} 0 0" mass="{a[0]}" diaginertia="1e-3 {a[3]} {a[3]}"/>
  <body pos="{a[2]} 0 0"><joint name="elbow" axis="0 1 0"/>
    <inertial pos="{b[1]} 0 0" mass="{b[0]}" diaginertia="1e-3 {b[3]} {b[3]}"/></body></body></worldbody></mujoco>"""
G = 9.81


def arm(folder, limits=""):
    (folder / "arm.xml").write_text(ARM.format(a=ONE, b=TWO, limits=limits))
    return Load(folder / "arm.xml")


def test_inertia_and_holding_torque_of_a_two_link_arm_are_the_closed_form_s(ours):
    """M_11 = I_1 + m_1 c_1^2 + I_2 + m_2 (l^2 + c_2^2 + 2 l c_2 cos q_2); gravity is most when stretched out."""
    shoulder, elbow = joint_loads(arm(ours))
    (m1, c1, l1, i1), (m2, c2, _, i2) = ONE, TWO
    constant, swing = i1 + m1 * c1**2 + i2 + m2 * (l1**2 + c2**2), 2.0 * m2 * l1 * c2
    assert shoulder.inertia == pytest.approx((constant - swing, constant + swing), rel=1e-9)
    assert elbow.inertia == pytest.approx((i2 + m2 * c2**2,) * 2, rel=1e-9)
    most = G * (m1 * c1 + m2 * (l1 + c2))
    assert shoulder.holding == pytest.approx((-most, most), rel=0.01)  # poses on a grid
    assert elbow.holding == pytest.approx((-G * m2 * c2, G * m2 * c2), rel=0.01)
    assert (shoulder.friction, shoulder.damping) == (0.1, 0.3)


def test_holding_torque_is_that_within_the_range(ours):
    shoulder, _ = joint_loads(arm(ours, ' range="1.0 1.5"'))
    (m1, c1, l1, _), (m2, c2, _, _) = ONE, TWO
    # Turned down by q, the upper arm's share is m_1 c_1 cos q; the forearm adds between -1 and 1 of its own.
    expected = G * ((m1 * c1 + m2 * l1) * np.cos([1.5, 1.0]) + m2 * c2 * np.array([-1.0, 1.0]))
    assert np.sort(np.abs(shoulder.holding)) == pytest.approx(np.sort(np.abs(expected)), rel=0.02)
    assert shoulder.travel == (1.0, 1.5)


def test_the_inertia_at_the_rotor_is_what_the_plant_has_there(ours):
    """The written model in the plant of the emulator, looked at by another way."""
    found = joint_loads(arm(ours))
    proposal = propose_drives(found, TMCM1636, TMCM1636.motors.values(), 2.0)
    gears = {row.name: axis.gear for row, axis in zip(found, proposal.axes, strict=True)}
    (ours / "written.xml").write_text(with_motors(arm(ours), gears))
    J = np.full((1, 2), proposal.motor.inertia)
    seen = shaft_load(PackedLoad(find_load(ours / "written.xml"), J, np.zeros((1, 2, 4)), {}, 2e-4))
    assert seen.inertia[0] == pytest.approx([axis.inertia for axis in proposal.axes], rel=0.1)
    holding = [row.holding.high / axis.gear for row, axis in zip(found, proposal.axes, strict=True)]
    assert np.all(seen.gravity[0] <= np.array(holding) * 1.001) and seen.gravity[0] == pytest.approx(holding, rel=0.1)


def test_what_an_equality_moves_counts_at_the_joint_that_moves_it(ours):
    """Two slides of 2 kg and 0.5 kg, the second 3 times as fast: 2 + 9 x 0.5 kg and 2 g + 3 x 0.5 g."""
    text = (
        '<mujoco><worldbody><body><joint name="a" type="slide" axis="0 0 1"/><geom size=".1" mass="2"/></body>'
        '<body><joint name="b" type="slide" axis="0 0 1"/><geom size=".1" mass="0.5"/></body></worldbody>'
        '<equality><joint joint1="{}" joint2="{}" polycoef="0 {!r} 0 0 0"/></equality>'
        '<actuator><motor joint="a"/></actuator></mujoco>'
    )
    for names in (("b", "a", 3.0), ("a", "b", 1.0 / 3.0)):
        (ours / "way.xml").write_text(text.format(*names))
        a, b = joint_loads(Load(ours / "way.xml"))
        assert a.inertia == pytest.approx((6.5, 6.5)) and a.holding == pytest.approx((3.5 * G, 3.5 * G))
        assert b.refusal.startswith("it follows 'a' by the equality 0")


def test_margins_are_what_the_move_leaves():
    """A disc of 0.02 kg m^2 under 1 N m, a turn in 1 s: 9.42 rad/s, 28.3 rad/s^2; by hand with a gear of 20."""
    motor = find_motor("class_400w")
    disc = JointLoad("disc", "hinge", Range(-math.inf, math.inf), Range(0.01, 0.02), Range(-1.0, 0.4), 0.1, 0.01)
    speed, acceleration = demand(disc, 1.0)
    assert (speed, acceleration) == pytest.approx((3.0 * math.pi, 9.0 * math.pi))
    # In thirds of the time: up, along, down.
    assert acceleration / 9.0 + speed / 3.0 == pytest.approx(2.0 * math.pi)
    axis = axis_proposal(disc, TMCM1636, motor, 20.0, 1.0)
    torque = (0.02 * acceleration + 1.0 + 0.1 + 0.01 * speed) / 20.0
    torque += 2.8e-5 * 20.0 * acceleration + 0.02 + 2e-5 * 20.0 * speed
    assert axis.torque_margin == pytest.approx(TMCM1636.torque_of(motor) / torque)
    assert axis.speed_margin == pytest.approx(100.0 * math.pi / (20.0 * speed))
    assert (axis.inertia, axis.inertia_ratio) == pytest.approx((0.02 / 400.0, 0.02 / 400.0 / 2.8e-5))
    # A count of 10,000 through a low-pass of 400 Hz, damping 0.7, whose impulse response has its peak at acos(0.7) of
    # its damped oscillation, answered by J w_v: a quarter of the reciprocal sum of the lags.
    w = 2.0 * math.pi * 400.0
    t = math.acos(0.7) / (w * math.sqrt(0.51))
    peak = w / math.sqrt(0.51) * math.exp(-0.7 * w * t) * math.sin(w * math.sqrt(0.51) * t)
    bandwidth = 0.25 / float(small_time_constants(TMCM1636, 400.0))
    count = 2.0 * math.pi / 10000.0 * peak * bandwidth * (0.02 / 400.0 + 2.8e-5)
    assert axis.encoder_margin == pytest.approx(TMCM1636.torque_of(motor) / count)


def test_the_smallest_motor_that_suffices_is_proposed():
    joints = [JointLoad("lift", "slide", Range(0.0, 0.5), Range(2.0, 2.0), Range(19.6, 19.6), 1.0, 0.0)]
    motors = TMCM1636.motors.values()
    proposal = propose_drives(joints, TMCM1636, motors, 2.0)
    assert proposal.fits and 2.0 * math.pi / proposal.axes[0].gear * 1e3 == pytest.approx(min(
        LEADS, key=lambda lead: abs(lead - 2e3 * math.pi / proposal.axes[0].gear)))  # fmt: skip
    power = proposal.motor.rated_torque * proposal.motor.rated_speed
    for motor in motors:
        if motor.rated_torque * motor.rated_speed < power:
            for lead in LEADS:
                gear = 2e3 * math.pi / lead
                assert axis_proposal(joints[0], TMCM1636, motor, gear, 2.0).least_margin < MARGIN
    heavy = [joints[0]._replace(name="crane", holding=Range(0.0, 1e6))]
    lacking = propose_drives(heavy, TMCM1636, motors, 2.0)
    assert not lacking.fits and lacking.axes[0].torque_margin < 1.0
    hinge = [joints[0]._replace(kind="hinge", travel=Range(-1.0, 1.0), inertia=Range(0.01, 0.01), holding=Range(0, 1))]
    assert propose_drives(hinge, TMCM1636, motors, 2.0).axes[0].gear in RATIOS


@pytest.mark.slow
def test_auto_tunes_what_is_proposed_for_the_scara(tmp_path):
    """A motor of 2,048 counts has the torque and the speed, and no gains on which it moves and rests."""
    out = tmp_path / "scara"
    code, _, says = run(SCARA, "--motor", "qube_servo_3", "--out", out)
    assert code == 2 and "of the encoder's resolution" in says and not out.exists()
    code, text, _ = run(SCARA, "--out", out, "--json")
    told = json.loads(text)
    assert code == 0 and all(joint["encoder_margin"] >= MARGIN for joint in told["joints"])
    with emulated(load=out / "scara.xml", motor=told["motor"], num_threads=1) as target:
        result = auto(target, tmp_path / "before.toml")
    assert [axis.accepted for axis in result.axes] == [True, True], [axis.reason for axis in result.axes]


# --- other joints that no drive can turn ------------------------------------------------------------------------------
BODY = (
    '<body name="{name}"><joint name="{name}" axis="0 0 1" {of}/>'
    '<inertial pos="0 0 0" mass="1" diaginertia="{i} {i} {i}"/></body>'
)


@pytest.mark.parametrize(
    ("more", "of", "inertia", "says"),
    [
        ("", 'range="0.5 0.5"', 1.0, "its range is 0.5 to 0.5, where nothing turns"),
        ("", 'range="0 0"', 1.0, "its range is 0 to 0, where nothing turns"),
        ("", 'armature="0.1"', 1e-14, "what it turns has no inertia about it"),
        ('<equality><joint name="lock" joint1="a"/></equality>', "", 1.0,
         "the equality 'lock' with polycoef 0 1 0 0 0 holds it where it is"),
        ('<equality><joint joint1="a" joint2="b" polycoef="0.1 0 0 0 0"/></equality>', "", 1.0,
         "the equality 0 with polycoef 0.1 0 0 0 0 holds it where it is"),
        ('<equality><connect body1="a" body2="b" anchor="1 0 0"/></equality>', "", 1.0,
         "its body is in a loop that the equality 0 closes"),
        ('<tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="0"/></fixed></tendon>'
         '<actuator><motor tendon="t"/></actuator>', "", 1.0, "the tendon 't' pulls it"),
    ],
)  # fmt: skip
def test_a_joint_that_no_drive_can_turn_says_why(more, of, inertia, says, ours):
    bodies = BODY.format(name="a", of=of, i=inertia) + BODY.format(name="b", of="", i=1.0)
    (ours / "m.xml").write_text(f"<mujoco><worldbody>{bodies}</worldbody>{more}</mujoco>")
    a, b = joint_loads(Load(ours / "m.xml"))
    assert a.refusal.startswith(says), a.refusal
    if "connect" not in more:
        assert not b.refusal or b.refusal.startswith(NO_ACTUATOR)
        assert not joint_loads(Load(ours / "m.xml"), ["b"])[1].refusal


def test_joints_without_a_name_are_each_refused(ours):
    bodies = BODY.replace('<joint name="{name}"', "<joint").format(name="a", of="", i=1.0)
    (ours / "m.xml").write_text(
        f'<mujoco><worldbody>{bodies}<body><freejoint/><geom size="1"/></body></worldbody></mujoco>'
    )
    hinge, free = joint_loads(Load(ours / "m.xml"))
    assert hinge.refusal.startswith("it has no name") and free.refusal.startswith("a free joint")


# --- the command ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["two_mass"], "two_mass has its joints and gears; give the file of a model, or a log of its move with --log"),
        (["arm.txt"], "arm.txt is no model: give an MJCF or URDF file, which ends with .xml, .mjcf, .urdf"),
        (["none.xml"], "there is no model file 'none.xml'"),
        ([LAYOUTS / "ur.xml", "--joint", "pam"], "has no joint 'pam'; did you mean 'pan'"),
        ([LAYOUTS / "mobile_base.xml", "--joint", "root"], "root: a free joint moves in six directions"),
        ([LAYOUTS / "ur.xml", "--move-time", "0"], "--move-time 0 s must be above 0 s"),
        ([LAYOUTS / "ur.xml", "--fit", "load.mass"], "--fit is for the comparison with a log; name it with --log"),
        ([LAYOUTS / "ur.xml", "--out", LAYOUTS], "exists already, and is not overwritten; choose another folder"),
        ([LAYOUTS / "ur.xml", "--motor", "class_20w", "--out", "made"], "no motor of tmcm1636 moves every joint of"),
        ([LAYOUTS / "ur.xml", "--motor", "qsh4218_51"], "tmcm1636 turns"),
    ],
)
def test_a_mistake_is_one_line(arguments, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, error = run(*arguments)
    assert (code, out) == (2, "") and says in error and error.count("\n") == 1, error
    assert not any(tmp_path.iterdir())


def test_the_table_names_joints_motor_and_what_to_run(tmp_path):
    code, text, _ = run(LAYOUTS / "cartpole.xml", "--out", tmp_path / "cart")
    assert code == 0
    for part in ("slider", "-1.8...1.8 m", "1.1 kg", "mm/turn", "hinge_1: no drive: no actuator of the file turns it"):
        assert part in text, part
    assert f"drive-env serve tmcm1636 --load {tmp_path / 'cart' / 'cartpole.xml'} --motor " in text.replace("\n", " ")


def test_a_folder_that_cannot_be_read_back_is_not_left(tmp_path, monkeypatch):
    def refuse(path):
        raise ValueError("no")

    monkeypatch.setattr("mechanics.loads.find_load", refuse)
    assert run(LAYOUTS / "unitree.xml", "--out", tmp_path / "arm")[0] == 2
    assert not (tmp_path / "arm").exists()


def test_meshes_that_a_urdf_only_shows_need_not_be_there(tmp_path):
    shutil.copy(LAYOUTS / "arm.urdf", tmp_path)
    assert find_load(Load(tmp_path / "arm.urdf", joints=("shoulder",))).joints == ("shoulder",)
    text = (tmp_path / "arm.urdf").read_text()
    (tmp_path / "arm.urdf").write_text(text.replace("<visual>", "<collision>").replace("</visual>", "</collision>"))
    with pytest.raises(ValueError, match="MuJoCo knows no packages: write where the file lies"):
        find_load(Load(tmp_path / "arm.urdf", joints=("shoulder",)))
