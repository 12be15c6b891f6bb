"""The response of the tilt servos in a recorded run: joint_states and command of its bag."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beetle_omni_ros.identify.csv_table import LogError
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.runs.bag import BagError, read_bag

LIMITS = shipped().log


def is_bag(path: Path) -> bool:
    """Whether ``path`` is a rosbag2 folder or one of its files."""
    return path.is_dir() or path.suffix == '.mcap' or path.name == 'metadata.yaml'


def read_bag_response(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Read joint positions with the command that was received last before each.

    Returns:
        (N,) times [s] from the first, (4, N) positions [rad], (4, N) commands [rad]: of the
        longest stretch in which commands came, at most half a minute, where they move most.

    Raises:
        LogError: no bag, or one without joint_states or command; one line.

    """
    try:
        log = read_bag(path)
    except (BagError, OSError) as error:
        raise LogError(str(error)) from None
    for name, count in (('joint_states', len(log.joint_t)), ('command', len(log.command_t))):
        if not count:
            raise LogError(f'{path}: no {name} in this bag')
    order = np.argsort(log.command_received, kind='stable')
    received, tilt = log.command_received[order], log.command_tilt[order]
    fresh = np.r_[True, np.diff(log.joint_t) > 0]
    t, position = log.joint_t[fresh], log.joint_position[fresh]
    last = np.searchsorted(received, t, side='right') - 1
    driven = (last >= 0) & (t - received[np.maximum(last, 0)] <= LIMITS.last_command)
    edges = np.flatnonzero(np.diff(np.r_[False, driven, False].astype(int)))
    stretches = edges.reshape(-1, 2)
    if not len(stretches):
        raise LogError(f'{path}: no joint_states while commands came; were stamps and clock those '
                       'of one computer?')
    first, end = stretches[np.argmax(stretches[:, 1] - stretches[:, 0])]
    first, end = _liveliest(t, tilt[last], first, end)
    chosen = slice(first, end)
    return t[chosen] - t[first], position[chosen].T, tilt[last[chosen]].T


def _liveliest(t, command, first, end):
    """Narrow a stretch to the longest part that is taken, in which all commands travel most."""
    ends = np.minimum(np.searchsorted(t, t[first:end] + LIMITS.longest_bag, side='right'), end)
    travel = np.cumsum(np.r_[0.0, np.abs(np.diff(command[:end], axis=0)).sum(axis=1)])
    gain = travel[ends - 1] - travel[first:end]
    begin = first + int(np.argmax(gain))
    return begin, ends[begin - first]
