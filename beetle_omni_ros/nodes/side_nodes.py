"""ROS nodes beside the control loop: targets of a task, recorder, markers for viewers."""

from dataclasses import dataclass
from functools import partial
import sys

from geometry_msgs.msg import Point, TransformStamped
import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.event_handler import SubscriptionEventCallbacks
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.messages.conversions import BODY, set_parts, set_time, WORLD
from beetle_omni_ros.messages.topics import ALL, EVENT, LATCHED_LOG, LOG, SENSOR, topics_with
from beetle_omni_ros.messages.values import Wrench
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.node import ERROR, FlightNode, OK, WARN
from beetle_omni_ros.nodes.parameters import file_parameter
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import NAMES, parameter, ParameterError
from beetle_omni_ros.runs.bag import BagError
from beetle_omni_ros.runs.bag_writer import BagWriter, COMPRESSIONS
from beetle_omni_ros.runs.tasks import make_task, TaskPlayer

try:
    from tf2_msgs.msg import TFMessage
except ImportError:     # a ROS from PyPI, for which there is no viewer of frames either
    TFMessage = None

PERIOD = 0.02           # s between updates of the task
IMPULSE_PERIOD = 0.005  # s, the same for tasks with impulses of 50 ms
# A trajectory is published in overlapping windows: a reader would need tenths of a second to
# decode the whole of it, and a node that starts late soon receives the next window.
WINDOW, WINDOW_PERIOD, WINDOW_SAMPLE = 3.0, 1.5, 0.05   # s
WRITE_PERIOD = 0.02     # s between writes of the received messages, so that no callback waits
FLUSH_WRITES = 20       # writes between flushes; a crash loses only messages after the last one
HELD = 1000             # messages at most that wait for the first simulated time
ANY_QOS = 'target_pose', 'target_trajectory'    # recorded with any quality of service
BODY_COLOUR, THRUST_COLOUR, TARGET_COLOUR = (0.3, 0.3, 0.35), (0.9, 0.5, 0.1), (0.2, 0.7, 0.3)


# --- targets ------------------------------------------------------------------------------------

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
            self.listen('odom', partial(setattr, self, '_odom'), qos=SENSOR)
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
        if isinstance(moment.target, PoseTarget):
            self._trajectory = None
            self._poses.publish(moment.target)
        elif moment.target is not None:
            self._trajectory, self._window_end = moment.target, moment.target.times[0]
        if self._trajectory is not None and now > self._window_end - WINDOW_PERIOD:
            self._publish_window(now)
        if moment.changed and self._task.kind in ('force', 'torque'):
            self._wrenches.publish(Wrench(now, moment.force_world, moment.torque_body))
        if moment.changed and self._task.kind == 'payload':
            self._payload.call_async(wire.parameter_request('payload', float(moment.payload)))
        if moment.finished:
            lost = f': control lost at level {self._player.lost_level:g}' if moment.lost else ''
            self._player = self._trajectory = None
            self._set_state(f'done{lost}')
        else:
            current = 1 + int(np.searchsorted(self._task.ends, now - self._player.start, 'right'))
            self._set_state(f'flying {min(current, len(self._task.ends))}/{len(self._task.ends)}')

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

@dataclass(frozen=True, kw_only=True)
class RecorderNodeParameters:
    """Parameters of recorder_node."""

    bag: str = parameter(doc='folder to create for the bag', read_only=True)
    controllers: NAMES = parameter(
        tuple(registry.standing_by()), read_only=True,
        doc='registered controllers whose commands are recorded')
    compression: str = parameter('none', choices=COMPRESSIONS, read_only=True,
                                 doc='compression of the chunks in the MCAP file')


class RecorderNode(FlightNode):
    """Writes the messages of every topic of the package into a bag, like ``ros2 bag record``."""

    real_time = True        # the times of receipt in the bag are measurements

    def __init__(self):
        super().__init__('recorder_node', RecorderNodeParameters)
        topics = topics_with(self.parameters.controllers)
        self._bag = None
        try:
            self._bag = BagWriter(self.parameters.bag, namespace=self.get_namespace(),
                                  topics=tuple(topics),
                                  compression=self.parameters.compression,
                                  frames=True)
        except BagError as error:
            raise ParameterError(f"key 'bag': {error}") from None
        self._written = self._lost = self._writes = 0
        self._failure = None
        self._received = []     # (topic, type, CDR, time of receipt [s]) not yet written
        prefix = self.get_namespace().rstrip('/') + '/'
        for name, topic in {**ALL, **topics}.items():
            keep = partial(self._keep, prefix + name, topic.type)
            if name in ANY_QOS:
                wire.subscribe_any(self, name, keep, depth=50, on_lost=self._on_lost)
                continue
            self.create_subscription(
                wire.message_class(topic.type), name, lambda data, keep=keep: keep(data),
                wire.profile(LATCHED_LOG if topic.qos.latched else LOG), raw=True,
                event_callbacks=SubscriptionEventCallbacks(message_lost=self._on_lost))
        self.health.report('bag', self._bag_status)
        self.create_timer(WRITE_PERIOD, self._write, clock=self.steady_clock)

    def waits_for(self):
        """Return what is recorded where; a recorder needs no particular input."""
        return f'messages, and writes them to {self.parameters.bag}'

    def _keep(self, topic, message_type, data, _=None):
        self._received.append((topic, message_type, data, self.now()))

    def _write(self):
        # Before the first /clock the time is 0: a bag that begins in 1970 cannot be viewed.
        if self._failure or not self.now() and len(self._received) < HELD:
            return
        received, self._received = self._received, []
        try:
            for topic, message_type, data, t in received:
                self._bag.write_raw(topic, message_type, data, t or self.now())
            self._written += len(received)
            self._writes += 1
            if self._writes % FLUSH_WRITES == 0:
                self._bag.flush()
        except BagError as error:
            # A full disk ends the recording but not the process, which is shared with other nodes.
            self._failure = str(error)
            self.get_logger().error(f'recording ended: {error}')

    def _on_lost(self, event):
        self._lost += event.total_count_change
        self.get_logger().warning(f'{event.total_count_change} messages lost')

    def _bag_status(self):
        values = {'written': self._written, 'lost': self._lost}
        if self._failure:
            return ERROR, self._failure, values
        return WARN if self._lost else OK, self.parameters.bag, values

    def close(self):
        """Finish the bag."""
        try:
            if self._bag:
                self._write()
                self._bag.close()
        except BagError as error:
            print(f'recorder_node: error: {error}', file=sys.stderr)


# --- markers ------------------------------------------------------------------------------------

@dataclass(frozen=True, kw_only=True)
class ViewerNodeParameters:
    """Parameters of viewer_node."""

    robot_file: str = file_parameter()
    frame_rate: float = parameter(50.0, doc='rate of the frame', unit='Hz', low=0.5, high=200,
                                  read_only=True)
    rate: float = parameter(20.0, doc='rate of the markers', unit='Hz', low=0.5, high=100,
                            read_only=True)
    newton_per_metre: float = parameter(40.0, doc='thrust that is drawn as one metre',
                                        unit='N/m', low=1, high=1000, read_only=True)


class ViewerNode(FlightNode):
    """Publishes the transform from world to base_link, and markers, for RViz and Foxglove."""

    def __init__(self):
        super().__init__('viewer_node', ViewerNodeParameters)
        given = self.parameters
        self._robot = RobotParameters.load(given.robot_file or None)
        if TFMessage is not None:
            self._transforms = self.create_publisher(TFMessage, '/tf', wire.profile(EVENT))
            self.create_timer(1 / given.frame_rate, self._move, clock=self.steady_clock)
        self._markers = self.create_publisher(MarkerArray, 'markers', wire.profile(EVENT))
        self._odom = self._joints = self._command = self._target = None
        self._moved = None      # stamp of the estimate that the frame shows
        self.listen('odom', partial(setattr, self, '_odom'), qos=SENSOR)
        self.listen('joint_states', partial(setattr, self, '_joints'))
        self.listen('command', partial(setattr, self, '_command'), qos=SENSOR, stale_after=None)
        self.listen('target_pose', partial(setattr, self, '_target'), any_qos=True,
                    stale_after=None)
        self.create_timer(1 / given.rate, self._draw, clock=self.steady_clock)

    def _move(self):
        """Publish the frame of the body, if there is a subscription."""
        odom = self._odom
        if odom is None or odom.stamp == self._moved or \
                not self._transforms.get_subscription_count():
            return
        self._moved = odom.stamp
        frame = TransformStamped(child_frame_id=BODY)
        set_time(frame.header.stamp, odom.stamp)
        frame.header.frame_id = WORLD
        set_parts(frame.transform.translation, odom.position)
        set_parts(frame.transform.rotation, odom.quaternion)
        self._transforms.publish(TFMessage(transforms=[frame]))

    def _draw(self):
        if self._odom is None or not self._markers.get_subscription_count():
            return
        odom, markers = self._odom, MarkerArray()
        to_world = rotations.matrix(odom.quaternion)
        centres = odom.position + self._robot.rotors.positions @ to_world.T
        lines = [point for centre in centres for point in (odom.position, centre)]
        markers.markers.append(self._marker('body', Marker.LINE_LIST, lines, 0.02, BODY_COLOUR))
        if self._joints is not None and self._command is not None:
            thrust = self._command.thrust / self.parameters.newton_per_metre
            for k, axis in enumerate(self._robot.tilt_axes):
                tilt = rotations.matrix(rotations.exp(axis * self._joints.position[k]))
                tip = centres[k] + thrust[k] * to_world @ tilt[:, 2]
                markers.markers.append(self._marker(
                    f'rotor{k + 1}', Marker.ARROW, [centres[k], tip], 0.03, THRUST_COLOUR))
        if self._target is not None:
            axes = rotations.matrix(self._target.quaternion)
            ends = [end for axis in axes.T
                    for end in (self._target.position, self._target.position + 0.3 * axis)]
            markers.markers.append(
                self._marker('target', Marker.LINE_LIST, ends, 0.01, TARGET_COLOUR))
        self._markers.publish(markers)

    def _marker(self, name, kind, points, width, colour):
        marker = Marker(ns=name, type=kind, action=Marker.ADD)
        marker.header.frame_id = WORLD
        set_time(marker.header.stamp, self._odom.stamp)
        marker.scale.x = width
        marker.scale.y = marker.scale.z = 2 * width
        marker.pose.orientation.w = 1.0
        marker.color = ColorRGBA(**dict(zip('rgb', colour)), a=1.0)
        marker.points = [Point(**dict(zip('xyz', map(float, p)))) for p in points]
        return marker
