"""
Who can find the nodes: this computer alone, unless somebody asked for more.

A second robot, or a student's simulation in the same network, would otherwise publish on the same
topics. ``BEETLE_OMNI_DISCOVERY=SUBNET`` opens it, and so does every setting of ROS itself.
"""

from collections.abc import MutableMapping
import os

from beetle_omni_ros.robot.schema import ParameterError

OWN = 'BEETLE_OMNI_DISCOVERY'
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# Settings of ROS by which a user has chosen already; what they say holds.
CHOSEN = (RANGE, 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS')
RANGES = ('LOCALHOST', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT')


def confine(environment: MutableMapping[str, str] | None = None) -> None:
    """
    Confine discovery to this computer, before the first context is made.

    Args:
        environment: variables to change; None: those of this process.

    Raises:
        ParameterError: ``BEETLE_OMNI_DISCOVERY`` is none of ``RANGES``; one line.

    """
    environment = os.environ if environment is None else environment
    asked = environment.get(OWN, '').strip().upper()
    if asked and asked not in RANGES:
        raise ParameterError(f"{OWN}: expected one of {', '.join(RANGES)}, found {asked[:40]!r}")
    if asked:
        environment[RANGE] = asked
    elif not any(environment.get(name) for name in CHOSEN):
        environment[RANGE] = RANGES[0]
