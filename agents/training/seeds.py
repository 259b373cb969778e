"""Seeds of training, validation and test: ranges that never meet, so that no agent is judged on what it has seen."""

from __future__ import annotations

TRAINING = range(2**32)  # a segment's 31 bits (training_run.segment_seed), and one more for each environment
VALIDATION = range(2**32, 2**33)  # of a search for hyper-parameters
TEST = range(2**33, 2**34)  # of the benchmark: its episode k has the seed TEST[k]
