"""
Entry points of all executables; also ``python -m beetle_omni_ros.start NAME``.

A program takes up to a second to import its modules. An interrupt during the import ends the
process by the signal, without a traceback. Later each program handles it itself. Before this
module Python prints a traceback, so nothing slow may be imported before it.
"""

from functools import partial
from importlib import import_module
import signal
import sys

PACKAGE = 'beetle_omni_ros'
INTERRUPTED = 130
TOOL = 'beetle_omni'    # all other executables are nodes


def run(name: str) -> int | None:
    """Run an executable; returns the exit status."""
    # A shell starts background jobs with the signal ignored, which must stay so.
    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if handled:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    main = import_module(f'{PACKAGE}.cli').main if name == TOOL else partial(
        import_module(f'{PACKAGE}.ros.runner').main, name)
    try:
        if handled:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        return main()
    except KeyboardInterrupt:
        return INTERRUPTED
    except RuntimeError as error:   # Python 3.11 wraps an interrupt while a class is made
        if isinstance(error.__cause__, KeyboardInterrupt):
            return INTERRUPTED
        raise


def __getattr__(name):
    """Entry point of the executable ``name``."""
    if name.startswith('_'):
        raise AttributeError(name)
    return partial(run, name)


if __name__ == '__main__':
    if len(sys.argv) < 2:
        sys.exit(f'usage: python -m {PACKAGE}.start NAME ...')
    del sys.argv[0]
    sys.exit(run(sys.argv[0]))
