"""The reported states of the actuator bridges, as used by the supervisor."""

READY, SILENT, LOST = 'ready', 'silent:', 'lost:'
NODES = {'joint': 'joint_bridge_node', 'rotor': 'rotor_bridge_node'}


class Actuators:
    """
    The newest state of each bridge: 'ready', 'waiting: WHY', 'silent: WHY' or 'lost: WHY'.

    A bridge that never reported a state has no influence: without bridges the simulator gets the
    commands directly.
    """

    def __init__(self):
        self._reported: dict[str, str] = {}

    def update(self, name: str, text: str) -> bool:
        """Store the state of bridge 'joint' or 'rotor'; False for another name."""
        if name not in NODES:
            return False
        self._reported[name] = ' '.join(text.split()) or 'empty state'
        return True

    def fault(self, name: str) -> str:
        """'' while bridge ``name`` is ready or never reported, else its node and state."""
        state = self._reported.get(name, READY)
        return '' if state == READY else f'{NODES[name]} {state}'

    @property
    def rotors_may_turn(self) -> bool:
        """Whether the motor board may still execute commands, although it sends nothing."""
        return self._reported.get('rotor', '').startswith(SILENT)

    @property
    def joints_lost(self) -> bool:
        """Whether some joint does not follow its command."""
        return self._reported.get('joint', '').startswith(LOST)

    @property
    def why_not_arm(self) -> str:
        """'' when both are ready, else the missing condition."""
        return '; '.join(filter(None, map(self.fault, NODES)))

    def diagnostics(self) -> dict[str, str]:
        """Reported states, by node."""
        return {NODES[name]: state for name, state in self._reported.items()}
