"""How commands reach the actuators of a graph: through the bridges, or straight into the plant."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

BRIDGES = ('joint_bridge_node', 'rotor_bridge_node')
STATES = {'joint_bridge_node': 'joint_bridge/state', 'rotor_bridge_node': 'rotor_bridge/state'}
ACTUATORS = ('emulated', 'direct')
READY = 'ready'
# status of the diagnostics, key there -> key of what a flight measured
MEASURED = {
    'joint_bridge_node': ('bus', 'servos'), 'rotor_bridge_node': ('board', 'motor_board')}


def bridged(folder: Path, believed: dict) -> dict[str, dict]:
    """
    Node name -> parameters of simulator and bridges that meet in ``folder``.

    Args:
        folder: for the names of the two pseudo-terminals.
        believed: parameters of every node that believes in a robot file.

    """
    servos, board = str(Path(folder) / 'servo_bus'), str(Path(folder) / 'motor_board')
    return {'sim_node': {'actuators': 'emulated', 'servo_port': servos, 'board_port': board},
            'joint_bridge_node': {**believed, 'port': servos, 'autostart': 'activate'},
            'rotor_bridge_node': {**believed, 'port': board}}


class BridgeCounts:
    """
    What the bridges did in a stretch of a flight, from their diagnostics.

    Args:
        values: status name -> its values, as they were told last.

    """

    def __init__(self, values: Callable[[str], dict[str, str]]):
        self._values = values
        self._first = self._cycles()

    def measured(self) -> dict[str, float]:
        """
        Count of cycles and of missed ones since the beginning; latencies [ms].

        Keys: ``servos_cycles``, ``servos_missed_cycles``, ``servos_latency_median_ms``,
        ``..._p99_ms`` and ``..._max_ms``, and the same of ``motor_board``. The latency is from
        the publication of `command` to its last byte written.
        """
        found = {}
        last = self._cycles()
        for node, (_, name) in MEASURED.items():
            for key in ('cycles', 'missed_cycles'):
                if f'{name}_{key}' in last:
                    found[f'{name}_{key}'] = \
                        last[f'{name}_{key}'] - self._first.get(f'{name}_{key}', 0)
            latency = self._values(f'{node}: latency')
            found.update({f'{name}_latency_{key}': float(latency[key])
                          for key in ('median_ms', 'p99_ms', 'max_ms') if key in latency})
        return found

    def _cycles(self):
        counts = {}
        for node, (status, name) in MEASURED.items():
            values = self._values(f'{node}: {status}')
            counts.update({f'{name}_{key}': int(values[key])
                           for key in ('cycles', 'missed_cycles') if key in values})
        return counts
