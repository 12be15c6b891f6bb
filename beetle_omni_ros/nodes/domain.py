"""A ROS domain that nobody else on this computer uses."""

from contextlib import contextmanager
import fcntl
import os
from pathlib import Path
import socket
import tempfile

# Linux keeps its ephemeral ports clear of domains up to 101; 0 is everybody's default.
DOMAINS = range(101, 0, -1)
# Ports of the RTPS standard: base + gain * domain + offset.
PORT_BASE, DOMAIN_GAIN, USER_UNICAST = 7400, 250, 11


@contextmanager
def reserved():
    """
    Reserve a free ROS domain while the context lasts.

    Yields:
        Its number.

    Raises:
        OSError: all are taken.

    """
    folder = Path(tempfile.gettempdir()) / f'beetle_omni_{os.getuid()}'
    folder.mkdir(mode=0o700, exist_ok=True)
    for number in DOMAINS:
        with open(folder / f'domain{number}.lock', 'w') as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            if _quiet(number):
                yield number
                return
    raise OSError('no free ROS domain between 1 and 101')


def _quiet(number):
    """Whether no participant of another program has the domain's first unicast port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', PORT_BASE + DOMAIN_GAIN * number + USER_UNICAST))
        except OSError:
            return False
    return True
