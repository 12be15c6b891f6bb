"""
Fly a trajectory of your own: a circle with rolls to both sides.

    python examples/own_trajectory.py [SECONDS]
"""

import sys

import numpy as np
from scipy.spatial.transform import Rotation

import beetle_omni_ros

RADIUS, HEIGHT, ROUND = 0.8, 1.5, 20.0          # [m], [m], [s]
ROLL = 115.0    # [deg] to each side; a continuous roll would turn the joints to their stops


def circle(duration):
    """Times [s], positions [m] and attitudes (x, y, z, w) of a circle that starts at rest."""
    times = np.arange(0.0, duration + 0.01, 0.02)
    phase = 2 * np.pi / ROUND * np.where(times < 4, times ** 2 / 8, times - 2)     # 4 s to speed
    positions = np.column_stack([RADIUS * np.cos(phase), RADIUS * np.sin(phase),
                                 np.full_like(phase, HEIGHT)])
    attitudes = Rotation.from_euler('x', ROLL * np.sin(phase)[:, None], degrees=True).as_quat()
    return times, positions, attitudes


if __name__ == '__main__':
    duration = float(sys.argv[1]) if len(sys.argv) > 1 else 24.0
    task = beetle_omni_ros.trajectory(*circle(duration), name='rolling circle')
    results = beetle_omni_ros.evaluate(['nmpc', 'rl'], task)
    for name in ('nmpc', 'rl'):
        tracking = results[name]['trajectory']
        print(f"{name}: {1000 * tracking['position_mean_m']:.1f} mm, "
              f"{tracking['orientation_mean_deg']:.2f} deg on average")
