"""A clock that tests of budgets set, in place of that of the machine."""

import pytest

from sympflow.training import session as sessions


class Clock:
    """Time that passes with every evaluation of something."""

    def __init__(self, monkeypatch):
        self.now, self.tick = 0.0, 0.0
        self.patch = monkeypatch
        monkeypatch.setattr(sessions, "time", self)

    def perf_counter(self):
        self.now += self.tick
        return self.now

    time = perf_counter

    def costs_seconds(self, owner, name, seconds):
        """Let a method take so long."""
        whole = getattr(owner, name)

        def slow(*arguments, **options):
            self.now += seconds
            return whole(*arguments, **options)

        self.patch.setattr(owner, name, slow)


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)
