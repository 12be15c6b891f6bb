"""Tasks: targets, external wrenches and payloads over time."""

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from math import exp, pi, sqrt
from pathlib import Path
import re

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target, TrajectoryTarget
from beetle_omni_ros.control.targets import has_poses, read_poses, read_set_points, YAML_FILES
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.schema import ParameterError

POSE_DURATION = 8.0  # [s] of one pose
HOVER_DURATION = 60.0  # [s]
PAYLOADS = (0.0, 0.25, 0.5, 0.75, 1.0)  # [kg]
LOST_POSITION = 1.5  # [m] position error above which control is lost
LOST_ORIENTATION = np.radians(90)  # [rad] the same for the orientation, at the end of a level
GROUND_HEIGHT = 0.25  # [m] height of base_link below which the robot is on the ground

# Poses: x, y, z [m], roll, pitch, yaw [deg]. WAYPOINTS are of the real-world experiment.
HOVER = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
DISTURBED = np.array([0.0, 0.0, 1.5, 25.0, 0.0, 0.0])
WAYPOINTS = np.array([[0.0, 0.0, 0.8, 0.0, 0.0, 0.0],
                      [1.0, 0.0, 1.0, 45.0, 0.0, 0.0],
                      [0.0, 1.0, 1.0, 0.0, -25.0, 0.0],
                      [-1.0, 0.0, 1.0, -25.0, 0.0, 0.0],
                      [0.0, 0.0, 0.8, 0.0, 0.0, 90.0]])
WAYPOINT_ROUNDS = 3

# Task -> kind, direction (force in world, torque in base_link), levels [N] or [N m], duration of a
# push and of the rest after it [s]. The first two are those of the published figure, which rise
# without a return to rest. The others are the protocol of the authors, with a rest.
AUTHORS_LEVELS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
RISING = {
    'force': ('force', (0, 0, 1, 0, 0, 0), tuple(np.arange(10.0, 101.0, 10.0)), 2.0, 0.0),
    'torque': ('torque', (0, 0, 0, 1, 0, 0), tuple(np.arange(2.5, 30.1, 2.5)), 0.05, 1.95),
    'force_down': ('force', (0, 0, -1, 0, 0, 0), AUTHORS_LEVELS, 2.0, 2.0),
    'force_up': ('force', (0, 0, 1, 0, 0, 0), AUTHORS_LEVELS, 2.0, 2.0),
    'torque_pulses': ('torque', (0, 0, 0, 1, 0, 0), AUTHORS_LEVELS, 0.05, 5.0),
}

# Task 'wind': a fan blows along x for 10 s at each speed. On the robot at rest in hover, wind u
# has the force k u + c |u| u. k is the drag of the rotors in their plane (Faessler et al. 2018),
# and along their axes (Leishman 2006, ch. 2), with the usual values of model/effects.py. c is 0.5
# x 1.2 kg/m^3 x 1.05 x 0.029 m^2: drag coefficient of a cube (Hoerner 1965), and the silhouette of
# the meshes from the side. On the axis of a free round jet, the turbulence is 0.25 of the speed,
# and its integral length 0.7 half-widths (Pope 2000, ch. 5); a half-width of 0.25 m covers the
# robot. The spectrum is Dryden's longitudinal one, first-order filtered noise, for all three axes.
WIND_SPEEDS = (2.0, 3.0, 4.0)  # [m/s]
WIND_DURATION = 10.0  # [s] of one speed
WIND_SAMPLE = 0.02  # [s] of constant force
ROTOR_DRAG = np.array([0.4, 0.4, 1.6])  # [N s/m] k of all rotors, in x, y and z
BODY_DRAG = 0.018  # [N s^2/m^2] c
TURBULENCE = 0.25  # [-]
EDDY = 0.7 * 0.25  # [m] integral length

# Task 'pushes': a stick pushes from four sides, 0.1 m above base_link. The publication states no
# size. This impulse makes mean speeds of its order.
PUSH_FORCE = 10.0  # [N]
PUSH_DURATION = 0.1  # [s]
PUSH_HEIGHT = 0.1  # [m]
PUSH_PERIOD = 5.0  # [s]
PUSH_SIDES = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])

# Task 'steps': each axis steps alone from the hover and back. The steps are those of the set
# points in the authors' code (`SetPointTraj`).
STEPS = np.array([0.3, 0.2, 0.5, *np.degrees([0.5, 0.5, 0.3])])  # [m], [deg]

# The 3D lemniscate of the publication: a figure of eight with varying height and attitude. With
# the phase phi, one round of which is 2 pi, and theta = phi + pi / 2:
#   x = A cos(theta),  y = A sin(2 theta) / 2,  z = H + C sin(2 theta + pi / 2)
#   roll = -D sin(2 theta),  pitch = D cos(theta),  yaw = pi / 2 (1 - sin(theta))
# Curve and numbers, also both values of D, are those of the authors' code (`LemniscateTrajOmni` in
# https://github.com/jsk-ros-pkg/jsk_aerial_robot and its forks). Yaw is within [0, pi] there; the
# publication states [0, 2 pi]. In addition, the phase starts and ends at rest here: its rate
# follows a quintic smoothstep over ramps before the first and after the last round, so all rounds
# have equal speed.
LENGTH = 1.0  # [m] A, half the extent in x, and the extent in y
HEIGHT = 1.0  # [m] H, mean height
RISE = 0.3  # [m] C, half the extent in z
TILTS = {'lemniscate': 0.5, 'lemniscate_large': 2.5}  # [rad] D, largest roll and pitch
PERIOD = 20.0  # [s] of one round
ROUNDS = 5
RAMP = 4.0  # [s] from rest to full speed
DURATION = 2 * RAMP + ROUNDS * PERIOD  # [s]
SAMPLE_PERIOD = 0.02  # [s] between the samples of the published trajectory

NAMES = ('waypoints', 'random100', *TILTS, 'hover', *RISING, 'wind', 'pushes', 'payload',
         'steps')
TASK_FILES = '.csv', *YAML_FILES
WITH_WRENCHES = ('force', 'torque', 'wind', 'pushes')  # kinds of tasks


@dataclass(frozen=True)
class Segment:
    """Part of a task with constant disturbance."""

    duration: float         # [s]
    # Start time of the segment [s] -> target to publish; None: the target stays.
    target: Callable[[float], Target] | None = None
    force_world: np.ndarray = field(default_factory=lambda: np.zeros(3))    # external [N]
    torque_body: np.ndarray = field(default_factory=lambda: np.zeros(3))    # in base_link [N m]
    payload: float = 0.0    # mass attached below the body [kg]
    level: float = 0.0      # of the disturbance [N, N m, m/s or kg], number of a push; 0: none


@dataclass(frozen=True)
class Task:
    """A named sequence of segments."""

    name: str       # or file given by the user
    # 'poses', 'trajectory', 'hover', 'force', 'torque', 'wind', 'pushes', 'payload' or 'steps'; it
    # decides the metrics.
    kind: str
    segments: tuple[Segment, ...]       # in order
    poses: np.ndarray       # (P, 6) pose targets in order: x, y, z [m], roll, pitch, yaw [deg]
    # (start, end) of each round of a trajectory, since the task's start [s].
    rounds: tuple[tuple[float, float], ...] = ()

    @property
    def ends(self) -> np.ndarray:
        """(S,) end of each segment since the task's start [s]."""
        return np.cumsum([segment.duration for segment in self.segments])

    @property
    def duration(self) -> float:
        """Duration of the whole task [s]."""
        return float(self.ends[-1])


class TaskPlayer:
    """
    Plays a task in time, by periodic calls of :meth:`update`.

    Targets are stamped with the time at which they are due, not with the time of the call, so
    that the 8 s of a pose are exact.

    Attributes:
        segment, index: the present one, and its number from 0.
        changed: whether it began with the last call.
        target: to publish now, or None.
        lost_level: level at which control was lost, which ends the task, or None.

    """

    def __init__(self, task: Task, start: float):
        self.task = task
        self.start = start
        self.segment, self.changed = Segment(0.0), False
        self.target: Target | None = None
        self.lost_level: float | None = None
        self._segments = (*task.segments, self.segment)     # after the task
        self._ends = task.ends.tolist()
        self.index = -1
        self._in_force: Target | None = None

    def update(self, now: float, position: np.ndarray | None = None,
               quaternion: np.ndarray | None = None) -> bool:
        """
        Advance to ``now`` [s]; return whether the task is over.

        Pose (3,) in world [m] and (4,) of the robot serve to detect a loss of control.
        """
        index = bisect_right(self._ends, now - self.start + 1e-6)
        level = self._segments[self.index].level
        if position is not None and level and self.task.kind in ('force', 'torque') \
                and isinstance(self._in_force, PoseTarget) \
                and control_lost(self._in_force, position,
                                 quaternion if self._segments[index].level != level else None):
            self.lost_level = level
        if self.lost_level is not None:
            index = len(self._ends)
        self.target, self.changed = None, index != self.index
        for k in range(self.index + 1, index + 1):
            if build := self._segments[k].target:
                due = float(self.start + (self._ends[k - 1] if k else 0))
                self.target = self._in_force = build(due)
        self.index, self.segment = index, self._segments[index]
        return index == len(self._ends)


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
    Make a task from its name or from a file of poses or set points.

    Args:
        name: one of ``NAMES``, ``randomN`` for N random poses, or the path of a CSV or YAML file
            of poses or of a YAML file of set points.
        seed: seed of the random poses.
        reach: largest step between two poses of a file for the controller [m].

    Raises:
        ParameterError: unknown name, or an unusable file.

    """
    name, hover = str(name), partial(pose_target, HOVER)
    if name == 'waypoints':
        return _pose_task(name, np.tile(WAYPOINTS, (WAYPOINT_ROUNDS, 1)))
    if match := re.fullmatch(r'random([1-9]\d{0,5})', name):
        return _pose_task(name, random_poses(int(match[1]), seed))
    if name in TILTS:
        return _lemniscate_task(name)
    if name == 'hover':
        return Task(name, name, (Segment(HOVER_DURATION, hover),), HOVER[None])
    if name == 'payload':
        return Task(name, name, tuple(
            Segment(POSE_DURATION, hover, payload=mass, level=mass)
            for mass in PAYLOADS), np.tile(HOVER, (len(PAYLOADS), 1)))
    if name == 'steps':
        poses = np.vstack([HOVER, *(pose for step in np.diag(STEPS)
                                    for pose in (HOVER + step, HOVER))])
        return _pose_task(name, poses, kind=name)
    if name in ('wind', 'pushes'):
        disturbed = _wind(np.random.default_rng(seed)) if name == 'wind' else _stick()
        return Task(name, name, (Segment(POSE_DURATION, hover), *disturbed), HOVER[None])
    if name in RISING:
        kind, direction, levels, push, rest = RISING[name]
        segments = [segment for level in levels for segment in (
            _push(push, level * np.array(direction), level), Segment(rest, level=level))
            if segment.duration]
        begin = Segment(POSE_DURATION, partial(pose_target, DISTURBED))
        return Task(name, kind, (begin, *segments), DISTURBED[None])
    if name.lower().endswith(YAML_FILES) and not has_poses(name):
        return trajectory_task(name, *read_set_points(name, SAMPLE_PERIOD))
    if name.lower().endswith(TASK_FILES) or name and Path(name).exists():
        return _pose_task(name, read_poses(name, reach))
    raise ParameterError(f"task '{name}': expected a CSV file of poses, a YAML file of poses "
                         f"or set points, random1 to random999999 or one of {', '.join(NAMES)}")


def random_poses(count: int, seed: int | np.random.Generator) -> np.ndarray:
    """Return (count, 6) uniform poses: x, y +-2 m, z 0.6 to 2 m, angles +-180 deg."""
    low = [-2.0, -2.0, 0.6, -180.0, -180.0, -180.0]
    high = [2.0, 2.0, 2.0, 180.0, 180.0, 180.0]
    return np.random.default_rng(seed).uniform(low, high, (count, 6))


def pose_target(pose: np.ndarray, stamp: float = 0.0) -> PoseTarget:
    """Return the target of (6,) x, y, z [m], roll, pitch, yaw [deg]."""
    return PoseTarget(np.array(pose[:3], dtype=float),
                      rotations.from_rpy(*np.radians(pose[3:])), stamp)


def _push(duration, wrench, level):
    """Segment with a wrench (6,): force in world [N], torque in base_link [N m]."""
    return Segment(duration, force_world=wrench[:3], torque_body=wrench[3:], level=level)


def _wind(rng):
    """Segments of a fan."""
    for speed in WIND_SPEEDS:
        count = round(WIND_DURATION / WIND_SAMPLE)
        kept = exp(-WIND_SAMPLE * speed / EDDY)
        gusts = TURBULENCE * speed * rng.standard_normal((count, 3))
        for k in range(1, count):
            gusts[k] = kept * gusts[k - 1] + sqrt(1 - kept ** 2) * gusts[k]
        for gust in gusts:
            wind = gust + [speed, 0, 0]
            force = ROTOR_DRAG * wind + BODY_DRAG * np.linalg.norm(wind) * wind
            yield _push(WIND_SAMPLE, np.concatenate([force, np.zeros(3)]), speed)


def _stick():
    """Segments of stick pushes."""
    for k, side in enumerate(PUSH_SIDES):
        force = PUSH_FORCE * side
        torque = np.cross([0, 0, PUSH_HEIGHT], force)
        yield _push(PUSH_DURATION, np.concatenate([force, torque]), k + 1)
        yield Segment(PUSH_PERIOD - PUSH_DURATION, level=k + 1)


def _pose_task(name, poses, kind='poses'):
    segments = tuple(Segment(POSE_DURATION, partial(pose_target, pose)) for pose in poses)
    return Task(name, kind, segments, poses)


def _lemniscate_task(name):
    tilt, rate = TILTS[name], 2 * pi / PERIOD
    times = np.linspace(0.0, DURATION, round(DURATION / SAMPLE_PERIOD) + 1)
    # Integral of the smoothstep s^3 (10 - 15 s + 6 s^2) over each ramp; the phase is 0 at the
    # beginning of the first round.
    rising, falling = (RAMP * s ** 4 * (2.5 - 3 * s + s * s) for s in (
        np.clip(times / RAMP, 0, 1), np.clip((DURATION - times) / RAMP, 0, 1)))
    phase = rate * (rising - falling + np.clip(times - RAMP, 0, ROUNDS * PERIOD))
    once, twice = phase + pi / 2, 2 * phase + pi
    positions = np.stack([LENGTH * np.cos(once), LENGTH / 2 * np.sin(twice),
                          HEIGHT + RISE * np.sin(twice + pi / 2)], axis=1)
    angles = np.stack([-tilt * np.sin(twice), tilt * np.cos(once),
                       pi / 2 * (1 - np.sin(once))], axis=1)
    task = trajectory_task(name, times, positions, np.array([
        rotations.from_rpy(*row) for row in angles]))
    begins = [POSE_DURATION + RAMP + k * PERIOD for k in range(ROUNDS)]
    return replace(task, rounds=tuple((begin, begin + PERIOD) for begin in begins))


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
    segments = Segment(POSE_DURATION, partial(pose_target, hold)), Segment(duration, target)
    return Task(name, 'trajectory', segments, hold[None],
                ((POSE_DURATION, POSE_DURATION + duration),))


def poses_task(name: str, poses: np.ndarray) -> Task:
    """Make a task of (N, 6) poses: x, y, z [m], roll, pitch, yaw [deg], 8 s each."""
    poses = np.atleast_2d(np.asarray(poses, dtype=float))
    if poses.ndim != 2 or poses.shape[1] != 6 or not len(poses):
        raise ParameterError(f"task '{name}': expected poses (N, 6), found shape {poses.shape}")
    for k, pose in enumerate(poses):
        if not np.isfinite(pose).all():
            raise ParameterError(f"task '{name}': poses[{k}]: expected finite numbers, found "
                                 f'{pose.tolist()}')
    return _pose_task(name, poses)
