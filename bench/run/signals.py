"""Ctrl-C and SIGTERM. They are noted as well as raised: an interrupted library may swallow or replace the exception."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

_stopped = ""  # by which signal, in words
_delayed = False


def catch_signals() -> None:
    """From now on Ctrl-C and SIGTERM raise KeyboardInterrupt, which says which of them it was."""
    global _stopped
    _stopped = ""
    signal.signal(signal.SIGTERM, _stop)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # a shell's background jobs ignore it
        signal.signal(signal.SIGINT, _stop)


def _stop(number: int, frame: object) -> None:
    global _stopped
    _stopped = "stopped by Ctrl-C" if number == signal.SIGINT else f"stopped by {signal.Signals(number).name}"
    if not _delayed:
        raise KeyboardInterrupt(_stopped)


def stopped_by(error: BaseException) -> str:
    """The signal, in words, of which an error is the outcome; empty where it has another cause."""
    if isinstance(error, KeyboardInterrupt):
        return str(error) or "stopped by Ctrl-C"
    return _stopped


@contextmanager
def signals_delayed() -> Iterator[None]:
    """Signals that arrive in the block raise KeyboardInterrupt at its end."""
    global _delayed
    _delayed = True
    try:
        yield
    finally:
        _delayed = False
    raise_if_stopped()


def raise_if_stopped() -> None:
    """Raises KeyboardInterrupt after a signal, also where nothing came of the first one."""
    if _stopped:
        raise KeyboardInterrupt(_stopped)
