"""Numbers of the gap finder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import yaml

from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import load_yaml, ParameterError


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
            ParameterError: a key that the shipped file lacks.

        """
        values = yaml.safe_load(share_path('params/gap.yaml').read_text())
        more = {**(load_yaml(path) if path else {}), **changed}
        for key in more:
            if key not in values:
                raise ParameterError(f"{path or 'gap'}: key '{key}': unknown")
        return cls({**values, **more})

    def __getattr__(self, name):
        """Look the number up by its name."""
        try:
            return self.__dict__['values'][name]
        except KeyError:
            raise AttributeError(name) from None
