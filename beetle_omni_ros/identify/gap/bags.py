"""The measured topics of a bag as arrays, in the order of recording; needs no ROS."""

from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from beetle_omni_ros.bags.bag import BagError, read_all, read_together
from beetle_omni_ros.bags.messages import from_bytes
from beetle_omni_ros.bags.topics import ALL
from beetle_omni_ros.model.parameters import JOINT_NAMES, ROTOR_NAMES

# Topic -> columns of its table; PARTS: fields of the message that they come from.
NEEDED = {'imu/data_raw': 6, 'mocap/pose': 7, 'joint_states': 4, 'command': 8}
OPTIONAL = {'battery_state': 2}
PARTS = {'imu/data_raw': ('specific_force', 'angular_velocity'),
         'mocap/pose': ('position', 'quaternion'), 'joint_states': ('position',),
         'command': ('tilt', 'thrust'), 'battery_state': ('voltage', 'current')}


@dataclass
class Recording:
    """
    Contents of one bag.

    Attributes:
        name: name of the bag.
        times: topic -> (N,) header stamps [s], in the order of recording.
        values: topic -> (N, width): IMU specific force and rates, pose and quaternion xyzw, joint
            positions, tilt and thrust commands, voltage and current.
        states: (time of recording, supervisor state), if recorded.
        warnings: problems while reading.
        received: topic -> (N,) times of recording [s]; empty if unknown.

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
    for name, width in {**NEEDED, **OPTIONAL}.items():
        rows, read, refused = read_all(ALL[name], data[name])
        times[name] = np.array([value.stamp for value in read], dtype=float)
        values[name] = np.column_stack([[getattr(value, part) for value in read]
                                        for part in PARTS[name]]) if read else np.zeros((0, width))
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
