"""Small bags of a robot that turns and climbs, without a simulator."""

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic_flights import write_battery, write_command, write_imu, write_joints, write_mocap

from beetle_omni_ros.runs.bag import BagWriter

DURATION, GRAVITY = 1.2, 9.80665    # [s], [m/s^2]
BEGIN = 1.795e9                     # [s] a date, as recordings have


def small_bag(path, phase=0.0):
    """Write a bag: 200 Hz IMU, 100 Hz MoCap, joints and commands, all values different."""
    with BagWriter(path, meta={'task': 'poses'}) as bag:
        for k in range(int(DURATION * 200)):
            t, stamp = 1.0 + k / 200, BEGIN + k / 200
            s = np.sin(t * np.array([1.1, 1.7, 2.3]) + phase)
            turn = Rotation.from_rotvec(1.5 * s)
            write_imu(bag, stamp, turn.inv().apply([0.1 * s[0], 0, GRAVITY]), 2.5 * s[::-1])
            if k % 2:
                continue
            q = 0.3 + 0.2 * np.sin(t * np.array([1.0, 1.3, 1.6, 1.9]) + phase)
            write_mocap(bag, stamp, [s[0], 2 * s[1], 1.5 + 0.3 * s[2]], turn.as_quat())
            write_joints(bag, stamp, q, q - 0.3)
            write_command(bag, stamp, q + 0.01, 7 + q)
            if k % 40 == 0:
                write_battery(bag, stamp, 24.0, -20.0)
    return path
