"""A gear with play: a response within the play is no identification of the axis; one beside axes that give way is."""

from __future__ import annotations

import pytest
from rigs import ROOT
from rigs.known_machines import true_plant

from mechanics import Load
from tuning.identify.quick_identification import identify_briefly
from tuning.target import emulated

SCARA = ROOT / "examples/models/scara.xml"
LOOSE = {
    "motor.R_s": 0.2996, "motor.L_d": 0.0002285, "motor.L_q": 0.0002122, "motor.psi_m": 0.002528,
    "motor.inertia": 1.914e-05, "motor.cogging_torque": 0.00397, "motor.coulomb": 0.002084, "motor.viscous": 1.953e-05,
    "stage.adc_noise": 0.03061, "stage.velocity_filter": 313.6, "load.inertia": 0.05085, "load.stiffness": 5411.0,
    "load.damping": 0.2619, "load.backlash": 0.004, "load.efficiency": 0.8892, "load.coulomb": 0.1326,
    "load.breakaway": 0.1284, "load.viscous": 0.03574,
}  # fmt: skip


@pytest.mark.slow
def test_a_response_within_the_play_of_a_gear_is_no_identification_of_the_axis():
    """It gives half of the inertia; the two moves, which drive through the play, 0.9.

    Where in its play a gear stands decides whether the shaking leaves it: of these plays one is not left.
    """
    refused = 0
    for play in (0.004, 0.005, 0.006, 0.007):
        loose = LOOSE | {"load.backlash": play}
        with emulated(load="geared_joint", motor="ec_45_flat", parameters=loose, num_threads=1) as target:
            (found,) = identify_briefly(target)
            true = true_plant(target.drives).inertia
        assert found.value("inertia") == pytest.approx(true, rel=0.25), play
        refused += "it was measured within the play of a gear" in found.estimates["velocity_filter"].reason
    assert refused


@pytest.mark.slow
def test_an_axis_beside_others_that_give_way_is_identified():
    """While a link is shaken the other one gives way: the response gives 0.64 and 0.74 of the inertia of the moves."""
    load = Load(SCARA, joints=("shoulder", "elbow"), gear=(35, 20))
    with emulated(load=load, motor="qbl4208", num_threads=1) as target:
        found = identify_briefly(target)
    for one in found:
        assert "play" not in "".join(estimate.reason for estimate in one.estimates.values())
        assert one.fit is not None and one.fit.is_good
