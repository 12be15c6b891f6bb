"""The motion as each sensor measures it, on a common grid and with a common low-pass edge."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from beetle_omni_ros.identify.gap.bags import NEEDED, Recording
from beetle_omni_ros.identify.gap.series import aligned, low_pass, matrices
from beetle_omni_ros.identify.recording.limits import RecordingLimits
from beetle_omni_ros.robot.parameters import RobotParameters

GRID = 0.01             # [s]
EVERY = 10              # decimation
WIDE = 6.0              # [Hz] edge of a derivative before its rotation into another frame
LEAST_TIME = 6.0        # [s] common to all topics
LONGEST_GAP = 0.15      # [s] for linear interpolation
LEAST_SAMPLES = 40      # without such gaps
# Convention of a stored quaternion -> indices of x, y, z and w, and sign of the vector part.
QUATERNIONS = {'': ((0, 1, 2, 3), 1.0), '(w, x, y, z)': ((1, 2, 3, 0), 1.0),
               'inverse': ((0, 1, 2, 3), -1.0), 'inverse (w, x, y, z)': ((1, 2, 3, 0), -1.0)}


@dataclass(frozen=True)
class Motion:
    """
    Smoothed series of one recording.

    Attributes:
        t: (N,) stamps [s].
        rate: (N, 3) rates of the gyroscope [rad/s].
        force: (N, 3) specific force of the accelerometer [m/s^2].
        seen_rate: convention of the quaternion -> (N, 3) rate by MoCap in body axes [rad/s].
        seen_up: convention -> (N, 3, 3) world axes x, y, z in body axes, one a row.
        seen_push: convention -> (N, 3, 3) acceleration along each world axis, as vectors in body
            axes, one a row [m/s^2].
        tilt: (N, 4) encoder angles [rad].
        tilt_command: (N, 4) commanded angles [rad].
        thrust_force: (N, 3) specific force by commanded thrusts at the measured tilts [m/s^2].
        rotor_wrench: (N, 6, 4) specific force and torque over inertia by 1 N of each rotor.
        thrust: (N, 4) commanded thrusts after the rotor lag [N].
        turning: (N, 3) derivative of the gyroscope's rate [rad/s^2].

    """

    t: np.ndarray
    rate: np.ndarray
    force: np.ndarray
    seen_rate: dict[str, np.ndarray]
    seen_up: dict[str, np.ndarray]
    seen_acceleration: dict[str, np.ndarray]
    tilt: np.ndarray
    tilt_command: np.ndarray
    thrust_force: np.ndarray
    rotor_wrench: np.ndarray
    thrust: np.ndarray
    turning: np.ndarray


def series_of(recording: Recording, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Ascending unique stamps (N,) and finite values (N, width)."""
    t, values = recording.times[topic], recording.values[topic]
    fine = np.isfinite(t) & np.isfinite(values).all(axis=1)
    t, first = np.unique(t[fine], return_index=True)
    return t, values[fine][first]


def common_grid(recording: Recording) -> np.ndarray | None:
    """(N,) times that all topics have in common [s]; None if these are too few."""
    spans = [series_of(recording, topic)[0] for topic in NEEDED]
    if min(len(t) for t in spans) < 2:
        return None
    begin, end = max(t[0] for t in spans), min(t[-1] for t in spans)
    if not LEAST_TIME < end - begin < 1e5:
        return None
    return begin + GRID * np.arange(int((end - begin) / GRID))


def held(recording: Recording, topic: str, t: np.ndarray) -> np.ndarray:
    """(N, width) values on a grid by linear interpolation."""
    stamps, values = series_of(recording, topic)
    return np.stack([np.interp(t, stamps, column) for column in values.T], axis=1)


def motion_of(recording: Recording, robot: RobotParameters,
              limits: RecordingLimits) -> Motion | None:
    """Smooth all topics with the same filter; None if they have too little time in common."""
    grid = common_grid(recording)
    if grid is None:
        return None
    kernel, wide = low_pass(limits.edge, EVERY, GRID), low_pass(WIDE, 1, GRID)
    inner = slice(wide.margin, len(grid) - wide.margin)
    t = grid[inner]
    if len(t) < 4 * kernel.margin:
        return None
    imu, pose = held(recording, 'imu/data_raw', grid), held(recording, 'mocap/pose', grid)
    position = wide(pose[:, :3], 2)
    position = position[:len(t)]
    rates, ups, pushes = {}, {}, {}
    stamps, values = series_of(recording, 'mocap/pose')
    for convention, (order, sign) in QUATERNIONS.items():
        q = _orientation(stamps, values[:, 3:][:, order] * [sign, sign, sign, 1.0], grid)
        rotation = matrices(q)
        rates[convention] = kernel(_body_rate(rotation)[inner])
        turned = rotation[inner]
        ups[convention] = kernel(turned)
        pushes[convention] = kernel(turned * position[:, :, None])
    command = held(recording, 'command', grid)[inner]
    tilt = held(recording, 'joint_states', grid)[inner]
    wrench, thrust = _wrench(robot, tilt), _lagged(robot, command[:, 4:])
    rate = wide(imu[:, 3:], 1)[:len(t)]
    at = t[kernel.centres(len(t))]
    near = ~silent(recording, at, kernel.margin * GRID)
    if near.sum() < LEAST_SAMPLES:
        return None

    def part(series):
        return series[near]

    def smooth(series):
        return part(kernel(series))

    def parts(by_convention):
        return {convention: part(series) for convention, series in by_convention.items()}

    return Motion(part(at), smooth(imu[inner, 3:]), smooth(imu[inner, :3]), parts(rates),
                  parts(ups), parts(pushes), smooth(tilt), smooth(command[:, :4]),
                  smooth(np.einsum('nci,ni->nc', wrench[:, :3], thrust)), smooth(wrench),
                  smooth(thrust), smooth(rate))


def silent(recording: Recording, t: np.ndarray, reach: float) -> np.ndarray:
    """(N,) whether any topic has a gap within ``reach`` [s] of each time."""
    result = np.zeros(len(t), dtype=bool)
    for topic in NEEDED:
        stamps = series_of(recording, topic)[0]
        for k in np.flatnonzero(np.diff(stamps) > LONGEST_GAP):
            result |= (t > stamps[k] - reach) & (t < stamps[k + 1] + reach)
    return result


def _orientation(stamps, quaternion, grid):
    """Unit quaternions (N, 4) xyzw on a grid."""
    norm = np.linalg.norm(quaternion, axis=1, keepdims=True)
    unit = aligned(quaternion / np.where(norm > 1e-9, norm, 1.0))
    q = np.stack([np.interp(grid, stamps, column) for column in unit.T], axis=1)
    return q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-9)


def _body_rate(rotation):
    """(N, 3) rates in body axes [rad/s] of rotations (N, 3, 3)."""
    change = np.gradient(rotation, GRID, axis=0)
    skew = np.einsum('nji,njk->nik', rotation, change)
    return np.stack([skew[:, 2, 1] - skew[:, 1, 2], skew[:, 0, 2] - skew[:, 2, 0],
                     skew[:, 1, 0] - skew[:, 0, 1]], axis=1) / 2


def _wrench(robot, tilt):
    """(N, 6, 4) specific force and torque over inertia by 1 N of each rotor at tilts (N, 4)."""
    result = np.empty((len(tilt), 6, 4))
    for i, axis in enumerate(robot.tilt_axes):
        level = np.cross(axis, [0.0, 0.0, 1.0])
        normal = np.cos(tilt[:, i:i + 1]) * [0.0, 0.0, 1.0] + np.sin(tilt[:, i:i + 1]) * level
        torque = np.cross(robot.rotors.positions[i], normal) \
            - robot.rotors.spin[i] * robot.rotors.torque_to_thrust_ratio * normal
        result[:, :3, i], result[:, 3:, i] = normal / robot.mass, torque / robot.inertia
    return result


def _lagged(robot, thrust):
    """(N, 4) thrusts after the first-order rotor lag [N]."""
    keep = np.exp(-GRID / robot.rotors.time_constant)
    return lfilter([1 - keep], [1, -keep], thrust, axis=0, zi=keep * thrust[:1])[0]
