"""Read a certificate: is it as it was written, what is the verdict, which reservations, which figures.

python examples/read_certificate.py tuned/certificate.json

It ends with 1 unless every axis was accepted without reservations, so that a script may go by it.
"""

import argparse
import math
import sys

from tuning.certificate.certificate_files import load_certificate


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", help="certificate.json of drive-tune auto or drive-agent tune")
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
        for loop in axis.frequency_responses:
            if loop.tuned:
                figures = {name: value for name, value in loop.margins.items() if math.isfinite(value)}
                print(f"  {loop.name}: " + ", ".join(f"{name} {value:.3g}" for name, value in figures.items()))
        for step in axis.steps:
            if step.tuned:
                figures = {name: value for name, value in step.figures.items() if math.isfinite(value)}
                print(f"  {step.name}: " + ", ".join(f"{name} {value:.3g}" for name, value in figures.items()))
    return 0 if all(axis.verdict == "accepted" for axis in certificate.axes) else 1


if __name__ == "__main__":
    sys.exit(main())
