"""A ROS domain that nobody else on this computer uses."""

from contextlib import contextmanager
from itertools import count
import os
import socket

from beetle_omni_ros.nodes.private import forget, HeldError, Lock

# Linux keeps its ephemeral ports clear of domains up to 101; 0 is everybody's default.
DOMAINS = range(101, 0, -1)
# Ports of the RTPS standard: base + gain * domain + offset. All participants of a domain share the
# first, for discovery; the second is the first participant's own.
PORT_BASE, DOMAIN_GAIN, USER_UNICAST = 7400, 250, 11
_turns = count(os.getpid())


@contextmanager
def reserved():
    """
    Reserve a free ROS domain while the context lasts.

    Each call begins its search at another number: participants that are on their way out may
    still tell the next ones in their domain what they know.

    Yields:
        Its number.

    Raises:
        OSError: all are taken, or there is no safe place for the locks.

    """
    first = next(_turns) % len(DOMAINS)
    for number in [*DOMAINS[first:], *DOMAINS[:first]]:
        try:
            lock = Lock(f'domain{number}.lock')
        except HeldError:
            continue
        try:
            if _quiet(number):
                try:
                    yield number
                finally:
                    forget(f'{number}.*.lock')      # of nodes that were killed in it
                return
        finally:
            lock.close()
    raise OSError('no free ROS domain between 1 and 101')


def _quiet(number):
    """Whether no participant of another program holds a port of the domain."""
    for offset in (0, USER_UNICAST):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(('', PORT_BASE + DOMAIN_GAIN * number + offset))
            except OSError:
                return False
    return True
