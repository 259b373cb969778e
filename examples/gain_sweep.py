"""Sweep the velocity loop's gains from Python: run it, look at the best, save it.

    python examples/gain_sweep.py --points 8 --out runs/example

A coarser grid than `drive-tune sweep`'s, so that it takes seconds.
"""

import argparse
import math
from dataclasses import dataclass, replace

from drive_env.motors import MOTORS
from tuning.runs import sweep
from tuning.runs.sweep_files import save_sweep


@dataclass
class Arguments:
    points: int = 16  # values per gain
    motor: str = "qbl4208"  # drive-tune sweep --list shows the others
    seed: int = 0  # of the machine and its noise
    out: str = ""  # folder for table, pictures and settings; nothing is written without


def main(arguments: Arguments) -> None:
    experiment = sweep.load_experiment(motor=arguments.motor, seed=arguments.seed)
    coarse = tuple(replace(swept, count=arguments.points) for swept in experiment.sweep)
    result = sweep.run(replace(experiment, sweep=coarse))
    for row in result.best(5):
        print(
            ", ".join(
                f"{name} = {row[name]:.4g}" for name in (*result.objects, "score [s]", "settling [s]", "dip [rpm]")
            )
        )
    usable = int((result.score < math.inf).sum())
    print(f"{usable} of {len(result.order)} points are usable")
    if arguments.out:
        print(f"written to {save_sweep(result, arguments.out)}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=Arguments.points, help="values per gain")
    parser.add_argument("--motor", default=Arguments.motor, choices=MOTORS, help="motor")
    parser.add_argument("--seed", type=int, default=Arguments.seed, help="seed of the machine and its noise")
    parser.add_argument("--out", default=Arguments.out, help="folder for the results; nothing is written without")
    main(Arguments(**vars(parser.parse_args())))
