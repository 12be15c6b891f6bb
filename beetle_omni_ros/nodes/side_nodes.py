"""ROS nodes beside the control loop: targets of a task, recorder, the frame for viewers."""

from functools import partial
import sys

import numpy as np
from rcl_interfaces.srv import SetParameters

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import MOTORS_OFF, PoseTarget, TrajectoryTarget
from beetle_omni_ros.messages.topics import ALL, LATCHED_LOG, LOG, SENSOR, topics_with
from beetle_omni_ros.messages.values import Wrench
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.node import ERROR, FlightNode, OK, WARN
from beetle_omni_ros.robot.schema import parameter, RunError
from beetle_omni_ros.runs.bag_writer import BagWriter, FRAMES, FrameWriter
from beetle_omni_ros.runs.tasks import make_task, TaskPlayer, WITH_WRENCHES

PERIOD = 0.02           # s between updates of the task
IMPULSE_PERIOD = 0.005  # s, the same for tasks with impulses of 50 ms
# A trajectory is published in overlapping windows: a reader would need tenths of a second to
# decode the whole of it, and a node that starts late soon receives the next window.
WINDOW, WINDOW_PERIOD, WINDOW_SAMPLE = 3.0, 1.5, 0.05   # s
LINE = 'rcl_interfaces/msg/Log'
WRITE_PERIOD = 0.02     # s between writes of the received messages, so that no callback waits
FLUSH_WRITES = 20       # writes between flushes; a crash loses only messages after the last one


# --- targets ------------------------------------------------------------------------------------

class ReferenceNode(FlightNode):
    """
    Publishes the targets of a task, beginning when the supervisor reports 'flying'.

    ``reference/state`` (latched) is 'waiting', 'flying 3/15', 'done',
    'done: control lost at level 60', or 'aborted' if the flight ended before the task.
    """

    def __init__(self):
        super().__init__(
            'reference_node',
            task=parameter('hover', doc='name of a task, or a CSV file of poses'),
            seed=parameter(0, doc='seed of random poses', low=0, high=2**31 - 1))
        self._task = make_task(self.parameters.task, self.parameters.seed)
        self._player = self._odom = self._trajectory = None
        self._window_end = 0.0
        self._poses = wire.Publisher(self, 'target_pose')
        self._trajectories = wire.Publisher(self, 'target_trajectory')
        self._wrenches = wire.Publisher(self, 'disturbance')
        self._states = wire.Publisher(self, 'reference/state')
        self._payload = self.create_client(SetParameters, 'sim_node/set_parameters')
        self._states.update('waiting')
        wire.subscribe(self, 'supervisor/state', self._on_supervisor)
        disturbed = self._task.kind in WITH_WRENCHES
        if disturbed:       # the loss of control ends tasks with rising levels
            self.listen('odom', partial(setattr, self, '_odom'), qos=SENSOR)
        self.report('task', lambda: (OK, self._states.value, {'task': self._task.name}))
        self.create_timer(IMPULSE_PERIOD if disturbed else PERIOD, self._on_timer,
                          clock=self.flight_clock)

    def _on_supervisor(self, state):
        if self._states.value == 'waiting' and state.startswith('flying'):
            self._player = TaskPlayer(self._task, self.now())
            self.get_logger().info(f"task '{self._task.name}', {self._task.ends[-1]:g} s")
        elif self._player and state.partition(':')[0] in ('landing', *MOTORS_OFF):
            self._player = None
            self._states.update('aborted')

    def _on_timer(self):
        if self._player is None:
            return
        now, player = self.now(), self._player
        over = player.update(now, *((self._odom.position, self._odom.quaternion)
                                    if self._odom else ()))
        target, segment = player.target, player.segment
        if isinstance(target, PoseTarget):
            self._trajectory = None
            self._poses.publish(target)
        elif target is not None:
            self._trajectory, self._window_end = target, target.times[0]
        if self._trajectory is not None and now > self._window_end - WINDOW_PERIOD:
            self._publish_window(now)
        if player.changed and self._task.kind in WITH_WRENCHES:
            self._wrenches.publish(Wrench(now, segment.force_world, segment.torque_body))
        if player.changed and self._task.kind == 'payload':
            self._payload.call_async(wire.parameter_request('payload', float(segment.payload)))
        if over:
            level = player.lost_level
            lost = '' if level is None else f': control lost at level {level:g}'
            self._player = self._trajectory = None
            self._states.update(f'done{lost}')
        else:
            ends = self._task.ends
            current = 1 + int(np.searchsorted(ends, now - player.start, 'right'))
            self._states.update(f'flying {min(current, len(ends))}/{len(ends)}')

    def _publish_window(self, now):
        path = self._trajectory
        first = self._window_end == path.times[0]
        start = min(path.times[0] if first else now, path.times[-1] - WINDOW_SAMPLE)
        end = min(start + WINDOW, path.times[-1])
        times = np.linspace(start, end, max(2, round((end - start) / WINDOW_SAMPLE) + 1))
        samples = path.sample(times)
        self._trajectories.publish(TrajectoryTarget(
            times, samples.position, samples.quaternion, samples.velocity,
            samples.angular_velocity, stamp=float(times[0])))
        self._window_end = end if end < path.times[-1] else float('inf')


# --- recorder -----------------------------------------------------------------------------------

class RecorderNode(FlightNode):
    """Writes every topic of the package and /rosout into a bag, like ``ros2 bag record``."""

    def __init__(self):
        super().__init__(
            'recorder_node',
            bag=parameter(doc='folder to create for the bag'),
            controllers=parameter(registry.STANDING_BY,
                                  doc='registered controllers whose commands are recorded'))
        topics = topics_with(self.parameters.controllers)
        self._bag = BagWriter(self.parameters.bag, namespace=self.get_namespace(),
                              topics=tuple(topics), frames=True)
        self._written = self._lost = self._writes = 0
        self._failure = None
        self._received = []     # (topic, type, CDR, time of receipt [s]) not yet written
        prefix = self.get_namespace().rstrip('/') + '/'
        for name, topic in {**ALL, **topics}.items():
            wire.subscribe_raw(self, name, partial(self._keep, prefix + name, topic.type),
                               LATCHED_LOG if topic.qos.latched else LOG, self._on_lost)
        self.create_subscription(wire.message_class(LINE), '/rosout', partial(
            self._keep, '/rosout', LINE), wire.profile(LATCHED_LOG), raw=True)
        self.report('bag', self._bag_status)
        self.create_timer(WRITE_PERIOD, self._write, clock=self.steady_clock)

    def _keep(self, topic, message_type, data, *_):
        if not self._failure:       # nothing would empty the list any more
            self._received.append((topic, message_type, data, self.now()))

    def _write(self):
        # Before the first /clock the time is 0: a bag that begins in 1970 cannot be viewed.
        if self._failure or not self._bag or not self.now():
            return
        received, self._received = self._received, []
        try:
            for topic, message_type, data, t in received:
                self._bag.write_raw(topic, message_type, data, t or self.now())
            self._written += len(received)
            self._writes += 1
            if self._writes % FLUSH_WRITES == 0:
                self._bag.flush()
        except RunError as error:
            # A full disk ends the recording but not the process, which is shared with other nodes.
            self._failure = str(error)
            self.get_logger().error(f'recording ended: {error}')

    def _on_lost(self, event):
        new = event.total_count_change
        self._lost += new if new < 2**31 - 1 else 1     # so Fast DDS reports an unknown number
        self.warn('lost', f'{self._lost} messages lost so far')

    def _bag_status(self):
        values = {'written': self._written, 'lost': self._lost}
        if self._failure:
            return ERROR, self._failure, values
        return WARN if self._lost else OK, self.parameters.bag, values

    def close(self):
        """Finish the bag; a second call does nothing."""
        try:
            if self._bag:
                self._write()
                self._bag.close()
        except RunError as error:
            print(f'recorder_node: error: {error}', file=sys.stderr)
        self._bag = None


# --- viewers ------------------------------------------------------------------------------------

class ViewerNode(FlightNode):
    """Publishes description and frames of the robot for RViz and Foxglove, like those of a bag."""

    def __init__(self):
        super().__init__('viewer_node')
        self._outputs = {     # tf2_msgs is not on PyPI
            name: self.create_publisher(wire.message_class(kind), name, wire.profile(qos))
            for name, (kind, qos) in FRAMES.items()}
        frames = FrameWriter(self._write, '')
        for topic in ('odom', 'joint_states'):
            wire.subscribe_raw(self, topic, lambda data, topic=topic: frames.take(
                topic, data, self.now()), SENSOR)

    def _write(self, topic, kind, data, t):
        self._outputs[topic].publish(bytes(data))
