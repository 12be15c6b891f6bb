"""Hostile ROS messages are accepted or refused; nothing else is raised."""


import numpy as np
import pytest

pytest.importorskip('rclpy')

from rclpy.serialization import deserialize_message, serialize_message

from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.messages.topics import ALL
from beetle_omni_ros.messages.values import MessageError, Odom, Wrench
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.readings import (
    BatteryReading,
    ImuReading,
    JointReading,
    PoseReading,
    RotorReading,
)
from beetle_omni_ros.runs.targets import TargetChecks

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
NUMBERS = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320, 0.0, -5.0, 1e6)
TEXTS = ('', 'world', 'map', 'x' * 100_000, 'gimbal1', 'a\0b', '\N{SNOWMAN}')
LONGEST_TEXT = 500


class Messages:
    """Hostile fields in every message type of a node."""

    def __init__(self):
        zero = np.zeros(3)
        self._checks = TargetChecks(RobotParameters.load())
        track = TrajectoryTarget(np.arange(3.0), np.ones((3, 3)), np.tile(LEVEL, (3, 1)),
                                 np.zeros((3, 3)), np.zeros((3, 3)))
        values = {'mocap/pose': PoseReading(1.0, zero, LEVEL),
                  'odom': Odom(1.0, zero, zero, LEVEL, zero),
                  'command': Command(1.0, np.zeros(4), np.ones(4)),
                  'joint_states': JointReading(1.0, np.zeros(4), np.zeros(4)),
                  'rotor_states': RotorReading(1.0, np.ones(4)),
                  'battery_state': BatteryReading(1.0, 24.0, -9.0, 6),
                  'disturbance': Wrench(1.0, zero, zero),
                  'imu/data_raw': ImuReading(0.0, zero, zero),
                  'target_pose': PoseTarget(zero + 1, LEVEL, 1.0), 'target_trajectory': track}
        self._kinds = [(ALL[name], deserialize_message(
            wire.serialized(name, value), wire.message_class(ALL[name].type)))
            for name, value in values.items()]

    def _judge(self, target):
        if not self._checks.why_not(target, 5.0):
            positions = np.atleast_2d(getattr(target, 'positions', getattr(
                target, 'position', None)))
            if not (np.isfinite(positions).all() and positions[:, 2].min() > 0
                    and np.abs(positions).max() <= 18):
                raise AssertionError(f'a target at {positions.tolist()} is taken')

    def __call__(self, rng):
        """Read one message."""
        topic, made = self._kinds[rng.integers(len(self._kinds))]
        message = copied(made)
        for _ in range(rng.integers(1, 4)):
            spoil(rng, message)
        try:
            value = topic.take(wire.message(topic, serialize_message(message)))
            if topic.name.startswith('target'):
                self._judge(value)
        except MessageError as error:
            if '\n' in str(error) or len(str(error)) > LONGEST_TEXT:
                raise AssertionError(f'a refusal of {len(str(error))} characters') from None


def copied(message):
    """A message that can be changed."""
    made = type(message)()
    for field in message.get_fields_and_field_types():
        value = getattr(message, field)
        if hasattr(value, 'get_fields_and_field_types'):
            value = copied(value)
        elif isinstance(value, list):
            value = [copied(one) if hasattr(one, 'get_fields_and_field_types') else one
                     for one in value]
        setattr(made, field, value)
    return made


def spoil(rng, message):
    """Change one random field of the message or of its parts."""
    fields = list(message.get_fields_and_field_types())
    field = fields[rng.integers(len(fields))]
    value = getattr(message, field)
    if hasattr(value, 'get_fields_and_field_types'):
        spoil(rng, value)
    elif isinstance(value, bool):
        setattr(message, field, not value)
    elif isinstance(value, int):
        low = -2**31 if field == 'sec' else 0
        setattr(message, field, int(rng.choice([0, 1, 255 if low == 0 else low, 200])))
    elif isinstance(value, float):
        number = NUMBERS[rng.integers(len(NUMBERS))]
        if message.get_fields_and_field_types()[field] == 'float':      # of 32 bits
            with np.errstate(over='ignore'):
                number = np.float32(number)
        setattr(message, field, float(number))
    elif isinstance(value, str):
        setattr(message, field, TEXTS[rng.integers(len(TEXTS))])
    else:
        spoil_sequence(rng, message, field, list(value))


def spoil_sequence(rng, message, field, values):
    """Change, drop or repeat an entry; of fixed arrays only change one."""
    at = int(rng.integers(len(values))) if values else 0
    if values and hasattr(values[at], 'get_fields_and_field_types') and rng.random() < 0.7:
        spoil(rng, values[at])
    elif values and isinstance(values[at], float) and rng.random() < 0.7:
        small = message.get_fields_and_field_types()[field].startswith('sequence<float')
        values[at] = float(NUMBERS[rng.integers(3 if small else len(NUMBERS))])
    elif values and isinstance(values[at], str) and rng.random() < 0.7:
        values[at] = TEXTS[rng.integers(len(TEXTS))]
    elif type(getattr(message, field)) is not np.ndarray and values:
        values = values[:at] if rng.random() < 0.5 else values * int(rng.integers(2, 30))
    setattr(message, field, values)


def test_hostile_messages_are_accepted_or_refused():
    feed, rng = Messages(), np.random.default_rng(1)
    with np.errstate(all='ignore'):
        for _ in range(1500):
            feed(rng)
