"""The benchmark of learning tasks: agents of several seeds and baselines on held-out episodes, with intervals."""
