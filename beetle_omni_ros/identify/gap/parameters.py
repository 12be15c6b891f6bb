"""Numbers of the gap finder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import yaml

from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import load_yaml, ParameterError
from beetle_omni_ros.robot.yaml_file import quoted

LARGEST = 1e12          # no number of the gap finder comes near


@dataclass(frozen=True)
class GapParameters:
    """
    The entries of params/gap.yaml as attributes.

    Attributes:
        values: name -> number or list.

    """

    values: dict

    @classmethod
    def load(cls, path: str | Path | None = None, **changed) -> GapParameters:
        """
        Read the shipped file, a further one on top of it, and single changes.

        Raises:
            ParameterError: a key that the shipped file lacks, or a value of another kind.

        """
        values = yaml.safe_load(share_path('params/gap.yaml').read_text())
        more = {**(load_yaml(path) if path else {}), **changed}
        for key in more:
            if key not in values:
                raise ParameterError(f"{path or 'gap'}: key {quoted(key)}: unknown")
            _check(more[key], values[key], f"{path or 'gap'}: key '{key}'")
        return cls({**values, **more})

    def __getattr__(self, name):
        """Look the number up by its name."""
        try:
            return self.__dict__['values'][name]
        except KeyError:
            raise AttributeError(name) from None


def _check(value, shipped, at):
    """A finite number where the shipped file has one, a list of as many where it has a list."""
    if isinstance(shipped, list):
        if not isinstance(value, (list, tuple)) or len(value) != len(shipped):
            raise ParameterError(f'{at}: expected a list of {len(shipped)}, found {quoted(value)}')
        for one, other in zip(value, shipped, strict=True):
            _check(one, other, at)
    elif isinstance(shipped, bool) != isinstance(value, bool) \
            or not isinstance(value, (int, float)) or not abs(value) <= LARGEST:
        raise ParameterError(f'{at}: expected a number, found {quoted(value)}')
