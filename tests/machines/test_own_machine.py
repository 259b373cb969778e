"""Your own machine: a MuJoCo model, a mapping of its joints to drives, and errors that name what there is."""

import os
import subprocess
import sys

import numpy as np
import pytest
from rigs import ROOT
from rigs.stepped_load import stepped

from drive_env import EmulatedDrives, motion
from mechanics import Contact, Friction, Load, Parameter
from mechanics.loads import find_load
from mechanics.model import CONSTRAINED_PACKING_BOUND, compile_packed, copies_per_model, is_constrained, read_model
from mechanics.packed import PackedLoad

pytestmark = pytest.mark.filterwarnings("ignore::drive_env.emulator.inertia_check.MisfitWarning")

EXAMPLES = ROOT / "examples"
TURN = 65536
H = 200e-6
J_M = 4.8e-6

PLAIN = """
<mujoco model="plain">
  <worldbody><body>
    <joint name="axle" type="hinge" axis="0 0 1" armature="7" frictionloss="0.002"/>
    <inertial pos="0 0 0" mass="0.1" diaginertia="2e-3 2e-3 2e-3"/>
  </body></worldbody>
</mujoco>
"""

TWO = """
<mujoco model="two">
  <option gravity="0 0 0"/>
  <worldbody>
    <site name="a" pos="0 1 0"/>
    <body name="slider">
      <joint name="x" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="1.5" diaginertia="1e-3 1e-3 1e-3"/>
      <site name="b"/>
      <body name="table">
        <joint name="turn" type="hinge" axis="0 0 1"/>
        <inertial pos="0 0 0" mass="0.5" diaginertia="2e-3 2e-3 2e-3"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="belt" armature="5"><joint joint="x" coef="1"/><joint joint="turn" coef="0.1"/></fixed>
    <spatial name="rope"><site site="a"/><site site="b"/></spatial>
  </tendon>
  ACTUATORS
  <keyframe><key name="home" qpos="0.2 0.3"/></keyframe>
</mujoco>
"""

LIMITS = """
<mujoco model="limits">
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -0.28"/>
    <body name="upper">
      <joint name="shoulder" type="hinge" axis="0 1 0" limited="true" range="-60 60"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01" mass="0.3" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -0.2">
        <joint name="elbow" type="hinge" axis="0 1 0" limited="true" range="-90 90"/>
        <geom name="tip" type="sphere" pos="0 0 -0.1" size="0.02" mass="0.1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

LOOP = """
<mujoco model="loop">
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body name="crank">
      <joint name="crank" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.05 0 0" size="0.005" mass="0.05" contype="0" conaffinity="0"/>
      <body name="rod" pos="0.05 0 0">
        <joint name="pin" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.15 0 0" size="0.005" mass="0.05" contype="0" conaffinity="0"/>
      </body>
    </body>
    <body name="piston" pos="0.2 0 0">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom type="box" size="0.02 0.02 0.02" mass="0.2" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <equality><connect body1="rod" body2="piston" anchor="0.15 0 0"/></equality>
</mujoco>
"""


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Write a model to a file and return its path. It counts as ours: compiled here, in no process of its own."""
    monkeypatch.setattr("mechanics.model.MODELS", tmp_path)

    def write(text, name="machine.xml"):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def two(actuators=""):
    return TWO.replace("ACTUATORS", f"<actuator>{actuators}</actuator>" if actuators else "")


# --- which joints -----------------------------------------------------------------------------------------------------
def test_a_path_is_enough_for_a_model_with_one_joint(file):
    path = file(PLAIN, "axle.xml")
    for load in (path, str(path), Load(path)):
        with EmulatedDrives(load=load, ideal=True, parameters={}) as drives:
            assert drives.load.name == "axle"
            assert drives.load.joints == ("axle",)
            assert drives.num_axes == 1


@pytest.mark.parametrize(
    ("actuators", "joints"),
    [
        ('<motor joint="turn"/>', ("turn",)),
        ('<motor joint="turn"/><motor joint="x"/>', ("turn", "x")),
        ('<motor tendon="belt"/><position joint="turn"/>', ("belt", "turn")),
        ('<motor joint="x"/><velocity joint="x"/>', ("x",)),
    ],
)
def test_the_model_s_actuators_say_what_is_driven(file, actuators, joints):
    assert find_load(file(two(actuators))).joints == joints
    # What is said beside the file goes before.
    assert find_load(Load(file(two(actuators)), joints="x")).joints == ("x",)


def test_an_actuator_s_gear_is_the_drive_s_unless_one_is_given(file):
    path = file(two('<motor joint="turn" gear="-20"/><motor joint="x"/>'))
    assert find_load(path).gears == (-20.0, 1.0)
    assert find_load(Load(path, gear=3.0)).gears == (3.0, 3.0)
    assert find_load(Load(path, joints=("turn",))).gears == (1.0,)


def test_zeros_are_refused_where_nothing_would_turn_and_ignored_where_others_do(file):
    """A coefficient 0 of a tendon ended in a division by it; an actuator's gear 0 was told as 1."""
    path = file(two('<motor joint="x" gear="0"/>'))
    with pytest.raises(ValueError, match=r"the gear of the actuator of 'x' is 0, and its rotor would turn nothing"):
        find_load(path)
    partly = file(
        TWO.replace("ACTUATORS", '<actuator><motor tendon="belt"/></actuator>').replace('coef="0.1"', 'coef="0"')
    )
    with EmulatedDrives(load=partly, ideal=True) as drives:
        assert drives.load.disturbance == {"x": 1.0}
        drives.advance(0.002)
    none = file(TWO.replace("ACTUATORS", "").replace('coef="0.1"', 'coef="0"').replace('coef="1"', 'coef="0"'))
    with pytest.raises(
        ValueError, match=r"every coef of the fixed tendon 'belt' is 0, and its rotor would turn nothing"
    ):
        find_load(Load(none, joints="belt"))
    for other in ('joint2="turn"', ""):
        held = file(two().replace("<tendon>", f'<equality><joint name="lock" joint1="x" {other} '
                                  'polycoef="0.1 0 0 0 0"/></equality><tendon>'))  # fmt: skip
        with pytest.raises(
            ValueError, match=r"the equality 'lock' with polycoef 0\.1 0 0 0 0 holds 'x' where it is, .*term"
        ):
            find_load(Load(held, joints="x"))
        assert find_load(Load(held, joints="turn")).joints == ("turn",)
        # Of a tendon's joints one still turns.
        assert find_load(Load(held, joints="belt")).joints == ("belt",)
    free = file(two().replace("<tendon>", '<equality><joint joint1="x" active="false"/></equality><tendon>'))
    assert find_load(Load(free, joints="x")).joints == ("x",)


@pytest.mark.parametrize(
    ("joint", "wrong"),
    [('damping="nan"', "dof_damping of the MJCF has nan"), ('damping="-1"', "dof_damping .* has -1; .*0 or more"),
     ('limited="true" range="nan 1"', "jnt_range of the MJCF has nan"), ('ref="inf"', "qpos0 of the MJCF has inf")],
)  # fmt: skip
def test_numbers_by_which_a_machine_would_be_frozen_or_run_away_are_refused(file, joint, wrong):
    path = file(two().replace('name="x"', f'name="x" {joint}', 1))
    with pytest.raises(ValueError, match=wrong):
        find_load(path)


THERE = r"the model has the joints x, turn and the fixed tendons belt"


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, rf"load 'machine' does not name the joints that its drives turn; {THERE}"),
        ({"joints": ("x", "y")}, rf"load 'machine' has no joint or fixed tendon 'y'; {THERE}"),
        ({"joints": "rope"}, rf"no joint or fixed tendon 'rope'; {THERE}"),
        ({"joints": ("x", "x")}, r"names a joint twice: x, x; a joint takes one drive"),
        ({"joints": ("x", "turn"), "gear": (1.0,)}, r"has 2 driven joints and 1 gears"),
        ({"joints": ("x", "turn"), "gear": (1.0, 0.0)}, r"the gear of 'turn' is 0, and its rotor would turn nothing"),
        ({"joints": "x", "gear": 0.0}, r"the gear of 'x' is 0, .*of 1e-09 to 1e\+09 in size"),
        ({"joints": "x", "gear": float("inf")}, r"the gear of 'x' is inf; "),
        ({"joints": "x", "gear": 1e300}, r"the gear of 'x' is 1e\+300; "),
        (
            {"joints": "x", "contacts": (Contact("stop", {"x": 0.0}, -1.0, 1.0, 1e4, 1.0),)},
            r"its contact 'stop' has 0 of 'x', which is no motion; give a joint a coefficient",
        ),
        ({"joints": "x", "positions": ({"x": float("nan")},)}, r"its position has nan of 'x'; give a finite number"),
        ({"joints": "x", "disturbance": {"z": 1.0}}, rf"its disturbance names the joint 'z'; {THERE}"),
        ({"joints": "x", "start": {"z": 1.0}}, rf"its start names the joint 'z'; {THERE}"),
        ({"joints": "x", "frictions": (Friction("guide", {"z": 1.0}),)}, rf"its friction 'guide' names .*'z'; {THERE}"),
        (
            {"joints": "x", "frictions": (Friction("nut", {"x": 1.0}, carries="teeth"),)},
            r"its friction 'nut' carries the contact 'teeth'; the contacts are \(none\)",
        ),
        (
            {"joints": "x", "contacts": (Contact("stop", {"z": 1.0}, -1.0, 1.0, 1e4, 1.0),)},
            rf"its contact 'stop' names the joint 'z'; {THERE}",
        ),
        ({"joints": "x", "positions": ({"x": 1.0}, {"x": 1.0})}, r"has 1 axes and 2 positions; give one per axis"),
        ({"joints": "x", "travel": ((0, 1), (0, 1))}, r"has 1 axes and 2 travel; give one per axis"),
    ],
)
def test_a_mapping_that_does_not_fit_is_answered_with_what_there_is(file, options, text):
    path = file(two())
    with pytest.raises(ValueError, match=text):
        EmulatedDrives(load=Load(path, **options))


@pytest.mark.parametrize(
    ("parameter", "text"),
    [
        (("tool", "kg", "body_mass", "arm"), r"'tool', a body_mass, names 'arm'; there are .*slider, table"),
        (("k", "N/m", "jnt_stiffness", "y"), r"'k', a jnt_stiffness, names 'y'; there are x, turn"),
        (("c", "N", "coulomb", "guide"), r"'c', a coulomb, names 'guide'; there are \(none\)"),
        (("m", "kg", "mass", "table"), r"'m' is not a 'mass'; there are body_mass, body_inertia"),
    ],
)
def test_a_parameter_that_lives_nowhere_is_answered_with_the_places(file, parameter, text):
    with pytest.raises(ValueError, match=text):
        EmulatedDrives(load=Load(file(two()), joints="x", parameters=(Parameter(*parameter, 0.5, 2.0, ""),)))


def test_files_that_are_no_models_are_refused(file, tmp_path):
    with pytest.raises(ValueError, match=r"there is no model file '.*missing\.xml'"):
        EmulatedDrives(load=tmp_path / "missing.xml")
    with pytest.raises(ValueError, match=r"MuJoCo cannot read '.*machine\.xml': .*XML"):
        EmulatedDrives(load=file("<mujoco><worldbody>"))
    with pytest.raises(ValueError, match=r"MuJoCo cannot (read|compile)"):
        EmulatedDrives(load=file('<mujoco><worldbody><body><joint name="a"/></body></worldbody></mujoco>'))
    with pytest.raises(ValueError, match="has no joint, so there is nothing that a drive could turn"):
        EmulatedDrives(load=file("<mujoco/>"))
    with pytest.raises(
        ValueError, match=r"no load is named 'machine'; there are .*robot.*, or give the path of an MJCF"
    ):
        EmulatedDrives(load="machine")


def test_a_body_that_flies_is_refused(file):
    flies = '<body name="b"><freejoint name="fly"/><geom size="0.1"/></body>'
    text = PLAIN.replace("</worldbody>", flies + '<body name="cube"><freejoint/><geom size="1"/></body></worldbody>')
    told = r"has free or ball joints \('fly', one of body 'cube'\).*take a free joint out.*three hinges"
    with pytest.raises(ValueError, match=told):
        EmulatedDrives(load=Load(file(text), joints="axle"))


# --- what the drives feel -------------------------------------------------------------------------------------------
def packed(load, copies=1, **options):
    load = find_load(load)
    axes = (copies, load.num_axes)
    return PackedLoad(load, np.full(axes, J_M), np.zeros((*axes, 4)), {}, H, **options)


def test_the_rotor_s_inertia_replaces_the_file_s_armature(file):
    """armature = J gear^2."""
    load = packed(Load(file(PLAIN), gear=20.0))
    assert load.mass_matrix()[0, 0, 0] == pytest.approx(2e-3 + J_M * 400, rel=1e-12)


def test_the_rotor_s_inertia_on_a_fixed_tendon(file):
    """The belt moves by x + 0.1 turn: armature J gear^2 on that motion couples the joints."""
    mass = packed(Load(file(two()), joints=("belt", "turn"), gear=(100.0, 3.0))).mass_matrix()[0]
    belt = J_M * 1e4
    expected = [[2.0 + belt, 0.1 * belt], [0.1 * belt, 2e-3 + 0.01 * belt + J_M * 9]]
    np.testing.assert_allclose(mass, expected, rtol=1e-12)


def test_a_drive_turns_a_tendon(file):
    """The rotor's angle is gear (x + 0.1 turn), from the keyframe's start on."""
    with EmulatedDrives(load=Load(file(two()), joints="belt", gear=100.0), ideal=True) as drives:
        assert drives.machine.joint_positions.tolist() == [[0.2, 0.3]]
        assert drives.machine.rotor_angle[0] == 0.0
        motion.enable(drives, mode="pp")
        motion.move_to(drives, TURN)
        drives.advance(0.2)
        x, turn = drives.machine.joint_positions[0] - [0.2, 0.3]
        assert 100.0 * (x + 0.1 * turn) == pytest.approx(2 * np.pi, rel=1e-3)
        # Torque on the belt pulls both joints by their share: M (x, turn) = F (1, 0.1).
        assert turn / x == pytest.approx((0.1 / 2e-3) / (1 / 2.0), rel=0.02)


@pytest.mark.slow
def test_friction_loss_of_the_file_is_dry_friction_of_ours(file):
    """At the joint, held and slid as friction.py says; the solver has none of it."""
    load = packed(Load(file(PLAIN)))
    assert not load.constrained
    assert np.all(load.model.dof_frictionloss == 0.0)
    assert [row.coulomb for row in load.load.frictions] == [0.002]
    assert np.all(stepped(load.plant, np.full(500, 0.0019), H).qpos == 0.0)
    moved = stepped(load.plant, np.full(500, 0.003), H).qpos[-1, 0]
    assert moved == pytest.approx(0.5 * 0.001 / (2e-3 + J_M) * 0.1**2, rel=5e-3)


def test_numbers_of_the_model_can_be_parameters(file):
    rows = (
        Parameter("payload", "kg", "body_mass", "slider", 0.5, 2.0, "of the slider"),
        Parameter("drag", "N*s/m", "dof_damping", "x", 0.5, 2.0, "of the guide"),
        Parameter("grip", "N", "coulomb", "guide", 0.0, 2.0, "of the guide"),
    )
    guide = Friction("guide", {"x": 1.0}, 0.4, 0.4)
    load = Load(file(two()), joints="x", gear=50.0, parameters=rows, frictions=(guide,))
    with EmulatedDrives(load=load, num_machines=40, randomise=("load",), parameters={"load.drag": 2.0}) as drives:
        found = drives.machine.parameters
        assert np.all((found["load.payload"] >= 0.75) & (found["load.payload"] <= 3.0))
        assert len(set(found["load.payload"])) == 40
        assert np.all(found["load.drag"] == 2.0)
        drives.machine.set("load.payload", 1.0)
        drives.machine.set("load.grip", 0.1)
        drives.machine.load_torque = 1.0
        drives.advance(0.05)
        assert not drives.machine.diverged.any()


# --- constraints ----------------------------------------------------------------------------------------------------
MODELS = {"limits and contacts": (LIMITS, ("shoulder", "elbow"), 10.0), "a loop": (LOOP, ("crank",), 5.0)}


def swing(load, chosen, copies, duration=0.6):
    """Return qpos of the chosen copies of `copies`, each driven by sines of its own, shape (n, chosen, D)."""
    axes, n = load.num_axes, round(duration / H)
    generator = np.random.default_rng(0)
    frequency, amplitude = generator.uniform((0.5, 0.006), (2.0, 0.02), (copies, axes, 2)).transpose(2, 0, 1)
    t = (np.arange(n) + 0.5) * H
    torque = (amplitude * np.sin(2 * np.pi * frequency * t[:, None, None]))[:, chosen].reshape(n, -1)
    found = packed(load, len(chosen))
    qpos = stepped(found.plant, torque, H).qpos
    assert not found.plant.diverged.any()
    return qpos.reshape(n, len(chosen), -1)


@pytest.mark.every(2)
@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("copies", [8, 32])
def test_packed_copies_with_constraints_equal_those_alone_within_the_bound(file, kind, copies):
    """Copies lie in the same place: if they touched each other, nothing would be as it is alone."""
    text, joints, gear = MODELS[kind]
    load = find_load(Load(file(text), joints=joints, gear=gear))
    assert load.packing_bound == CONSTRAINED_PACKING_BOUND
    together = swing(load, np.arange(copies), copies)
    for k in (0, 3, copies - 1):
        alone = swing(load, np.array([k]), copies)[:, 0]
        assert np.all(np.abs(together[:, k] - alone).max(0) <= load.packing_bound * np.ptp(alone, axis=0))
        assert np.ptp(alone, axis=0).min() > 0.05
    assert not np.array_equal(together[:, 0], together[:, 1])


def test_a_loop_stays_closed(file):
    """Within 3 mm, as soft as MuJoCo makes it: slide = 0.05 cos(crank) + 0.15 cos(crank + pin) - 0.2."""
    load = find_load(Load(file(LOOP), joints="crank", gear=5.0))
    crank, pin, slide = swing(load, np.arange(2), 8)[:, 1].T
    assert np.ptp(crank) > 1.0
    assert np.abs(0.05 * np.cos(crank) + 0.15 * np.cos(crank + pin) - 0.2 - slide).max() < 3e-3


def test_a_limit_of_a_joint_holds_and_is_felt_by_the_drive(file):
    """The drive is told to go to 90 degrees; the joint ends at 60, the current is at work."""
    text = LIMITS.replace("0 0 -0.28", "0 0 -0.4")  # out of reach
    load = Load(file(text), joints=("shoulder", "elbow"), gear=10.0)
    with EmulatedDrives(load=load, ideal=True) as drives:
        motion.enable(drives, mode="csp")
        ramp = np.zeros((1000, 2), int)
        ramp[:, 0] = np.round(np.linspace(0.0, 0.25 * 10 * TURN, 1000))
        trace = drives.record([0x6077], 1.0, play={0x607A: ramp})
        shoulder = np.degrees(drives.machine.joint_positions[0, 0])
    assert 59.5 < shoulder < 63.0
    assert trace[0x6077][-1, 0] == pytest.approx(7000, rel=0.01)  # mA, the drive's limit


@pytest.mark.slow
def test_a_model_holds_as_many_copies_as_there_are_contact_bits(file):
    def load(text, **options):
        return Load(file(text), joints=("shoulder", "elbow"), **options)

    assert copies_per_model(Load(file(PLAIN))) == 64
    assert copies_per_model(load(LIMITS)) == 32  # one bit
    apart = LIMITS.replace('size="0.02" mass="0.1"', 'size="0.02" mass="0.1" contype="2" conaffinity="8"')
    assert copies_per_model(load(apart)) == 8  # four bits
    far = LIMITS.replace('size="0.02" mass="0.1"', 'size="0.02" mass="0.1" contype="16"')
    with pytest.raises(ValueError, match=r"uses contact bit 4; .* it may use bits 0 to 3 of contype and conaffinity"):
        copies_per_model(load(far))


def test_every_copy_has_contact_bits_of_its_own(file):
    model = compile_packed(find_load(Load(file(LIMITS), joints=("shoulder", "elbow"))), 32)
    for name in ("floor", "tip"):
        bits = [int(model.geom(f"{k}/{name}").contype[0]) & 0xFFFFFFFF for k in range(32)]
        assert bits == [1 << k for k in range(32)]
    assert np.array_equal(model.geom_conaffinity, model.geom_contype)


@pytest.mark.slow
def test_more_machines_than_one_model_holds(file):
    """40 machines with contacts are two models; all live."""
    with EmulatedDrives(load=Load(file(LIMITS), joints=("shoulder", "elbow"), gear=10.0), num_machines=40) as drives:
        drives.machine.load_torque = np.linspace(-0.5, 0.5, 40)
        drives.advance(0.3)
        assert not drives.machine.diverged.any()
        shoulder = drives.machine.joint_positions[:, 0]
        assert shoulder[0] < -0.5
        assert shoulder[-1] > 0.5


@pytest.mark.parametrize(
    ("text", "constrained"),
    [(PLAIN, False), (two(), False), (LIMITS, True), (LOOP, True)],
    ids=["plain", "two", "limits", "loop"],
)
def test_the_solver_works_only_where_it_has_to(file, text, constrained):
    model = read_model(Load(file(text)))
    assert is_constrained(model) == constrained


# --- the example ------------------------------------------------------------------------------------------------------
def script(*arguments):
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLES.parent)}
    return subprocess.run(
        [sys.executable, str(EXAMPLES / "own_machine.py"), *arguments],
        capture_output=True, text=True, timeout=120, check=True, env=environment,
    ).stdout  # fmt: skip


@pytest.mark.slow
def test_the_example_runs():
    lines = script("--gear", "40").splitlines()
    assert len(lines) == 3
    assert lines[0].startswith("asked for (45, -60) degrees, the joints are at [")
    reached = [float(x) for x in lines[0].split("[")[1].rstrip("]").split()]
    assert reached == pytest.approx([45.0, -60.0], abs=0.1)
    assert "--tool TOOL" in script("--help")


def test_the_example_s_model_says_itself_what_is_driven():
    assert find_load(EXAMPLES / "models" / "scara.xml").joints == ("shoulder", "elbow")


# --- forces that only MuJoCo knows ------------------------------------------------------------------------------------
def test_a_tendon_s_spring_acts_though_inertia_and_gravity_are_constant(file):
    """The step leaves out what does not change; the spring of a tendon is no joint's, and does."""
    path = file(
        """<mujoco model="sprung"><option gravity="0 0 0"/>
          <worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
            <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody>
          <tendon><fixed name="spring" stiffness="400" springlength="0"><joint joint="x" coef="1"/></fixed></tendon>
        </mujoco>"""
    )
    load = PackedLoad(
        find_load(Load(path, joints=("x",), start={"x": 0.05})), np.full((1, 1), J_M), np.zeros((1, 1, 4)), {}, H
    )
    qpos = stepped(load.plant, np.zeros(2000), H).qpos
    w = np.sqrt(400.0 / (1.0 + J_M))
    # The first position counts as the middle of the first step.
    expected = 0.05 * np.cos(w * H * np.arange(1, 2001))
    assert np.abs(qpos[:, 0] - expected).max() < 0.05 * w * H
