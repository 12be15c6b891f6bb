"""Undamaged flights, made in this process and kept in a folder."""

from __future__ import annotations

from dataclasses import dataclass
import json
from pathlib import Path
import shutil

import numpy as np

from beetle_omni_ros.evaluation.command import fly
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.tasks import make_task, pose_target, Segment, Task

POSES = 7       # of 8 s each
FLIGHTS = 3     # of a set: two fitted ones and a held-out one
WAYS = (('nmpc', 'nominal'), ('rl', 'published'), ('nmpc', 'published'), ('rl', 'nominal'))
TASKS = ('poses', 'mixture', 'poses', 'hover', 'lemniscate')


@dataclass(frozen=True)
class Order:
    """
    One flight to make.

    Attributes:
        folder: folder of the bag.
        controller: 'nmpc' or 'rl'.
        conditions: 'nominal' or 'published'.
        task: key of ``TASKS``.
        seed: seed of the conditions; flights of one set have the same robot.
        poses: seed of the poses.

    """

    folder: Path
    controller: str
    conditions: str
    task: str
    seed: int
    poses: int


def sets_of(folder: Path, count: int, seed: int) -> list[list[Order]]:
    """Sets of flights, each with its controller, conditions and seed."""
    made = []
    for k in range(count):
        controller, conditions = WAYS[k % len(WAYS)]
        made.append([
            Order(folder / f'{controller}_{conditions}_{seed}_{k}' / f'flight_{n}', controller,
                  conditions, 'poses', 1000 * seed + k, 100 * (1000 * seed + k) + n)
            for n in range(FLIGHTS)])
    return made


def undamaged(folder: Path, count: int, seed: int) -> list[Order]:
    """Single flights of all controllers, conditions and tasks in turn."""
    made = []
    for k in range(count):
        controller, conditions = WAYS[k % len(WAYS)]
        task = TASKS[k % len(TASKS)]
        made.append(Order(folder / f'{controller}_{conditions}_{task}_{seed}_{k}', controller,
                          conditions, task, 1000 * seed + 500 + k, 7000 * seed + k))
    return made


def make_flight(order: Order) -> str:
    """
    Fly, unless the bag exists.

    Returns:
        reason of a failed flight, or ''.

    """
    done = order.folder / 'done.json'
    if done.exists():
        return json.loads(done.read_text())['ended']
    shutil.rmtree(order.folder, ignore_errors=True)
    order.folder.mkdir(parents=True)
    robot = RobotParameters.load()
    log = fly(order.controller, task_of(order), robot=robot, plant=robot,
              conditions=order.conditions, seed=order.seed, bag=order.folder / 'bag',
              meta={'task': order.task, 'conditions': order.conditions, 'seed': order.seed})
    done.write_text(json.dumps({'ended': log.meta['ended']}) + '\n')
    return log.meta['ended']


def poses(seed: int, count: int = POSES) -> np.ndarray:
    """(count, 6) poses with large rotations, clear of the ground: x, y, z [m], angles [deg]."""
    random = np.random.default_rng(seed)
    low = [-1.5, -1.5, 1.0, -150.0, -80.0, -180.0]
    high = [1.5, 1.5, 2.0, 150.0, 80.0, 180.0]
    return random.uniform(low, high, (count, 6))


def task_of(order: Order) -> Task:
    """Poses, hover, lemniscate, or some of each."""
    if order.task == 'hover':
        return make_task('hover')
    rows = poses(order.poses)
    held = [_hold(row) for row in rows]
    track = make_task('lemniscate').segments
    lemniscate = (track[0], Segment(min(45.0, track[1].duration), track[1].target))
    level = _hold(np.array([0.0, 0.0, 1.2, 0.0, 0.0, 0.0]))
    segments = {'poses': tuple(held), 'lemniscate': lemniscate,
                'mixture': (*held[:3], level, *lemniscate)}[order.task]
    return Task(order.task, 'poses', segments, rows)


def _hold(pose):
    return Segment(8.0, lambda start: pose_target(pose, start))
