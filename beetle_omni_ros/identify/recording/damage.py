"""What is wrong with a recording, in words, with the moment and the probability."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.identify.gap.bags import Recording

MOST_CERTAIN = 0.999    # no probability from a finite model is stated above this
# A repair changes a recording in place of the user; only a cause this certain offers one.
CERTAIN = 0.99
PRIOR = 6.0             # logarithm of the odds against each deviation from a convention
FLOOR = 1e-4            # part of a variance that no agreement of two sensors is below
Repair = Callable[[Recording], Recording]


@dataclass(frozen=True)
class Damage:
    """
    One fault of a recording.

    Attributes:
        run: name of the recording.
        topic: that is wrong.
        cause: the likely cause in words, with the numbers that show it.
        at_s: stamp of the onset, from the start of the recording [s]; None: all of it.
        sure: probability of the cause among the causes that were compared, 0 to 1.
        fix: what the repair does, in words; None where no correction is certain.
        repair: function that makes a corrected recording, or None.

    """

    run: str
    topic: str
    cause: str
    at_s: float | None = None
    sure: float = MOST_CERTAIN
    fix: str | None = None
    repair: Repair | None = None

    @property
    def text(self) -> str:
        """One line."""
        moment = '' if self.at_s is None else f', from {self.at_s:.1f} s on'
        return f'{self.run}: {self.topic}: {self.cause}{moment}'


def changed(recording: Recording, topic: str, times=None, values=None,
            keep=None) -> Recording:
    """
    Return a copy of a recording with one topic changed.

    Args:
        recording: stays as it is.
        topic: to change.
        times: (N,) new stamps [s], or None.
        values: (N, width) new values, or None.
        keep: (N,) mask or indices of the messages that stay, applied last; or None.

    """
    made = replace(recording, times=dict(recording.times), values=dict(recording.values),
                   received=dict(recording.received))
    if times is not None:
        made.times[topic] = times
    if values is not None:
        made.values[topic] = values
    if keep is not None:
        for part in (made.times, made.values, made.received):
            if topic in part:
                part[topic] = part[topic][keep]
    return made


def columns_changed(first: int, last: int, change: Callable[..., np.ndarray],
                    topic: str = 'mocap/pose') -> Repair:
    """A repair of some columns of a topic."""
    def repair(recording):
        values = recording.values[topic].copy()
        values[:, first:last] = change(values[:, first:last])
        return changed(recording, topic, values=values)
    return repair
