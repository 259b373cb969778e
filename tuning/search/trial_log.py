"""Trials of a search, remembered in a file: after the process was killed they are taken from there, not made again.

A search is a function of its seed and of what its trials showed. With those at hand it goes through the same steps
without moving anything, until it comes to the trial at which it ended, and on from there, to the last digit.
"""

from __future__ import annotations

import numpy as np

from drive_env.drives.raw_gains import read_gains, write_gains
from mechanics.arrays import Integers, Mask
from tuning.runs.shard_log import ShardLog, ShardLogError
from tuning.search.trial_bench import TrialBench, Tried
from tuning.target import DriveTime


class LoggedTrials:
    """Runs trials on a bench, or takes them from a log.

    Args:
        bench: Which begins every trial anew, so that a trial does not depend on those before it.
        clock: Time that passes on the drives, which goes on as well.
        log: A frame for each call of `run`.
    """

    def __init__(self, bench: TrialBench, clock: DriveTime, log: ShardLog) -> None:
        self._bench, self._clock, self._log = bench, clock, log
        self._number = 0

    def run(self, gains: Integers, where: Mask) -> Tried:
        """Try gains as `TrialBench.run` does.

        Raises:
            ShardLogError: If the log has another trial in this place.
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
