"""
Range of ROS discovery: by default this computer only.

With a larger range, a second robot or simulation in the same network would publish on the same
topics. The argument ``--discovery SUBNET``, the variable ``BEETLE_OMNI_DISCOVERY=SUBNET`` or a
discovery setting of ROS itself selects another range.
"""

from collections.abc import MutableMapping, Sequence
from contextlib import contextmanager
from itertools import count
import os
import socket

from beetle_omni_ros.robot.schema import ParameterError

VARIABLE, ARGUMENT = 'BEETLE_OMNI_DISCOVERY', '--discovery'
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# Settings of ROS; if the user set one of them, it has precedence over the default.
ROS_SETTINGS = (RANGE, 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS')
RANGES = ('LOCALHOST', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT')
# The ports of domains up to 101 are below the ephemeral ports of Linux; 0 is the default domain.
DOMAINS = range(101, 0, -1)
# Ports of the RTPS standard: base + gain * domain + offset. Offset 0: discovery, shared by all
# participants of a domain; USER_UNICAST: first participant.
PORT_BASE, DOMAIN_GAIN, USER_UNICAST = 7400, 250, 11
_starts = count(os.getpid())


def confine(environment: MutableMapping[str, str] | None = None,
            requested: str | None = None) -> None:
    """
    Set the range of discovery; must run before the first context is made.

    Args:
        environment: variables to change; None: those of this process.
        requested: one of ``RANGES``, for this process and its children; '' or None: the value of
            ``BEETLE_OMNI_DISCOVERY``, else this computer only.

    Raises:
        ParameterError: not one of ``RANGES``.

    """
    environment = os.environ if environment is None else environment
    source, wanted = (ARGUMENT, requested) if requested else \
        (VARIABLE, environment.get(VARIABLE, ''))
    wanted = wanted.strip().upper()
    if wanted and wanted not in RANGES:
        raise ParameterError(f"{source}: expected one of {', '.join(RANGES)}, "
                             f'found {wanted[:40]!r}')
    if wanted:
        environment[VARIABLE] = environment[RANGE] = wanted
    elif not any(environment.get(name) for name in ROS_SETTINGS):
        environment[RANGE] = RANGES[0]


def apply_argument(arguments: Sequence[str]) -> list[str]:
    """
    Apply ``--discovery RANGE`` of a node's arguments.

    Returns:
        The other arguments.

    Raises:
        ParameterError: missing or unknown range.

    """
    rest = []
    left = iter(arguments)
    for argument in left:
        name, equals, value = argument.partition('=')
        if name == ARGUMENT:
            confine(requested=(value if equals else next(left, '')) or 'nothing')
        else:
            rest.append(argument)
    return rest


def claim(name: str) -> socket.socket | None:
    """
    Take a name on this computer, until the socket is closed or the process ends.

    Returns:
        A socket of Linux' abstract namespace, which leaves no file; None: the name is taken.

    """
    holder = socket.socket(socket.AF_UNIX)
    try:
        holder.bind(f'\0beetle_omni/{name}')
    except OSError:
        holder.close()
        return None
    return holder


@contextmanager
def reserved_domain():
    """
    Reserve a free ROS domain while the context lasts.

    Each call begins its search at another number, because participants that are shutting down may
    still send discovery data to new ones in the same domain.

    Yields:
        Number of the domain.

    Raises:
        OSError: no domain is free.

    """
    first = next(_starts) % len(DOMAINS)
    for number in [*DOMAINS[first:], *DOMAINS[:first]]:
        holder = claim(f'domain/{number}')
        if holder is not None:
            with holder:
                if _ports_are_free(number):
                    yield number
                    return
    raise OSError('no free ROS domain between 1 and 101')


def _ports_are_free(number):
    """Whether the ports of the domain are free."""
    for offset in (0, USER_UNICAST):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(('', PORT_BASE + DOMAIN_GAIN * number + offset))
            except OSError:
                return False
    return True
