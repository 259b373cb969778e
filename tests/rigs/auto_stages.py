"""Stages of auto that do nothing, and what stages hand on, for tests of what lies around and between them."""

from __future__ import annotations

from dataclasses import replace as vary
from types import SimpleNamespace

import numpy as np

from agents.tuner.tuning_run import method_of
from drive_env.loops.dynamics import DEFAULT
from tuning.auto import correction, design, one_button
from tuning.auto.stages import Basis, IdentifiedAxes, RecordedGains


def basis(reference, *, before=None, plant=None, found=None):
    """Return what a design starts from: reference and calm gains, (num_axes, count), and one plant for all axes."""
    reference = np.asarray(reference)
    n = len(reference)
    before = reference if before is None else np.asarray(before)
    return Basis(IdentifiedAxes((found,) * n, (plant,) * n), before, reference, reference, np.full(n, "", object))


def recorded(gains, **known):
    """Return gains, (num_axes, count), of which nothing more than this is known."""
    return vary(RecordedGains.only(np.asarray(gains)), **known)


def designs(replace, gains, again=None):
    """Have auto design gains, (num_axes, count), at once, and others where it corrects; `replace` is setattr."""

    def design_axes(bench, basis, where, say=None, recorded=None, dynamics=None, most=None):
        wanted = gains if recorded is None or again is None else again
        n = len(bench.before)
        one = np.ones(n)
        return np.array(np.resize(wanted, (n, bench.before.shape[1]))), one, one

    replace(one_button, "design_axes", design_axes)
    replace(correction, "design_axes", design_axes)


def short_designs(replace):
    """Have auto look at few sets of gains; `replace` is monkeypatch.setattr or setattr."""
    for name, value in (("FINALISTS", 2), ("EACH", 1), ("STEPS", (1.15,)), ("PROMISING", 4)):
        replace(design, name, value)


def run_agent(target, policy, file, *, name, doubts=()):
    """Tune by an agent as `drive-tune auto --by agent` does; return the result, and each trial."""
    trials = []
    method = method_of(policy, name, doubts, trials.append, lambda what: None)
    asked = policy.bundle.configuration.get("dynamics", DEFAULT)
    return SimpleNamespace(result=one_button.auto(target, file, method=method, dynamics=asked), trials=trials)


def skip_stages(replace, gains):
    """Have auto find gains, (num_axes, count), and move nothing; `replace` is monkeypatch.setattr or setattr."""
    n = len(gains)
    replace(one_button, "identify", lambda bench, experiments: IdentifiedAxes((None,) * n, (None,) * n))
    replace(one_button, "prepare", lambda bench, identified: basis(gains, before=bench.before))
    replace(one_button, "on_twins", lambda bench, basis, say: RecordedGains.only(gains.copy()))
    replace(one_button, "correct", lambda bench, basis, tried, target, say, improves: tried)
    replace(one_button, "record_previous_gains", lambda bench, basis, recorded: recorded)
    replace(one_button, "judge", lambda bench, basis, recorded: recorded)
