"""
Who can find the nodes: this computer alone, unless somebody asked for more.

A second robot, or a student's simulation in the same network, would otherwise publish on the same
topics. The argument ``--discovery SUBNET`` opens it, or ``BEETLE_OMNI_DISCOVERY=SUBNET``, and so
does every setting of ROS itself.
"""

from collections.abc import MutableMapping, Sequence
from contextlib import contextmanager
from itertools import count
import os
import socket

from beetle_omni_ros.nodes.private import forget, HeldError, Lock
from beetle_omni_ros.robot.schema import ParameterError

OWN, ARGUMENT = 'BEETLE_OMNI_DISCOVERY', '--discovery'
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# Settings of ROS by which a user has chosen already; what they say holds.
CHOSEN = (RANGE, 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS')
RANGES = ('LOCALHOST', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT')
# Linux keeps its ephemeral ports clear of domains up to 101; 0 is everybody's default.
DOMAINS = range(101, 0, -1)
# Ports of the RTPS standard: base + gain * domain + offset. All participants of a domain share the
# first, for discovery; the second is the first participant's own.
PORT_BASE, DOMAIN_GAIN, USER_UNICAST = 7400, 250, 11
_turns = count(os.getpid())


def confine(environment: MutableMapping[str, str] | None = None, asked: str | None = None) -> None:
    """
    Confine discovery to this computer, before the first context is made.

    Args:
        environment: variables to change; None: those of this process.
        asked: one of ``RANGES``, for this process and those that it starts; '' or None: as
            ``BEETLE_OMNI_DISCOVERY`` says.

    Raises:
        ParameterError: what was asked for is none of ``RANGES``; one line.

    """
    environment = os.environ if environment is None else environment
    source, wanted = (ARGUMENT, asked) if asked else (OWN, environment.get(OWN, ''))
    wanted = wanted.strip().upper()
    if wanted and wanted not in RANGES:
        raise ParameterError(f"{source}: expected one of {', '.join(RANGES)}, "
                             f'found {wanted[:40]!r}')
    if wanted:
        environment[OWN] = environment[RANGE] = wanted
    elif not any(environment.get(name) for name in CHOSEN):
        environment[RANGE] = RANGES[0]


def take(arguments: Sequence[str]) -> list[str]:
    """
    Take ``--discovery RANGE`` out of a node's arguments and obey it.

    Returns:
        The other arguments.

    Raises:
        ParameterError: no range, or an unknown one; one line.

    """
    rest = []
    left = iter(arguments)
    for argument in left:
        name, equals, value = argument.partition('=')
        if name == ARGUMENT:
            confine(asked=(value if equals else next(left, '')) or 'nothing')
        else:
            rest.append(argument)
    return rest


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
