"""
One flight as numpy arrays.

Times are float seconds on the flight's clock: ROS time in the graph, from 0 in the in-process
loop.
"""

from dataclasses import dataclass, field, fields

import numpy as np

from beetle_omni_ros.control.base import Target
from beetle_omni_ros.messages.values import Diagnostic

SERIES = {
    'truth': {'position': 3, 'quaternion': 4, 'velocity': 3, 'angular_velocity': 3},
    'odom': {'position': 3, 'quaternion': 4, 'velocity': 3, 'angular_velocity': 3},
    'imu': {'specific_force': 3, 'angular_velocity': 3},
    'mocap': {'position': 3, 'quaternion': 4},
    'joint': {'position': 4, 'velocity': 4, 'effort': 4},
    'battery': {'voltage': 0, 'current': 0},
    'command': {'received': 0, 'tilt': 4, 'thrust': 4},
    'wrench': {'force': 3, 'torque': 3},
}
"""Series -> channel -> width; 0 is a scalar channel. Each series has times ``<series>_t``."""

SERIES_OF = {'ground_truth/odom': 'truth', 'odom': 'odom', 'imu/data_raw': 'imu',
             'mocap/pose': 'mocap', 'joint_states': 'joint', 'battery_state': 'battery',
             'command': 'command', 'disturbance': 'wrench'}
"""Topic -> series of its values."""

WIDTHS = {name: 1 + sum(max(1, width) for width in channels.values())
          for name, channels in SERIES.items()}
"""Series -> count of numbers in one sample, including its time."""

RUN_STATUS = 'run'  # diagnostic status '<node>: run' with a flight's metadata
COMPUTE_STATUS = 'compute'  # diagnostic status '<name>_node: compute'
SUPERVISOR_STATUS, FAULT_KEY = 'supervisor_node: supervisor', 'fault.'
COMPUTE_KEYS = {'median_ms': 'median', 'p99_ms': 'p99', 'max_ms': 'max',
                'deadline_misses': 'deadline_misses', 'count': 'count'}
"""Diagnostic key -> key in ``FlightLog.compute``; the times are CPU milliseconds."""


def _empty(width):
    return field(default_factory=lambda: np.zeros((0, width) if width else 0))


@dataclass
class Commands:
    """Commands: t (M,) stamps [s], received (M,) [s], tilt (M, 4) [rad], thrust (M, 4) [N]."""

    t: np.ndarray = _empty(0)
    received: np.ndarray = _empty(0)
    tilt: np.ndarray = _empty(4)
    thrust: np.ndarray = _empty(4)


@dataclass
class FlightLog:
    """
    One flight. Every series is sorted by its time; an absent topic is an empty array.

    Attributes:
        truth_t, truth_position, truth_quaternion, truth_velocity, truth_angular_velocity:
            simulated truth: (N,) [s], (N, 3) in world [m], (N, 4) body to world (x, y, z, w),
            (N, 3) in world [m/s], (N, 3) in base_link [rad/s].
        odom_t, odom_position, odom_quaternion, odom_velocity, odom_angular_velocity: the estimate,
            same channels.
        imu_t, imu_specific_force, imu_angular_velocity: (N,), (N, 3) [m/s^2], (N, 3) [rad/s].
        mocap_t, mocap_position, mocap_quaternion: measured poses at their capture times.
        joint_t, joint_position, joint_velocity, joint_effort: (N, 4) [rad], [rad/s], [N m];
            effort is NaN where the message had none.
        battery_t, battery_voltage, battery_current: (N,) [V], [A, negative discharging].
        command_t, command_received, command_tilt, command_thrust: commands to the actuators:
            stamp of the answered estimate, time of recording, (M, 4) [rad], (M, 4) [N].
        wrench_t, wrench_force, wrench_torque: external force in world [N] and torque in
            base_link [N m], each valid until the next.
        requests: controller -> its commands, before the supervisor.
        targets: pose and trajectory targets in the order of their stamps.
        state_t, states: (S,) times and names of the supervisor's states.
        compute: controller, or another node's name without '_node' -> median, p99, max [ms],
            deadline_misses, count (cumulative).
        compute_history: the same names -> list of (t, such a dict), one for each report.
        diagnostics: every other status, in the order of time.
        meta: task, conditions, seed, robot, version, if known.
        warnings: problems found while reading, one line each.
        source: folder or file of the bag, '' in memory.

    """

    truth_t: np.ndarray = _empty(0)
    truth_position: np.ndarray = _empty(3)
    truth_quaternion: np.ndarray = _empty(4)
    truth_velocity: np.ndarray = _empty(3)
    truth_angular_velocity: np.ndarray = _empty(3)
    odom_t: np.ndarray = _empty(0)
    odom_position: np.ndarray = _empty(3)
    odom_quaternion: np.ndarray = _empty(4)
    odom_velocity: np.ndarray = _empty(3)
    odom_angular_velocity: np.ndarray = _empty(3)
    imu_t: np.ndarray = _empty(0)
    imu_specific_force: np.ndarray = _empty(3)
    imu_angular_velocity: np.ndarray = _empty(3)
    mocap_t: np.ndarray = _empty(0)
    mocap_position: np.ndarray = _empty(3)
    mocap_quaternion: np.ndarray = _empty(4)
    joint_t: np.ndarray = _empty(0)
    joint_position: np.ndarray = _empty(4)
    joint_velocity: np.ndarray = _empty(4)
    joint_effort: np.ndarray = _empty(4)
    battery_t: np.ndarray = _empty(0)
    battery_voltage: np.ndarray = _empty(0)
    battery_current: np.ndarray = _empty(0)
    command_t: np.ndarray = _empty(0)
    command_received: np.ndarray = _empty(0)
    command_tilt: np.ndarray = _empty(4)
    command_thrust: np.ndarray = _empty(4)
    wrench_t: np.ndarray = _empty(0)
    wrench_force: np.ndarray = _empty(3)
    wrench_torque: np.ndarray = _empty(3)
    requests: dict[str, Commands] = field(default_factory=dict)
    targets: list[Target] = field(default_factory=list)
    state_t: np.ndarray = _empty(0)
    states: list[str] = field(default_factory=list)
    compute: dict[str, dict] = field(default_factory=dict)
    compute_history: dict[str, list] = field(default_factory=dict)
    diagnostics: list[Diagnostic] = field(default_factory=list)
    meta: dict = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    source: str = ''

    @property
    def body(self) -> str:
        """Series that metrics use: 'truth' if it was recorded, else 'odom'."""
        return 'truth' if len(self.truth_t) else 'odom'

    @property
    def start(self) -> float:
        """Earliest time in any series [s]; 0 for an empty log."""
        return min((times[0] for times in self._times()), default=0.0)

    @property
    def end(self) -> float:
        """Latest time in any series [s]; 0 for an empty log."""
        return max((times[-1] for times in self._times()), default=0.0)

    def _times(self):
        return [times for entry in fields(self) if entry.name.endswith('_t')
                and len(times := getattr(self, entry.name))]

    def controllers(self) -> list[str]:
        """Return the names of the controllers that flew, in this order."""
        names = [name for _, name in self.active_controller() if name]
        return list(dict.fromkeys(names))

    def named_faults(self) -> dict[str, float]:
        """Return the supervisor's fault names -> time of the first report [s], by time."""
        found: dict[str, float] = {}
        for t, state in zip(self.state_t, self.states, strict=True):
            kind, _, fault = state.partition(':')
            if fault and kind != 'flying':
                found.setdefault(fault, float(t))
        for entry in self.diagnostics:
            if entry.name.endswith(SUPERVISOR_STATUS):
                for key in entry.values:
                    if key.startswith(FAULT_KEY):
                        name = key.removeprefix(FAULT_KEY)
                        found[name] = min(found.get(name, entry.t), entry.t)
        return dict(sorted(found.items(), key=lambda item: item[1]))

    def active_controller(self) -> list[tuple[float, str | None]]:
        """
        Return the changes of the active controller.

        Returns:
            (t, name) in the order of time; None while no controller flew (on the ground, during
            take-off and landing). A fallback counts for the controller that it replaced.

        """
        if not self.states:
            only = next(iter(self.requests)) if len(self.requests) == 1 else 'unknown'
            return [(self.start, self.meta.get('controller', only))]
        changes: list[tuple[float, str | None]] = []
        for t, state in zip(self.state_t, self.states, strict=True):
            if state.startswith('flying:'):
                name = state.partition(':')[2]
            elif state.partition(':')[0] == 'fallback':
                name = changes[-1][1] if changes else None
            else:
                name = None
            if not changes or changes[-1][1] != name:
                changes.append((float(t), name))
        return changes
