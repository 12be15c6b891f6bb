"""Robot files that extend another one."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from beetle_omni_ros.model.files import write_text
from beetle_omni_ros.model.parameters import find_robot
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import ParameterError

SHIPPED = 'robot.yaml'


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
