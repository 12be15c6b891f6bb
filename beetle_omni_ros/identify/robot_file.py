"""Writing robot files that extend the one that was believed."""

from __future__ import annotations

from pathlib import Path

import yaml

from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError

SHIPPED = 'robot.yaml'


def check_not_base(path: Path, base: Path | None) -> None:
    """
    Refuse to overwrite the file that the new one is to extend.

    Raises:
        ParameterError: they are the same.

    """
    if base and path.resolve() == base.resolve():
        raise ParameterError(f'{path}: --params cannot replace the file of --robot, which it '
                             'extends')


def write_robot_file(path: Path, head: str, content: dict, base: Path | None) -> None:
    """
    Write what differs from ``base``, the shipped robot file where None.

    Args:
        path: to write.
        head: comment lines.
        content: keys of a robot file.
        base: that it extends; by name where it lies beside.

    Raises:
        ParameterError: the file cannot be written.

    """
    if base:
        together = base.resolve().parent == path.resolve().parent
        extends = base.name if together else str(base.resolve())
    else:
        # A file of that name beside would win over the shipped one.
        beside = path.with_name(SHIPPED)
        hidden = beside.is_file() and beside.resolve() != path.resolve()
        extends = str(share_path(f'params/{SHIPPED}')) if hidden else SHIPPED
    text = yaml.safe_dump({'extends': extends, **content}, sort_keys=False,
                          default_flow_style=None, width=99)
    write_text(path, head + text, 'parameter file')


def write_text(path: Path, text: str, what: str) -> None:
    """
    Replace a file at once.

    Raises:
        ParameterError: it cannot be written.

    """
    try:
        temporary = path.with_name(path.name + '.tmp')
        temporary.write_text(text, encoding='utf-8')
        temporary.replace(path)
    except OSError as error:
        raise ParameterError(f'{path}: cannot write the {what} ({error.strerror})') from None


def rounded(value: float, digits: int = 5) -> float:
    """A number with so many significant digits."""
    return float(f'{value:.{digits}g}')
