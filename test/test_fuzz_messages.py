"""Hostile ROS messages are accepted or refused; nothing else is raised."""


import numpy as np
import pytest

pytest.importorskip('rclpy')

from rclpy.serialization import deserialize_message, serialize_message

from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.messages.topics import ALL
from beetle_omni_ros.messages.values import MessageError, Odom
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.readings import (
    BatteryReading,
    JointReading,
    PoseReading,
)
from beetle_omni_ros.runs.targets import TargetChecks

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
NUMBERS = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320, 0.0, -5.0, 1e6)
TEXTS = ('', 'world', 'map', 'x' * 100_000, 'gimbal1', 'a\0b', '\N{SNOWMAN}')
LONGEST_TEXT = 500


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


def why_wrong(target, checks):
    """Why a target that the checks accept is not one to fly to."""
    positions = np.atleast_2d(getattr(target, 'positions', getattr(target, 'position', None)))
    if not checks.why_not(target, 5.0) and not (
            np.isfinite(positions).all() and positions[:, 2].min() > 0
            and np.abs(positions).max() <= 18):
        return f'a target at {positions.tolist()} is taken'
    return ''


def test_hostile_messages_are_accepted_or_refused():
    rng, checks, zero = np.random.default_rng(1), TargetChecks(RobotParameters.load()), np.zeros(3)
    values = {'mocap/pose': PoseReading(1.0, zero, LEVEL),
              'odom': Odom(1.0, zero, zero, LEVEL, zero),
              'command': Command(1.0, np.zeros(4), np.ones(4)),
              'joint_states': JointReading(1.0, np.zeros(4), np.zeros(4)),
              'battery_state': BatteryReading(1.0, 24.0, -9.0),
              'target_pose': PoseTarget(zero + 1, LEVEL, 1.0),
              'target_trajectory': TrajectoryTarget(
                  np.arange(3.0), np.ones((3, 3)), np.tile(LEVEL, (3, 1)), np.zeros((3, 3)),
                  np.zeros((3, 3)))}
    sent = [(ALL[name], wire.serialized(name, value)) for name, value in values.items()]
    for _ in range(1500):
        topic, data = sent[rng.integers(len(sent))]
        message = deserialize_message(data, wire.message_class(topic.type))
        with np.errstate(all='ignore'):
            for _ in range(rng.integers(1, 4)):
                spoil(rng, message)
            try:
                value = topic.take(wire.message(topic, serialize_message(message)))
                assert not topic.name.startswith('target') or not why_wrong(value, checks)
            except MessageError as error:
                assert '\n' not in str(error) and len(str(error)) <= LONGEST_TEXT
