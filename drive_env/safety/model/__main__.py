"""python -m drive_env.safety.model: explore the code before and ours, and print every counterexample by its trace."""

from __future__ import annotations

import argparse

from drive_env.safety.model.exploration import explore
from drive_env.safety.model.rules import OURS, TODAY, Assumptions


def main() -> None:
    """Explore both rule sets."""
    parser = argparse.ArgumentParser(prog="python -m drive_env.safety.model", description=__doc__)
    parser.add_argument(
        "--troubles", type=int, default=1, choices=range(4), help="troubles of a run: frames lost, other masters, ..."
    )
    arguments = parser.parse_args()
    for rules in (TODAY, OURS):
        result = explore(rules, Assumptions(arguments.troubles))
        print(f"{rules.name}: {result.states} states, {result.transitions} steps, {result.seconds:.1f} s")
        print("\n".join(map(str, result.found.values())) or "no counterexample")


if __name__ == "__main__":
    main()
