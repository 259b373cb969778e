"""Seeds by purpose: disjoint ranges, so that no agent is evaluated in episodes of its training."""

from __future__ import annotations

# Of trainings, a segment's 31 bits (training_run.segment_seed): environments of a seed are told apart by a spawn key.
TRAINING = range(2**32)
VALIDATION = range(2**32, 2**33)  # of a search for hyper-parameters
TEST = range(2**33, 2**34)  # of the benchmark: its episode k has the seed TEST[k]
EVALUATION = range(20_000_000_000, 30_000_000_000)  # of `drive-agent evaluate`, and of the scores on a training's card
