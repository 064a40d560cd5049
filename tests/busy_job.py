"""A job for processes, in a module that imports next to nothing, as each process imports it anew."""

from typing import NamedTuple


class BusyJob(NamedTuple):
    """A job that reports once and then never looks up again."""

    number: int

    def run(self, report):
        report(self.number)
        while True:
            pass


class BriefJob(NamedTuple):
    """A job that reports once and ends."""

    number: int

    def run(self, report):
        report(self.number)
