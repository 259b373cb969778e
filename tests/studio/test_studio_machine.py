"""The page Machine: what it sets acts on the emulated machine, and its picture costs what it says."""

from __future__ import annotations

import io
import time

import numpy as np
import pytest
from rigs.session_rig import until

pytest.importorskip("nicegui", reason="the extra `studio` is not installed")

from drive_env import EmulatedDrives, cia402
from drive_env.faults.table import FAULTS
from drive_env.fieldbus.description import describe
from drive_env.pictures.opengl import OpenGLError
from drive_env.studio import machine_jobs, motion_jobs
from drive_env.studio.machine_camera import HEIGHT, PERIOD, SHARE, WIDTH, MachineCamera
from drive_env.studio.machine_page import know
from drive_env.studio.session import Session


@pytest.fixture(scope="module")
def session():
    made = Session(lambda: EmulatedDrives(load="two_mass", num_threads=1), "a machine", describe("tmcm1636", None))
    made.presence.beat("page")
    made.start()
    until(lambda: made.state != "opening", 120.0)
    assert made.state == "open", made.failure
    yield made
    made.close()


def do(session, job):
    session.presence.beat("page")
    return session.do(job, "a job", page="page").result(30.0)


def test_a_glimpse_sees_the_machine_while_it_lives(session):
    assert session.glimpse(lambda machine: float(machine.supply[0])) == pytest.approx(24.0)
    assert session.glimpse(lambda machine: machine.joint_positions).shape[0] == 1


def test_what_is_known_of_a_machine(session):
    known = session.glimpse(know)
    assert known.rows["load.inertia"].unit == "kg*m^2"
    assert known.rows["load.inertia"].low < known.rows["load.inertia"].default < known.rows["load.inertia"].high
    assert known.meanings["load.stiffness"]
    assert "encoder_stuck" in known.faults
    assert not {name for name in known.faults if FAULTS[name].group == "bus"}
    assert known.torque == pytest.approx(session.glimpse(lambda machine: machine.inside.motor.rated_torque))


def test_parameters_torque_and_supply_act(session):
    do(session, machine_jobs.set_parameters({"load.inertia": 2e-5}))
    do(session, machine_jobs.act("load_torque", 0.01))
    do(session, machine_jobs.act("supply", 30.0))
    found = session.glimpse(
        lambda machine: (machine.parameters["load.inertia"][0], machine.load_torque[0], machine.supply[0])
    )
    assert found == pytest.approx((2e-5, 0.01, 30.0))
    with pytest.raises(ValueError, match="must be finite and 0 V or more"):
        do(session, machine_jobs.act("supply", -1.0))
    with pytest.raises(ValueError):
        do(session, machine_jobs.set_parameters({"load.inertia": -1.0}))
    do(session, machine_jobs.act("load_torque", 0.0))
    do(session, machine_jobs.act("supply", 24.0))
    do(session, machine_jobs.set_parameters({"load.inertia": 1e-5}))
    assert session.glimpse(lambda machine: machine.parameters["load.inertia"][0]) == pytest.approx(1e-5)


def test_a_fault_that_is_switched_on_acts_and_one_that_is_ended_does_not(session):
    number = do(session, machine_jobs.begin_fault("supply_dip", None, "", {"voltage": 5.0}))
    do(session, lambda drives: drives.advance(0.3))
    faults = session.glimpse(lambda machine: machine.faults())
    assert [(fault.number, fault.order.name, bool(fault.active.any())) for fault in faults] == [
        (number, "supply_dip", True)
    ]
    assert session.glimpse(lambda machine: machine.supply[0]) == pytest.approx(5.0)
    do(session, machine_jobs.end_faults("supply_dip"))
    do(session, machine_jobs.end_faults("supply_dip"))  # it is over already
    do(session, lambda drives: drives.advance(0.1))
    assert session.glimpse(lambda machine: machine.supply[0]) == pytest.approx(24.0)
    do(session, motion_jobs.reset_fault(0))
    assert cia402.state_of(int(do(session, lambda drives: drives.read(cia402.STATUSWORD)[0]))) is not cia402.State.FAULT


def test_a_fault_for_a_while_ends_by_itself(session):
    do(session, machine_jobs.begin_fault("encoder_noise", 0.05, "", {}))
    assert session.glimpse(lambda machine: len(machine.faults())) == 1
    do(session, lambda drives: drives.advance(0.1))
    assert session.glimpse(lambda machine: machine.faults()) == []


def test_a_fault_with_a_number_out_of_its_range_is_refused(session):
    with pytest.raises(ValueError, match="must be 0 to 1"):
        do(session, machine_jobs.begin_fault("encoder_lost_counts", None, "", {"share": 2.0}))


# --- the picture --------------------------------------------------------------------------------------------------
def test_the_picture_is_drawn_when_the_load_moves_and_only_then(session):
    from PIL import Image

    camera = MachineCamera(session)
    look = lambda seen: camera.thread.submit(camera.picture, seen).result(30.0)  # noqa: E731
    try:
        try:
            first, picture = look(0)
        except OpenGLError as error:
            pytest.skip(str(error))
        assert Image.open(io.BytesIO(picture)).size == (WIDTH, HEIGHT)
        time.sleep(1.1 * camera.period)
        assert look(first) == (first, b"")  # it stands
        do(session, motion_jobs.enable(0, "pp"))
        do(session, motion_jobs.move(session, 0, "0.25 rev", "", relative=True))
        time.sleep(1.1 * camera.period)
        second, other = look(first)
        assert second > first and other != picture
        do(session, motion_jobs.disable(0))
        assert camera.cost > 0.0
        assert camera.period == pytest.approx(max(PERIOD, camera.cost / SHARE))
        assert np.std(np.asarray(Image.open(io.BytesIO(other)))) > 10.0  # there is something on it
    finally:
        camera.close()
