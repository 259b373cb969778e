"""The certificate holds everything and shows a change; the report is one file with its pictures in it."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import math
import re
from dataclasses import fields as dataclass_fields
from dataclasses import is_dataclass, replace
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.image import imread
from rigs.chip_gains import Gains, bandwidths_from_gains
from typer.testing import CliRunner

from drive_env.devices import find_device
from drive_env.devices.gains import gains_in_si
from drive_env.loops.margins import Margins, margins
from drive_env.motors import find_motor
from tuning.certificate.certificate import (
    CROSSOVERS,
    KEPT,
    NEARLY_KEPT,
    NOT_MEASURED,
    TAKEN,
    AxisCertificate,
    Certificate,
    CertificateError,
    Correction,
    FrequencyResponse,
    Requirement,
    StatedParameter,
    StepResponse,
    frequency_response,
    identified,
    si_gains,
)
from tuning.certificate.certificate_files import certificate_files, is_unchanged, load_certificate
from tuning.certificate.certificate_pictures import AFTER, BEFORE, DOUBTFUL, bode_picture, step_picture
from tuning.certificate.report import to_html
from tuning.commands.cli import app
from tuning.estimate import Estimate, refused
from tuning.identify.identified_axis import Identification
from tuning.response.measured_loop import AtLeast

DEVICE = find_device("tmcm1636")
BEFORE_GAINS, AFTER_GAINS = Gains(4021, 2359, 445, 823, 0), Gains(4021, 2359, 1400, 2000, 500)
F = np.geomspace(5.0, 400.0, 60)


def step(tuned, time_constant):
    t = np.arange(100) * 1e-3
    actual = 500.0 * -np.expm1(-t / time_constant)
    return StepResponse(
        "velocity step", tuned, "rpm", t, np.full(100, 500.0), actual, np.exp(-t / time_constant),
        {"settling [s]": time_constant * math.log(50.0), "overshoot [%]": 0.0, "disturbance dip [rpm]": math.nan},
    )  # fmt: skip


def bode(tuned, crossover, coherence):
    L = crossover / F * -1j
    return frequency_response(
        "velocity loop", F, L, margins(F, L), tuned=tuned, coherence=coherence, source="multisine"
    )


@pytest.fixture
def certificate():
    axis = AxisCertificate(
        axis=0,
        accepted=True,
        reason="all checks passed",
        reservations=(),
        identified={
            "resistance": StatedParameter(0.3612, 0.355, 0.367, "ohm"),
            "resonance": StatedParameter(math.nan, math.nan, math.nan, "Hz", "travel too short: 0.1 <turns>"),
        },
        before=tuple(BEFORE_GAINS),
        after=tuple(AFTER_GAINS),
        before_si=si_gains(DEVICE, 24.0, BEFORE_GAINS),
        after_si=si_gains(DEVICE, 24.0, AFTER_GAINS),
        steps=(step(False, 0.02), step(True, 0.005)),
        frequency_responses=(bode(False, 20.0, np.ones(60)), bode(True, 50.0, np.where(F < 200.0, 0.99, 0.5))),
        dynamics="standard",
        requirements=(
            Requirement("velocity loop, phase margin [deg]", 45.0, 44.2, False, NEARLY_KEPT),
            Requirement("velocity loop, gain margin [dB]", 8.0, 9.5, True, KEPT),
            Requirement("overshoot of a small step in csp [%]", 20.0, math.nan, False, NOT_MEASURED),
        ),
        figures=dict(zip(CROSSOVERS, (1400.0, 50.0, 35.5, 0.71), strict=True)),
        corrections=(
            Correction(tuple(AFTER_GAINS._replace(position_p=620)), tuple(AFTER_GAINS), "it overshot by 24 %", TAKEN),
        ),
        notes=("2042h:02 would be 2000.4",),
        hardware_seconds=7.25,
        aborts=2,
    )
    envelope = {"travel low [rad]": -math.inf, "speed [rad/s]": 418.9}
    return Certificate(
        "auto", "tmcm1636", "qbl4208", "two_mass", 24.0, 7, envelope, (axis,), {"numpy": "2.4"}, "2026-01-02T03:04:05"
    )


# --- the file -----------------------------------------------------------------------------------------------------
def test_a_certificate_reads_back_to_the_last_digit(certificate, tmp_path):
    with certificate_files(certificate, tmp_path / "run") as (path, _):
        pass
    found, unchanged = load_certificate(path)
    assert unchanged
    assert found.to_json() == certificate.to_json()
    assert found.axes[0].before == (4021, 2359, 445, 823, 0)
    assert math.isnan(found.axes[0].identified["resonance"].value)
    assert found.axes[0].before_si["position P [1/s]"] == 0.0
    assert found.envelope["travel low [rad]"] == -math.inf
    np.testing.assert_array_equal(found.axes[0].steps[1].actual, certificate.axes[0].steps[1].actual)
    np.testing.assert_array_equal(
        found.axes[0].frequency_responses[1].coherence, certificate.axes[0].frequency_responses[1].coherence
    )


def test_the_file_is_strict_json_with_all_that_is_promised(certificate):
    data = json.loads(certificate.to_json(), parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert set(data) == {
        "format", "tuner", "device", "motor", "machine", "supply", "seed", "envelope", "axes", "versions", "created",
        "sha256",
    }  # fmt: skip
    assert set(data["axes"][0]) == {
        "axis", "accepted", "reason", "reservations", "identified", "before", "after", "before_si", "after_si", "steps",
        "frequency_responses", "dynamics", "requirements", "figures", "corrections", "notes", "hardware_seconds",
        "aborts",
    }  # fmt: skip


def test_the_hash_is_that_of_the_sorted_content_which_anybody_can_compute(certificate):
    data = json.loads(certificate.to_json())
    stated = data.pop("sha256")
    text = json.dumps(data, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert hashlib.sha256(text.encode()).hexdigest() == stated == certificate.hash()


def test_written_otherwise_it_is_the_same_certificate(certificate, tmp_path):
    data = json.loads(certificate.to_json())
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(dict(reversed(data.items()))), encoding="utf-8")
    assert is_unchanged(path)


@pytest.mark.parametrize(("where", "value"), [
    (("seed",), 8),
    (("axes", 0, "accepted"), False),
    (("axes", 0, "after", 2), 1401),
    (("axes", 0, "identified", "resistance", "high"), 0.3671),
    (("axes", 0, "steps", 1, "actual", 50), 499.0),
    (("axes", 0, "frequency_responses", 0, "coherence", 3), 0.5),
    (("axes", 0, "aborts"), 0),
    (("sha256",), "0" * 64),
])  # fmt: skip
def test_any_change_shows(certificate, tmp_path, where, value):
    data = json.loads(certificate.to_json())
    place = data
    for key in where[:-1]:
        place = place[key]
    assert place[where[-1]] != value
    place[where[-1]] = value
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    assert not is_unchanged(path)
    assert not load_certificate(path)[1]


@pytest.mark.parametrize(("text", "message"), [
    ("", "is not a certificate"),
    ("[1]", "is not a certificate of format 3"),
    ('{"a": 1}', "is not a certificate of format 3"),
    ('{"format": 1, "sha256": "", "x": NaN}', "NaN is not a number of JSON"),
    ('{"format": 3, "sha256": ""}', "is not a certificate of this version: 'tuner'"),
])  # fmt: skip
def test_what_is_no_certificate_is_said_to_be_none(tmp_path, text, message):
    path = tmp_path / "certificate.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CertificateError, match=message):
        load_certificate(path)


# --- the command --------------------------------------------------------------------------------------------------
def verify(path):
    return CliRunner().invoke(app, ["verify", str(path)])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["certificate.json", "report.html"])
def test_verify_tells_by_its_exit_code_whether_a_file_was_changed(certificate, tmp_path, name):
    with certificate_files(certificate, tmp_path):
        path = tmp_path / name
    done = verify(path)
    assert (done.exit_code, done.stdout) == (0, f"{path} is unchanged\n")
    told = CliRunner().invoke(app, ["verify", str(path), "--json"])
    assert json.loads(told.stdout) == {"file": str(path), "unchanged": True}
    path.write_text(path.read_text(encoding="utf-8").replace("0.3612", "0.3613"), encoding="utf-8")
    done = verify(path)
    assert done.exit_code == 1
    assert done.stderr == f"drive-tune: {path} was changed since it was written: its hash does not match its content\n"


@pytest.mark.parametrize(("name", "message"), [
    ("none.json", "cannot read .*none.json: No such file"),
    ("x.json", "is not a certificate"),
    ("x.html", "is not a report of drive-tune"),
])  # fmt: skip
def test_a_mistake_is_one_line(tmp_path, name, message):
    for made in ("x.json", "x.html"):
        (tmp_path / made).write_text("x", encoding="utf-8")
    done = verify(tmp_path / name)
    assert done.exit_code == 2
    assert re.fullmatch(rf"drive-tune: .*{message}.*\n", done.stderr)


# --- the report ---------------------------------------------------------------------------------------------------
class Page(HTMLParser):
    """What a page shows and what it refers to."""

    def __init__(self, text):
        super().__init__()
        self.words, self.images, self.references, self.open = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.references += [(tag, name) for name in ("href", "srcset", "data") if name in found]
        if tag == "img":
            assert found["alt"]
            self.images.append(found["src"])
        elif tag not in ("meta",):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data.strip())


@pytest.mark.slow
def test_the_report_needs_nothing_from_anywhere(certificate):
    text = to_html(certificate)
    page = Page(text)
    assert page.open == [] and page.references == []
    assert "script" not in text and "url(" not in text and "http" not in re.sub(r"base64,[^\"]*", "", text)
    assert len(page.images) == 2
    for source in page.images:
        kind, _, coded = source.partition(";base64,")
        assert kind == "data:image/png"
        picture = imread(io.BytesIO(base64.b64decode(coded)))[:, :, :3]
        assert min(picture.shape[:2]) > 400
        assert len(np.unique((picture * 255).astype(int).reshape(-1, 3), axis=0)) > 20


@pytest.mark.slow
def test_no_text_of_a_certificate_is_taken_for_html(certificate):
    """What drives, files and people wrote is text: emergencies, names of motors and devices, reasons, notes."""
    evil = "<script>alert(1)</script><img src=x onerror='alert(1)'>\" onclick='alert(1)"
    spoilt = spoil(certificate, evil)
    assert spoilt != certificate
    found = Tags()
    found.feed(to_html(spoilt))
    assert "script" not in found.names and not found.handlers
    assert found.names.count("img") == len(re.findall("<img alt=", to_html(certificate)))


def spoil(value, evil):
    """Return a value with something added to each text in it that is not a name the report knows."""
    if is_dataclass(value):
        kept = ("device", "verdict", "loop", "quantity", "kind", "unit")
        fields = {one.name: getattr(value, one.name) for one in dataclass_fields(value) if one.init}
        return replace(value, **{name: x if name in kept else spoil(x, evil) for name, x in fields.items()})
    if isinstance(value, dict):
        return {name: spoil(x, evil) for name, x in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(spoil(x, evil) for x in value)
    return value + evil if isinstance(value, str) else value


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.names, self.handlers = [], []

    def handle_starttag(self, tag, attributes):
        self.names.append(tag)
        self.handlers += [name for name, _ in attributes if name.startswith("on")]


@pytest.mark.slow
def test_the_report_says_everything_that_the_certificate_holds(certificate):
    words = Page(to_html(certificate)).words
    for said in ("0.3612", "0.355 to 0.367", "ohm", "not identified", "travel too short: 0.1 <turns>", "1400",
                 "all checks passed", "2042h:02 would be 2000.4", "multisine", "7.25", "2", "new gains in the drive",
                 "none", "418.9", "numpy", "Dynamics asked for: standard", "at least 9.5", NEARLY_KEPT, NOT_MEASURED,
                 "35.5", "position P 620 → 500", "it overshot by 24 %", TAKEN,
                 "phase margin [deg]", "90", "settling [s]", "0.07824", "seed", "7",
                 certificate.hash()):  # fmt: skip
        assert any(said in word for word in words), said


DOUBT = "no margins <yet>"


@pytest.mark.every(3)
@pytest.mark.parametrize(("accepted", "reservations", "verdict", "colour", "words"), [
    (True, (), "accepted", "accepted", "new gains in the drive"),
    (True, (DOUBT,), "accepted with reservations", "reserved", "new gains in the drive, with reservations"),
    (False, (DOUBT,), "rejected", "rejected", "rejected; the drive has its gains from before"),
])  # fmt: skip
def test_a_verdict_has_three_colours_and_names_each_reservation(
    certificate, accepted, reservations, verdict, colour, words
):
    axis = replace(certificate.axes[0], accepted=accepted, reservations=reservations)
    page = to_html(replace(certificate, axes=(axis,)))
    assert axis.verdict == verdict
    assert f"<span class='{colour}'>{words}</span>" in page
    assert page.count("no margins &lt;yet&gt;") == len(reservations)


def test_a_margin_that_was_not_seen_is_there_as_what_it_is_at_least():
    L = np.full(F.shape, np.nan + 0j)
    nothing = Margins(*(np.nan,) * 5)
    shown = frequency_response("velocity loop", F, L, nothing, tuned=True, at_least=AtLeast(31.0, np.inf))
    assert shown.margins["phase margin, at least [deg]"] == 31.0
    assert "gain margin, at least [dB]" not in shown.margins
    seen = nothing._replace(phase_deg=40.0)
    shown = frequency_response("velocity loop", F, L, seen, tuned=True, at_least=AtLeast(31.0, 8.0))
    assert [name for name in shown.margins if "at least" in name] == ["gain margin, at least [dB]"]


@pytest.mark.slow
def test_what_a_tuner_guessed_is_in_neither_file(certificate):
    guess, reason = Estimate(0.4567, 0.32, 0.59, "A"), "two moves do not tell it from viscous friction"
    known = Estimate(1.48e-5, 1.4e-5, 1.56e-5, "kg*m^2")
    found = identified(Identification(
        {"coulomb": guess, "inertia": known, "damping": guess}, 4.0,
        {"coulomb": refused("A", reason), "inertia": known},
    ), find_motor("qbl4208"))  # fmt: skip
    assert set(found) == {"coulomb", "inertia", "inertia_ratio"}
    assert (found["inertia"].value, found["inertia"].low, found["inertia"].high) == known[:3]
    paper = replace(certificate, axes=(replace(certificate.axes[0], identified=found),))
    words = Page(to_html(paper)).words
    assert reason in words and "not identified" in words
    assert json.loads(paper.to_json())["axes"][0]["identified"]["coulomb"]["value"] is None
    assert "0.4567" not in paper.to_json() and not any("0.4567" in word for word in words)


def test_what_has_no_guesses_is_identified_as_it_is():
    known = Estimate(0.36, 0.35, 0.37, "ohm")
    found = identified(Identification({"resistance": known}, 4.0), find_motor("qbl4208"))
    assert found == {"resistance": StatedParameter(*known)}


@pytest.mark.parametrize(("total", "ratio"), [((3.0, 2.5, 3.5), (2.0, 1.5, 2.5)), ((1.0, 0.9, 1.1), (0.0, 0.0, 0.1))])
def test_the_load_is_told_as_a_multiple_of_the_rotor(total, ratio):
    motor = find_motor("qbl4208")
    known = Estimate(*(motor.inertia * J for J in total), "kg*m^2")
    found = identified(Identification({"inertia": known}, 4.0), motor)["inertia_ratio"]
    assert (found.value, found.low, found.high) == pytest.approx(ratio)


def test_a_load_that_is_not_known_is_said_to_be_none():
    unknown = refused("kg*m^2", "it does not turn")
    found = identified(Identification({"inertia": unknown}, 4.0), find_motor("qbl4208"))["inertia_ratio"]
    assert math.isnan(found.value) and found.reason == "it does not turn"


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "told"), [(0.5, False), (0.51, True), (math.nan, False)])
def test_a_position_loop_near_the_velocity_loop_is_pointed_out(certificate, ratio, told):
    axis = certificate.axes[0]
    figures = {**axis.figures, CROSSOVERS[-1]: ratio}
    words = Page(to_html(replace(certificate, axes=(replace(axis, figures=figures),)))).words
    assert any("crosses over beyond 0.5 of the velocity loop's" in word for word in words) == told
    assert axis.verdict == "accepted"


def test_an_axis_of_which_nothing_is_known_has_a_report_too(certificate):
    bare = AxisCertificate(3, False, "the encoder turns the other way", (), {}, (0,) * 5, (0,) * 5, {}, {})
    page = Page(to_html(replace(certificate, axes=(bare,))))
    assert "the encoder turns the other way" in page.words
    assert page.images == []


# --- the pictures -------------------------------------------------------------------------------------------------
def curves(axes):
    return {(line.get_color(), len(line.get_xdata())): line for line in axes.lines}


def test_a_step_is_shown_with_the_gains_before_and_the_new_ones_and_its_set_point(certificate):
    steps = certificate.axes[0].steps
    motion, current = step_picture(steps).axes
    np.testing.assert_allclose(curves(motion)[BEFORE, 100].get_ydata(), steps[0].actual)
    np.testing.assert_allclose(curves(motion)[AFTER, 100].get_ydata(), steps[1].actual)
    assert curves(motion)["black", 100].get_ydata().tolist() == [500.0] * 100
    np.testing.assert_allclose(curves(current)[AFTER, 100].get_ydata(), steps[1].current)
    assert motion.get_ylabel() == "actual [rpm]"


def test_frequencies_of_low_coherence_are_grey_and_not_the_curve(certificate):
    found = certificate.axes[0].frequency_responses[1]
    magnitude, phase, coherence = bode_picture([found]).axes
    for axes, values in ((magnitude, found.magnitude_db), (phase, found.phase_deg)):
        shown = curves(axes)[AFTER, 60].get_ydata()
        assert np.isnan(shown[F >= 200.0]).all()
        np.testing.assert_allclose(shown[F < 200.0], values[F < 200.0])
        np.testing.assert_allclose(curves(axes)[DOUBTFUL, 60].get_ydata(), values)
    assert "coherence below 0.95" in [text.get_text() for text in magnitude.get_legend().get_texts()]
    np.testing.assert_allclose(curves(coherence)[AFTER, 60].get_ydata(), found.coherence)


def test_a_model_has_no_coherence_and_nothing_grey(certificate):
    L = 20.0 / F * -1j
    found = frequency_response("velocity loop", F, L, margins(F, L), tuned=True)
    assert isinstance(found, FrequencyResponse) and np.isnan(found.coherence).all()
    magnitude = bode_picture([found]).axes[0]
    assert not np.isnan(curves(magnitude)[AFTER, 60].get_ydata()).any()
    assert [text.get_text() for text in magnitude.get_legend().get_texts()] == ["new gains"]


def test_margins_and_decibels_are_those_of_an_integrator():
    found = bode(True, 50.0, np.ones(60))
    np.testing.assert_allclose(found.magnitude_db, 20.0 * np.log10(50.0 / F))
    np.testing.assert_allclose(found.phase_deg, -90.0)
    assert found.margins["phase margin [deg]"] == pytest.approx(90.0)
    assert found.margins["crossover [Hz]"] == pytest.approx(50.0, rel=1e-3)


# --- gains in SI --------------------------------------------------------------------------------------------------
def test_gains_in_si_are_what_the_bandwidths_say_of_them():
    """Current loop: P = w L, T_i = L / R; velocity: P = J w / K_t, T_i; position: k_v. An independent way round."""
    motor, J = find_motor("qbl4208"), 3.0 * 4.8e-6
    means = bandwidths_from_gains(DEVICE, motor, J, AFTER_GAINS, supply=30.0)
    found = gains_in_si(DEVICE, 30.0, AFTER_GAINS)
    assert found.torque_p == pytest.approx(2.0 * math.pi * means.current_hz * motor.L_q)
    assert found.velocity_p == pytest.approx(2.0 * math.pi * means.velocity_hz * J / motor.torque_constant)
    assert found.velocity_integration == pytest.approx(means.velocity_integration_s)
    assert found.position_p == pytest.approx(2.0 * math.pi * means.position_hz)
    # I_T = 2.62 R/L, by which the integrator cancels the winding.
    assert gains_in_si(DEVICE, 30.0, AFTER_GAINS._replace(torque_i=2621)).torque_integration == pytest.approx(
        1e-3, rel=1e-3
    )
    assert gains_in_si(DEVICE, 30.0, Gains(1, 0, 1, 0, 1))[1::2] == (math.inf, math.inf)
