"""Hostile ROS messages are accepted or refused; nothing else is raised."""

from collections import defaultdict
from dataclasses import fields, is_dataclass

import numpy as np

from beetle_omni_ros.bags.messages import MessageError
from beetle_omni_ros.bags.topics import ALL
from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.control.targets import TargetChecks
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.readings import BatteryReading, JointReading, PoseReading
from beetle_omni_ros.model.rotations import BodyState

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
NUMBERS = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320, 0.0, -5.0, 1e6)
TEXTS = ('', 'world', 'map', 'x' * 100_000, 'gimbal1', 'a\0b', '\N{SNOWMAN}')
INTEGERS = (0, 1, 200, 255)
FIXED = (9, 36)     # lengths of covariances, which are part of the type
LONGEST_TEXT = 500


def spoil(rng, message):
    """Change one random field of the message or of its parts."""
    name = rng.choice([field.name for field in fields(message)])
    setattr(message, name, spoilt(rng, getattr(message, name)))


def spoilt(rng, value):
    """Another value of the same type; an array may lose or repeat entries."""
    if is_dataclass(value):
        spoil(rng, value)
        return value
    if isinstance(value, (list, np.ndarray)):
        if len(value) and rng.random() < 0.7:
            at, value = int(rng.integers(len(value))), value.copy()
            value[at] = spoilt(rng, value[at])
        elif len(value) not in FIXED:
            longer = 9 * value if isinstance(value, list) else np.tile(value, 9)
            value = value[:len(value) // 2] if rng.random() < 0.5 else longer
        return value
    choices = TEXTS if isinstance(value, str) else \
        INTEGERS if isinstance(value, (int, np.integer)) else NUMBERS
    return choices[rng.integers(len(choices))]


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
              'odom': BodyState(1.0, zero, zero, LEVEL, zero),
              'command': Command(1.0, np.zeros(4), np.ones(4)),
              'joint_states': JointReading(1.0, np.zeros(4), np.zeros(4)),
              'battery_state': BatteryReading(1.0, 24.0, -9.0),
              'target_pose': PoseTarget(zero + 1, LEVEL, 1.0),
              'target_trajectory': TrajectoryTarget(
                  np.arange(3.0), np.ones((3, 3)), np.tile(LEVEL, (3, 1)), np.zeros((3, 3)),
                  np.zeros((3, 3)))}
    kinds = defaultdict(set)    # of the refusals, which are counted by kind
    for _ in range(1500):
        topic = ALL[rng.choice(list(values))]
        message = topic.write(values[topic.name])
        with np.errstate(all='ignore'):
            for _ in range(rng.integers(1, 4)):
                spoil(rng, message)
            try:
                value = topic.take(message)
                assert not topic.name.startswith('target') or not why_wrong(value, checks)
            except MessageError as error:
                assert '\n' not in str(error) and len(str(error)) <= LONGEST_TEXT
                kinds[topic.name].add(error.kind)
    assert set(kinds) == set(values) and max(map(len, kinds.values())) <= 8, kinds
