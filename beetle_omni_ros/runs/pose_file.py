"""Pose files: CSV with one target pose a line."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.robot.yaml_file import quoted
from beetle_omni_ros.runs.csv_table import read_table
from beetle_omni_ros.runs.target_checks import TargetChecks

START = (0.0, 0.0, 1.0)     # [m] position after the take-off
COLUMNS = ('x_m', 'y_m', 'z_m', 'roll_deg', 'pitch_deg', 'yaw_deg')


def read_poses(path: str | Path, reach: float = np.inf) -> np.ndarray:
    """
    Read a pose file with the header ``x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg``.

    Blank lines and spaces around fields are ignored; columns may be in any order.

    Args:
        path: CSV file.
        reach: largest step between poses, and from the take-off to the first pose [m].

    Returns:
        (N, 6) x, y, z [m], roll, pitch, yaw [deg].

    Raises:
        ParameterError: unusable file; names file, row (as in an editor), column and expectation.

    """
    table = read_table(path, _columns, ','.join(COLUMNS), rows=' and poses', comment=None,
                       error=ParameterError, check=_unusable)
    if not len(table):
        raise ParameterError(f'{path}: no pose below the header; expected at least one row')
    poses = np.stack(list(table.columns.values()), axis=1)
    check_steps(poses, reach, lambda k: f'{path}: row {table.rows[k]}')
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


def _columns(header):
    unknown = [cell for cell in header if cell not in COLUMNS]
    if unknown:
        raise ParameterError(f'unknown column {quoted(unknown[0])}')
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise ParameterError(f"column '{missing[0]}' is missing")
    if len(header) != len(COLUMNS):
        twice = next(name for name in header if header.count(name) > 1)
        raise ParameterError(f"column '{twice}' occurs twice")
    return list(COLUMNS)


def _unusable(pose):
    if pose[2] <= 0:
        return f', column z_m: expected a height above the floor, found {pose[2]:g}'
    reason = _checks().why_not_pose(pose[:3], rotations.from_rpy(*np.radians(pose[3:])))
    return f': {reason}' if reason else ''


@cache
def _checks():
    """Checks with the shipped robot, because a task is for any robot of its kind."""
    return TargetChecks(RobotParameters.load())
