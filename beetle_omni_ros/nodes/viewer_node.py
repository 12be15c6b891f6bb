"""ROS node for RViz and Foxglove: the frame of the body and markers."""

from dataclasses import dataclass

from geometry_msgs.msg import Point, TransformStamped
import numpy as np
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from beetle_omni_ros.messages.conversions import BODY, set_time, set_xyz, set_xyzw, WORLD
from beetle_omni_ros.messages.topics import EVENT, SENSOR
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.node import FlightNode
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import parameter

try:
    from tf2_msgs.msg import TFMessage
except ImportError:     # a ROS from PyPI, for which there is no viewer of frames either
    TFMessage = None

BODY_COLOUR, THRUST_COLOUR, TARGET_COLOUR = (0.3, 0.3, 0.35), (0.9, 0.5, 0.1), (0.2, 0.7, 0.3)


@dataclass(frozen=True, kw_only=True)
class ViewerNodeParameters:
    """Parameters of viewer_node."""

    robot_file: str = parameter('', doc='robot file; empty: the shipped one', read_only=True)
    frame_rate: float = parameter(50.0, doc='rate of the frame', unit='Hz', low=0.5, high=200,
                                  read_only=True)
    rate: float = parameter(20.0, doc='rate of the markers', unit='Hz', low=0.5, high=100,
                            read_only=True)
    newton_per_metre: float = parameter(40.0, doc='thrust that is drawn as one metre',
                                        unit='N/m', low=1, high=1000)


class ViewerNode(FlightNode):
    """Publishes the transform from world to base_link, and markers."""

    def __init__(self):
        super().__init__('viewer_node', ViewerNodeParameters, on_change=self._changed)
        given = self.parameters
        self._robot = RobotParameters.load(given.robot_file or None)
        if TFMessage is not None:
            self._transforms = self.create_publisher(TFMessage, '/tf', wire.profile(EVENT))
            self.create_timer(1 / given.frame_rate, self._move, clock=self.steady_clock)
        self._markers = self.create_publisher(MarkerArray, 'markers', wire.profile(EVENT))
        self._odom = self._joints = self._command = self._target = None
        self._moved = None      # stamp of the estimate that the frame shows
        self.listen('odom', self._keep('_odom'), qos=SENSOR)
        self.listen('joint_states', self._keep('_joints'))
        self.listen('command', self._keep('_command'), qos=SENSOR, stale_after=None)
        self.listen('target_pose', self._keep('_target'), any_qos=True, stale_after=None)
        self.create_timer(1 / given.rate, self._draw, clock=self.steady_clock)

    def _changed(self, new):
        self.parameters = new

    def _keep(self, name):
        return lambda value: setattr(self, name, value)

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
        set_xyz(frame.transform.translation, odom.position)
        set_xyzw(frame.transform.rotation, odom.quaternion)
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
        marker.color = ColorRGBA(r=colour[0], g=colour[1], b=colour[2], a=1.0)
        marker.points = [Point(x=float(p[0]), y=float(p[1]), z=float(p[2]))
                         for p in np.asarray(points)]
        return marker
