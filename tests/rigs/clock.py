"""A clock of a test's own, in place of `time`."""


class Clock:
    """Time that passes by sleeping alone."""

    def __init__(self):
        self.now, self.slept = 1000.0, []

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now += seconds
