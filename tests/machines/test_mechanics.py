"""The loads: inertias, resonances, energy and parameters against hand calculation."""

import numpy as np
import pytest
from rigs.stepped_load import stepped
from rigs.tables import every_row

from drive_env import EmulatedDrives, motion
from mechanics.loads import LOADS, find_load
from mechanics.model import compile_packed, motion_of
from mechanics.packed import PackedLoad

H = 200e-6
J_M = 4.8e-6  # rotor of the QBL4208-class motor
J_HUB = 1e-9  # the motor-side body of two_mass.xml, a formality
J_L, STIFFNESS, DAMPING = 1e-5, 2.527, 8.6e-5  # two_mass.xml
MOTOR_SIDE = J_M + J_HUB
FRICTIONLESS = {"coulomb": 0.0, "breakaway": 0.0, "viscous": 0.0}


def run(load, torque):
    """Return qpos and qvel after every step, shape (n, copies, D); torque is (n,) or (n, copies)."""
    found = stepped(load.plant, np.broadcast_to(np.asarray(torque, float).T, (load.copies, len(torque))).T, load.h)
    shape = (len(torque), load.copies, load.num_dofs)
    return found.qpos.reshape(shape), found.qvel.reshape(shape)


def machines(name, copies=1, h=H, bearing=(0.0, 0.0, 1.0, 0.0), integrator="leapfrog", **parameters):
    values = {**FRICTIONLESS, **parameters}
    return PackedLoad(
        LOADS[name],
        np.full((copies, 1), J_M),
        np.broadcast_to(np.array(bearing), (copies, 1, 4)),
        {key: np.broadcast_to(value, (copies,)) for key, value in values.items()},
        h,
        integrator=integrator,
    )


def analytic(stiffness, J_load=J_L):
    """Return anti-resonance and resonance of two masses on a shaft [Hz]."""
    return (np.sqrt(stiffness / J_load) / (2 * np.pi), np.sqrt(stiffness * (1 / MOTOR_SIDE + 1 / J_load)) / (2 * np.pi))


# --- inertia ----------------------------------------------------------------------------------------------------------
def test_mass_matrix_is_that_of_the_hand_calculation():
    """Relative joints: kinetic energy = (J_m w^2 + J_L (w + twist rate)^2) / 2."""
    inertia = np.array([0.5e-5, 1e-5, 4e-5])
    found = machines("two_mass", 3, inertia=inertia).mass_matrix()
    for k, J in enumerate(inertia):
        np.testing.assert_allclose(found[k], [[MOTOR_SIDE + J, J], [J, J]], rtol=1e-12)
    rigid = machines("inertia", 3, inertia=inertia).mass_matrix()
    np.testing.assert_allclose(rigid[:, 0, 0], J_M + inertia, rtol=1e-12)


def test_defaults_are_those_of_the_model_files():
    load = PackedLoad(LOADS["two_mass"], np.full((1, 1), J_M), np.zeros((1, 1, 4)), {}, H)
    defaults = {p.name: float(load.get(p.name)[0]) for p in LOADS["two_mass"].parameters}
    assert defaults == {
        "inertia": 1e-5, "stiffness": 2.527, "damping": 8.6e-5, "coulomb": 2e-3, "breakaway": 3e-3, "viscous": 2e-6
    }  # fmt: skip
    assert analytic(STIFFNESS) == pytest.approx((80.0, 140.5), rel=2e-3)  # as the file's comment says


# --- resonance --------------------------------------------------------------------------------------------------------
def extremum(frequencies, gain, largest):
    """Return where the gain is largest or smallest [Hz]: a parabola through the logarithm at the extremum."""
    y = np.log(gain) * (1 if largest else -1)
    k = int(np.argmax(y))
    assert 0 < k < len(y) - 1, "the extremum must lie within the sweep"
    a, b, c = y[k - 1 : k + 2]
    return frequencies[k] + 0.5 * (a - c) / (a - 2 * b + c) * (frequencies[1] - frequencies[0])


def amplitude(signal, t, frequencies):
    """Return the amplitude of each column at its own frequency, Hann-weighted."""
    window = np.hanning(len(t))[:, None]
    phasor = np.exp(-2j * np.pi * t[:, None] * frequencies)
    return 2 * np.abs((signal * window * phasor).sum(axis=0)) / window.sum()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stiffness", "gate"),
    [(0.3 * STIFFNESS, 0.01), (STIFFNESS, 0.01), (4 * STIFFNESS, 0.01), (10.2 * STIFFNESS, 0.01)],
    ids=["soft", "default", "stiff", "450 Hz"],
)
def test_resonances_of_a_sweep(stiffness, gate):
    """Sine torque in, motor speed out; one frequency per copy."""
    anti, resonance = analytic(stiffness)
    sweep = np.concatenate([np.linspace(0.96, 1.04, 32) * anti, np.linspace(0.96, 1.04, 32) * resonance])
    damping = DAMPING * np.sqrt(stiffness / STIFFNESS)  # keeps the damping ratio
    load = machines("two_mass", 64, stiffness=stiffness, damping=damping)
    t = (np.arange(6000) + 0.5) * H
    _, qvel = run(load, 0.01 * np.sin(2 * np.pi * t[:, None] * sweep))
    gain = amplitude(qvel[4000:, :, 0], (np.arange(6000) + 1)[4000:] * H, sweep)
    found = extremum(sweep[:32], gain[:32], False), extremum(sweep[32:], gain[32:], True)
    errors = found[0] / anti - 1, found[1] / resonance - 1
    print(
        f"anti-resonance {found[0]:.2f} Hz ({100 * errors[0]:+.2f} %), "
        f"resonance {found[1]:.2f} Hz ({100 * errors[1]:+.2f} %)"
    )
    assert abs(errors[0]) < gate
    assert abs(errors[1]) < gate


@pytest.mark.parametrize("factor", [0.4, 1.0])
def test_resonances_seen_through_the_drive(factor):
    """In cst with a played 6071h, as on a real axis: 606Ch over 6077h, one frequency per machine."""
    stiffness = factor * STIFFNESS
    anti, resonance = analytic(stiffness)
    sweep = np.concatenate([np.linspace(0.96, 1.04, 24) * anti, np.linspace(0.96, 1.04, 24) * resonance])
    parameters = {f"load.{name}": value for name, value in FRICTIONLESS.items()} | {"load.stiffness": stiffness}
    with EmulatedDrives(num_machines=48, distinct=1, ideal=True, parameters=parameters) as drives:
        motion.enable(drives, mode="cst")
        t = np.arange(1500) * 1e-3
        target = np.rint(500 * np.sin(2 * np.pi * t[:, None] * sweep)).astype(int)
        trace = drives.record([0x606C, 0x6077], 1.5, play={0x6071: target})
    speed, torque = (amplitude(trace[index][700:], t[700:], sweep) for index in (0x606C, 0x6077))
    gain = speed / torque
    assert extremum(sweep[:24], gain[:24], False) == pytest.approx(anti, rel=0.01)
    assert extremum(sweep[24:], gain[24:], True) == pytest.approx(resonance, rel=0.01)


@pytest.mark.slow
def test_damping_sets_the_decay():
    """Free ringing of the shaft: the envelope falls with exp(-zeta w t), zeta w = d (1/J_m + 1/J_L) / 2."""
    load = machines("two_mass", 2, damping=np.array([DAMPING, 2 * DAMPING]))
    load.data.qvel[:] = (0.0, 10.0, 0.0, 10.0)
    _, qvel = run(load, np.zeros(2000))
    energy = (qvel[:, :, 1].reshape(20, 100, 2) ** 2).sum(axis=1)  # of 20 ms, whole periods nearly
    rates = -np.log(energy[8] / energy[1]) / (7 * 100 * H) / 2
    expected = 0.5 * np.array([DAMPING, 2 * DAMPING]) * (1 / MOTOR_SIDE + 1 / J_L)
    assert rates == pytest.approx(expected, rel=0.03)


# --- energy -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("friction", [False, True])
def test_energy_is_accounted_for_at_20_steps_per_millisecond(friction):
    """Work of the motor = kinetic + spring energy + loss in the shaft's damping and in the bearings."""
    h = 50e-6
    losses = {"coulomb": 2e-3, "breakaway": 2e-3, "viscous": 2e-6} if friction else {}
    load = machines("two_mass", h=h, **losses)
    torque = np.repeat(np.random.default_rng(0).uniform(-0.05, 0.05, 40), 200)
    qpos, qvel = (x[:, 0] for x in run(load, torque))
    motor, twist = qvel.T
    absolute = motor + twist
    mean = lambda x: 0.5 * (x + np.concatenate([[0.0], x[:-1]]))  # noqa: E731
    work = np.cumsum(torque * mean(motor)) * h
    # Position stands half a step after the speed.
    elongation = qpos[:, 1] - 0.5 * h * twist
    stored = 0.5 * MOTOR_SIDE * motor**2 + 0.5 * J_L * absolute**2 + 0.5 * STIFFNESS * elongation**2
    lost = np.cumsum(DAMPING * mean(twist) ** 2) * h
    if friction:
        speed = np.abs(mean(absolute))
        lost += np.cumsum((2e-3 + 2e-6 * speed) * speed) * h
    through = np.cumsum(np.abs(torque * mean(motor))) * h
    error = np.abs(work - stored - lost).max() / through[-1]
    print(f"energy: {100 * error:.4f} % of what went through")
    assert stored[-1] + lost[-1] > 0.05 * through[-1]
    assert error < 5e-4


@pytest.mark.parametrize("integrator", ["leapfrog", "rk4"])
def test_an_undamped_shaft_rings_on(integrator):
    """No drift of the energy over 10 s, 1400 periods: leapfrog is symplectic; RK4 loses a little per period."""
    load = machines("two_mass", damping=0.0, integrator=integrator)
    load.data.qvel[:] = (0.0, 10.0)
    _, qvel = run(load, np.zeros(50_000))
    first, last = (np.abs(qvel[part, 0, 1]).max() for part in (slice(0, 500), slice(-500, None)))
    assert last == pytest.approx(first, rel=1e-3 if integrator == "leapfrog" else 0.05)
    assert np.isfinite(qvel).all()


# --- load torque ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("h", "tolerance"), [(200e-6, 3e-3), (50e-6, 2e-4)])
def test_load_torque_twists_the_shaft_of_a_held_motor(h, tolerance):
    """At rest twist = torque / stiffness; the stiffness that puts the resonance right is low by (w_r h)^2 / 12."""
    load = machines("two_mass", h=h, bearing=(1.0, 1.0, 1.0, 0.0), damping=20 * DAMPING)
    load.plant.load_torque[:] = 0.1
    qpos, qvel = run(load, np.zeros(round(0.3 / h)))
    assert abs(qvel[-1, 0, 0]) < 1e-9  # the motor is held
    # While the load swings, the damping that MuJoCo takes at the step's end moves a held motor a little.
    assert np.abs(qpos[:, 0, 0]).max() < 1e-2 * qpos[-1, 0, 1]
    assert qpos[-1, 0, 1] == pytest.approx(0.1 / STIFFNESS, rel=tolerance)


def test_load_torque_acts_on_the_load_side():
    """In the first step only the load turns; on the rigid load, both."""
    load = machines("two_mass")
    load.plant.load_torque[:] = 0.1
    _, qvel = run(load, np.zeros(1))
    assert qvel[0, 0].sum() == pytest.approx(0.1 / J_L * H, rel=1e-2)
    assert abs(qvel[0, 0, 0]) < 1e-2 * qvel[0, 0].sum()
    rigid = machines("inertia")
    rigid.plant.load_torque[:] = 0.1
    _, qvel = run(rigid, np.zeros(1))
    assert qvel[0, 0, 0] == pytest.approx(0.1 / (J_M + J_L) * H, rel=1e-9)


def test_a_positive_load_torque_drives_forward():
    with EmulatedDrives(load="two_mass", num_machines=3) as drives:
        drives.machine.load_torque = [0.02, -0.02, 0.0]
        drives.advance(0.05)
        speed = drives.machine.rotor_speed
    assert speed[0] > 10
    assert speed[1] < -10
    assert speed[2] == 0.0


# --- parameters -------------------------------------------------------------------------------------------------------
def test_parameters_have_their_effect():
    load = machines("inertia", 4)
    load.set("inertia", np.array([2e-5, 1.0, 4e-5, 1.0]), np.array([True, False, True, False]))
    assert load.get("inertia").tolist() == [2e-5, 1e-5, 4e-5, 1e-5]
    _, qvel = run(load, np.full(100, 0.01))
    expected = 0.01 * 100 * H / (J_M + np.array([2e-5, 1e-5, 4e-5, 1e-5]))
    np.testing.assert_allclose(qvel[-1, :, 0], expected, rtol=1e-9)

    load.set_motor(np.full((4, 1), 1e-5), np.zeros((4, 1, 4)))
    before = load.data.qvel.copy()
    _, qvel = run(load, np.full(100, 0.01))
    expected = 0.01 * 100 * H / (1e-5 + np.array([2e-5, 1e-5, 4e-5, 1e-5]))
    np.testing.assert_allclose(qvel[-1, :, 0] - before, expected, rtol=1e-9)


def test_stiffness_and_friction_have_their_effect():
    load = machines("two_mass", 2, bearing=(1.0, 1.0, 1.0, 0.0), damping=20 * DAMPING)
    load.set("stiffness", np.array([1.0, 4.0]), np.ones(2, bool))
    load.plant.load_torque[:] = 0.01
    qpos, _ = run(load, np.zeros(3000))
    assert qpos[-1, :, 1] == pytest.approx([0.01, 0.0025], rel=0.01)

    load = machines("inertia", 3)
    load.set("coulomb", np.array([1e-3, 2e-3, 0.0]), np.ones(3, bool))
    load.set("breakaway", np.array([1e-3, 2e-3, 0.0]), np.ones(3, bool))
    load.data.qvel[:] = 50.0
    _, qvel = run(load, np.zeros(100))
    expected = 50.0 - np.array([1e-3, 2e-3, 0.0]) / (J_M + J_L) * 100 * H
    np.testing.assert_allclose(qvel[-1, :, 0], expected, rtol=1e-9)


def test_machine_set_reaches_the_mechanics():
    with EmulatedDrives(load="inertia", num_machines=2, ideal=True, parameters={
        "load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0,
    }) as drives:  # fmt: skip
        drives.machine.set("load.inertia", 4e-5, where=np.array([False, True]))
        drives.machine.load_torque = 0.01
        drives.advance(0.1)
        speed = drives.machine.rotor_speed
        assert drives.machine.parameters["load.inertia"].tolist() == [1e-5, 4e-5]
    assert speed == pytest.approx([0.01 * 0.1 / (J_M + 1e-5), 0.01 * 0.1 / (J_M + 4e-5)], rel=1e-3)


# --- what is refused --------------------------------------------------------------------------------------------------
def state(load):
    return [load.get(p.name).tolist() for p in load.load.parameters] + [
        np.array(field).tolist()
        for field in (load.plant.stiffness, load.plant.damping, load.plant.friction, load.plant.share,
                      load.plant.mass, load.model.jnt_stiffness, load.model.dof_damping,
                      load.model.dof_armature, load.data.qpos, load.data.qvel)
    ]  # fmt: skip


def test_a_resonance_too_fast_for_the_step_is_refused():
    """The limit is 0.7 rad of the resonance per step: 557 Hz at 200 us."""
    load = machines("two_mass", 3)
    before = state(load)
    for change in (
        lambda: load.set("stiffness", np.array([2.0, 60.0, 2.0]), np.ones(3, bool)),
        lambda: load.set("inertia", np.array([1e-5, 1e-7, 1e-5]), np.ones(3, bool)),
        lambda: load.set_motor(np.array([[J_M], [1e-7], [J_M]]), np.ones((3, 1, 4))),
    ):
        with pytest.raises(ValueError) as refused:
            change()
        text = str(refused.value)
        assert "'twist' of machine 1 resonates at" in text
        assert "the limit is 557 Hz at a physics step of 200 us" in text
        assert "lower its stiffness, raise its inertia or take more physics steps per millisecond" in text
        assert state(load) == before
    with pytest.raises(ValueError, match=f"resonates at {analytic(60.0)[1]:.0f} Hz"):
        load.set("stiffness", np.full(3, 60.0), np.ones(3, bool))


def test_the_remedy_works():
    parameters = {"load.stiffness": 60.0}
    with pytest.raises(ValueError, match="take more physics steps"):
        EmulatedDrives(load="two_mass", parameters=parameters)
    with EmulatedDrives(load="two_mass", parameters=parameters, physics_steps=2) as drives:
        drives.advance(0.01)


def test_a_refused_setting_leaves_every_group_as_it_was():
    """66 machines are two groups; the second refuses what the first could take."""
    with EmulatedDrives(load="two_mass", num_machines=66) as drives:
        stiffness = np.full(66, 3.0)
        stiffness[65] = 60.0
        before = [state(group.load) for group in drives.inside.groups]
        with pytest.raises(ValueError, match="resonates"):
            drives.machine.set("load.stiffness", stiffness)
        assert np.all(drives.machine.parameters["load.stiffness"] == STIFFNESS)
        assert [state(group.load) for group in drives.inside.groups] == before


def test_the_refusal_names_the_machine():
    """Machine 65 is copy 1 of the second group; the user knows it as 65."""
    with EmulatedDrives(load="two_mass", num_machines=66) as drives:
        where = np.arange(66) == 65
        with pytest.raises(ValueError, match="65"):
            drives.machine.set("load.stiffness", 60.0, where=where)


@every_row("name", ["inertia", "stiffness", "damping", "coulomb", "breakaway", "viscous"])
@every_row("value", [-1e-6, np.nan, np.inf])
def test_a_load_parameter_that_cannot_be_is_refused(name, value):
    load = machines("two_mass", 2)
    before = state(load)
    with pytest.raises(ValueError, match=rf"{name} of load 'two_mass' must be finite and not negative"):
        load.set(name, np.array([1e-5, value]), np.ones(2, bool))
    assert state(load) == before


def test_no_body_without_inertia():
    load = machines("inertia")
    with pytest.raises(ValueError, match=r"inertia of load 'inertia' must be above 0 kg\*m\^2"):
        load.set("inertia", np.zeros(1), np.ones(1, bool))


@every_row(
    "name",
    ["motor.inertia", "motor.coulomb", "motor.viscous", "motor.R_s", "motor.L_d", "load.inertia", "load.stiffness"],
)
@every_row("value", [-1e-6, np.nan, np.inf])
def test_a_machine_parameter_that_cannot_be_is_refused(name, value):
    with EmulatedDrives(load="two_mass", num_machines=2) as drives:
        before = {key: values.tolist() for key, values in drives.machine.parameters.items()}
        with pytest.raises(ValueError, match=r"."):
            drives.machine.set(name, value)
        assert {key: values.tolist() for key, values in drives.machine.parameters.items()} == before


def test_names_that_do_not_exist_are_answered_with_those_that_do():
    with pytest.raises(ValueError, match=r"no load is named 'four_mass'; there are .*inertia, .*two_mass"):
        find_load("four_mass")
    with pytest.raises(ValueError, match=r"no load is named 'four_mass'; there are .*inertia, .*two_mass"):
        EmulatedDrives(load="four_mass")
    load = machines("two_mass")
    with pytest.raises(ValueError, match=r"no parameter 'mass'; it has inertia, stiffness, damping, coulomb"):
        load.set("mass", np.ones(1), np.ones(1, bool))
    with pytest.raises(ValueError, match=r"no parameter 'stiffness'; it has inertia, coulomb, breakaway, viscous"):
        machines("inertia", stiffness=1.0)
    with pytest.raises(ValueError, match=r"no integrator is named 'euler'; there are leapfrog, rk4"):
        machines("inertia", integrator="euler")
    with EmulatedDrives(load="inertia") as drives:
        with pytest.raises(ValueError, match=r"no parameter 'load.stiffness'; they have motor\.R_s, .*load\.inertia"):
            drives.machine.set("load.stiffness", 1.0)
        with pytest.raises(ValueError, match=r"where must be a boolean array of shape \(1,\)"):
            drives.machine.set("load.inertia", 1e-5, where=np.array([True, False]))


@pytest.mark.parametrize("name", sorted(LOADS))
@pytest.mark.parametrize("copies", [1, 3])
def test_a_packed_model_holds_every_copy_by_name(name, copies):
    load = LOADS[name]
    model = compile_packed(load, copies)
    single = compile_packed(load, 1)
    assert model.nq == model.nv == copies * single.nv
    for k in range(copies):
        for axis in load.joints:
            for joint in motion_of(model, axis, f"{k}/"):  # a tendon is made of joints
                assert model.joint(f"{k}/{joint}").qposadr[0] // single.nv == k
