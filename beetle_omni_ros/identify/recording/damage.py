"""A damage of a recording: cause in words, time and probability."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.identify.gap.bags import Recording

MOST_CERTAIN = 0.999    # largest stated probability
CERTAIN = 0.99          # least probability of a cause for a repair
PRIOR = 6.0             # log odds against each deviation from a convention
FLOOR = 1e-4            # least relative variance of the difference of two sensors
Repair = Callable[[Recording], Recording]


@dataclass(frozen=True)
class Damage:
    """
    One damage of a recording.

    Attributes:
        run: name of the recording.
        topic: damaged topic.
        cause: likely cause in words, with the numbers that show it.
        at_s: time of the onset after the first IMU message [s]; None: the whole recording.
        sure: probability of the cause among the compared causes, 0 to 1.
        fix: description of the repair; None without a certain correction.
        repair: function that returns a corrected recording, or None.

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
    Copy of a recording with one topic changed.

    Args:
        recording: original, not modified.
        topic: topic to change.
        times: (N,) new stamps [s], or None.
        values: (N, width) new values, or None.
        keep: (N,) mask or indices of the kept messages, applied last; or None.

    """
    result = replace(recording, times=dict(recording.times), values=dict(recording.values),
                     received=dict(recording.received))
    if times is not None:
        result.times[topic] = times
    if values is not None:
        result.values[topic] = values
    if keep is not None:
        for part in (result.times, result.values, result.received):
            if topic in part:
                part[topic] = part[topic][keep]
    return result


def columns_changed(first: int, last: int, change: Callable[..., np.ndarray],
                    topic: str = 'mocap/pose') -> Repair:
    """Repair of the columns ``first`` to ``last`` of a topic."""
    def repair(recording):
        values = recording.values[topic].copy()
        values[:, first:last] = change(values[:, first:last])
        return changed(recording, topic, values=values)
    return repair
