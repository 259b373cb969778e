"""Stages of auto that do nothing, and what stages hand on, for tests of what lies around and between them."""

from __future__ import annotations

import numpy as np

from tuning.auto import one_button
from tuning.auto.stages import Basis, IdentifiedAxes, RecordedGains, TriedGains


def basis(reference, *, before=None, plant=None, found=None):
    """Return what a search starts from: the rule's gains, (num_axes, count), and one plant for all axes."""
    reference = np.asarray(reference)
    n = len(reference)
    before = reference if before is None else np.asarray(before)
    return Basis(
        IdentifiedAxes((found,) * n, (plant,) * n), before, reference, np.tile(reference, (3, 1, 1)), ("",) * n
    )


def recorded(gains, *, spare=0, **known):
    """Return gains, (num_axes, count), of which nothing more than this is known."""
    tried = TriedGains.only(np.asarray(gains))
    values = vars(RecordedGains.of(tried)) | {"spare": np.full_like(tried.spare, spare)} | known
    return RecordedGains(**values)


def skip_stages(replace, gains):
    """Have auto find gains, (num_axes, count), and move nothing; `replace` is monkeypatch.setattr or setattr."""

    def stays(bench, basis, recorded, *more):
        return recorded

    replace(
        one_button, "identify", lambda bench, experiments: IdentifiedAxes((None,) * len(gains), (None,) * len(gains))
    )
    replace(one_button, "prepare", lambda bench, identified: basis(gains, before=bench.before))
    replace(one_button, "compute", lambda bench, basis, *more: None)
    replace(one_button, "prove", lambda bench, basis, candidates: TriedGains.only(gains.copy()))
    for name in ("show", "measure", "look_back"):
        replace(one_button, name, stays)
