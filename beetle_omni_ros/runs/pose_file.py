"""Pose files: CSV with one target pose a line."""

from collections.abc import Callable
import csv
from functools import cache
from math import isfinite
from pathlib import Path

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.robot.yaml_file import quoted
from beetle_omni_ros.runs.target_checks import TargetChecks

START = (0.0, 0.0, 1.0)     # [m] position after the take-off
COLUMNS = ('x_m', 'y_m', 'z_m', 'roll_deg', 'pitch_deg', 'yaw_deg')


class TaskError(ParameterError):
    """A task is unusable; the text names file, row, column and expectation."""


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
        TaskError: unusable file; names file, row (as in an editor), column and expectation.

    """
    try:
        with open(path, newline='', encoding='utf-8-sig') as file:
            rows = [(reader.line_num, [cell.strip() for cell in row])
                    for reader in [csv.reader(file)] for row in reader]
    except FileNotFoundError:
        raise TaskError(f'{path}: no such file') from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = f"not a CSV text file ({getattr(error, 'strerror', None) or error})"
        raise TaskError(f'{path}: {reason}') from None
    rows = [(line, row) for line, row in rows if any(row)]
    if not rows:
        raise TaskError(f"{path}: empty; expected the header {','.join(COLUMNS)} and poses")
    order = _column_order(path, *rows[0])
    if len(rows) == 1:
        raise TaskError(f'{path}: no pose below the header; expected at least one row')
    poses = np.array([_pose(path, line, row, order) for line, row in rows[1:]])
    check_steps(poses, reach, lambda k: f'{path}: row {rows[k + 1][0]}')
    return poses


def check_steps(poses: np.ndarray, reach: float, where: Callable[[int], str]) -> None:
    """
    Check that the steps between poses (N, 6) are at most ``reach`` [m].

    Raises:
        TaskError: a longer step to pose k; the text begins with ``where(k)``.

    """
    steps = np.linalg.norm(np.diff(poses[:, :3], axis=0, prepend=[START]), axis=1)
    if np.any(steps > reach):
        k = int(np.argmax(steps > reach))
        raise TaskError(f'{where(k)}: {steps[k]:.4g} m from '
                        f"{'the pose before' if k else 'the take-off'}, expected at most "
                        f'{reach:g} m: the reach of the controller')


def _column_order(path, line, header):
    expected = ','.join(COLUMNS)
    if all(_number(cell) is not None for cell in header):
        raise TaskError(f'{path}: row {line}: the header is missing; expected {expected}')
    unknown = [cell for cell in header if cell not in COLUMNS]
    if unknown:
        raise TaskError(f'{path}: row {line}: unknown column {quoted(unknown[0])}; '
                        f'expected {expected}')
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise TaskError(f"{path}: row {line}: column '{missing[0]}' is missing; "
                        f'expected {expected}')
    if len(header) != len(COLUMNS):
        twice = next(name for name in header if header.count(name) > 1)
        raise TaskError(f"{path}: row {line}: column '{twice}' stands there twice; "
                        f'expected {expected}')
    return [header.index(name) for name in COLUMNS]


def _pose(path, line, row, order):
    if len(row) != len(COLUMNS):
        raise TaskError(f'{path}: row {line}: expected {len(COLUMNS)} values, found {len(row)}')
    pose = []
    for name, index in zip(COLUMNS, order, strict=True):
        value = _number(row[index])
        if value is None or not isfinite(value):
            raise TaskError(f'{path}: row {line}, column {name}: expected a finite number, '
                            f'found {quoted(row[index])}')
        pose.append(value)
    if pose[2] <= 0:
        raise TaskError(f'{path}: row {line}, column z_m: expected a height above the floor, '
                        f'found {pose[2]:g}')
    reason = _checks().why_not_pose(pose[:3], rotations.from_rpy(*np.radians(pose[3:])))
    if reason:
        raise TaskError(f'{path}: row {line}: {reason}')
    return pose


@cache
def _checks():
    """Checks with the shipped robot, because a task is for any robot of its kind."""
    return TargetChecks(RobotParameters.load())


def _number(text):
    try:
        return float(text)
    except ValueError:
        return None
