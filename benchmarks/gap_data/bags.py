"""Recordings as rosbag2 folders, with the package's messages and writer."""

from functools import partial
from pathlib import Path

import numpy as np

from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.control.base import Command
from beetle_omni_ros.model.readings import BatteryReading, ImuReading, JointReading, PoseReading

# table of a recording -> topic, message, columns of its values, seconds from stamp to arrival
TABLES = {
    'imu': ('imu/data_raw', ImuReading, (slice(1, 4), slice(4, 7)), 0.001),
    'mocap': ('mocap/pose', PoseReading, (slice(1, 4), slice(4, 8)), 0.010),
    'joints': ('joint_states', partial(JointReading, velocity=None), (slice(1, 5),), 0.010),
    'battery': ('battery_state', BatteryReading, (1, 2), 0.002),
    'commands': ('command', Command, (slice(1, 5), slice(5, 9)), 0.001)}


def write_bag(path: str | Path, recording: dict[str, np.ndarray], *, epoch: int) -> None:
    """Write a :func:`~gap_data.sensors.measure`; ``epoch``: UNIX time of its beginning [s]."""
    entries = [(epoch + float(row[0]) + age, topic,
                message(epoch + float(row[0]), *(row[part] for part in parts)))
               for table, (topic, message, parts, age) in TABLES.items()
               for row in recording[table]]
    with BagWriter(path, topics=[topic for topic, *_ in TABLES.values()]) as bag:
        for received, topic, value in sorted(entries, key=lambda entry: entry[0]):
            bag.write(topic, value, received)
