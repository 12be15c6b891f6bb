"""Tells the supervisor's commands from anybody else's."""

from __future__ import annotations

import secrets

from sensor_msgs.msg import JointState
from std_msgs.msg import String

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.nodes import convert, qos

TOPIC = 'supervisor/identity'
TEXT_LIMIT = 40     # characters of somebody else's text in ours
KIND = 'not from the supervisor'


def new_identity(name: str) -> str:
    """Make the identity of one run of a node: its name and 8 hex digits."""
    return f'{name}:{secrets.token_hex(4)}'


class CommandSource:
    """
    Reads commands for a node that executes them.

    Before a supervisor was heard, each command is taken. From then on only those are whose
    frame_id is its identity; the latest supervisor counts.
    """

    def __init__(self, node):
        """Listen to the identity, which is latched, for ``node``."""
        self._identity = ''
        node.create_subscription(String, TOPIC, self._on_identity, qos.LATCHED)

    def _on_identity(self, message):
        self._identity = message.data

    def read(self, message: JointState) -> Command:
        """Read a command; MessageError when it is malformed or somebody else's."""
        source = message.header.frame_id
        if self._identity and source != self._identity:
            name = f"'{source[:TEXT_LIMIT]}'" if source else 'no identity'
            raise convert.MessageError(
                f"2nd publisher: frame_id has {name}, expected '{self._identity[:TEXT_LIMIT]}'",
                KIND)
        return convert.command(message)
