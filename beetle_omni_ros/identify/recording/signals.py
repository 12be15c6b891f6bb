"""The smoothed readings of all topics on one grid, and what two topics say about one motion."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from beetle_omni_ros.identify.gap.bags import Recording
from beetle_omni_ros.identify.gap.series import aligned, low_pass, matrices
from beetle_omni_ros.identify.recording.damage import COMMAND, IMU, JOINTS, POSE
from beetle_omni_ros.identify.recording.limits import shipped
from beetle_omni_ros.model.parameters import RobotParameters

GRAVITY = 'gravity'     # [m/s^2] that the accelerometer measures
THINNED = 4             # points of the fine grid for each point of the coarse one


@dataclass(frozen=True)
class Signals:
    """
    All topics of one flight on one grid, below three times the edge of the comparisons.

    Attributes:
        t: (N,) stamps [s].
        data: topic -> (3, N, width) values and their first and second derivatives; ``GRAVITY``
            -> (3, N, 1) gravity [m/s^2] that the accelerometer measures.
        silent: (N,) whether a topic has a gap there.
        noise: topic -> (width,) density of the white noise of its readings: variance times
            period.
        robot: its geometry.

    """

    t: np.ndarray
    data: dict[str, np.ndarray]
    silent: np.ndarray
    noise: dict[str, np.ndarray]
    robot: RobotParameters

    def corrected(self, topic: str, undo: np.ndarray) -> 'Signals':
        """The same with ``undo`` (width, width) applied to the values of one topic."""
        return replace(self, data=self.data | {topic: self.data[topic] @ undo.T},
                       noise=self.noise | {topic: undo**2 @ self.noise[topic]})

    def turning(self) -> tuple[np.ndarray, np.ndarray]:
        """Rates (N, 3) [rad/s] by MoCap and gyroscope, body axes."""
        q, change = self.data[POSE][:2, :, 3:]
        v, w, dv, dw = q[:, :3], q[:, 3:], change[:, :3], change[:, 3:]
        rate = 2 * (w * dv - dw * v - np.cross(v, dv)) / (q**2).sum(axis=1, keepdims=True)
        return rate, self.data[IMU][0, :, 3:]

    def pushing(self) -> tuple[np.ndarray, np.ndarray]:
        """Accelerations (N, 3) [m/s^2] by MoCap and accelerometer, body axes."""
        rotation = matrices(self.data[POSE][0, :, 3:])
        seen = np.einsum('nij,ni->nj', rotation, self.data[POSE][2, :, :3])
        return seen, self.data[IMU][0, :, :3] - self.data[GRAVITY][0] * rotation[:, 2]

    def tilting(self) -> tuple[np.ndarray, np.ndarray]:
        """Tilts (N, 4) [rad] by encoders and commands, without their means."""
        read, told = self.data[JOINTS][0], self.data[COMMAND][0, :, :4]
        return read - read.mean(axis=0), told - told.mean(axis=0)

    def lifting(self) -> tuple[np.ndarray, np.ndarray]:
        """Specific forces (N, 3) [m/s^2] by accelerometer and thrusts at the measured tilts."""
        axes, tilt = self.robot.tilt_axes, self.data[JOINTS][0, :, :, None]
        normals = np.cos(tilt) * [0, 0, 1] + np.sin(tilt) * np.cross(axes, [0.0, 0.0, 1.0])
        force = np.einsum('ni,nij->nj', self.data[COMMAND][0, :, 4:], normals)
        return self.data[IMU][0, :, :3], force / self.robot.mass


def signals_of(recording: Recording, robot: RobotParameters) -> Signals | None:
    """Smooth all topics with the same filter; None if they have too little time in common."""
    limits = shipped()
    series = {topic: series_of(recording, topic) for topic in (IMU, POSE, JOINTS, COMMAND)}
    if min(len(t) for t, _ in series.values()) < 2:
        return None
    begin = max(t[0] for t, _ in series.values())
    end = min(t[-1] for t, _ in series.values())
    if not limits.window < end - begin < 1e5:
        return None
    kernel = low_pass(3 * limits.edge, THINNED, limits.period[1] / 10)
    grid = begin + kernel.period * np.arange(int((end - begin) / kernel.period))
    at = grid[kernel.centres(len(grid))]
    data = {GRAVITY: np.full((3, len(at), 1), robot.gravity)}
    noise, silent = {GRAVITY: np.zeros(1)}, np.zeros(len(at), dtype=bool)
    for topic, (t, values) in series.items():
        if topic == POSE:
            norm = np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
            values = np.concatenate([values[:, :3], aligned(values[:, 3:] / norm)], axis=1)
        even = np.stack([np.interp(grid, t, column) for column in values.T], axis=1)
        if topic == COMMAND:
            keep = np.exp(-kernel.period / robot.rotors.time_constant)
            even[:, 4:] = lfilter([1 - keep], [1, -keep], even[:, 4:], axis=0,
                                  zi=keep * even[:1, 4:])[0]
        data[topic] = np.stack([kernel(even, order)[:len(at)] for order in range(3)])
        for k in np.flatnonzero(np.diff(t) > limits.period[1]):
            silent |= (at > t[k]) & (at < t[k + 1])
        noise[topic] = white_noise(values)**2 * np.median(np.diff(t))
    return Signals(at, data, silent, noise, robot)


def series_of(recording: Recording, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Ascending unique stamps (N,) and finite values (N, width)."""
    t, values = recording.times[topic], recording.values[topic]
    fine = np.isfinite(t) & np.isfinite(values).all(axis=1)
    t, first = np.unique(t[fine], return_index=True)
    return t, values[fine][first]


def white_noise(values: np.ndarray) -> np.ndarray:
    """
    Standard deviation (width,) of the white noise of equidistant readings (N, width).

    The third difference removes smooth motion. Its variance is 1 + 9 + 9 + 1 times that of white
    noise, and its median absolute deviation is robust against single steps.
    """
    return 1.4826 / 20**0.5 * np.median(np.abs(np.diff(values, 3, axis=0)), axis=0)
