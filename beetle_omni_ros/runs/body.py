"""Motion of the robot and its errors from the targets, over windows and intervals."""

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target, TrajectoryTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.runs.log import FlightLog

# [s] tolerance of a window's edges. Stamps are integer nanoseconds in a bag and floats in memory,
# where UNIX time has a resolution of 0.24 us.
EDGE = 1e-5
SAME_TIME = 2.5e-3  # [s] between stamps of an estimate and of the truth that are compared


@dataclass(frozen=True)
class Motion:
    """
    Motion of a body.

    Attributes:
        t: (N,) [s].
        position: (N, 3) in world [m].
        quaternion: (N, 4) body to world (x, y, z, w).
        velocity: (N, 3) in world [m/s].
        angular_velocity: (N, 3) in base_link [rad/s].

    """

    t: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray

    def window(self, begin: float, end: float) -> slice:
        """Slice of the samples from ``begin`` to ``end`` [s], both included."""
        return slice(int(np.searchsorted(self.t, begin - EDGE, side='left')),
                     int(np.searchsorted(self.t, end + EDGE, side='right')))

    def covers(self, begin: float, end: float, gap: float = 0.1) -> bool:
        """Whether the first and last sample in the window are within ``gap`` [s] of its edges."""
        times = self.t[self.window(begin, end)]
        return len(times) > 0 and times[0] <= begin + gap and times[-1] >= end - gap


def motion(log: FlightLog, series: str | None = None) -> Motion:
    """Return the motion of a series, by default of the truth if recorded, else the estimate."""
    name = series or log.body
    return Motion(*(getattr(log, f'{name}_{channel}') for channel in
                    ('t', 'position', 'quaternion', 'velocity', 'angular_velocity')))


def geodesic_angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles (N,) [rad] between the rotations of (N, 4) and (N, 4) or (4,) quaternions."""
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
    Compute the errors from a target over the samples of a window.

    Returns:
        (n,) position error [m] and (n,) orientation error [deg].

    """
    if isinstance(target, PoseTarget):
        position, quaternion = target.position, target.quaternion
    else:
        position, quaternion = reference_poses(target, body.t[window])
    return (np.linalg.norm(body.position[window] - position, axis=1),
            np.degrees(geodesic_angles(body.quaternion[window], quaternion)))


def estimate_errors(log: FlightLog) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Compute the errors of the estimate from the truth, where their stamps agree within 2.5 ms.

    Returns:
        (n,) times [s], (n,) position errors [m], (n,) orientation errors [deg].

    """
    if not len(log.truth_t):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    index = np.clip(np.searchsorted(log.truth_t, log.odom_t - SAME_TIME), 0, len(log.truth_t) - 1)
    near = np.abs(log.truth_t[index] - log.odom_t) < SAME_TIME
    index = index[near]
    distance = np.linalg.norm(log.odom_position[near] - log.truth_position[index], axis=1)
    angle = np.degrees(geodesic_angles(log.odom_quaternion[near], log.truth_quaternion[index]))
    return log.odom_t[near], distance, angle


def reference_poses(target: Target, times: np.ndarray):
    """Return (n, 3) positions and (n, 4) quaternions of a target at ``times`` (n,) [s]."""
    references = [target.at(float(t)) for t in times]
    return (np.array([r.position for r in references]).reshape(-1, 3),
            np.array([r.quaternion for r in references]).reshape(-1, 4))


def target_ends(log: FlightLog, last: float) -> list[float]:
    """
    Return the time at which each target of a log ended.

    Args:
        log: the flight.
        last: duration of the last target if it is a pose [s].

    """
    ends = [target.stamp for target in log.targets[1:]]
    if log.targets:
        final = log.targets[-1]
        ends.append(final.times[-1] if isinstance(final, TrajectoryTarget) else final.stamp + last)
    return ends


def hold(times: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the latest values at the times ``at``; before the first sample, the first one."""
    index = np.searchsorted(times, at + EDGE, side='right') - 1
    return values[np.maximum(index, 0)]


def inside(times: np.ndarray, intervals: list[tuple[float, float]]) -> np.ndarray:
    """Return a mask of the times that are in one of the intervals."""
    mask = np.zeros(len(times), dtype=bool)
    for begin, end in intervals:
        mask |= (times >= begin - EDGE) & (times <= end + EDGE)
    return mask
