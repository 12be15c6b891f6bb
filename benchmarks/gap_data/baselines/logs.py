"""Bags as arrays on one grid, for the baselines."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_typestore, Stores
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

STORE = get_typestore(Stores.ROS2_JAZZY)
GRID = 200.0  # [Hz]
REQUIRED = ('imu/data_raw', 'mocap/pose', 'joint_states', 'command')


class UnusableLog(ValueError):
    """A bag that the baselines cannot use; one line says why."""


@dataclass
class Log:
    """
    One flight on a grid of ``GRID``.

    Attributes:
        t: (N,) [s] since the first command.
        specific_force, gyro: (N, 3), unfiltered.
        position: (N, 3), quaternion: (N, 4) x y z w, of MoCap.
        tilt: (N, 4) of the encoders.
        commands: (M, 9) stamp, tilts, thrusts.
        voltage: (N,).

    """

    t: np.ndarray
    specific_force: np.ndarray
    gyro: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    tilt: np.ndarray
    commands: np.ndarray
    voltage: np.ndarray


def load(path: str | Path) -> Log:
    """Read a bag; an UnusableLog where it cannot be."""
    rows: dict[str, list] = {}
    try:
        with Reader(Path(path)) as reader:
            for connection, _, data in reader.messages():
                name = connection.topic.lstrip('/')
                if name in EXTRACT:
                    message = STORE.deserialize_cdr(data, connection.msgtype)
                    stamp = message.header.stamp
                    rows.setdefault(name, []).append(
                        (stamp.sec + stamp.nanosec * 1e-9, *EXTRACT[name](message)))
    except Exception as error:  # whatever a broken bag raises, the answer is the same
        raise UnusableLog(f'{path}: cannot be read ({type(error).__name__})') from None
    for name in REQUIRED:
        if len(rows.get(name, ())) < 100:
            raise UnusableLog(f'{path}: topic {name} is missing')
    tables = {name: _sound(path, name, np.array(table)) for name, table in rows.items()}
    start = max(table[0, 0] for name, table in tables.items() if name in REQUIRED) + 0.1
    end = min(table[-1, 0] for name, table in tables.items() if name in REQUIRED) - 0.1
    if end - start < 2.0:
        raise UnusableLog(f'{path}: the topics overlap by less than 2 s')
    t = np.arange(start, end, 1 / GRID)
    imu, mocap, joints = (tables[n] for n in REQUIRED[:3])
    quaternion = mocap[:, 4:8] * np.where(np.cumprod(
        np.r_[1.0, np.sign(np.einsum('ij,ij->i', mocap[1:, 4:8], mocap[:-1, 4:8]))]) < 0,
        -1.0, 1.0)[:, None]
    battery = tables.get('battery_state', np.array([[start, 24.0], [end, 24.0]]))
    commands = tables['command'].copy()
    commands[:, 0] -= start
    return Log(t - start, _at(t, imu[:, :4]), _at(t, imu[:, [0, 4, 5, 6]]),
               CubicSpline(mocap[:, 0], mocap[:, 1:4])(t),
               CubicSpline(mocap[:, 0], quaternion)(t),
               CubicSpline(joints[:, 0], joints[:, 1:5])(t), commands,
               np.interp(t, battery[:, 0], battery[:, 1]))


EXTRACT = {
    'imu/data_raw': lambda m: (m.linear_acceleration.x, m.linear_acceleration.y,
                               m.linear_acceleration.z, m.angular_velocity.x,
                               m.angular_velocity.y, m.angular_velocity.z),
    'mocap/pose': lambda m: (m.pose.position.x, m.pose.position.y, m.pose.position.z,
                             m.pose.orientation.x, m.pose.orientation.y, m.pose.orientation.z,
                             m.pose.orientation.w),
    'joint_states': lambda m: tuple(m.position[:4]),
    'command': lambda m: (*m.position[:4], *m.effort[4:8]),
    'battery_state': lambda m: (m.voltage,)}


def _sound(path, name, table):
    steps = np.diff(table[:, 0])
    if np.any(np.abs(steps) > 0.5 + 10 * np.median(steps)) or np.any(steps < -1e-6):
        raise UnusableLog(f'{path}: the clock of {name} jumps')
    return table[np.r_[True, steps > 1e-6]]


def _at(t, table):
    return np.column_stack([np.interp(t, table[:, 0], column) for column in table[:, 1:].T])


def smooth(values: np.ndarray, cut: float) -> np.ndarray:
    """Zero-phase low-pass along time, ``cut`` in Hz."""
    return sosfiltfilt(butter(4, cut / (GRID / 2), output='sos'), values, axis=0)
