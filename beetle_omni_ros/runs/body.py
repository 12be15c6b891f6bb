"""The flown body against its targets: errors in time, windows and intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target, TrajectoryTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.runs.log import FlightLog

# Stamps are whole nanoseconds in a bag and floats in memory, and an absolute time resolves
# 0.24 us: a sample on a window's edge counts as inside in either.
EDGE = 1e-5  # [s]


@dataclass(frozen=True)
class Motion:
    """
    A body in time: t (N,) [s], position (N, 3) [m], quaternion (N, 4), velocity (N, 3).

    Velocity is in world [m/s], angular_velocity (N, 3) in base_link [rad/s].
    """

    t: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray

    def window(self, begin: float, end: float) -> slice:
        """Samples from ``begin`` to ``end``, both included."""
        return slice(int(np.searchsorted(self.t, begin - EDGE, side='left')),
                     int(np.searchsorted(self.t, end + EDGE, side='right')))

    def covers(self, begin: float, end: float, gap: float = 0.1) -> bool:
        """Whether there are samples in the window, from edge to edge up to ``gap`` [s]."""
        times = self.t[self.window(begin, end)]
        return len(times) > 0 and times[0] <= begin + gap and times[-1] >= end - gap


def motion(log: FlightLog, series: str | None = None) -> Motion:
    """Take the truth where it was recorded, else the estimate; or the series asked for."""
    name = series or log.body
    return Motion(*(getattr(log, f'{name}_{channel}') for channel in
                    ('t', 'position', 'quaternion', 'velocity', 'angular_velocity')))


def geodesic_angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles [rad] between the rotations of (N, 4) and (N, 4) or (4,) quaternions."""
    bx, by, bz, bw = np.asarray(b).T
    x, y, z, w = rotations.product(-bx, -by, -bz, bw, *np.asarray(a).T)
    return 2 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w))


def roll_pitch_yaw(quaternions: np.ndarray) -> np.ndarray:
    """(N, 3) roll, pitch, yaw [deg] of (N, 4) quaternions, R = Rz(yaw) Ry(pitch) Rx(roll)."""
    x, y, z, w = np.asarray(quaternions).T
    return np.degrees(np.stack([
        np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
        np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))], axis=1))


def errors(body: Motion, target: Target, window: slice = slice(None)):
    """
    Distance from the target and angle to it.

    Returns:
        (n,) position error [m] and (n,) orientation error [deg] of the window's samples.

    """
    if isinstance(target, PoseTarget):
        position, quaternion = target.position, target.quaternion
    else:
        position, quaternion = reference_poses(target, body.t[window])
    return (np.linalg.norm(body.position[window] - position, axis=1),
            np.degrees(geodesic_angles(body.quaternion[window], quaternion)))


def reference_poses(target: Target, times: np.ndarray):
    """(n, 3) positions and (n, 4) quaternions of a target at ``times``."""
    references = [target.at(float(t)) for t in times]
    return (np.array([r.position for r in references]).reshape(-1, 3),
            np.array([r.quaternion for r in references]).reshape(-1, 4))


def target_ends(log: FlightLog, last: float) -> list[float]:
    """
    When each target of a log went out of force.

    Args:
        log: the flight.
        last: how long the last pose counts [s]; a trajectory counts to its own end.

    """
    ends = [target.stamp for target in log.targets[1:]]
    if log.targets:
        final = log.targets[-1]
        ends.append(final.times[-1] if isinstance(final, TrajectoryTarget) else final.stamp + last)
    return ends


def hold(times: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values in force at the times ``at``: the latest sample, the first before it began."""
    index = np.searchsorted(times, at + EDGE, side='right') - 1
    return values[np.maximum(index, 0)]


def inside(times: np.ndarray, intervals: list[tuple[float, float]]) -> np.ndarray:
    """Mask of the times that lie in one of the intervals."""
    mask = np.zeros(len(times), dtype=bool)
    for begin, end in intervals:
        mask |= (times >= begin - EDGE) & (times <= end + EDGE)
    return mask
