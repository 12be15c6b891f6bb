"""Recordings of simulated flights, and changes to their arrays."""

from copy import deepcopy
from functools import cache
from pathlib import Path
import tempfile

import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.evaluation.command import fly
from beetle_omni_ros.identify.gap.bags import read_recording
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.tasks import make_task

ROBOT = RobotParameters.load()
POSES = '-0.7,0.5,1.0,-90,10,-60\n0.9,-0.6,1.3,60,50,100\n0,0.4,1.1,170,0,20\n'


@cache
def _flown(conditions):
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        (folder / 'poses.csv').write_text('x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n'
                                          + POSES)
        fly('hover', make_task(str(folder / 'poses.csv'), 0), robot=ROBOT, plant=ROBOT, seed=5,
            conditions=conditions, bag=folder / 'case')
        return read_recording(folder / 'case')


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
