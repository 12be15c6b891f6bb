"""
Entry points of all executables, and ``python -m beetle_omni_ros.start NAME``.

A node takes up to a second to load its modules. An interrupt in this time ends the process by the
signal, without a traceback; afterwards each program answers it in its own way. What comes before
this module stays short: Python itself answers an interrupt there, with a traceback.
"""

from __future__ import annotations

from functools import partial
from importlib import import_module
import signal
import sys

PACKAGE = 'beetle_omni_ros'
INTERRUPTED = 130
PROGRAMS = {'beetle_omni': f'{PACKAGE}.cli'}     # the others are modules of nodes/


def begin(module: str) -> int | None:
    """Import ``module`` and run its ``main``; returns the exit status."""
    # A shell lets what it runs in the background ignore the signal: that stays.
    listens = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if listens:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    main = import_module(module).main
    try:
        if listens:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        return main()
    except KeyboardInterrupt:
        return INTERRUPTED


def __getattr__(name):
    """Give the entry point of an executable."""
    if name.startswith('_'):
        raise AttributeError(name)
    return partial(begin, PROGRAMS.get(name, f'{PACKAGE}.nodes.{name}'))


if __name__ == '__main__':
    if len(sys.argv) < 2:
        sys.exit(f'usage: python -m {PACKAGE}.start NAME ...')
    del sys.argv[0]
    sys.exit(begin(PROGRAMS.get(sys.argv[0], f'{PACKAGE}.nodes.{sys.argv[0]}')))
