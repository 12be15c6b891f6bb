"""`/tf`, `/tf_static` and `robot_description` in a bag, from its odometry and joint states."""

from collections.abc import Callable
from math import isfinite
import struct

from rosbags.serde import SerdeError

from beetle_omni_ros.messages.bag_types import BAG, from_bytes, to_bytes
from beetle_omni_ros.messages.conversions import BODY, WORLD
from beetle_omni_ros.messages.topics import EVENT, LATCHED
from beetle_omni_ros.robot.urdf import joints

TRANSFORMS = 'tf2_msgs/msg/TFMessage'
TEXT = 'std_msgs/msg/String'
PERIOD = 0.02       # [s] between transforms
STAMP, POSE = struct.Struct('<iI'), struct.Struct('<7d')
MARK = 1e3          # placeholder of a pose; its bytes occur in no frame name


class FrameWriter:
    """
    Converts `odom` and `joint_states` to transforms, 50 times a second.

    Args:
        write: called with topic, ROS type, CDR and time [s].
        description: URDF.
        prefix: prefix of the robot's topics, '/' or e.g. '/robot1/'.

    Raises:
        ParameterError: unusable URDF.

    """

    def __init__(self, write: Callable[[str, str, bytes, float], None], description: str,
                 prefix: str = '/'):
        self._write, self._text = write, description
        self._odom, self._joints = f'{prefix}odom', f'{prefix}joint_states'
        self.topics = {'/tf': (TRANSFORMS, EVENT), '/tf_static': (TRANSFORMS, LATCHED),
                       f'{prefix}robot_description': (TEXT, LATCHED)}
        tree = joints(description)
        self._fixed = [joint for joint in tree if joint.axis is None]
        self._moving = {joint.name: joint for joint in tree if joint.axis is not None}
        self._latest = None     # message of joint_states
        self._due = None
        # Only stamps and poses of the message change, so only these are serialised.
        self._frame = _Template([(WORLD, BODY),
                                 *((joint.parent, joint.child)
                                   for joint in self._moving.values())])

    def take(self, topic: str, data: bytes | memoryview, t: float) -> None:
        """Process a message recorded at ``t`` [s], and write transforms if they are due."""
        try:
            if topic == self._joints:
                self._latest = data
            elif topic == self._odom and self._latest is not None \
                    and (self._due is None or t >= self._due):
                self._follow(data, t)
        except (LookupError, TypeError, ValueError, SerdeError, struct.error):
            pass        # an unreadable message is recorded as it is, without transforms

    def _follow(self, data, t):
        joints = from_bytes(self._latest, 'sensor_msgs/msg/JointState')
        stamp, angles = joints.header.stamp, dict(zip(joints.name, joints.position))
        odom = from_bytes(data, 'nav_msgs/msg/Odometry')
        if not angles.keys() >= self._moving.keys():
            return
        if self._due is None:
            self._begin(odom.header.stamp, t)
        self._due = t + PERIOD if self._due is None else max(self._due + PERIOD, t)
        at, turn = odom.pose.pose.position, odom.pose.pose.orientation
        poses = [(odom.header.stamp, (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)),
                 *((stamp, (*joint.position, *joint.turned(angles[name])))
                   for name, joint in self._moving.items())]
        if all(isfinite(x) for _, pose in poses for x in pose):
            self._write('/tf', TRANSFORMS, self._frame.filled(poses), t)

    def _begin(self, stamp, t):
        fixed = _Template([(joint.parent, joint.child) for joint in self._fixed])
        self._write('/tf_static', TRANSFORMS, fixed.filled(
            [(stamp, (*joint.position, *joint.quaternion)) for joint in self._fixed]), t)
        text = BAG.new(TEXT)
        text.data = self._text
        self._write(list(self.topics)[-1], TEXT, to_bytes(text, TEXT), t)


class _Template:
    """CDR of transforms between given frames, with exchangeable stamps and poses."""

    def __init__(self, frames):
        message = BAG.new(TRANSFORMS)
        for k, (parent, child) in enumerate(frames):
            frame = BAG.new('geometry_msgs/msg/TransformStamped')
            stamp, at, turn = frame.header.stamp, frame.transform.translation, \
                frame.transform.rotation
            stamp.sec, stamp.nanosec = k, 0xBEEF
            frame.header.frame_id, frame.child_frame_id = parent, child
            at.x = at.y = at.z = turn.x = turn.y = turn.z = turn.w = MARK
            message.transforms.append(frame)
        self._data = bytearray(to_bytes(message, TRANSFORMS))
        self._places, start = [], 0
        for k in range(len(frames)):
            header = self._data.index(STAMP.pack(k, 0xBEEF), start)
            start = self._data.index(POSE.pack(*[MARK] * 7), header)
            self._places.append((header, start))

    def filled(self, poses):
        """Return the CDR with (stamp, seven numbers of the pose) for each transform."""
        for (header, place), (stamp, pose) in zip(self._places, poses, strict=True):
            STAMP.pack_into(self._data, header, stamp.sec, stamp.nanosec)
            POSE.pack_into(self._data, place, *pose)
        return bytes(self._data)
