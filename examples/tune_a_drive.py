"""Tune a drive: identify it, let a rule compute its gains, write them with a way back, record a move.

python examples/tune_a_drive.py --load belt --rule cascade
"""

import argparse

import numpy as np

from drive_env import motion
from drive_env.drives.raw_gains import write_gains
from drive_env.loops.linear_model import Plant
from mechanics.loads import LOADS
from tuning.identify.identification import identify
from tuning.rules.rules_by_name import RULES, propose
from tuning.snapshot import Transaction
from tuning.target import emulated

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--load", default="two_mass", choices=LOADS, help="load")
parser.add_argument("--rule", default="margin_55", choices=RULES, help="rule")
options = parser.parse_args()
with emulated(load=options.load) as target:  # a real drive: on_bus(channel="can0", travel=(-20.0, 20.0), ...)
    gains = []
    for supply, found in zip(target.supply, identify(target), strict=True):
        plant = Plant.from_identification(target.device, target.motor, supply, found)
        gains.append(propose(options.rule, target.device, target.motor, plant).gains)
    with Transaction(target, "before.toml") as transaction:  # without commit(), all is as it was
        write_gains(target.drives, np.array(gains))
        transaction.commit()
    motion.enable(target.drives, mode="pp")
    motion.start_move(target.drives, 32_768, relative=True)  # half a turn
    trace = target.drives.record(["Position actual value"], duration=0.5)
    position = trace["Position actual value"]
    for one in gains:
        print(", ".join(f"{name}={value}" for name, value in zip(target.device.gains.names, one, strict=True)))
    print(f"moved by [inc]: {position[-1] - position[0]}")
