"""Signals that end a flight: at any moment, and never in the middle of cleaning up."""

from contextlib import contextmanager
import signal
import threading

ENDING = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def terminable():
    """
    Let SIGTERM end what is inside as Ctrl-C does, so that nothing is left behind.

    The first signal counts; those that follow do not cut the cleaning up short.

    Raises:
        KeyboardInterrupt: one of the signals came, whatever a library made of it.

    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came = []

    def interrupt(number, _):
        came.append(number)
        for each in ENDING:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in ENDING}
    try:
        yield
    except Exception:
        if came:
            raise KeyboardInterrupt from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def undisturbed():
    """Let signals wait: who cleans up has been told already, and a launch system tells twice."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
