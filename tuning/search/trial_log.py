"""Trials of a search stored in a file: after an interruption they are read from it instead of repeated.

A search depends only on its seed and the results of its trials. With stored results it repeats the same steps without
moving anything up to the trial at which it was interrupted, and continues from there with identical results.
"""

from __future__ import annotations

import numpy as np

from drive_env.drives.raw_gains import read_gains, write_gains
from mechanics.arrays import Integers, Mask
from tuning.runs.shard_log import ShardLog, ShardLogError
from tuning.search.trial_bench import TrialBench, Tried
from tuning.target import DriveTime


class LoggedTrials:
    """Runs trials on a bench, or reads them from a log.

    Args:
        bench: A bench that resets the machines before every trial, so that a trial does not depend on earlier ones.
        clock: Clock of the drives' time, which is advanced as well.
        log: Log with one frame for each call of `run`.
    """

    def __init__(self, bench: TrialBench, clock: DriveTime, log: ShardLog) -> None:
        self._bench, self._clock, self._log = bench, clock, log
        self._number = 0

    def run(self, gains: Integers, where: Mask) -> Tried:
        """Try gains as `TrialBench.run`.

        Raises:
            ShardLogError: If the log contains another trial at this position.
        """
        bench, drives = self._bench, self._bench.target.drives
        number, self._number = self._number, self._number + 1
        if number not in self._log.done:
            tried = bench.run(gains, where)
            self._log.append(number, {
                "tried": gains, "where": where, **tried._asdict(), "moves": bench.moves, "aborts": bench.aborts,
                "seconds": np.array(self._clock.seconds), "left": read_gains(drives),
            })  # fmt: skip
            return tried
        known = self._log.done[number]
        if not np.array_equal(known["tried"], gains) or not np.array_equal(known["where"], where):
            raise ShardLogError(f"{self._log.path} holds trials of another search; remove it and start again")
        write_gains(drives, known["left"])
        bench.moves, bench.aborts = known["moves"].copy(), known["aborts"].copy()
        self._clock.seconds = float(known["seconds"])
        return Tried(*(known[name] for name in Tried._fields))
