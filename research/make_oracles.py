"""Make tuning/compare/oracles.csv: `python -m research.make_oracles` searches the best gains of the suite's machines.

Rows that are still true are kept; `--again` searches all. It takes seconds a machine, half a minute with two axes, two
minutes with six; what is done of a run that is stopped is in the file.
"""

from __future__ import annotations

import argparse

from tuning.compare.oracle import KEPT, digest, find_oracles, read_oracles, write_oracles
from tuning.compare.suite import load_suite


def main() -> None:
    """Search, machine by machine."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", default="public", help="name of the suite (default: public)")
    parser.add_argument("--seed", type=int, default=0, help="of its drawn machines (default: 0)")
    parser.add_argument("--again", action="store_true", help="search those that are kept, too")
    arguments = parser.parse_args()
    machines = load_suite(arguments.suite, arguments.seed)
    rows = {} if arguments.again else read_oracles()
    found = {machine.name: rows[digest(machine)] for machine in machines if digest(machine) in rows}
    for machine in machines:
        found |= find_oracles([machine], kept=None if arguments.again else KEPT)
        row = found[machine.name]
        print(f"{machine.name}: robust performance {row.performance:.3f}, slack {row.slack:.3f}", flush=True)
        write_oracles(KEPT, [one for one in machines if one.name in found], found)


if __name__ == "__main__":
    main()
