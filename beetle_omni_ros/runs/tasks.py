"""Tasks: targets, external wrenches and payloads over time."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
import re

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target, TrajectoryTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs import lemniscate, pose_file

POSE_DURATION = 8.0  # [s] of one pose
HOVER_DURATION = 60.0  # [s]
DISTURBANCE_PERIOD = 2.0  # [s] between disturbance levels
TORQUE_IMPULSE = 0.05  # [s]
FORCE_LEVELS = np.arange(10.0, 101.0, 10.0)  # [N] upwards
TORQUE_LEVELS = np.arange(2.5, 30.1, 2.5)  # [N m]
PAYLOADS = (0.0, 0.25, 0.5, 0.75, 1.0)  # [kg]
LOST_POSITION = 1.5  # [m] position error above which control is lost
LOST_ORIENTATION = np.radians(90)  # [rad] the same for the orientation, at the end of a level
GROUND_HEIGHT = 0.25  # [m] height of base_link below which the robot is on the ground

# The poses of the real-world experiment: x, y, z [m], roll, pitch, yaw [deg].
WAYPOINTS = np.array([[0.0, 0.0, 0.8, 0.0, 0.0, 0.0],
                      [1.0, 0.0, 1.0, 45.0, 0.0, 0.0],
                      [0.0, 1.0, 1.0, 0.0, -25.0, 0.0],
                      [-1.0, 0.0, 1.0, -25.0, 0.0, 0.0],
                      [0.0, 0.0, 0.8, 0.0, 0.0, 90.0]])
WAYPOINT_ROUNDS = 3

NAMES = ('waypoints', 'random100', 'lemniscate', 'hover', 'force', 'torque', 'payload')


@dataclass(frozen=True)
class Segment:
    """
    Part of a task with constant disturbance.

    Attributes:
        duration: [s].
        target: start time of the segment [s] -> target to publish; None: the target stays.
        force_world: (3,) external force in world [N].
        torque_body: (3,) external torque in base_link [N m].
        payload: mass attached below the body [kg].
        level: disturbance level of this segment [N, N m or kg], 0 for none.

    """

    duration: float
    target: Callable[[float], Target] | None = None
    force_world: np.ndarray = field(default_factory=lambda: np.zeros(3))
    torque_body: np.ndarray = field(default_factory=lambda: np.zeros(3))
    payload: float = 0.0
    level: float = 0.0


@dataclass(frozen=True)
class Task:
    """
    A named sequence of segments.

    Attributes:
        name: name or file given by the user.
        kind: 'poses', 'trajectory', 'hover', 'force', 'torque' or 'payload'.
        segments: segments in order.
        poses: (P, 6) pose targets in order: x, y, z [m], roll, pitch, yaw [deg].
        rounds: (start, end) of each round of a trajectory, since the task's start [s].

    """

    name: str
    kind: str
    segments: tuple[Segment, ...]
    poses: np.ndarray
    rounds: tuple[tuple[float, float], ...] = ()

    @property
    def ends(self) -> np.ndarray:
        """(S,) end of each segment since the task's start [s]."""
        return np.cumsum([segment.duration for segment in self.segments])

    @property
    def duration(self) -> float:
        """Duration of the whole task [s]."""
        return float(self.ends[-1])

    def targets(self, start: float) -> list[Target]:
        """Return all targets of a flight of this task that starts at ``start`` [s]."""
        begins = start + np.concatenate([[0.0], self.ends[:-1]])
        return [segment.target(float(begin))
                for begin, segment in zip(begins, self.segments, strict=True) if segment.target]


@dataclass(frozen=True)
class Moment:
    """
    State of a task at one time.

    Attributes:
        target: target to publish now, or None.
        force_world: (3,) external force in world [N].
        torque_body: (3,) external torque in base_link [N m].
        payload: [kg].
        changed: whether a new segment has begun.
        finished: whether the task is over.
        lost: whether control was lost, which ends the task.

    """

    target: Target | None
    force_world: np.ndarray
    torque_body: np.ndarray
    payload: float
    changed: bool = False
    finished: bool = False
    lost: bool = False


class TaskPlayer:
    """
    Plays a task in time, by periodic calls of :meth:`update`.

    Targets are stamped with the time at which they are due, not with the time of the call, so
    that the 8 s of a pose are exact.
    """

    def __init__(self, task: Task, start: float):
        self.task = task
        self.start = start
        self.lost_level: float | None = None
        self._ends = task.ends
        self._index = -1
        self._target: Target | None = None

    def update(self, now: float, position: np.ndarray | None = None,
               quaternion: np.ndarray | None = None) -> Moment:
        """
        Return the state of the task at ``now`` [s].

        Pose (3,) in world [m] and (4,) of the robot serve to detect a loss of control.
        """
        index = int(self._ends.searchsorted(now - self.start + 1e-6, side='right'))
        if position is not None and self._lost(position, quaternion, index):
            self.lost_level = self.task.segments[max(self._index, 0)].level
        if index >= len(self._ends) or self.lost_level is not None:
            changed, self._index = self._index != len(self._ends), len(self._ends)
            return Moment(None, np.zeros(3), np.zeros(3), 0.0, changed=changed, finished=True,
                          lost=self.lost_level is not None)
        target = None
        changed = index != self._index
        for k in range(self._index + 1, index + 1):
            segment = self.task.segments[k]
            if segment.target:
                begin = self.start + (self._ends[k - 1] if k else 0.0)
                target = self._target = segment.target(float(begin))
        self._index = index
        segment = self.task.segments[index]
        return Moment(target, segment.force_world, segment.torque_body, segment.payload, changed)

    def _lost(self, position, quaternion, index):
        if self.task.kind not in ('force', 'torque') or self._target is None \
                or not 0 <= self._index < len(self._ends) or self.lost_level is not None:
            return False
        segments = self.task.segments
        if segments[self._index].level == 0:
            return False
        due = index >= len(segments) or segments[index].level != segments[self._index].level
        return control_lost(self._target, position, quaternion if due else None)


def control_lost(target: PoseTarget, position: np.ndarray,
                 quaternion: np.ndarray | None = None) -> bool:
    """
    Whether a robot that should hold ``target`` is out of control.

    Control is lost if the robot is more than 1.5 m away or on the ground. With ``quaternion``,
    given at the end of a disturbance level, control is also lost above an orientation error of
    90 deg: the robot did not recover before the next level.
    """
    if np.linalg.norm(position - target.position) > LOST_POSITION or position[2] < GROUND_HEIGHT:
        return True
    return quaternion is not None and \
        rotations.geodesic_angle(quaternion, target.quaternion) > LOST_ORIENTATION


def make_task(name: str | Path, seed: int = 0, reach: float = np.inf) -> Task:
    """
    Make a task from its name or from a pose file.

    Args:
        name: one of ``NAMES``, ``randomN`` for N random poses, or the path of a CSV file.
        seed: seed of the random poses.
        reach: largest step between two poses of a file for the controller [m].

    Raises:
        ParameterError: unknown name, or an unusable file.

    """
    name = str(name)
    if name == 'waypoints':
        return _pose_task(name, np.tile(WAYPOINTS, (WAYPOINT_ROUNDS, 1)))
    if match := re.fullmatch(r'random([1-9]\d{0,5})', name):
        return _pose_task(name, random_poses(int(match[1]), seed))
    if name == 'lemniscate':
        return _lemniscate_task(name)
    if name in ('hover', 'force', 'torque', 'payload'):
        return {'hover': _hover_task, 'force': _force_task, 'torque': _torque_task,
                'payload': _payload_task}[name](name)
    if name.lower().endswith('.csv') or name and Path(name).exists():
        return _pose_task(name, pose_file.read_poses(name, reach))
    raise ParameterError(f"task '{name}': expected a CSV file of poses, random1 to random999999 "
                         f"or one of {', '.join(NAMES)}")


def random_poses(count: int, seed: int) -> np.ndarray:
    """Return (count, 6) uniform poses: x, y +-2 m, z 0.6 to 2 m, angles +-180 deg."""
    low = [-2.0, -2.0, 0.6, -180.0, -180.0, -180.0]
    high = [2.0, 2.0, 2.0, 180.0, 180.0, 180.0]
    return np.random.default_rng(seed).uniform(low, high, (count, 6))


def pose_target(pose: np.ndarray, stamp: float = 0.0) -> PoseTarget:
    """Return the target of (6,) x, y, z [m], roll, pitch, yaw [deg]."""
    return PoseTarget(np.array(pose[:3], dtype=float),
                      rotations.from_rpy(*np.radians(pose[3:])), stamp)


def _builder(pose):
    return lambda start: pose_target(pose, start)


def _pose_task(name, poses):
    segments = tuple(Segment(POSE_DURATION, _builder(pose)) for pose in poses)
    return Task(name, 'poses', segments, poses)


def _hover_task(name):
    pose = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    return Task(name, 'hover', (Segment(HOVER_DURATION, _builder(pose)),), pose[None])


def _disturbance_pose():
    return np.array([0.0, 0.0, 1.5, 25.0, 0.0, 0.0])


def _force_task(name):
    pose = _disturbance_pose()
    levels = (Segment(DISTURBANCE_PERIOD, force_world=np.array([0.0, 0.0, level]), level=level)
              for level in FORCE_LEVELS)
    return Task(name, 'force', (Segment(POSE_DURATION, _builder(pose)), *levels), pose[None])


def _torque_task(name):
    pose = _disturbance_pose()
    segments = [Segment(POSE_DURATION, _builder(pose))]
    for level in TORQUE_LEVELS:
        segments += [Segment(TORQUE_IMPULSE, torque_body=np.array([level, 0.0, 0.0]), level=level),
                     Segment(DISTURBANCE_PERIOD - TORQUE_IMPULSE, level=level)]
    return Task(name, 'torque', tuple(segments), pose[None])


def _payload_task(name):
    pose = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    segments = tuple(Segment(POSE_DURATION, _builder(pose), payload=mass, level=mass)
                     for mass in PAYLOADS)
    return Task(name, 'payload', segments, np.tile(pose, (len(PAYLOADS), 1)))


def _lemniscate_task(name):
    first = lemniscate.sample(0.0)
    pose = np.concatenate([first.position, np.degrees(rotations.to_rpy(first.quaternion))])
    hold = Segment(POSE_DURATION, _builder(pose))
    track = Segment(lemniscate.DURATION, lemniscate.target)
    begin = POSE_DURATION + lemniscate.RAMP
    rounds = tuple((begin + k * lemniscate.PERIOD, begin + (k + 1) * lemniscate.PERIOD)
                   for k in range(lemniscate.ROUNDS))
    return Task(name, 'trajectory', (hold, track), pose[None], rounds)


def trajectory_task(name: str, times: np.ndarray, positions: np.ndarray,
                    quaternions: np.ndarray) -> Task:
    """
    Make a task of a trajectory: 8 s at its first pose, then the trajectory.

    Args:
        name: name of the task.
        times: (N,) increasing times from 0 [s].
        positions: (N, 3) in world [m].
        quaternions: (N, 4) body to world (x, y, z, w).

    Raises:
        ParameterError: inconsistent shapes, or too few samples.

    """
    times, positions, quaternions = (np.asarray(array, dtype=float)
                                     for array in (times, positions, quaternions))
    count = len(times)
    if count < 3 or positions.shape != (count, 3) or quaternions.shape != (count, 4):
        raise ParameterError(f"task '{name}': expected times (N,), positions (N, 3) and "
                             'quaternions (N, 4) of at least 3 samples, found '
                             f'{times.shape}, {positions.shape} and {quaternions.shape}')
    quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    steps = [rotations.log(rotations.multiply(rotations.conjugate(a), b))
             for a, b in zip(quaternions, quaternions[1:])]
    between = np.array(steps) / np.diff(times)[:, None]
    rates = np.vstack([between[:1], 0.5 * (between[1:] + between[:-1]), between[-1:]])
    velocities = np.gradient(positions, times, axis=0)
    hold = np.concatenate([positions[0], np.degrees(rotations.to_rpy(quaternions[0]))])

    def target(start):
        return TrajectoryTarget(start + times, positions, quaternions, velocities, rates, start)

    duration = float(times[-1])
    return Task(name, 'trajectory',
                (Segment(POSE_DURATION, _builder(hold)), Segment(duration, target)), hold[None],
                ((POSE_DURATION, POSE_DURATION + duration),))


def poses_task(name: str, poses: np.ndarray) -> Task:
    """Make a task of (N, 6) poses: x, y, z [m], roll, pitch, yaw [deg], 8 s each."""
    poses = np.atleast_2d(np.asarray(poses, dtype=float))
    if poses.ndim != 2 or poses.shape[1] != 6 or not np.isfinite(poses).all():
        raise ParameterError(f"task '{name}': expected finite poses (N, 6), found shape "
                             f'{poses.shape}')
    return _pose_task(name, poses)


__all__ = ['control_lost', 'make_task', 'Moment', 'NAMES', 'pose_target', 'poses_task',
           'random_poses', 'Segment', 'Task', 'TaskPlayer', 'trajectory_task']
