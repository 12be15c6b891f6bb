"""Measured states of a flight, given delays and mounting of the sensors."""

from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.flights.keys import base_of, names_of, OF_ONE, THRUST_BUS, TILT_BUS
from beetle_omni_ros.identify.recording.bag import BATTERY, COMMAND, IMU, JOINTS, POSE, Recording
from beetle_omni_ros.identify.recording.parameters import GapParameters
from beetle_omni_ros.identify.recording.relations import white_noise
from beetle_omni_ros.identify.recording.series import (
    bridged,
    derivatives,
    EDGE,
    held_at,
    integral,
    low_pass,
    matrices,
    spread,
    turned,
    within,
)
from beetle_omni_ros.model.effects import CATALOGUE, ignored
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import play

FINE = 0.005            # [s] grid on which measurements are smoothed
# The IMU's clock is the reference: its delay shifts all other signals. Shifting the IMU itself
# would resample its noise, which changes chi2 by more than a delay does.
IMU_LAG = 'imu_filter_lag.delay'
# Keys that change thrusts after their delay.
LAGS = ('rotor_lag.time_constant', 'thrust_saturation.thrust_max',
        *(f'rotor.lag[{k}]' for k in range(4)))
PLAY = tuple(f'servo.gap[{k}]' for k in range(4))


class Signals:
    """
    Series of one flight on the common grid, cached by the deviations that they depend on.

    Attributes:
        t: (N,) grid [s].
        reading_noise: standard deviation of an encoder's noise [rad].
        position_noise: standard deviation of MoCap's position noise [m].
        model_tilts: (N, 4) tilts of a servo model [rad], or None: encoders alone.

    """

    def __init__(self, flight: Recording, robot: RobotParameters, p: GapParameters):
        self.flight, self.robot, self.p = flight, robot, p
        steps = int((flight.duration - 2 * EDGE) / p.grid)
        self.t = EDGE + p.grid * np.arange(steps)
        self._ratio = round(p.grid / FINE)
        pad = 0.5
        self._fine = np.arange(EDGE - pad, self.t[-1] + pad + FINE / 2, FINE)
        self._lead = round(pad / FINE)
        self._step, self._begin = FINE / 2, self._fine[0] - p.memory    # of the rotors' filter
        # Linear interpolation would halve the noise power between readings, and a fit would
        # shift the IMU accordingly.
        times, values = flight.times, flight.values
        self._imu, self._pose, self._joint = (
            CubicSpline(*bridged(*spread(times[topic], rows))) for topic, rows in (
                (IMU, values[IMU]), (POSE, values[POSE]),
                (JOINTS, robot.sensors.tilts(values[JOINTS]))))
        self._command_t, self._command = command_t, command = spread(
            times[COMMAND], values[COMMAND])
        limit = robot.joints.position_limit
        self._tilt_integral = integral(command_t, np.clip(command[:, :4], -limit, limit))
        full = robot.battery.full_voltage
        battery_t, battery = times[BATTERY], values[BATTERY].T
        self.voltage = np.interp(self.t, battery_t, battery[0]) / full \
            if len(battery_t) > 1 else np.ones(len(self.t))
        if not (0.5 < self.voltage.min() and self.voltage.max() < 1.5):
            self.voltage = np.ones(len(self.t))
        # Sensor effects and backlash of the robot file; deviations are added to them.
        self.file = {key: float(value) for name, values in robot.effects.items()
                     for parameter, given in values.items()
                     if CATALOGUE[name].in_readings(parameter) and parameter not in OF_ONE
                     if not ignored('gap', name)
                     for key, value in zip(names_of(name, parameter), base_of(
                         CATALOGUE[name].parameters[parameter], given))}
        self._play = np.broadcast_to(robot.effects.get('joint_backlash', {}).get('gap', 0.0), 4)
        self._kept: dict = {}
        third = np.abs(np.diff(values[JOINTS], 3, axis=0))
        self.reading_noise = float(np.median(np.sqrt((np.minimum(third, np.quantile(
            third, 0.9, axis=0))**2).mean(axis=0) / 20)))
        self.position_noise = float(np.median(white_noise(values[POSE][:, :3])))
        self.model_tilts: np.ndarray | None = None

    def use_model_tilts(self, model_tilts: np.ndarray) -> None:
        """Take the fast part of the tilts from those of a servo model (N, 4) [rad]."""
        self.model_tilts = model_tilts
        self._model_derivatives = derivatives(model_tilts, self.p.smooth_joint, self.p.grid)
        self._kept = {key: value for key, value in self._kept.items() if key[0] != 'joints'}

    def _beyond_file(self, theta):
        return {**theta, **{name: theta.get(name, 0.0) + own for name, own in self.file.items()}}

    def _cached(self, what, theta, names, make):
        key = (what, tuple(theta.get(name, 0.0) for name in names))
        if key not in self._kept:
            if len(self._kept) > 60:
                for old in list(self._kept)[:30]:
                    del self._kept[old]
            self._kept[key] = make()
        return self._kept[key]

    def _at(self, spline, shift):
        """Readings on the fine grid, ``shift`` [s] later, held beyond the first and the last."""
        return spline(np.clip(self._fine + shift, spline.x[0], spline.x[-1]))

    def _smooth(self, fine, edge, derivative=0):
        """Fine series (M, ...) on the common grid."""
        kernel = low_pass(edge, 1, FINE)
        y = kernel(fine, derivative)
        first = self._lead - kernel.margin
        return y[first:first + self._ratio * len(self.t):self._ratio]

    @cached_property
    def _own_imu(self):
        """Specific force, rates and their derivative (N, 3) each, in axes of the IMU."""
        fine = self._at(self._imu, 0.0)
        edge = self.p.smooth_imu
        return (self._smooth(fine[:, :3], edge), self._smooth(fine[:, 3:], edge),
                self._smooth(fine[:, 3:], edge, 1))

    def imu(self, theta):
        """Specific force, rates and their derivative (N, 3) each, of base_link."""
        theta = self._beyond_file(theta)
        names = [f'{e}[{k}]' for e in (
            'imu_accelerometer_bias.bias', 'imu_gyroscope_bias.bias',
            'imu_misalignment.rotation', 'imu_lever_arm.offset') for k in range(3)]
        values = np.array([theta.get(name, 0.0) for name in names])

        def make():
            force, rate, turning = self._own_imu
            force, rate = force - values[:3], rate - values[3:6]
            if values[6:9].any():
                rotation = Rotation.from_rotvec(values[6:9]).as_matrix().T
                force, rate, turning = force @ rotation, rate @ rotation, turning @ rotation
            if values[9:].any():
                lever = values[9:]
                force = force - np.cross(turning, lever) - np.cross(rate, np.cross(rate, lever))
            return force, rate, turning
        return self._cached('imu', theta, names, make)

    def pose(self, theta):
        """Raw position (N, 3), quaternion (N, 4), velocity (N, 3) in world axes."""
        theta = self._beyond_file(theta)
        names = ['mocap_time_offset.delay', IMU_LAG, *(f'mocap_misalignment.rotation[{k}]'
                                                       for k in range(3))]
        values = [theta.get(name, 0.0) for name in names]
        position, quaternion, velocity = self._cached(
            'pose', theta, names[:2], lambda: self._shifted_pose(values[0] - values[1]))
        if any(values[2:]):
            quaternion = turned(quaternion, -np.array(values[2:]))
        return position, quaternion, velocity

    def _shifted_pose(self, shift):
        """As :meth:`pose`, without misalignment of MoCap."""
        fine = self._at(self._pose, shift)
        position = fine[self._lead::self._ratio][:len(self.t), :3]
        quaternion = self._smooth(fine[:, 3:], 10.0)
        quaternion = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
        if self.position_noise > self.p.coarse_noise:
            velocity = self._fused(self._smooth(fine[:, :3], self.p.smooth_pose), quaternion)
        else:
            velocity = self._smooth(fine[:, :3], self.p.smooth_pose, 1)
        return position, quaternion, velocity

    def _fused(self, position, quaternion):
        """Velocity (N, 3): slow part from positions (N, 3), fast part from the IMU."""
        acceleration = np.einsum('nij,nj->ni', matrices(quaternion), self.imu({})[0])
        acceleration[:, 2] -= self.robot.gravity
        quick = self.p.grid * np.cumsum(acceleration, axis=0)
        kernel = low_pass(self.p.velocity_edge, 1, self.p.grid)
        # Linear extrapolation at the ends; constant positions would mean zero velocity.
        lead = np.arange(-kernel.margin, 0)[:, None] * (position[20] - position[0]) / 20
        tail = np.arange(1, kernel.margin + 1)[:, None] * (position[-1] - position[-21]) / 20
        longer = np.concatenate([position[0] + lead, position, position[-1] + tail])
        return kernel(longer, 1) + quick - within(kernel, quick, 0)

    def joints(self, theta):
        """Angle, rate, acceleration (N, 4) of the tilts, and the raw reading (N, 4)."""
        theta = self._beyond_file(theta)
        names = ['joint_feedback_delay.delay', IMU_LAG, 'joint_backlash.gap', *PLAY]
        delay, late, *more = (theta.get(name, 0.0) for name in names)
        gap = np.maximum(self._play + more[0] + more[1:], 0.0)

        def make():
            fine, raw = self._cached('readings', theta, names[:2],
                                     lambda: self._readings(delay - late))
            if gap.any():
                fine = play(fine, gap / 2)
            if self.model_tilts is not None:
                return *self._fused_tilts(self.model_tilts, raw, gap), raw
            return tuple(self._smooth(fine, self.p.smooth_joint, k) for k in range(3)) + (raw,)
        return self._cached('joints', theta, names, make)

    def _readings(self, shift):
        """Readings of the encoders on the fine grid, and smoothed ones on the common grid."""
        fine = self._at(self._joint, shift)
        return fine, self._smooth(fine, self.p.smooth_reading)

    def drawn_reading_noise(self):
        """(N, 4) white noise of readings of the encoders, drawn and smoothed as these are."""
        times = self._joint.x
        drawn = self.reading_noise * np.random.default_rng(0).standard_normal((len(times), 4))
        return self._smooth(CubicSpline(times, drawn)(np.clip(
            self._fine, times[0], times[-1])), self.p.smooth_reading)

    def _fused_tilts(self, model_tilts, raw, gap):
        """Angle, rate, acceleration (N, 4): slow part from encoders, fast part from the model."""
        p, derivatives_of_model = self.p, self._model_derivatives
        if gap.any():
            model_tilts = play(model_tilts, gap / 2)
            derivatives_of_model = derivatives(model_tilts, p.smooth_joint, p.grid)
        slow = [within(low_pass(p.guide_edge, 1, p.grid), raw - model_tilts, 0)]
        for _ in range(2):
            slow.append(np.gradient(slow[-1], p.grid, axis=0))
        return tuple(a + b for a, b in zip(derivatives_of_model, slow, strict=True))

    def delays(self, theta):
        """Delays of tilt and thrust commands [s]."""
        theta = self._beyond_file(theta)
        common = self.p.command_delay + theta.get('command_latency.delay', 0.0) \
            + theta.get(IMU_LAG, 0.0)
        tilt, thrust = self.robot.command_delays
        return (tilt + common + theta.get(TILT_BUS, 0.0)
                + theta.get('joint_command_latency.delay', 0.0),
                thrust + common + theta.get(THRUST_BUS, 0.0)
                + theta.get('rotor_dead_time.delay', 0.0))

    def smooth_thrust(self, theta):
        """The thrusts and rates, smoothed as the IMU's readings."""
        kernel = low_pass(self.p.smooth_imu, 1, self.p.grid)
        return self._cached(('smooth', self.delays(theta)[1]), theta, LAGS, lambda: [
            within(kernel, series, 0) for series in self.thrust(theta)])

    def thrust(self, theta):
        """Thrusts after delay, limits and lag [N], and their rates of change (N, 4)."""
        lag, limit, *own = (theta.get(name, 0.0) for name in LAGS)
        delay = self.delays(theta)[1]

        def make():
            mean = self._cached(('commands', delay), theta, LAGS[1:2],
                                lambda: self._mean_commands(delay, limit))
            tau = self.robot.rotors.time_constant * np.exp(lag + np.array(own))
            places = np.rint((self.t - self._begin) / self._step).astype(int) - 1
            keep = np.exp(-self._step / tau)
            lagged = np.stack([lfilter([1 - k], [1, -k], column, zi=k * column[:1])[0]
                               for k, column in zip(keep, mean.T, strict=True)], axis=1)
            places = np.rint((self.t - self._begin) / self._step).astype(int) - 1
            force = lagged[places]
            return force, (mean[places + 1] - force) / tau
        return self._cached(('thrust', delay), theta, LAGS, make)

    def state(self, effect, theta):
        """State (N, 4) of the rotors by an effect with a rate, from zero at the first sample."""
        entry = CATALOGUE[effect]
        values = {key: value + theta.get(f'{effect}.{key}', 0.0) for key, value in {
            **{key: parameter.neutral for key, parameter in entry.parameters.items()},
            **self.robot.effects.get(effect, {})}.items()}

        def make():
            ratio = self.thrust(theta)[0] / self.robot.hover_thrust
            state = np.zeros_like(ratio)
            for k in range(1, len(state)):
                state[k] = entry.advanced(values, state[k - 1], ratio[k - 1], self.p.grid)
            return state
        return self._cached(('state', effect, self.delays(theta)[1]), theta, (
            *LAGS, *(f'{effect}.{key}' for key in values)), make)

    def _mean_commands(self, delay, limit):
        """Mean thrust commands (K, 4) between the steps of the rotor filter [N]."""
        rotors, h = self.robot.rotors, self._step
        # Recorded commands are already within the limit of the robot file.
        most = rotors.thrust_max * np.exp(limit) if limit else np.inf
        commanded = np.clip(self._command[:, 4:], rotors.thrust_min, most)
        edges = self._begin + h * np.arange(round((self.t[-1] - self._begin) / h) + 3)
        return np.diff(held_at(edges - delay, self._command_t, *integral(
            self._command_t, commanded)), axis=0) / h

    def tilt_targets(self, edges, delay):
        """(K, 4) mean tilt commands between ``edges`` (K + 1,) [s], delayed by ``delay``."""
        integral = held_at(edges - delay, self._command_t, *self._tilt_integral)
        return np.diff(integral, axis=0) / np.diff(edges)[:, None]
