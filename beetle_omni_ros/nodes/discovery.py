"""
Who can find the nodes: this computer alone, unless somebody asked for more.

A second robot, or a student's simulation in the same network, would otherwise publish on the same
topics. The argument ``--discovery SUBNET`` opens it, or ``BEETLE_OMNI_DISCOVERY=SUBNET``, and so
does every setting of ROS itself.
"""

from collections.abc import MutableMapping, Sequence
import os

from beetle_omni_ros.robot.schema import ParameterError

OWN, ARGUMENT = 'BEETLE_OMNI_DISCOVERY', '--discovery'
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# Settings of ROS by which a user has chosen already; what they say holds.
CHOSEN = (RANGE, 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS')
RANGES = ('LOCALHOST', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT')


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
