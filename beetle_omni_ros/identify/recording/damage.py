"""A damage of a recording: cause in words, time and probability."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from beetle_omni_ros.identify.gap.bags import NEEDED, Recording

IMU, POSE, JOINTS, COMMAND = NEEDED


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
    sure: float = 0.99
    fix: str | None = None
    repair: Callable[[Recording], Recording] | None = None

    @property
    def text(self) -> str:
        """One line."""
        moment = '' if self.at_s is None else f', from {self.at_s:.1f} s on'
        return f'{self.run}: {self.topic}: {self.cause}{moment}'


def changed(recording: Recording, topic: str, times=None, values=None,
            keep=slice(None)) -> Recording:
    """
    Copy of a recording with one topic changed.

    Args:
        recording: original, not modified.
        topic: topic to change.
        times: (N,) new stamps [s], or None.
        values: (N, width) new values, or None.
        keep: mask or indices of the kept messages, applied last.

    """
    def part(old, new=None):
        return old | {topic: (old[topic] if new is None else new)[keep]} if topic in old else old
    return replace(recording, times=part(recording.times, times), received=part(
        recording.received), values=part(recording.values, values))
