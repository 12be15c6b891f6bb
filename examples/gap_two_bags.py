"""
Find the effect that the model lacks, from two bags: one is fitted, the other one validates.

    python examples/gap_two_bags.py [FITTED VALIDATION]

Without bags, two flights in a wind that is not in the robot file are recorded first.
"""

from dataclasses import replace
from pathlib import Path
import sys
import tempfile

import numpy as np

import beetle_omni_ros

POSES = [[0.8, 0.4, 1.2, 40, 20, 90], [-0.6, 0.8, 0.9, -30, 35, -120],
         [-0.7, 0.5, 1.0, -90, 10, -60], [0.9, -0.6, 1.3, 60, 50, 100], [0, 0.4, 1.1, 170, 0, 20]]


def record(folder):
    """Record two flights of 40 s in a hidden wind [N]; return their bags."""
    robot = beetle_omni_ros.robot()
    windy = replace(robot, effects={'wind': {'force': (1.2, -0.8, 0.0)}})
    bags = [Path(folder) / f'flight{seed}' for seed in (0, 1)]
    for seed, bag in enumerate(bags):
        beetle_omni_ros.simulate('hover', POSES, plant=windy, seed=seed, bag=bag)
    return bags


def explain(fitted, judging):
    """Print the result."""
    found = beetle_omni_ros.find_gap([fitted], [judging], quiet=True)
    if found['verdict'] == 'bad_data':
        sys.exit('no flights to be judged by; beetle_omni gap says why')
    print(f"{found['verdict']}: gap {found['gap_before']:.2f} before, {found['gap_after']:.2f} "
          f"after, noise {found['noise_floor']:.2f}")
    for effect in found['effects']:
        for name, value in effect['parameters'].items():
            print(' or '.join(effect['names']), name, np.round(value['value'], 3), value['unit'],
                  '95 % within', *np.round(value['interval'], 3).tolist())


if __name__ == '__main__':
    if len(sys.argv) == 3:
        explain(*sys.argv[1:])
    else:
        with tempfile.TemporaryDirectory() as folder:
            explain(*record(folder))
