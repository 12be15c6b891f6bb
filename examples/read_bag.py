"""
Read a recorded flight into numpy arrays.

    python examples/read_bag.py [BAG]           # without one, a short flight is recorded first

Times are seconds since the first sample; log.epoch is that moment in seconds since 1970.
"""

from pathlib import Path
import sys
import tempfile

import numpy as np

import beetle_omni_ros


def summary(bag):
    """Print the contents of a bag, and errors of the position."""
    log = beetle_omni_ros.read_run(bag)
    print(f'{log.end:.1f} s, task {log.meta.get("task")}, '
          f'{len(log.imu.t)} IMU samples, {len(log.mocap.t)} poses, {len(log.targets)} targets')
    print('highest speed', f'{np.linalg.norm(log.odom.velocity, axis=1).max():.2f} m/s,',
          'largest tilt', f'{np.abs(log.joint.position).max():.2f} rad,',
          'mean thrust', f'{log.command.thrust.mean():.2f} N')
    stamps = [target.stamp for target in log.targets]
    latest = np.searchsorted(stamps, log.odom.t, side='right') - 1      # -1 before the first
    error = [np.linalg.norm(position - log.targets[k].at(t).position) for k, t, position
             in zip(latest, log.odom.t, log.odom.position, strict=True) if k >= 0]
    if error:
        print(f'distance to the target: {1000 * np.median(error):.1f} mm median, '
              f'{1000 * error[-1]:.1f} mm at {log.odom.t[-1]:.1f} s')
    if len(log.truth.t):                        # of simulated flights only
        truth = np.column_stack([np.interp(log.odom.t, log.truth.t, axis)
                                 for axis in log.truth.position.T])
        error = np.linalg.norm(log.odom.position - truth, axis=1)
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
