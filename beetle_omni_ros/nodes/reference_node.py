"""ROS node that publishes the targets, disturbances and payloads of a task."""

from dataclasses import dataclass

import numpy as np
from rcl_interfaces.srv import SetParameters

from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.messages.topics import SENSOR
from beetle_omni_ros.messages.values import Wrench
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.node import FlightNode, OK
from beetle_omni_ros.robot.schema import parameter
from beetle_omni_ros.runs.tasks import make_task, TaskPlayer

PERIOD = 0.02           # s between updates of the task
IMPULSE_PERIOD = 0.005  # s, the same for tasks with impulses of 50 ms
# A trajectory is published in overlapping windows: a reader would need tenths of a second to
# decode the whole of it, and a node that starts late soon receives the next window.
WINDOW, WINDOW_PERIOD, WINDOW_SAMPLE = 3.0, 1.5, 0.05   # s


@dataclass(frozen=True, kw_only=True)
class ReferenceNodeParameters:
    """Parameters of reference_node."""

    task: str = parameter('hover', doc='name of a task, or a CSV file of poses', read_only=True)
    seed: int = parameter(0, doc='seed of random poses', low=0, high=2**31 - 1, read_only=True)


class ReferenceNode(FlightNode):
    """
    Publishes the targets of a task, beginning when the supervisor reports 'flying'.

    ``reference/state`` (latched) is 'waiting', 'flying 3/15', 'done',
    'done: control lost at level 60', or 'aborted' if the flight ended before the task.
    """

    def __init__(self):
        super().__init__('reference_node', ReferenceNodeParameters)
        self._task = make_task(self.parameters.task, self.parameters.seed)
        self._player = self._odom = self._trajectory = None
        self._window_end = 0.0
        self._state = ''
        self._poses = self.publisher('target_pose')
        self._trajectories = self.publisher('target_trajectory')
        self._wrenches = self.publisher('disturbance')
        self._states = self.publisher('reference/state')
        self._payload = self.create_client(SetParameters, 'sim_node/set_parameters')
        self._set_state('waiting')
        self.follow('supervisor/state', self._on_supervisor)
        disturbed = self._task.kind in ('force', 'torque')
        if disturbed:       # the loss of control ends these tasks
            self.listen('odom', self._on_odom, qos=SENSOR)
        self.health.report('task', lambda: (OK, self._state, {'task': self._task.name}))
        self.create_timer(IMPULSE_PERIOD if disturbed else PERIOD, self._on_timer,
                          clock=self.flight_clock)

    def waits_for(self):
        """Return the trigger of the task."""
        return f"'flying' on supervisor/state; then flies task '{self._task.name}'"

    def _set_state(self, state):
        if state != self._state:
            self._state = state
            self._states.publish(state)

    def _on_odom(self, odom):
        self._odom = odom

    def _on_supervisor(self, state):
        if self._state == 'waiting' and state.startswith('flying'):
            self._player = TaskPlayer(self._task, self.now())
            self.get_logger().info(f"task '{self._task.name}', {self._task.ends[-1]:g} s")
        elif self._player and state.partition(':')[0] in (
                'landing', 'disarmed', 'emergency_stop'):
            self._player = None
            self._set_state('aborted')

    def _on_timer(self):
        if self._player is None:
            return
        now = self.now()
        moment = self._player.update(now, *((self._odom.position, self._odom.quaternion)
                                            if self._odom else ()))
        if moment.target is not None:
            self._start_target(moment.target)
        if self._trajectory is not None and now > self._window_end - WINDOW_PERIOD:
            self._publish_window(now)
        if moment.changed:
            self._disturb(now, moment)
        if moment.finished:
            lost = f': control lost at level {self._player.lost_level:g}' if moment.lost else ''
            self._player = self._trajectory = None
            self._set_state(f'done{lost}')
        else:
            current = 1 + int(np.searchsorted(self._task.ends, now - self._player.start, 'right'))
            self._set_state(f'flying {min(current, len(self._task.ends))}/{len(self._task.ends)}')

    def _start_target(self, target):
        self._trajectory = None
        if isinstance(target, PoseTarget):
            self._poses.publish(target)
        else:
            self._trajectory, self._window_end = target, target.times[0]

    def _publish_window(self, now):
        path = self._trajectory
        first = self._window_end == path.times[0]
        start = min(path.times[0] if first else now, path.times[-1] - WINDOW_SAMPLE)
        end = min(start + WINDOW, path.times[-1])
        times = np.linspace(start, end, max(2, round((end - start) / WINDOW_SAMPLE) + 1))
        samples = [path.at(float(time)) for time in times]
        window = TrajectoryTarget(times, *(
            np.array([getattr(sample, name) for sample in samples])
            for name in ('position', 'quaternion', 'velocity', 'angular_velocity')),
            stamp=float(times[0]))
        self._trajectories.publish(window)
        self._window_end = end if end < path.times[-1] else float('inf')

    def _disturb(self, now, moment):
        if self._task.kind in ('force', 'torque'):
            self._wrenches.publish(Wrench(now, moment.force_world, moment.torque_body))
        if self._task.kind == 'payload':
            self._payload.call_async(wire.parameter_request('payload', float(moment.payload)))
