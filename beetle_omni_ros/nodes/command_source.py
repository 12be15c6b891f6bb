"""Filter on commands: actuators execute those of the supervisor only."""

import secrets
from typing import Any

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.messages.conversions import take_command
from beetle_omni_ros.messages.values import MessageError
from beetle_omni_ros.nodes import wire

TOPIC = 'supervisor/identity'
TEXT_LIMIT = 40     # characters of a foreign frame_id in an error message
KIND = 'not from the supervisor'


def new_identity(name: str) -> str:
    """Return an identity for one run of a node: its name and 8 random hex digits."""
    return f'{name}:{secrets.token_hex(4)}'


class CommandSource:
    """
    Reads commands for a node that executes them.

    Until a supervisor publishes its identity, every command is accepted. After that, only commands
    whose frame_id is the newest identity are accepted.
    """

    def __init__(self, node):
        self._identity = ''
        wire.subscribe(node, TOPIC, self._on_identity)

    def _on_identity(self, identity):
        self._identity = identity

    def read(self, message: Any) -> Command:
        """Read a command; MessageError if it is malformed or not from the supervisor."""
        source = message.header.frame_id
        if self._identity and source != self._identity:
            name = f"'{source[:TEXT_LIMIT]}'" if source else 'no identity'
            raise MessageError(
                f"2nd publisher: frame_id has {name}, expected '{self._identity[:TEXT_LIMIT]}'",
                KIND)
        return take_command(message)
