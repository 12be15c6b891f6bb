"""Values in messages, independent of ROS. Stamps in seconds, SI units."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


class MessageError(ValueError):
    """
    A message is unusable; the text gives the reason.

    Attributes:
        kind: category under which it is counted; default: the text. Needed if the text contains
            numbers or names.

    """

    def __init__(self, text: str, kind: str = ''):
        super().__init__(text)
        self.kind = kind or text


@dataclass(frozen=True)
class Wrench:
    """External force in world (3,) [N] and torque in base_link (3,) [N m]."""

    stamp: float
    force: np.ndarray
    torque: np.ndarray


@dataclass(frozen=True)
class Diagnostic:
    """One diagnostic status: level 0 ok, 1 warning, 2 error, 3 stale; values as text."""

    t: float
    name: str
    level: int
    message: str
    values: dict[str, str] = field(default_factory=dict)
