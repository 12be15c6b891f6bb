"""Recordings of bags: measured topics as arrays, in the order of recording; their damages."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from beetle_omni_ros.bags.bag import BagError, read_bag
from beetle_omni_ros.bags.log import CHANNELS, FlightLog, SERIES
from beetle_omni_ros.model.parameters import JOINT_NAMES

NEEDED = IMU, POSE, JOINTS, COMMAND = 'imu/data_raw', 'mocap/pose', 'joint_states', 'command'
BATTERY, STATE = 'battery_state', 'supervisor/state'
# topic -> the columns of its table
PARTS = {topic: CHANNELS[topic] for topic in NEEDED} | {
    JOINTS: {'position': 4}, BATTERY: {'voltage': 1}}


@dataclass
class Recording:
    """
    Contents of one bag, or one contiguous piece of flight.

    Attributes:
        name: name of the bag.
        times: topic -> (N,) header stamps [s], in the order of recording. Those of a flight are
            relative to its start, ascending and unique.
        values: topic -> (N, width): IMU specific force [m/s^2] and rates [rad/s], position [m] and
            quaternion xyzw, joint positions [rad], tilt [rad] and thrust [N] commands, voltage
            [V]; of a flight, sign-continuous quaternions.
        states: (time of recording, supervisor state), if recorded.
        findings: remarks of reading and checks.
        received: topic -> (N,) times of recording [s]; empty if unknown.
        start: stamp of the beginning of a flight [s].
        duration: of a flight [s].

    """

    name: str
    times: dict[str, np.ndarray]
    values: dict[str, np.ndarray]
    states: list[tuple[float, str]] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    received: dict[str, np.ndarray] = field(default_factory=dict)
    start: float = 0.0
    duration: float = 0.0


def read_recording(path: str | Path) -> Recording:
    """
    Read the topics that the gap finder needs.

    Raises:
        BagError: no such bag, unreadable bag, several robots, or another robot.

    """
    log = read_bag(path, (*PARTS, STATE))
    if not len(log.joint) and not len(log.command):
        raise BagError(f'{path}: no recording of this robot: expected {", ".join(NEEDED)}, with '
                       f'joints {", ".join(JOINT_NAMES)}; {"; ".join(log.warnings)}')
    return recording_of(log, Path(path).name)


def recording_of(log: FlightLog, name: str) -> Recording:
    """The series of a flight in the order of recording."""
    series = {topic: getattr(log, own) for own, (topic, _) in SERIES.items() if topic in PARTS}
    order = {topic: np.argsort(own.received, kind='stable') for topic, own in series.items()}
    return Recording(
        name, {topic: own.t[order[topic]] for topic, own in series.items()},
        {topic: np.column_stack([getattr(series[topic], channel)[order[topic]]
                                 for channel in channels]) for topic, channels in PARTS.items()},
        list(zip(log.state_t, log.states, strict=True)), list(log.warnings),
        {topic: own.received[order[topic]] for topic, own in series.items()})


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
