"""Recordings of simulated flights, and changes to their arrays."""

from copy import deepcopy
from functools import cache
from pathlib import Path
import tempfile

from flown_once import flight, hover, THREE_POSES
import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.gap.bags import read_recording
from beetle_omni_ros.robot.parameters import RobotParameters

ROBOT = RobotParameters.load()


@cache
def _flown(conditions):
    if conditions == 'nominal':
        return read_recording(flight('calm'))
    with tempfile.TemporaryDirectory() as folder:
        return read_recording(hover(Path(folder) / conditions, THREE_POSES, seed=5,
                                    conditions=conditions))


def recording(conditions='nominal'):
    """24 s over three poses, with stamps of a real clock."""
    made = deepcopy(_flown(conditions))
    for topic in made.times:
        made.times[topic] = made.times[topic] + 1.78e9
        made.received[topic] = made.received[topic] + 1.78e9
    return made


def late_half(made, topic):
    """Mask (N,) of the second half of a topic."""
    received = made.received[topic]
    return received > 0.5 * (received[0] + received[-1])


def columns(made, topic, first, last, change):
    """Change some columns of a topic's values."""
    made.values[topic][:, first:last] = change(made.values[topic][:, first:last].copy())
    return made


def kept(made, topic, keep):
    """Only some messages of a topic."""
    for part in (made.times, made.values, made.received):
        part[topic] = part[topic][keep]
    return made


def turned_pose(made, world=None, body=None):
    """Orientations with a rotation of the world before them and one of the body behind."""
    q = Rotation.from_quat(made.values['mocap/pose'][:, 3:])
    q = (Rotation.identity() if world is None else world) * q
    q = q * (Rotation.identity() if body is None else body)
    made.values['mocap/pose'] = np.column_stack([made.values['mocap/pose'][:, :3], q.as_quat()])
    return made
