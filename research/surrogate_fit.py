"""The surrogate's network in torch, and its fit to trials; `surrogate.py` has its equations, and acts with it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from agents.tuner.surrogate import ASKED, CONTEXT, IDENTIFIED, KEY, LAYERS, LEAST, MOST, SHOWN, Normaliser
from mechanics.arrays import Singles

HEADS, VALUE, SUMMARY, HIDDEN, HIDDEN_OF_TRIAL = 4, 24, 64, 96, 128
# Of the dynamics, over their standard deviation: exact ones would tell a set of machines, and with it their load.
BLUR = 0.5
EPOCHS, BATCH, RATE, DECAY = 30, 128, 4e-3, 2e-3  # BATCH is of machines


class TrialData(NamedTuple):
    """Trials of machines.

    context: Shape (n, 21). gains: ln over the rule's, (n, trials, gains). shown: What they showed, (n, trials, 16).
    worth: ln of the robust cost, (n, trials); NaN where a machine had fewer trials than others.
    """

    context: Singles
    gains: Singles
    shown: Singles
    worth: Singles


def join(parts: Sequence[TrialData]) -> TrialData:
    """Return the machines of all parts."""
    most = max(part.worth.shape[1] for part in parts)

    def padded(values: Singles, filling: float) -> Singles:
        none = ((0, 0),) * (values.ndim - 2)
        return np.pad(values, ((0, 0), (0, most - values.shape[1]), *none), constant_values=filling)

    return TrialData(
        np.concatenate([part.context for part in parts]),
        np.concatenate([padded(part.gains, 0.0) for part in parts]),
        np.concatenate([padded(part.shown, 0.0) for part in parts]),
        np.concatenate([padded(part.worth, math.nan) for part in parts]),
    )


class SurrogateNetwork(nn.Module):  # type: ignore[misc]
    """The network of `surrogate.EnsembleMember`, for normalised inputs."""

    def __init__(self, gains: int) -> None:
        super().__init__()
        self.trial_in = nn.Linear(CONTEXT + gains + SHOWN, HIDDEN_OF_TRIAL)
        self.trial_out = nn.Linear(HIDDEN_OF_TRIAL, VALUE + SUMMARY + HEADS * KEY)
        self.query = nn.Linear(gains + CONTEXT, HEADS * KEY)
        self.nearness = nn.Parameter(torch.linspace(-2.0, 2.0, HEADS))
        self.worth_in = nn.Linear(gains + HEADS * VALUE + CONTEXT + SUMMARY, HIDDEN)
        self.worth_hidden = nn.Linear(HIDDEN, HIDDEN)
        self.worth_out = nn.Linear(HIDDEN, 2)

    def forward(self, context: Tensor, asked: Tensor, tried: Tensor, shown: Tensor, known: Tensor) -> Tensor:
        """Return median and ln of the scale, (machines, n, 2), of asked gains (machines, n, gains)."""
        machines, n, _ = asked.shape
        trials = tried.shape[1]

        def each(values: Tensor, count: int) -> Tensor:
            return values[:, None].expand(-1, count, -1)

        told = self.trial_out(silu(self.trial_in(torch.cat([each(context, trials), tried, shown], -1))))
        value, share, keys = told.split([VALUE, SUMMARY, HEADS * KEY], -1)
        weight = known.float() / known.sum(-1, keepdim=True)
        summary = silu(torch.einsum("mt,mtu->mu", weight, share))
        query = self.query(torch.cat([asked, each(context, n)], -1)).reshape(machines, n, HEADS, KEY)
        distance = (asked[:, :, None] - tried[:, None]).square().sum(-1)
        score = torch.einsum("mnhk,mthk->mnth", query, keys.reshape(machines, trials, HEADS, KEY))
        score = score - distance[..., None] * self.nearness.exp()
        attention = torch.softmax(score.masked_fill(~known[:, None, :, None], -1e9), 2)
        seen = torch.einsum("mnth,mtv->mnhv", attention, value).flatten(2)
        h = silu(self.worth_in(torch.cat([asked, seen, each(context, n), each(summary, n)], -1)))
        found: Tensor = self.worth_out(silu(self.worth_hidden(h)))
        return found


def fit(
    data: TrialData,
    reach: Sequence[float],
    seed: int,
    networks: int,
    progress: Callable[[float], None] = lambda share: None,
) -> dict[str, Singles]:
    """Return the arrays of a surrogate: the normaliser's, and the networks' weights in half precision.

    Args:
        data: Trials.
        reach: By which the gains are divided, one number for each.
        seed: Of the networks.
        networks: How many.
        progress: Called with the share that is done.
    """
    normal = _normaliser(data, reach)
    arrays: dict[str, Any] = normal._asdict()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # networks this small are slower on several; and the result is the same everywhere
    fitted = []
    for k in range(networks):
        fitted.append(_fit_one(data, normal, seed + k, partial(_part, progress, k, networks)))
    torch.set_num_threads(threads)
    for name in fitted[0]:
        # A thousandth of ln J does not matter, and the file is half as large.
        arrays[name] = np.stack([one[name] for one in fitted]).astype(np.float16)
    return arrays


def _part(progress: Callable[[float], None], number: int, count: int, share: float) -> None:
    progress((number + share) / count)


def _normaliser(data: TrialData, reach: Sequence[float]) -> Normaliser:
    flat = data.shown[np.isfinite(data.worth)]
    return Normaliser(
        data.context.mean(axis=0), 1.0 / (data.context.std(axis=0) + 1e-6),
        flat.mean(axis=0), 1.0 / (flat.std(axis=0) + 1e-6), 1.0 / np.array(reach, np.float32)
    )  # fmt: skip


def _fit_one(data: TrialData, normal: Normaliser, seed: int, progress: Callable[[float], None]) -> dict[str, Singles]:
    """Return a network's weights, fitted to the worth of all trials, each time knowing other ones of the machine.

    It knows the trial at the rule's gains always, of the others a random number, the asked one included or not: so it
    learns both to foresee a trial and to judge it.
    """
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    count, trials, gains = data.gains.shape
    net = SurrogateNetwork(gains)
    context, shown = torch.from_numpy(normal.context(data.context)), torch.from_numpy(normal.shown(data.shown))
    of_rule = torch.from_numpy(normal.shown(data.context[:, IDENTIFIED : IDENTIFIED + SHOWN]))
    asked = torch.from_numpy(normal.gains(data.gains))
    tried = torch.cat([torch.zeros(count, 1, gains), asked], 1)
    showed = torch.cat([of_rule[:, None], shown], 1)
    worth, real = torch.from_numpy(data.worth), torch.from_numpy(np.isfinite(data.worth))
    optimiser = torch.optim.AdamW(net.parameters(), RATE / 2.0, weight_decay=DECAY)
    steps = EPOCHS * math.ceil(count / BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    for epoch in range(EPOCHS):
        for rows in torch.randperm(count, generator=generator).split(BATCH):
            number = torch.randint(0, trials + 1, (len(rows), 1), generator=generator)
            others = torch.rand(len(rows), trials, generator=generator).argsort(1) < number
            others &= real[rows]
            known = torch.cat([torch.ones(len(rows), 1, dtype=torch.bool), others], 1)
            blur = BLUR * torch.randn(len(rows), ASKED, generator=generator)
            blurred = torch.cat([context[rows, :-ASKED], context[rows, -ASKED:] + blur], 1)
            told = net(blurred, asked[rows], tried[rows], showed[rows], known)
            loss = _surprise(told[real[rows]], worth[rows][real[rows]])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        progress((epoch + 1) / EPOCHS)
    found = {"nearness": net.nearness.detach().numpy().copy()}
    for name in LAYERS:
        layer = getattr(net, name)
        found[f"{name}_weight"] = layer.weight.detach().T.numpy().copy()
        found[f"{name}_bias"] = layer.bias.detach().numpy().copy()
    return found


def _surprise(told: Tensor, worth: Tensor) -> Tensor:
    """Return the mean of -ln of the Laplace law's density, without ln 2."""
    ln_scale = told[..., 1].clamp(LEAST, MOST)
    return ((worth - told[..., 0]).abs() / ln_scale.exp() + ln_scale).mean()
