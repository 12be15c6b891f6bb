"""
Read a recorded flight into numpy arrays.

    python examples/read_bag.py [BAG]           # without one, a short flight is recorded first
"""

from pathlib import Path
import sys
import tempfile

import numpy as np

import beetle_omni_ros


def summary(bag):
    """Print the contents of a bag, and the error of the estimated position."""
    log = beetle_omni_ros.read_run(bag)
    print(f'{log.end - log.start:.1f} s, task {log.meta.get("task")}, '
          f'{len(log.imu_t)} IMU samples, {len(log.mocap_t)} poses, {len(log.targets)} targets')
    print('highest speed', f'{np.linalg.norm(log.odom_velocity, axis=1).max():.2f} m/s,',
          'largest tilt', f'{np.abs(log.joint_position).max():.2f} rad,',
          'mean thrust', f'{log.command_thrust.mean():.2f} N')
    if len(log.truth_t):                        # of simulated flights only
        truth = np.column_stack([np.interp(log.odom_t, log.truth_t, axis)
                                 for axis in log.truth_position.T])
        error = np.linalg.norm(log.odom_position - truth, axis=1)
        print(f'estimated position: {1000 * np.sqrt(np.mean(error ** 2)):.2f} mm RMS')
    for name, asked in log.requests.items():
        print(f'{name} asked for {len(asked.t)} commands')
    for warning in log.warnings:
        print('warning:', warning)


if __name__ == '__main__':
    if len(sys.argv) > 1:
        summary(sys.argv[1])
    else:
        with tempfile.TemporaryDirectory() as folder:
            bag = Path(folder) / 'flight'
            beetle_omni_ros.simulate('nmpc', [[0.5, 0.0, 1.2, 90, 0, 45]], bag=bag)
            summary(bag)
