"""Recordings of bags: measured topics as arrays, in the order of recording; their damages."""

from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from beetle_omni_ros.bags.bag import BagError, read_columns, read_together
from beetle_omni_ros.bags.log import CHANNELS, FlightLog, SERIES
from beetle_omni_ros.bags.messages import from_bytes
from beetle_omni_ros.bags.topics import ALL
from beetle_omni_ros.model.parameters import JOINT_NAMES, ROTOR_NAMES

NEEDED = IMU, POSE, JOINTS, COMMAND = 'imu/data_raw', 'mocap/pose', 'joint_states', 'command'
BATTERY = 'battery_state'
# topic -> the columns of its table
PARTS = {topic: CHANNELS[topic] for topic in (*NEEDED, BATTERY)} | {JOINTS: {'position': 4}}


@dataclass
class Recording:
    """
    Contents of one bag, or one contiguous piece of flight.

    Attributes:
        name: name of the bag.
        times: topic -> (N,) header stamps [s], in the order of recording. Those of a flight are
            relative to its start, ascending and unique.
        values: topic -> (N, width): IMU specific force [m/s^2] and rates [rad/s], position [m] and
            quaternion xyzw, joint positions [rad], tilt [rad] and thrust [N] commands, voltage [V]
            and current [A]; of a flight, sign-continuous quaternions and, in place of the current,
            the charge drawn since the first message [A h], zero if no current is known.
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
    warnings: list[str] = []
    states: list[tuple[float, str]] = []
    data: dict[str, list] = defaultdict(list)
    when: dict[str, list] = defaultdict(list)
    known: set[str] = set()
    bad: dict[str, int] = {}
    for together in read_together(path, warnings):
        for messages in together:
            name, count = messages.topic, len(messages.data)
            known.add(name)
            if name not in PARTS and name != 'supervisor/state':
                continue
            if messages.type != ALL[name].type:
                bad[name] = bad.get(name, 0) + count
            elif name in PARTS:
                data[name] += messages.data
                when[name].append(messages.received)
            else:
                _note(states, messages)
    times, values, received = {}, {}, {}
    for name in PARTS:
        rows, table, refused = read_columns(ALL[name], data[name], PARTS[name])
        times[name] = table.pop('stamp')
        values[name] = np.column_stack(list(table.values()))
        received[name] = np.concatenate([np.zeros(0), *when[name]])[rows]
        if refused:
            bad[name] = bad.get(name, 0) + refused.total()
    if not any(len(times[name]) for name in NEEDED):
        found = ', '.join(sorted(known)) or 'no message'
        raise BagError(f'{path}: no recording of this robot: expected {", ".join(NEEDED)} with '
                       f'its joints and rotors, found {found}')
    _check_members(path, data, times)
    warnings += [f'{name}: {count} messages not readable' for name, count in bad.items()]
    return Recording(Path(path).name, times, values, states, warnings, received)


def recording_of(log: FlightLog, name: str) -> Recording:
    """A flight in memory as it is read from a bag."""
    series = {topic: getattr(log, own) for own, (topic, _) in SERIES.items() if topic in PARTS}
    return Recording(
        name, {topic: own.t for topic, own in series.items()},
        {topic: np.column_stack([getattr(series[topic], channel) for channel in channels])
         for topic, channels in PARTS.items()},
        [(float(t), str(mode)) for t, mode in zip(log.state_t, log.states, strict=True)],
        received={topic: own.received for topic, own in series.items()})


def _note(states, messages):
    for data, received in zip(messages.data, messages.received.tolist(), strict=True):
        # A message that cannot be decoded costs one state, not the recording.
        with suppress(Exception):
            states.append((received, from_bytes(data, messages.type).data))


def _check_members(path, data, times):
    """Refuse joints and rotors of another robot, whose IMU and MoCap may have the same topics."""
    named = [name for name in ('joint_states', 'command') if data[name]]
    if not named or any(len(times[name]) for name in named):
        return
    for name in named:
        try:
            others = from_bytes(data[name][0], ALL[name].type).name
        except Exception:       # a message that cannot be decoded
            continue
        if others and not {*JOINT_NAMES, *ROTOR_NAMES} & set(others):
            raise BagError(f'{path}: no recording of this robot: {" and ".join(named)} hold '
                           f'{", ".join(others)}, expected {", ".join(JOINT_NAMES)}')


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
