"""A drive's FMU in FMPy: enable it, move two turns in pp, follow a sine in csp; what happened as CSV and as a picture.

drive-env export fmu tmcm1636 --load two_mass --out servo.fmu
python examples/fmu_move.py servo.fmu --out move

The program imports nothing of drive-env; the FMU does, in the Python that runs it.
"""

import argparse
import csv
import math
import shutil
from pathlib import Path

import fmpy
import matplotlib
from fmpy.fmi3 import FMU3Slave

matplotlib.use("Agg")
from matplotlib import pyplot

CYCLE = 0.001  # s: the drive's communication cycle, the least step
TURN = 65536  # increments of a revolution
PP, CSP = 1, 8  # modes of operation
SHUTDOWN, SWITCH_ON, ENABLE, NEW_SET_POINT = 0x06, 0x07, 0x0F, 0x1F  # controlwords
STATE, ENABLED, TARGET_REACHED = 0x6F, 0x27, 0x400  # of the statusword
INPUTS = ("mode_of_operation", "controlword", "target_position")
OUTPUTS = ("statusword", "position_demand_value", "position_actual_value", "torque_actual_value")


class Servo:
    """The FMU, one communication cycle after the other."""

    def __init__(self, file: str) -> None:
        description = fmpy.read_model_description(file)
        self.reference = {one.name: one.valueReference for one in description.modelVariables}
        self.folder = fmpy.extract(file)
        self.fmu = FMU3Slave(
            guid=description.guid, unzipDirectory=self.folder, instanceName="servo",
            modelIdentifier=description.coSimulation.modelIdentifier,
        )  # fmt: skip
        self.inputs = dict.fromkeys(INPUTS, 0)
        self.rows: list[dict[str, int]] = []
        self.fmu.instantiate()
        self.fmu.enterInitializationMode()
        self.fmu.setInt64([self.reference["'Profile velocity'"]], [20 * TURN])  # as the dictionary calls 6081h
        self.fmu.exitInitializationMode()

    def step(self, **inputs: int) -> dict[str, int]:
        """Set inputs, let a cycle pass, and return the outputs."""
        self.inputs |= inputs
        self.fmu.setInt32([self.reference[name] for name in INPUTS], list(self.inputs.values()))
        self.fmu.doStep(len(self.rows) * CYCLE, CYCLE)
        values = self.fmu.getInt32([self.reference[name] for name in OUTPUTS])
        self.rows.append(self.inputs | dict(zip(OUTPUTS, values, strict=True)))
        return self.rows[-1]

    def step_until(self, mask: int, value: int, most: int = 2000) -> dict[str, int]:
        """Let cycles pass until the statusword has a value in the bits of a mask."""
        for _ in range(most):
            row = self.step()
            if row["statusword"] & mask == value:
                return row
        raise TimeoutError(f"the statusword is {row['statusword']:04X}h after {most} cycles")

    def close(self) -> None:
        """End the FMU."""
        self.fmu.terminate()
        self.fmu.freeInstance()
        shutil.rmtree(self.folder, ignore_errors=True)


def draw(rows: list[dict[str, int]], file: str) -> None:
    """Draw positions and current over time."""
    time = [CYCLE * k for k in range(len(rows))]
    figure, (above, below) = pyplot.subplots(2, 1, sharex=True, figsize=(7, 4.2), height_ratios=(2, 1))
    for name, label in (("position_demand_value", "demanded"), ("position_actual_value", "actual")):
        above.plot(time, [row[name] / TURN for row in rows], label=label)
    below.plot(time, [row["torque_actual_value"] / 1000 for row in rows], color="C2")
    above.set(ylabel="position [rev]")
    above.legend()
    below.set(xlabel="time [s]", ylabel="current [A]")
    figure.tight_layout()
    figure.savefig(file, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("fmu", help="FMU of FMI 3, of a drive with one axis")
    parser.add_argument("--out", default="move", help="name of the CSV and of the picture, without ending")
    options = parser.parse_args()
    servo = Servo(options.fmu)
    servo.step(mode_of_operation=PP)
    for controlword in (SHUTDOWN, SWITCH_ON, ENABLE):
        servo.step(controlword=controlword)
    servo.step_until(STATE, ENABLED)
    servo.step(target_position=2 * TURN, controlword=NEW_SET_POINT)
    servo.step(controlword=ENABLE)
    end = servo.step_until(TARGET_REACHED, TARGET_REACHED)
    print(f"pp: {end['position_actual_value']} inc after {len(servo.rows)} ms")
    servo.step(mode_of_operation=CSP)
    for k in range(500):
        servo.step(target_position=2 * TURN + round(TURN * math.sin(2 * math.pi * k * CYCLE) ** 2))
    print(f"csp: {servo.rows[-1]['position_actual_value']} inc, statusword {servo.rows[-1]['statusword']:04X}h")
    servo.close()
    with Path(f"{options.out}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, servo.rows[0])
        writer.writeheader()
        writer.writerows(servo.rows)
    draw(servo.rows, f"{options.out}.png")


if __name__ == "__main__":
    main()
