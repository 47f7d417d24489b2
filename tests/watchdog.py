"""A watchdog for tests of what must not hang: it ends a hung call, and times nothing else."""

import contextlib
import faulthandler
import signal

LIMIT = 60.0  # seconds, for a call that needs at most 5 on a quiet machine: the suite may share its machine


class HungError(Exception):
    """The call did not return."""


def _bite(*_):
    raise HungError("the call did not return: it hangs")


@contextlib.contextmanager
def watched(seconds=LIMIT):
    """End the block with an error after so long; the process, if the block is deaf to signals, after twice as long."""
    before = signal.signal(signal.SIGALRM, _bite)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    faulthandler.dump_traceback_later(2 * seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
