"""Robot files that extend another one."""

from collections.abc import Sequence
from dataclasses import dataclass
import hashlib
from pathlib import Path
import shlex
import sys
from typing import Any

import numpy as np
import yaml

from beetle_omni_ros import __version__
from beetle_omni_ros.model.effects import settings
from beetle_omni_ros.model.files import LogError, write_text
from beetle_omni_ros.model.parameters import find_robot, RobotParameters
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import nest, ParameterError

SHIPPED = 'robot.yaml'
NESTED = 'rotors', 'joints', 'effects'      # sections whose members have keys of their own
MEASURED = """\
# The robot as its logs show it; `provenance` has command, logs and the origin of each value, and
# `intervals` the 95 % intervals [lowest, highest]. Lists are of gimbal1 to gimbal4. Units: kp
# [N m/rad], kd [N m s/rad], coulomb and stiction [N m], gap, sine and cosine [rad], delay,
# tilt_lag and time_constant [s], torque_to_thrust_ratio [m]. A row of the map is as in robot.yaml.
"""


@dataclass(frozen=True)
class Measured:
    """A key of a robot file, as logs show it."""

    key: str                # dotted
    value: Any              # None: it is not written
    interval: Any           # of 95 %; None: unknown
    logs: Sequence[str]     # names of the logs that show it
    how: str                # what value and interval are; empty: a constant


class _Plain(yaml.SafeDumper):
    def ignore_aliases(self, data):
        return True         # a person reads the file


def check_differs(path: Path | None, base: Path | None) -> None:
    """Raise a ParameterError if a robot file would replace the one that it extends."""
    if path and base and path.resolve() == find_robot(base).resolve():
        raise ParameterError(f'{path}: --params cannot replace the file of --robot, which it '
                             'extends')


def write_robot_file(path: Path, head: str, content: dict, base: Path | None) -> None:
    """
    Write a robot file that extends ``base``.

    Args:
        path: output file.
        head: comment lines.
        content: changed keys.
        base: extended file, by name if it is in the same folder; None: the shipped one.

    Raises:
        ParameterError: the file cannot be written.

    """
    if base:
        base = find_robot(base)
        together = base.resolve().parent == path.resolve().parent
        extends = base.name if together else str(base.resolve())
    else:
        # A file of that name in the same folder would take precedence over the shipped one.
        beside = path.with_name(SHIPPED)
        shipped = share_path(f'params/{SHIPPED}')
        hidden = beside.is_file() and beside.resolve() not in (path.resolve(), shipped.resolve())
        extends = str(shipped) if hidden else SHIPPED
    text = yaml.dump({'extends': extends, **content}, Dumper=_Plain, sort_keys=False,
                     default_flow_style=None, width=99)
    write_text(path, head + text, 'parameter file')


def rounded(value: Any, digits: int = 5) -> Any:
    """``value`` with so many significant digits: a number, or those of mappings and sequences."""
    if isinstance(value, dict):
        return {key: rounded(item, digits) for key, item in value.items()}
    if isinstance(value, np.ndarray):       # with one number: this number
        return rounded(value.squeeze().tolist(), digits)
    if isinstance(value, (list, tuple)):
        return [rounded(item, digits) for item in value]
    return float(f'{value:.{digits}g}') if isinstance(value, float) else value


def write_measured(path: Path, robot: RobotParameters, base: Path | None, logs: Sequence[Path],
                   found: Sequence[Measured]) -> dict:
    """
    Write a robot file that extends ``base``, whose robot is given, by what ``logs`` show.

    Returns:
        Content of the file.

    Raises:
        LogError: they show nothing.
        ParameterError: the file cannot be written.

    """
    content = nest({one.key: one.value for one in found if one.value is not None})
    if not content:
        raise LogError(f'{path}: no robot file written, because the logs show no value of it '
                       '(verdict bad_data of a rotor log?)')
    stated = {one.key for one in found} | settings(content.get('effects', {})).keys()
    if 'effects' in content:
        content['effects'] = robot.effects | content['effects']
    keys = [f'{name}.{member}' if member else name for name, value in robot.as_dict().items()
            for member in (value if name in NESTED else [''])]
    content['intervals'] = {one.key: one.interval for one in found if one.interval is not None}
    content['provenance'] = {
        'command': shlex.join(['beetle_omni', *sys.argv[1:]]), 'version': __version__,
        'logs': {log.name: {'sha256': hashlib.sha256(log.read_bytes()).hexdigest()}
                 for log in logs if log.is_file()},
        'origin': {one.key: {'logs': one.logs, 'how': one.how} for one in found if one.how},
        'of_the_extended_file': [key for key in keys if key not in stated]}
    write_robot_file(path, MEASURED, content, base)
    return content
