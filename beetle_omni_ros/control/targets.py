"""Checks of targets, for messages and for files of poses and of set points, and these files."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import isfinite
from pathlib import Path

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.files import missing, read_table
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import (
    numbers,
    parameter,
    ParameterError,
    ParameterFile,
    read_yaml,
)

OLDEST, AHEAD = 10.0, 1.0   # [s] a stamp may be before and after the present time
START = (0.0, 0.0, 1.0)     # [m] position after the take-off
YAML_FILES = '.yaml', '.yml'
COLUMNS = ('x_m', 'y_m', 'z_m', 'roll_deg', 'pitch_deg', 'yaw_deg')


@dataclass(frozen=True, kw_only=True)
class TargetLimits(ParameterFile, file='targets.yaml'):
    """Limits of a target."""

    half_width: float = parameter(18.0, doc='largest |x| and |y|', unit='m', low=0.5, high=1000)
    height: float = parameter(18.0, doc='largest z', unit='m', low=0.5, high=1000)
    clearance: float = parameter(0.02, doc='height of the lowest point above the floor', unit='m',
                                 low=0, high=1)
    feet: float = parameter(0.16, doc='soles below base_link', unit='m', low=0, high=5)
    feet_spread: float = parameter(0.11, doc='|x| = |y| of a foot', unit='m', low=0, high=5)
    propeller_radius: float = parameter(0.1143, doc='radius of a propeller', unit='m', low=0,
                                        high=5)
    ball_radius: float = parameter(0.04, doc='radius of the end-effector', unit='m', low=0, high=5)
    speed: float = parameter(10.0, doc='largest speed of a trajectory along each axis', unit='m/s',
                             low=0.1, high=100)
    rate: float = parameter(20.0, doc='largest rate of a trajectory about each axis', unit='rad/s',
                            low=0.1, high=100)


class TargetChecks:
    """Checks targets of one robot."""

    def __init__(self, robot: RobotParameters):
        self._p = p = TargetLimits.load()
        feet = [(x * p.feet_spread, y * p.feet_spread, -p.feet) for x in (1, -1) for y in (1, -1)]
        # The joints' axes pass through the rotors' centres, which gives the main body's height.
        ball = robot.rotors.positions.mean(axis=0) + [
            0.0, 0.0, robot.parts.end_effector.height - robot.parts.module.joint_height]
        self._points = np.array([*feet, *robot.rotors.positions, ball])
        self._radii = np.array([*[0.0] * 4, *[p.propeller_radius] * 4, p.ball_radius])

    def why_not(self, target: Target, now: float | None = None) -> str:
        """
        Check a target.

        Args:
            target: pose, or trajectory, of which every point is checked.
            now: present time [s]; if None, or for the stamp 0, the stamp is not checked.

        Returns:
            '' for a valid target, else error and expectation in one line.

        """
        age = 0.0 if now is None or target.stamp == 0.0 else now - target.stamp
        if not -AHEAD <= age <= OLDEST:
            return f'the stamp is {age:.4g} s old, expected from {-AHEAD:g} to {OLDEST:g} s'
        if isinstance(target, PoseTarget):
            return self.why_not_pose(target.position, target.quaternion)
        for k, pose in enumerate(zip(target.positions, target.quaternions)):
            if reason := self.why_not_pose(*pose):
                return f'point {k + 1}: {reason}'
        return self._motion(target.velocities, 'velocity', self._p.speed, 'm/s') or self._motion(
            target.angular_velocities, 'angular velocity', self._p.rate, 'rad/s') or \
            self._steps(target)

    def why_not_pose(self, position: np.ndarray, quaternion: np.ndarray) -> str:
        """Check a pose: (3,) in world [m], (4,) xyzw; returns as :meth:`why_not`."""
        numbers = [*np.asarray(position, dtype=float).tolist(),
                   *np.asarray(quaternion, dtype=float).tolist()]
        if not all(map(isfinite, numbers)):
            return 'not seven finite numbers'
        x, y, z = numbers[:3]
        for name, value, most in (('|x|', abs(x), self._p.half_width),
                                  ('|y|', abs(y), self._p.half_width),
                                  ('z', z, self._p.height)):
            if value > most:
                return f'{name} = {value:.4g} m, expected at most {most:g} m: the fence'
        down = self._points @ rotations.matrix(rotations.normalized(quaternion))[2] - self._radii
        needed = self._p.clearance - float(down.min())
        if z < needed - 1e-9:
            return f'z = {z:.4g} m, expected at least {needed:.2f} m at this attitude: the floor'
        return ''

    @staticmethod
    def _motion(values, name, most, unit):
        fast = np.argwhere(~(np.abs(values) <= most))       # nan too
        if not len(fast):
            return ''
        k, axis = fast[0]
        return f'point {k + 1}: {name} {values[k, axis]:.4g} {unit}, expected within ' \
               f'+-{most:g} {unit}'

    def _steps(self, target):
        """Check the mean speeds between points."""
        time = np.maximum(np.diff(target.times), 1e-9)
        away = np.linalg.norm(np.diff(target.positions, axis=0), axis=1)
        same = np.abs(np.sum(target.quaternions[:-1] * target.quaternions[1:], axis=1))
        turn = 2 * np.arccos(np.minimum(same, 1.0))
        for way, most, unit in ((away, self._p.speed, 'm'), (turn, self._p.rate, 'rad')):
            fast = way > np.sqrt(3) * most * time + 1e-6     # each axis has the limit
            if np.any(fast):
                k = int(np.argmax(fast))
                return (f'point {k + 2}: {way[k]:.4g} {unit} from the one before within '
                        f'{time[k]:.3g} s, expected at most {np.sqrt(3) * most:.3g} {unit}/s')
        return ''


def read_poses(path: str | Path, reach: float = np.inf) -> np.ndarray:
    """
    Read a pose file with the header ``x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg``, or YAML.

    Blank lines and spaces around fields are ignored; columns may be in any order. In YAML, the key
    ``poses`` has rows in the order of this header.

    Args:
        path: CSV file, or YAML file.
        reach: largest step between poses, and from the take-off to the first pose [m].

    Returns:
        (N, 6) x, y, z [m], roll, pitch, yaw [deg].

    Raises:
        ParameterError: unusable file; names file, row (as in an editor), column and expectation.

    """
    if str(path).lower().endswith(YAML_FILES):
        poses = _rows(path, 'poses', COLUMNS, 1)
        for k, pose in enumerate(poses):
            if reason := _unusable(pose):
                raise ParameterError(f'{path}: poses[{k}]{reason}')
        check_steps(poses, reach, lambda k: f'{path}: poses[{k}]')
        return poses
    columns, rows = read_table(path, _columns, ','.join(COLUMNS), check=_unusable)
    if not len(rows):
        raise ParameterError(f'{path}: no pose below the header; expected at least one row')
    poses = np.stack(list(columns.values()), axis=1)
    check_steps(poses, reach, lambda k: f'{path}: row {rows[k]}')
    return poses


def check_steps(poses: np.ndarray, reach: float, where: Callable[[int], str]) -> None:
    """
    Check that the steps between poses (N, 6) are at most ``reach`` [m].

    Raises:
        ParameterError: a longer step to pose k; the text begins with ``where(k)``.

    """
    steps = np.linalg.norm(np.diff(poses[:, :3], axis=0, prepend=[START]), axis=1)
    if np.any(steps > reach):
        k = int(np.argmax(steps > reach))
        raise ParameterError(f'{where(k)}: {steps[k]:.4g} m from '
                             f"{'the pose before' if k else 'the take-off'}, expected at most "
                             f'{reach:g} m: the reach of the controller')


def read_set_points(path: str | Path, period: float
                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Read the set points of a trajectory: rows of time [s], x, y, z [m], roll, pitch, yaw [deg].

    Args:
        path: YAML file with the key ``set_points``.
        period: of the returned samples [s]; splines lead through the set points.

    Returns:
        (N,) times from 0 [s], (N, 3) positions in world [m], (N, 4) quaternions body to world.

    Raises:
        ParameterError: unusable file, or a pose outside the fence or too low.

    """
    from scipy.interpolate import CubicSpline  # would double the time to start
    from scipy.spatial.transform import Rotation, RotationSpline
    rows = _rows(path, 'set_points', ('time_s', *COLUMNS), 3)
    if rows[0, 0] != 0 or not (np.diff(rows[:, 0]) > 0).all():
        raise ParameterError(f'{path}: set_points: expected times that increase from 0')
    times = np.linspace(0.0, rows[-1, 0], max(round(rows[-1, 0] / period), 2) + 1)
    positions = CubicSpline(rows[:, 0], rows[:, 1:4], bc_type='clamped')(times)
    turns = Rotation.from_euler('xyz', rows[:, 4:], degrees=True)
    quaternions = RotationSpline(rows[:, 0], turns)(times).as_quat()
    for time, *pose in zip(times, positions, quaternions, strict=True):
        if reason := _checks().why_not_pose(*pose):
            raise ParameterError(f'{path}: at {time:.4g} s: {reason}')
    return times, positions, quaternions


def has_poses(path: str | Path) -> bool:
    """Whether a YAML file of a task lists poses to hold, and no set points of a trajectory."""
    content = read_yaml(path)
    return isinstance(content, dict) and 'poses' in content


def _rows(path, key, columns, least):
    """Rows of numbers (N, width) of a YAML file's ``key``."""
    content = read_yaml(path)
    if not isinstance(content, dict) or key not in content:
        raise ParameterError(f"{path}: expected the key 'poses' or 'set_points'")
    rows = numbers(content[key], f'{path}: {key}', dict.fromkeys(('low', 'high', 'unit')))
    if rows.ndim != 2 or rows.shape[1] != len(columns) or len(rows) < least:
        raise ParameterError(f"{path}: {key}: expected rows [{', '.join(columns)}], at least "
                             f'{least}, found numbers of shape {rows.shape}')
    return rows


def _columns(header):
    for name in COLUMNS:
        if name not in header:
            raise missing(name, header)
    return list(COLUMNS)


def _unusable(pose):
    reason = _checks().why_not_pose(pose[:3], rotations.from_rpy(*np.radians(pose[3:])))
    return f': {reason}' if reason else ''


@cache
def _checks():
    """Checks with the shipped robot, because a task is for any robot of its kind."""
    return TargetChecks(RobotParameters.load())
