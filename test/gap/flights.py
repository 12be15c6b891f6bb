"""Analytic flights: prescribed motion, tilts and thrusts, and the corresponding readings."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.flights.bag_flight import BagFlight, PLACE
from beetle_omni_ros.identify.flights.body import BodyModel
from beetle_omni_ros.identify.flights.keys import all_keys, extra_keys
from beetle_omni_ros.identify.recording.bag import BATTERY, COMMAND, IMU, JOINTS, POSE, Recording
from beetle_omni_ros.identify.recording.parameters import GapParameters
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = replace(RobotParameters.load(), multibody=None)
P = GapParameters.load()
KEYS = {**all_keys(ROBOT), **extra_keys(ROBOT)}
BODY = BodyModel(ROBOT, KEYS, (0.0, 0.0))
STEP = 0.005


def waves(t, seed, width, size, highest=0.5):
    """(N, width) sums of sines, with first and second derivative."""
    rng = np.random.default_rng(seed)
    x = np.zeros((3, len(t), width))
    for _ in range(4):
        w = 2 * np.pi * rng.uniform(0.1, highest, width)
        phase, part = rng.uniform(0, 2 * np.pi, width), size * rng.uniform(0.2, 0.5, width)
        angle = w * t[:, None] + phase
        x += np.array([part * np.sin(angle), part * w * np.cos(angle), -part * w**2 * np.sin(
            angle)])
    return x


class Motion:
    """True motion on a 200 Hz grid with true thrusts and tilts."""

    def __init__(self, seed=0, duration=16.0):
        self.t = t = np.arange(0, duration, STEP)
        self.position, self.velocity, acceleration = waves(t, seed, 3, 0.8)
        self.position = self.position + [0, 0, 1.2]
        self.rate, self.turning, _ = waves(t, seed + 1, 3, 1.0)
        turns = Rotation.from_rotvec(STEP * (self.rate[:-1] + self.rate[1:]) / 2)
        attitude = [(0.0, 0.0, 0.0, 1.0)]
        for a, b, c, d in turns.as_quat().tolist():     # a product of Rotations takes 10 us
            x, y, z, w = attitude[-1]
            attitude.append((w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a,
                             w * c + x * b - y * a + z * d, w * d - x * a - y * b - z * c))
        self.attitude = Rotation.from_quat(attitude)
        self.specific_force = self.attitude.inv().apply(acceleration + [0, 0, ROBOT.gravity])
        self.tilt, self.tilt_rate, self.tilt_acceleration = waves(t, seed + 2, 4, 0.9)
        self.thrust, self.thrust_rate, _ = waves(t, seed + 3, 4, 3.0)
        self.thrust = self.thrust + ROBOT.hover_thrust
        self.voltage = 25.2 - 0.15 * t / 2
        self.current = -20 - 0.5 * t
        self.charge = (20 * t + 0.25 * t**2) / 3600
        self.delays = P.command_delay, P.command_delay
        self.tilt_command = self.tilt + (ROBOT.joints.kd * self.tilt_rate + ROBOT.joints.inertia
                                         * self.tilt_acceleration) / ROBOT.joints.kp

    @property
    def normals(self):
        """(N, 4, 3) thrust directions in base_link, by scipy's rotations."""
        made = np.empty((len(self.t), 4, 3))
        for i, yaw in enumerate(ROBOT.rotors.arm_yaw):
            axis = np.array([np.cos(yaw), np.sin(yaw), 0])
            made[:, i] = Rotation.from_rotvec(self.tilt[:, i:i + 1] * axis).apply([0, 0, 1])
        return made

    @property
    def hubs(self):
        """(N, 4, 3) velocities of the rotors in base_link."""
        body = self.attitude.inv().apply(self.velocity)
        return body[:, None] + np.stack([np.cross(self.rate, r)
                                         for r in ROBOT.rotors.positions], axis=1)

    def flight(self, imu_delay=0.0, pose_delay=0.0, joint_delay=0.0, imu=None, pose=None):
        """Readings with delays; ``imu`` (N, 6) and ``pose`` (rotations) replace the true ones."""
        imu = np.concatenate([self.specific_force, self.rate], axis=1) if imu is None else imu
        thrust = self.thrust + ROBOT.rotors.time_constant * self.thrust_rate
        attitude = (self.attitude if pose is None else pose).as_quat()
        pose = np.concatenate([self.position, attitude], axis=1)[::2]
        sign = np.sign((pose[1:, 3:] * pose[:-1, 3:]).sum(axis=1))
        pose[1:, 3:] *= np.cumprod(sign)[:, None]
        shift = P.command_delay + STEP / 2       # held: half a step late on average
        # Commands have the times at which they must be sent to act at t.
        return Recording('made', {
            IMU: self.t + imu_delay, POSE: self.t[::2] + pose_delay, JOINTS: self.t + joint_delay,
            COMMAND: self.t - shift, BATTERY: self.t}, {
            IMU: imu, POSE: pose, JOINTS: self.tilt,
            COMMAND: np.concatenate([self.tilt_command, thrust], axis=1),
            BATTERY: np.column_stack([self.voltage, self.charge])}, duration=self.t[-1])


def model(flight, robot=ROBOT, body=BODY, keys=KEYS):
    """The flight as the engine reads it."""
    return BagFlight(flight, robot, body, keys, P)


def solved(made, names, groups, base=None, start=None, iterations=3):
    """
    Deviations of the named keys that minimise the residual.

    Args:
        made: BagFlight.
        names: fitted keys.
        groups: used groups of channels, such as 'BA'.
        base: group -> residual without any effect, which is subtracted.
        start: initial deviations.
        iterations: number of Gauss-Newton steps.

    """
    theta = dict.fromkeys(names, 0.0) | (start or {})
    for _ in range(iterations):
        linear = made.linear(theta, list(names))
        y, x = [], []
        for group in groups:
            own, counts = PLACE[group], made.mask[:, PLACE[group]]
            y.append((linear.residual[:, own] - (base[group] if base else 0.0))[counts])
            x.append(linear.slopes[:, own][counts])
        change = np.linalg.lstsq(np.concatenate(x), -np.concatenate(y), rcond=None)[0]
        for name, step in zip(names, change, strict=True):
            least = -made.keys[name].base if made.keys[name].ends_at_none else -np.inf
            theta[name] = float(max(theta[name] + step, least))
    return theta
