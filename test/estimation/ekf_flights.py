"""Analytic flights through all attitudes, with exact derivatives, and the sensors on them."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.estimation.ekf import EkfParameters, ErrorStateEkf, ImuReading, PoseReading
from beetle_omni_ros.estimation.model import ACCELEROMETER_BIAS_STD, GYROSCOPE_BIAS_STD

GRAVITY = 9.80665
IMU_PERIOD, MOCAP_PERIOD, MOCAP_DELAY = 0.005, 0.01, 0.01


class Waves:
    """Sum of sines for three channels: value, first and second derivative, all exact."""

    def __init__(self, rng, amplitude, frequency, terms=3):
        """Draw amplitudes, frequencies [rad/s] and phases."""
        self.amplitude = rng.uniform(0.3, 1.0, (terms, 3)) * amplitude / terms
        self.frequency = rng.uniform(0.3, 1.0, (terms, 3)) * frequency
        self.phase = rng.uniform(0, 2 * np.pi, (terms, 3))

    def __call__(self, times):
        """Three arrays (N, 3)."""
        angle = np.asarray(times, float)[:, None, None] * self.frequency + self.phase
        a, w = self.amplitude, self.frequency
        return (np.sum(a * np.sin(angle), 1), np.sum(a * w * np.cos(angle), 1),
                np.sum(-a * w * w * np.sin(angle), 1))


class Trajectory:
    """
    Agile random motion in SE(3), tumbling through inverted attitudes.

    Attitude is R = Rz(c) Ry(b) Rx(a) with analytic angles; body rates and their derivative
    follow by hand from the rates of the angles.
    """

    def __init__(self, seed, agility=1.0):
        """Draw the motion; ``agility`` scales its frequencies, 0 is rest."""
        rng = np.random.default_rng(seed)
        self._position = Waves(rng, 2.0, 3.0 * agility)
        self._angles = Waves(rng, 4.0, 2.0 * agility)

    def __call__(self, times):
        """Return a dict of arrays over ``times`` with the true motion of base_link."""
        position, velocity, acceleration = self._position(times)
        angles, d, dd = self._angles(times)
        (sa, sb, _), (ca, cb, _) = np.sin(angles).T, np.cos(angles).T
        (da, db, dc), (dda, ddb, ddc) = d.T, dd.T
        rate = np.stack([da - dc * sb, db * ca + dc * cb * sa, -db * sa + dc * cb * ca], 1)
        rate_change = np.stack([
            dda - ddc * sb - dc * db * cb,
            ddb * ca - db * da * sa + ddc * cb * sa - dc * db * sb * sa + dc * da * cb * ca,
            -ddb * sa - db * da * ca + ddc * cb * ca - dc * db * sb * ca - dc * da * cb * sa], 1)
        return {'position': position, 'velocity': velocity, 'acceleration': acceleration,
                'rotation': Rotation.from_euler('ZYX', angles[:, ::-1]),
                'rate': rate, 'rate_change': rate_change}


@dataclass
class Sensors:
    """Sensors of a flight."""

    accelerometer_noise: float = 0.05
    gyroscope_noise: float = 0.005
    accelerometer_bias: np.ndarray = field(default_factory=lambda: np.zeros(3))
    gyroscope_bias: np.ndarray = field(default_factory=lambda: np.zeros(3))
    accelerometer_bias_walk: float = 0.0
    gyroscope_bias_walk: float = 0.0
    position_noise: float = 0.001
    orientation_noise: float = np.deg2rad(0.1)
    imu_position: tuple = (0.0, 0.0, 0.0)
    imu_rotation: tuple = (0.0, 0.0, 0.0)
    mocap_position: tuple = (0.0, 0.0, 0.0)
    mocap_rotation: tuple = (0.0, 0.0, 0.0)

    @classmethod
    def matching(cls, parameters, seed):
        """Sensors with the noise and mounting of the filter's parameters, and random biases."""
        imu, mocap = parameters.imu, parameters.mocap
        rng = np.random.default_rng([seed, 2])
        return cls(imu.accelerometer_noise, imu.gyroscope_noise,
                   ACCELEROMETER_BIAS_STD * rng.standard_normal(3),
                   GYROSCOPE_BIAS_STD * rng.standard_normal(3),
                   imu.accelerometer_bias_walk, imu.gyroscope_bias_walk,
                   mocap.position_noise, mocap.orientation_noise, imu.position, imu.rotation,
                   mocap.position, mocap.rotation)

    @classmethod
    def perfect(cls, **changes):
        """Sensors without noise."""
        return cls(accelerometer_noise=0, gyroscope_noise=0, position_noise=0,
                   orientation_noise=0, **changes)

    def biases(self, times, rng):
        """Biases (N, 6) at ``times``: accelerometer, gyroscope, base_link axes."""
        walk = np.repeat([self.accelerometer_bias_walk, self.gyroscope_bias_walk], 3)
        steps = np.sqrt(np.diff(times, prepend=times[0]))[:, None] * walk
        start = np.concatenate([self.accelerometer_bias, self.gyroscope_bias])
        return start + np.cumsum(steps * rng.standard_normal(steps.shape), axis=0)

    def imu(self, trajectory, times, biases, rng):
        """IMU samples at ``times``, where and how the IMU is mounted."""
        truth = trajectory(times)
        rate, change, arm = truth['rate'], truth['rate_change'], np.array(self.imu_position)
        force = truth['rotation'].inv().apply(truth['acceleration'] + [0, 0, GRAVITY])
        force += np.cross(change, arm) + np.cross(rate, np.cross(rate, arm))
        axes = Rotation.from_rotvec(self.imu_rotation)
        force = axes.inv().apply(force + biases[:, :3])
        rate = axes.inv().apply(rate + biases[:, 3:])
        force = force + self.accelerometer_noise * rng.standard_normal(force.shape)
        rate = rate + self.gyroscope_noise * rng.standard_normal(rate.shape)
        return [ImuReading(*row) for row in zip(times.tolist(), force, rate)]

    def mocap(self, trajectory, times, rng):
        """Poses of the marker body at ``times``."""
        truth = trajectory(times)
        position = truth['position'] + truth['rotation'].apply(self.mocap_position)
        position = position + self.position_noise * rng.standard_normal(position.shape)
        noise = Rotation.from_rotvec(self.orientation_noise * rng.standard_normal(position.shape))
        quaternion = (truth['rotation'] * Rotation.from_rotvec(self.mocap_rotation)
                      * noise).as_quat()
        return [PoseReading(*row) for row in zip(times.tolist(), position, quaternion)]


@dataclass
class Flight:
    """One measured flight: samples in the order of arrival."""

    trajectory: Trajectory
    imu: list
    poses: list
    biases: np.ndarray
    delay: float = MOCAP_DELAY

    def arrivals(self):
        """Yield (time of arrival, sample); an IMU sample precedes a pose that arrives then."""
        events = [(sample.stamp, 0, sample) for sample in self.imu]
        events += [(sample.stamp + self.delay, 1, sample) for sample in self.poses]
        for time, _, sample in sorted(events, key=lambda event: (round(event[0], 7), event[1])):
            yield time, sample


def fly(seed, duration, sensors=None, agility=1.0):
    """Measure one random flight."""
    sensors = sensors or Sensors()
    rng = np.random.default_rng([seed, 1])
    trajectory = Trajectory(seed, agility)
    imu_times = IMU_PERIOD * np.arange(round(duration / IMU_PERIOD) + 1)
    pose_times = MOCAP_PERIOD * np.arange(round(duration / MOCAP_PERIOD) + 1)
    biases = sensors.biases(imu_times, rng)
    return Flight(trajectory, sensors.imu(trajectory, imu_times, biases, rng),
                  sensors.mocap(trajectory, pose_times, rng), biases)


def new_ekf():
    """Filter with the shipped parameters."""
    return ErrorStateEkf(EkfParameters.load(), GRAVITY)


def feed(ekf, sample):
    """Give one sample to the filter."""
    return ekf.imu(sample) if isinstance(sample, ImuReading) else ekf.pose(sample)


def run(ekf, flight, drop=lambda time: False, until=np.inf):
    """Feed a flight, without the poses for which ``drop`` is true; return the filter."""
    for time, sample in flight.arrivals():
        if time > until:
            break
        if isinstance(sample, PoseReading) and drop(sample.stamp):
            continue
        feed(ekf, sample)
    return ekf


def error_state(estimate, flight):
    """Error (15,) of an estimate in the filter's definition: truth minus estimate."""
    truth = flight.trajectory(np.array([estimate.stamp]))
    turn = Rotation.from_quat(estimate.quaternion).inv() * truth['rotation'][0]
    biases = flight.biases[np.searchsorted([s.stamp for s in flight.imu], estimate.stamp)]
    return np.concatenate([
        truth['position'][0] - estimate.position, truth['velocity'][0] - estimate.velocity,
        turn.as_rotvec(), biases[:3] - estimate.accelerometer_bias,
        biases[3:] - estimate.gyroscope_bias])
