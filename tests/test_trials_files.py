"""The picture of a search: whose best its line is, and which trials count."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from tuning.search.optimise import Settings, TrialRow
from tuning.search.trials_files import trials_figure

ALONE, OF_EACH = "best accepted so far", "best accepted so far, of each search"


@pytest.mark.parametrize(("searches", "label"), [(1, ALONE), (2, OF_EACH)])
def test_the_picture_says_whose_best_its_line_is(searches, label):
    """One line for each search, the first of which has the label; what was stopped is no best."""
    rows = [
        TrialRow(search, number, np.full((1, 5), 100), math.log(3.0 - number), (1.0, 1.0, 1.0), aborted=number == 2)
        for search in range(searches)
        for number in range(3)
    ]
    figure = trials_figure(SimpleNamespace(rows=rows, t_0=1.0), Settings(), "tmcm1636")
    (axes,) = figure.axes
    assert axes.get_legend().get_texts()[0].get_text() == label
    best = [line.get_ydata() for line in axes.get_lines()]
    np.testing.assert_allclose(best, [[3.0, 2.0, 2.0]] * searches)
