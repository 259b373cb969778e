"""Pictures of responses: what is not coherent is grey and belongs to no line."""

import dataclasses

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.image import imread

from tuning.response.bode import GREY, MEASURED, TRACED, bode_figure, write_bode
from tuning.response.frequency_response import Signal, measure
from tuning.target import emulated


@pytest.fixture(scope="module")
def response():
    with np.errstate(all="raise", under="ignore"):
        found = measure(
            emulated(load="inertia", parameters={"motor.encoder_interpolation": 16.0}),
            traced=True,
            signal=Signal(high=400),
        )
    coherence = found.coherence.copy()
    coherence[10:15] = 0.5
    return dataclasses.replace(found, coherence=coherence)


def drawn(plot, colour):
    """Return the frequencies of what is drawn in a colour."""
    points = [
        line.get_xdata()[np.isfinite(line.get_ydata())] for line in plot.lines if to_hex(line.get_color()) == colour
    ]
    return np.concatenate(points) if points else np.zeros(0)


@pytest.mark.slow
@pytest.mark.parametrize("plot", [0, 1])  # magnitude, phase
def test_incoherent_bins_are_grey_and_in_no_line(response, plot):
    axes = bode_figure(response).axes[plot]
    good = response.trusted[:, 0]
    grey = drawn(axes, GREY)
    assert set(response.f[10:15]) <= set(grey)
    assert set(grey) == set(response.f[~good])
    assert set(drawn(axes, MEASURED)) == set(response.f[good & ~response.traced])
    assert set(drawn(axes, TRACED)) == set(response.f[good & response.traced])
    assert min(drawn(axes, TRACED)) > 400.0


def test_the_picture_says_loop_gains_margins_and_source(response):
    figure = bode_figure(response)
    title = figure.get_suptitle()
    assert "velocity loop, axis 0" in title
    assert f"phase margin {response.margins().phase_deg:.1f} deg" in title
    legend = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert legend == ["not coherent", "on the bus, 1 kHz", "emulator's trace, 5 kHz", "linear model"]


def test_a_margin_that_was_not_seen_is_called_so(response):
    blind = dataclasses.replace(response, coherence=np.zeros_like(response.coherence))
    assert "phase margin not measured" in bode_figure(blind).get_suptitle()


@pytest.mark.slow
def test_a_picture_is_written(response, tmp_path):
    write_bode(tmp_path / "bode.png", response)
    pixels = imread(tmp_path / "bode.png")
    assert pixels.shape[0] > 600
    assert pixels[..., :3].std() > 0.05
