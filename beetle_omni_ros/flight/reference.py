"""The source of a task's targets as a component."""

from collections.abc import Callable

import numpy as np

from beetle_omni_ros.bags.messages import Wrench
from beetle_omni_ros.bags.topics import SENSOR
from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.control.tasks import Task, TaskPlayer, WITH_WRENCHES
from beetle_omni_ros.flight.component import Component, OK
from beetle_omni_ros.model.mode import FLYING, LANDING
from beetle_omni_ros.supervisor.events import INFO

# A trajectory is published in overlapping windows: a reader would need tenths of a second to
# decode the whole of it, and a node that starts late soon receives the next window.
WINDOW, WINDOW_PERIOD = 3.0, 1.5    # [s]
STATE = 'reference/state'
WAITING, DONE, ABORTED = 'waiting', 'done', 'aborted'


class Reference(Component):
    """
    Publishes the targets of a task, beginning when the supervisor reports 'flying'.

    Each command lets the task proceed, so that a target comes after the controllers' step and
    before the next one, in any host.

    ``reference/state`` (latched) is 'waiting', 'flying 3/15', 'done',
    'done: control lost at level 60', or 'aborted' if the flight ended before the task.
    ``hang`` is called with each new payload of the task [kg].
    """

    def __init__(self, task: Task, hang: Callable[[float], None]):
        super().__init__('reference_node')
        self._task, self._hang = task, hang
        self._player = self._odom = self._trajectory = None
        self._window_end = 0.0
        self.writes('target_pose', 'target_trajectory', 'disturbance', STATE)
        self.follows('supervisor/state', self._on_supervisor)
        if task.kind in WITH_WRENCHES:      # the loss of control ends tasks with rising levels
            self.reads('odom', self._on_odom, qos=SENSOR)
        self.reads('command', self._on_command, expected=False)
        self.report('task', lambda: (OK, self.state, {'task': task.name}))

    def start(self) -> None:
        """Publish the state."""
        self.update(STATE, WAITING)

    @property
    def state(self) -> str:
        """Newest value of ``reference/state``."""
        return self.newest[STATE]

    def _on_odom(self, odom):
        self._odom = odom

    def _on_supervisor(self, mode):
        if self.state == WAITING and mode.state == FLYING:
            self._player = TaskPlayer(self._task, self.host.now())
            self.host.log(INFO, f"task '{self._task.name}', {self._task.ends[-1]:g} s")
        elif self._player and (mode.motors_off or mode.state == LANDING):
            self._player = None
            self.update(STATE, ABORTED)

    def _on_command(self, command):
        player = self._player
        if player is None or command.stamp <= player.start:     # of the take-off
            return
        now = self.host.now()
        over = player.update(now, *((self._odom.position, self._odom.quaternion)
                                    if self._odom else ()))
        target, segment = player.target, player.segment
        if isinstance(target, PoseTarget):
            self._trajectory = None
            self.send('target_pose', target)
        elif target is not None:
            self._trajectory, self._window_end = target, target.times[0]
        if self._trajectory is not None and now > self._window_end - WINDOW_PERIOD:
            self._publish_window(now)
        if player.changed and self._task.kind in WITH_WRENCHES:
            self.send('disturbance', Wrench(now, segment.force_world, segment.torque_body))
        if player.changed and self._task.kind == 'payload':
            self._hang(float(segment.payload))
        if over:
            level = player.lost_level
            lost = '' if level is None else f': control lost at level {level:g}'
            self._player = self._trajectory = None
            self.update(STATE, f'{DONE}{lost}')
        else:
            count = len(self._task.ends)
            self.update(STATE, f'flying {min(player.index + 1, count)}/{count}')

    def _publish_window(self, now):
        """Publish the trajectory's own points from now on, so that no reader sees it changed."""
        path = self._trajectory
        last = len(path.times) - 1
        # One point before the present one, because a trajectory rests up to its first point.
        begin = min(max(int(np.searchsorted(path.times, now, 'right')) - 2, 0), last - 1)
        end = min(max(int(np.searchsorted(path.times, path.times[begin] + WINDOW)), begin + 1),
                  last)
        part = slice(begin, end + 1)
        self.send('target_trajectory', TrajectoryTarget(
            path.times[part], path.positions[part], path.quaternions[part], path.velocities[part],
            path.angular_velocities[part], stamp=float(path.times[begin])))
        self._window_end = path.times[end] if end < last else float('inf')
