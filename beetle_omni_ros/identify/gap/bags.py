"""The measured topics of a bag as arrays, in the order of recording and without ROS."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
import struct

import numpy as np

from beetle_omni_ros.robot.parameters import JOINT_NAMES, ROTOR_NAMES
from beetle_omni_ros.runs.bag_reader import BagError, read_messages
from beetle_omni_ros.runs.topics import is_ambiguous, split_topic, TOPICS

NEEDED = {'imu/data_raw': 6, 'mocap/pose': 7, 'joint_states': 4, 'command': 8}
OPTIONAL = {'battery_state': 1}
DOUBLES = struct.Struct('<4d')
IMU_RATE, IMU_FORCE = 13 * 8, 25 * 8        # bytes behind the header: quaternion, covariances


@dataclass
class Recording:
    """
    What one bag holds.

    Attributes:
        name: of the bag.
        times: topic -> (N,) header stamps [s], in the order of recording.
        values: topic -> (N, width): IMU specific force and rates, pose and quaternion xyzw,
            joint positions, tilt and thrust commands, voltage.
        states: (time of recording, supervisor state), where recorded.
        warnings: what was wrong while reading.
        received: topic -> (N,) times of recording [s]; empty where they are not known.

    """

    name: str
    times: dict[str, np.ndarray]
    values: dict[str, np.ndarray]
    states: list[tuple[float, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    received: dict[str, np.ndarray] = field(default_factory=dict)


def read_recording(path: str | Path) -> Recording:
    """
    Read the topics that the gap finder needs.

    Raises:
        BagError: no such bag, not readable, several robots in it, or none of this kind.

    """
    rows: dict[str, list] = {name: [] for name in (*NEEDED, *OPTIONAL)}
    warnings: list[str] = []
    states: list[tuple[float, str]] = []
    known: dict[str, str | None] = {}
    bad: Counter = Counter()
    layouts: dict = {}
    namespaces = set()
    for message in read_messages(path, warnings):
        if message.topic not in known:
            if not namespaces and is_ambiguous(message.topic):
                continue
            split = split_topic(message.topic, namespaces)
            known[message.topic] = split[1] if split else None
            if split and split[1] in NEEDED:
                namespaces.add(split[0])
                if len(namespaces) > 1:
                    raise BagError(f'{path}: holds several robots '
                                   f"({', '.join(map(repr, sorted(namespaces)))})")
        name = known[message.topic]
        if name == 'supervisor/state':
            text = bytes(message.data[8:]).split(b'\0')[0].decode('utf-8', 'replace')
            states.append((message.received, text))
        if name not in rows:
            continue
        if message.type != TOPICS[name].type:
            bad[name] += 1
            continue
        rows[name].append((message.data, message.received))
    tables = {name: _table(name, width, rows[name], layouts, bad)
              for name, width in {**NEEDED, **OPTIONAL}.items()}
    if not any(len(tables[name]) for name in NEEDED):
        found = ', '.join(sorted(known)) or 'no message'
        raise BagError(f'{path}: no recording of this robot: expected {", ".join(NEEDED)} with '
                       f'its joints and rotors, found {found}')
    _check_members(path, rows, tables, layouts)
    warnings += [f'{name}: {count} messages not readable' for name, count in bad.items()]
    times, values, received = {}, {}, {}
    for name, table in tables.items():
        times[name], values[name], received[name] = table[:, 0], table[:, 1:-1], table[:, -1]
    return Recording(Path(path).name, times, values, states, warnings, received)


def _check_members(path, rows, tables, layouts):
    """Refuse joints and rotors of another robot, whose IMU and MoCap may have the same topics."""
    told = [name for name in ('joint_states', 'command') if rows[name]]
    others = [names for names in layouts.values() if isinstance(names, list)
              and not {*JOINT_NAMES, *ROTOR_NAMES} & set(names)]
    if told and others and not any(len(tables[name]) for name in told):
        raise BagError(f'{path}: no recording of this robot: {" and ".join(told)} hold '
                       f'{", ".join(others[0])}, expected {", ".join(JOINT_NAMES)}')


def _table(name, width, rows, layouts, bad):
    """(N, width + 2) stamp, values and time of recording of each message that can be read."""
    made = _alike(name, rows, layouts) if rows else None
    if made is not None:
        return made
    read = []
    for data, received in rows:
        try:
            read.append((*_READERS[name](data, layouts), received))
        except (struct.error, ValueError, IndexError, KeyError):
            bad[name] += 1
    return np.array(read, dtype=float).reshape(-1, width + 2)


def _alike(name, rows, layouts):
    """As :func:`_table`, all at once, where only stamps and numbers differ; None elsewhere."""
    first = bytes(rows[0][0])
    if name not in WIDE or any(len(data) != len(first) for data, _ in rows):
        return None
    try:
        _READERS[name](first, layouts)
        _, end = _head(first)
    except (struct.error, ValueError, IndexError, KeyError):
        return None
    start = _aligned(end, 8)
    both = np.frombuffer(b''.join(data for data, _ in rows), np.uint8).reshape(len(rows), -1)
    same = both == both[0]
    if not (same[:, :4].all() and same[:, 12:start].all()):
        return None
    stamp = both[:, 4:8].copy().view('<i4') + 1e-9 * both[:, 8:12].copy().view('<u4')
    parts = [both[:, start + at:start + at + 8 * n].copy().view('<f8') for at, n in WIDE[name]]
    return np.concatenate([stamp, *parts, np.array([[r] for _, r in rows])], axis=1)


def _head(data):
    """Stamp [s] and the offset of what follows the header, aligned to 8 within the payload."""
    if data[1] not in (1, 3):
        raise ValueError('big endian')
    seconds, nanoseconds, length = struct.unpack_from('<iII', data, 4)
    end = 16 + length
    return seconds + 1e-9 * nanoseconds, end


def _aligned(offset, size):
    return 4 + -(-(offset - 4) // size) * size


def _imu(data, layouts):
    stamp, end = _head(data)
    start = _aligned(end, 8)
    return (stamp, *struct.unpack_from('<3d', data, start + IMU_FORCE),
            *struct.unpack_from('<3d', data, start + IMU_RATE))


def _pose(data, layouts):
    stamp, end = _head(data)
    return (stamp, *struct.unpack_from('<7d', data, _aligned(end, 8)))


def _battery(data, layouts):
    stamp, end = _head(data)
    return (stamp, *struct.unpack_from('<f', data, _aligned(end, 4)))


def _joints(data, layouts):
    stamp, end = _head(data)
    names, (position, _, _) = _joint_state(data, end, layouts)
    return (stamp, *_picked(data, position, names, JOINT_NAMES))


def _command(data, layouts):
    stamp, end = _head(data)
    names, (position, _, effort) = _joint_state(data, end, layouts)
    return (stamp, *_picked(data, position, names, JOINT_NAMES),
            *_picked(data, effort, names, ROTOR_NAMES))


def _joint_state(data, end, layouts):
    """Names, and (offset, count) of positions, velocities and efforts."""
    start = _aligned(end, 4)
    head = layouts.get('size')
    if head and bytes(data[start:start + head]) in layouts:
        names, at = layouts[bytes(data[start:start + head])], start + head
    else:
        count, at, names = struct.unpack_from('<I', data, start)[0], start + 4, []
        for _ in range(count):
            at = _aligned(at, 4)
            length, = struct.unpack_from('<I', data, at)
            names.append(bytes(data[at + 4:at + 3 + length]).decode())
            at += 4 + length
        layouts['size'] = at - start
        layouts[bytes(data[start:at])] = names
    parts = []
    for _ in range(3):
        at = _aligned(at, 4)
        count, = struct.unpack_from('<I', data, at)
        at = _aligned(at + 4, 8) if count else at + 4
        parts.append((at, count))
        at += 8 * count
    return names, parts


def _picked(data, part, names, wanted):
    offset, count = part
    numbers = struct.unpack_from(f'<{count}d', data, offset)
    return [numbers[names.index(name)] for name in wanted]


_READERS = {'imu/data_raw': _imu, 'mocap/pose': _pose, 'joint_states': _joints,
            'command': _command, 'battery_state': _battery}
# (offset behind the header, how many doubles) of messages whose layout is always the same.
WIDE = {'imu/data_raw': ((IMU_FORCE, 3), (IMU_RATE, 3)), 'mocap/pose': ((0, 7),)}
