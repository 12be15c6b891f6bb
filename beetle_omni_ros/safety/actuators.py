"""What the actuator bridges say of themselves, as the supervisor understands it."""

from __future__ import annotations

READY, SILENT, LOST = 'ready', 'silent:', 'lost:'
NODES = {'joint': 'joint_bridge_node', 'rotor': 'rotor_bridge_node'}


class Actuators:
    """
    The newest state of each bridge: 'ready', 'waiting: WHY', 'silent: WHY' or 'lost: WHY'.

    A bridge that was never heard has no influence: without bridges the simulator takes commands
    directly.
    """

    def __init__(self):
        self._told: dict[str, str] = {}

    def tell(self, name: str, text: str) -> bool:
        """Take the state of bridge 'joint' or 'rotor'; False for another name."""
        if name not in NODES:
            return False
        self._told[name] = ' '.join(text.split()) or 'says nothing'
        return True

    def fault(self, name: str) -> str:
        """'' while bridge ``name`` obeys or was never heard, else its node and what it said."""
        told = self._told.get(name, READY)
        return '' if told == READY else f'{NODES[name]} {told}'

    @property
    def rotors_may_turn(self) -> bool:
        """Whether the motor board may still follow, although it is not heard."""
        return self._told.get('rotor', '').startswith(SILENT)

    @property
    def joints_lost(self) -> bool:
        """Whether some joint does not follow."""
        return self._told.get('joint', '').startswith(LOST)

    @property
    def why_not_arm(self) -> str:
        """'' when both obey, else what is missing."""
        return '; '.join(filter(None, map(self.fault, NODES)))

    def diagnostics(self) -> dict[str, str]:
        """States as told, by node."""
        return {NODES[name]: told for name, told in self._told.items()}
