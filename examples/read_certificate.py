"""Read a certificate: is it as it was written, what is the verdict, what was asked for and is kept, figures.

python examples/read_certificate.py tuned/certificate.json

It ends with 1 unless every axis was accepted without reservations, so that a script may go by it.
"""

import argparse
import math
import sys

from tuning.certificate.certificate_files import load_certificate

GAINS = {False: "gains before", True: "new gains"}


def listed(figures: dict[str, float]) -> str:
    """Return figures as a line; a dash stands for a figure that was not measured, or did not come."""
    if not any(map(math.isfinite, figures.values())):
        return "not measured"
    return ", ".join(f"{name} {value:.3g}" if math.isfinite(value) else f"{name} -" for name, value in figures.items())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", help="certificate.json of drive-tune auto")
    options = parser.parse_args()
    certificate, unchanged = load_certificate(options.file)
    if not unchanged:
        print(f"{options.file} was changed after it was written: do not rely on it")
        return 1
    print(
        f"{certificate.device}, motor {certificate.motor}, machine {certificate.machine}, tuned by {certificate.tuner}"
    )
    for axis in certificate.axes:
        print(f"axis {axis.axis}: {axis.verdict}")
        for text in axis.reservations:
            print(f"  reservation: {text}")
        for one in axis.requirements:
            found = f"{'at least ' * one.is_bound}{one.found:.3g}" if math.isfinite(one.found) else "-"
            print(f"  {axis.dynamics} dynamics, {one.name}: {found} for {one.asked:g}, {one.kept}")
        if axis.figures:
            print(f"  {listed(axis.figures)}")
        for one in axis.corrections:
            print(f"  corrected from {list(one.old)} to {list(one.new)}, since {one.reason}: {one.outcome}")
        for loop in axis.frequency_responses:
            print(f"  {loop.name}, {GAINS[loop.tuned]}: {listed(loop.margins)}")
        for step in axis.steps:
            print(f"  {step.name}, {GAINS[step.tuned]}: {listed(step.figures)}")
    return 0 if all(axis.verdict == "accepted" for axis in certificate.axes) else 1


if __name__ == "__main__":
    sys.exit(main())
