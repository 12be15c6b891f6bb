"""Simulated flights that several test files use; each is flown once for all workers."""

from dataclasses import replace
import fcntl
from pathlib import Path
import shutil

import beetle_omni_ros

WIND = 1.2, -0.8, 0.0       # [N], not in the robot file
# x, y, z [m], roll, pitch, yaw [deg]
TWO_POSES = [[0.8, 0.4, 1.2, 40, 20, 90], [-0.6, 0.8, 0.9, -30, 35, -120]]
THREE_POSES = [[-0.7, 0.5, 1.0, -90, 10, -60], [0.9, -0.6, 1.3, 60, 50, 100],
               [0, 0.4, 1.1, 170, 0, 20]]
# name -> poses, wind, options
FLIGHTS = {'windy_0': (TWO_POSES + THREE_POSES, WIND, {'seed': 0}),
           'windy_1': (THREE_POSES, WIND, {'seed': 1}),
           'calm': (TWO_POSES, None, {'seed': 0}),
           'published': (THREE_POSES, None, {'seed': 5, 'conditions': 'published'})}
folder: Path | None = None      # set by conftest.py, the same for all workers


def flight(name):
    """Bag of a flight by the hover controller; the first caller flies it."""
    bag = folder / name
    with open(folder / f'{name}.lock', 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not bag.exists():
            poses, wind, options = FLIGHTS[name]
            robot, new = beetle_omni_ros.robot(), folder / 'new' / name
            new.parent.mkdir(exist_ok=True)
            shutil.rmtree(new, ignore_errors=True)      # of a test that exceeded its time
            beetle_omni_ros.simulate('hover', poses, bag=new, **options, plant=replace(
                robot, effects={'wind': {'force': wind}}) if wind is not None else robot)
            new.rename(bag)
    return bag
