"""A tuner against searches with as many trials, on machines that it was not trained on: the answer of each.

    python -m research.tuner_comparison --machines 26
    python -m research.tuner_comparison --device tgz_d --tuners surrogate_tgz.npz tpe

A search is given J by measured terms of its trials, the rule's gains first, and answers the best one. It draws gains
from the range that the device's tuner tries.
"""

from __future__ import annotations

import argparse

import numpy as np

from agents.policies.policy import load_policy
from agents.shipped import TUNER, find_agent
from agents.tuner.surrogate import IDENTIFIED, SHOWN
from mechanics.arrays import Singles
from research.surrogate_training import BUDGETS, UNSEEN, Answers, judge
from research.tuner_recipes import RECIPES, Recipe
from tuning.search.samplers import Proposer, new_proposer

SAMPLERS = ("tpe", "cmaes", "gp")


class SearchPolicy:
    """A search as a tuner of `judge`: one proposer for each machine."""

    def __init__(self, recipe: Recipe, sampler: str) -> None:
        self._recipe, self._sampler = recipe, sampler
        self._proposers: list[Proposer] = []

    def reset(self) -> None:
        """Forget the machines."""
        self._proposers = []

    def act(self, observation: Singles) -> Singles:
        """Return the change of the log gains to try, from the incumbent."""
        if not self._proposers:
            low, high = np.array(self._recipe.low), np.array(self._recipe.high)
            self._proposers = [
                new_proposer(self._sampler, low, high, seed=k, trials=11, first=[np.zeros(len(low))])
                for k in range(len(observation))
            ]
            for proposer in self._proposers:
                proposer.ask(1)
        G = len(self._recipe.gains)
        for proposer, cost in zip(self._proposers, observation[:, IDENTIFIED + 2 * G + SHOWN - 1], strict=True):
            proposer.tell([[float(cost)]], [{}])
        asked = np.array([proposer.ask(1)[0] for proposer in self._proposers])
        return np.asarray(asked - observation[:, IDENTIFIED + G : IDENTIFIED + 2 * G], np.float32)

    def answer(self, observation: Singles) -> Singles:
        """Return no change: the incumbent stays."""
        return np.zeros((len(observation), len(self._recipe.gains)), np.float32)


def main() -> None:
    """Compare from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=RECIPES, default="tmcm1636", help="drive that is tuned")
    parser.add_argument("--machines", type=int, default=BUDGETS["full"].judged, help="machines of a row")
    parser.add_argument("--tuners", nargs="+", default=[TUNER, *SAMPLERS], help="agents, by name or file, or samplers")
    arguments = parser.parse_args()
    recipe = RECIPES[arguments.device]
    for name in arguments.tuners:
        policy = SearchPolicy(recipe, name) if name in SAMPLERS else load_policy(find_agent(name))
        _tell(recipe, name, judge(recipe, policy, arguments.machines, UNSEEN))


def _tell(recipe: Recipe, name: str, answers: Answers) -> None:
    print(f"{name}: robust cost over the rule's, median {np.median(answers.ratio):.2f}; constraints kept "
          f"{100.0 * answers.kept.mean():.0f} % (the rule {100.0 * answers.rule.mean():.0f} %); trials stopped "
          f"{100.0 * answers.aborted.mean():.0f} %")  # fmt: skip
    for row, ratio, kept in zip(recipe.rows, answers.ratio, answers.kept, strict=True):
        print(f"  {row.name}: {np.median(ratio):.2f}, {100.0 * kept.mean():.0f} %")


if __name__ == "__main__":
    main()
