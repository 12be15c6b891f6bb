"""Recordings as rosbag2 folders, with the package's messages and writer."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.robot.readings import BatteryReading, ImuReading, JointReading, PoseReading
from beetle_omni_ros.runs.bag_writer import BagWriter
from gap_data.sensors import Recording

# table of a recording -> topic, message, columns of its values after the stamp
TABLES = {
    'imu': ('imu/data_raw', ImuReading, (slice(1, 4), slice(4, 7))),
    'mocap': ('mocap/pose', PoseReading, (slice(1, 4), slice(4, 8))),
    'joints': ('joint_states', partial(JointReading, velocity=None), (slice(1, 5),)),
    'battery': ('battery_state', BatteryReading, (1, 2)),
    'commands': ('command', Command, (slice(1, 5), slice(5, 9)))}


def write_bag(path: str | Path, recording: Recording, *, epoch: int) -> None:
    """Write one flight to a new folder; ``epoch``: UNIX time at which the flight began [s]."""
    entries = [(float(row[0]) + recording.ages[table], topic, message(
        float(row[0]), *(row[part] for part in parts)))
        for table, (topic, message, parts) in TABLES.items() for row in getattr(recording, table)]
    with BagWriter(path, topics=[topic for topic, *_ in TABLES.values()], epoch=epoch) as bag:
        for received, topic, value in sorted(entries, key=lambda entry: entry[0]):
            bag.write(topic, value, received)
