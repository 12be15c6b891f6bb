"""
Residuals of a flight that was read from a table, with their slopes.

Two groups of channels compare the measurements with the body equations: specific force along
the body's axes, and angular acceleration about them. Without quaternion,
the attitude follows from the direction of the measured acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.flights.spectrum import blocks_of
from beetle_omni_ros.identify.flights.table import Table
from beetle_omni_ros.identify.gap.body import BodyModel
from beetle_omni_ros.identify.gap.keys import Key
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

CHANNELS = ('force_x', 'force_y', 'force_z', 'torque_x', 'torque_y', 'torque_z')
FAR = 100.0             # [m] height without position, at which the ground has no effect
AIRBORNE = 0.15         # [m] above the first position, one rotor diameter: no contact
MEMORY = 2.0            # rotor time constants after which a lost command is forgotten
BRIDGED = 0.06          # [s] gaps of inputs that interpolation bridges, about a rotor lag
FULL = 0.995            # share of full duty from which a command is saturated
PHASE = 0.1             # [rad] error by wrong stamps up to which a frequency counts
SMOOTH = 0.05           # [s] moving average of positions before their derivative
DELAYS = ('rotor_dead_time.delay', 'command_latency.delay')


@dataclass(eq=False)
class Linear:
    """
    A flight linearised at a point.

    Attributes:
        residual: (N, C) measured minus expected at the point.
        slopes: (N, C, K) derivatives by the keys.
        measured: (N, C) measurements.

    """

    residual: np.ndarray
    slopes: np.ndarray
    measured: np.ndarray


@dataclass(eq=False)
class TableFlight:
    """
    Measurements and inputs of a flight on its grid.

    Attributes:
        channels: names of the channels that can be formed.
        mask: (N, C) samples that count.
        reasons: channel -> why it is not used; '' if it is used.

    """

    table: Table
    robot: RobotParameters
    body: BodyModel
    keys: dict[str, Key]
    channels: tuple[str, ...] = ()
    mask: np.ndarray = field(init=False)
    reasons: dict[str, str] = field(default_factory=dict)

    def __post_init__(self):
        """Form the inputs, the measurements and the mask."""
        table, n = self.table, len(self.table)
        self.name, self.period = table.name, table.period
        self._t = np.arange(n) * self.period
        stamps = table.format.clock_deviation
        self.highest = PHASE / (2 * np.pi * stamps) if stamps else np.inf
        self._command, known = self._commands()
        self._inputs, measured, reasons = self._states()
        chosen = [k for k, why in enumerate(reasons) if not why]
        self.channels = tuple(CHANNELS[k] for k in chosen)
        self.reasons = dict(zip(CHANNELS, reasons, strict=True))
        self._measured = measured[:, chosen]
        self._chosen = chosen
        flying = self._flying()
        self.mask = np.isfinite(self._measured) & (known & flying)[:, None]
        self._measured = np.nan_to_num(self._measured)

    @property
    def _motor(self):
        if self.robot.rotors.motor is None:
            raise ParameterError("key 'rotors.motor' is missing: expected the thrust by motor "
                                 'voltage, because the flight has duty')
        return self.robot.rotors.motor

    def _commands(self):
        """(N, 4) duty, or thrust [N], and (N,) whether it and its past are known."""
        values = self.table.values
        name = 'duty' if 'duty' in values else 'thrust'
        filled, known = _filled(values[name], self.period)
        if name == 'duty':
            known &= values[name].max(axis=1, initial=0, where=np.isfinite(values[name])) < FULL
            volts, _ = _filled(values['voltage'], self.period) if 'voltage' in values else (
                None, None)
            self._volts = np.full(len(filled), self._motor.nominal_voltage) if volts is None \
                else volts[:, 0]
        past = int(round(MEMORY * self.robot.rotors.time_constant / self.period))
        lost = np.convolve(~known, np.ones(past + 1))[:len(known)] > 0
        return filled, ~lost

    def _states(self):
        """Inputs of the body equations, (N, 6) measurements, and why a channel lacks one."""
        v, n, h = self.table.values, len(self.table), self.period
        reasons = [''] * 6
        if 'position' in v:
            position, _ = _filled(v['position'], h)
        else:
            position = np.tile([0.0, 0.0, FAR], (n, 1))
        if 'velocity' in v:
            velocity, _ = _filled(v['velocity'], h)
        else:
            width = max(int(round(SMOOTH / h)), 1)
            kernel = np.ones(width) / width
            padded = np.pad(position, ((width, width), (0, 0)), mode='edge')
            smooth = np.stack([np.convolve(c, kernel, 'same') for c in padded.T], axis=1)
            velocity = np.gradient(smooth, h, axis=0)[width:-width]
        acceleration = v.get('acceleration')
        if 'quaternion' in v:
            quaternion, _ = _filled(_signed(v['quaternion']), h)
            quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        elif acceleration is not None:
            quaternion = _along(acceleration + [0, 0, self.robot.gravity],
                                v['attitude'][:, 2] if 'attitude' in v else np.zeros(n))
        else:
            quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
        rotation = Rotation.from_quat(quaternion).as_matrix()
        if 'velocity' in v and self.table.format.signals['velocity'].frame == 'body':
            velocity = np.einsum('nij,nj->ni', rotation, velocity)
        if 'specific_force' in v:
            force = v['specific_force']
        elif acceleration is not None:
            force = np.einsum('nji,nj->ni', rotation, acceleration + [0, 0, self.robot.gravity])
            if 'quaternion' not in v:   # the direction was used for the attitude
                force = np.stack([np.full(n, np.nan), np.full(n, np.nan), force[:, 2]], axis=1)
        else:
            force = np.full((n, 3), np.nan)
        for k in range(3):
            if not np.isfinite(force[:, k]).any():
                reasons[k] = 'no specific force or acceleration along this axis'
        if 'angular_velocity' in v:
            rate, _ = _filled(v['angular_velocity'], h)
            turning = _derivative(v['angular_velocity'], h)
        else:
            rate, turning = np.zeros((n, 3)), np.full((n, 3), np.nan)
            reasons[3:] = ['no gyroscope'] * 3
        tilt = _filled(v['tilt'], h)[0] if 'tilt' in v else np.zeros((n, 4))
        inputs = {'velocity': velocity, 'quaternion': quaternion, 'rate': rate, 'tilt': tilt,
                  'thrust': np.zeros((n, 4)), 'tilt_rate': np.gradient(tilt, h, axis=0),
                  'tilt_acceleration': np.zeros((n, 4)), 'thrust_rate': np.zeros((n, 4)),
                  'position': position, 'voltage': np.ones(n), 'charge': np.zeros(n),
                  'modules': np.zeros(n)}
        return inputs, np.concatenate([force, turning], axis=1), reasons

    def _flying(self):
        """(N,) whether the robot is in the air."""
        position = self._inputs['position']
        high = np.ones(len(position), dtype=bool)
        if 'position' in self.table.values:
            high = position[:, 2] > position[:10, 2].mean() + AIRBORNE
        lifted = self._thrust({})[0].sum(axis=1) > 0.5 * self.robot.mass * self.robot.gravity
        flying = high & lifted
        edge = int(round(0.5 / self.period))    # half a second of transients at both ends
        inside = np.convolve(~flying, np.ones(2 * edge + 1), 'same') == 0
        return inside

    def _thrust(self, theta):
        """Thrusts after delay and lag (N, 4) [N] and their rates."""
        rotors, command = self.robot.rotors, self._command
        delay = sum(self.robot.command_delays[1:]) + sum(theta.get(key, 0.0) for key in DELAYS)
        if 'duty' in self.table.values:
            motor = self._motor
            exponent = self.robot.effect('voltage_sag.exponent', 0.0) \
                + theta.get('voltage_sag.exponent', 0.0)
            volts = command * (motor.nominal_voltage * (
                self._volts / motor.nominal_voltage)**exponent)[:, None]
            command = np.maximum(np.polynomial.polynomial.polyval(volts, motor.coefficients), 0)
        h = self.period
        tau = rotors.time_constant * np.exp(theta.get('rotor_lag.time_constant', 0.0))
        if delay:
            command = np.stack([np.interp(self._t - delay, self._t, c) for c in command.T], axis=1)
        keep, ramp = np.exp(-h / tau), (1 - np.exp(-h / tau)) * tau / h
        # exact for commands that are linear between samples; begins settled
        lagged = lfilter([1 - ramp, ramp - keep], [1, -keep], command, axis=0,
                         zi=ramp * command[:1])[0]
        return lagged, (command - lagged) / tau

    @property
    def usable(self) -> bool:
        """Whether it has a block of samples in the air."""
        return bool(self.channels) and len(blocks_of(self.mask, self.period)) > 0

    def without(self, group: str, reason: str) -> None:
        """Leave a group of channels out, for this ``reason``."""
        keep = [k for k, name in enumerate(self.channels) if not name.startswith(group)]
        for name in self.channels:
            if name.startswith(group):
                self.reasons[name] = reason
        self.mask, self._measured = self.mask[:, keep], self._measured[:, keep]
        self._chosen = [self._chosen[k] for k in keep]
        self.channels = tuple(self.channels[k] for k in keep)

    def _at(self, theta):
        thrust, thrust_rate = self._thrust(theta)
        inputs = {**self._inputs, 'thrust': thrust, 'thrust_rate': thrust_rate}
        if 'duty' in self.table.values:     # the voltage acts in the motor map
            theta = {**theta, 'voltage_sag.exponent': -self.robot.effect(
                'voltage_sag.exponent', 0.0)}
        return inputs, theta

    def _sensed(self, out, theta):
        """What the IMU reads: misalignment, then bias."""
        rotation = np.array([theta.get(f'imu_misalignment.rotation[{k}]', 0.0) for k in range(3)])
        bias = np.array([theta.get(f'imu_accelerometer_bias.bias[{k}]', 0.0) for k in range(3)])
        force, turning = out[:, :3], out[:, 3:]
        if rotation.any():
            matrix = Rotation.from_rotvec(rotation).as_matrix()
            force, turning = force @ matrix, turning @ matrix
        return np.concatenate([force + bias, turning], axis=1)

    def linear(self, theta: dict[str, float], names: list[str]) -> Linear:
        """Residual and its slopes at deviations ``theta``."""
        inputs, body_theta = self._at(theta)
        now = self._sensed(self.body(inputs, body_theta), theta)
        slopes = np.zeros((len(now), 6, len(names)))
        # the voltage of a table with duty is no term of the body equations
        outside = {'voltage_sag.exponent'} if 'duty' in self.table.values else set()
        exact = [name for name in names if self.keys[name].body and name not in outside]
        if exact:
            own = self.body.derivatives(inputs, body_theta, tuple(exact))
            for k, name in enumerate(exact):
                slopes[:, :, names.index(name)] = -own[:, :, k]
        for k, name in enumerate(names):
            if name in exact:
                continue
            step, both = self.keys[name].step, self.keys[name].parameter == 'delay'
            step = 0.5 * self.period if both else step
            ahead = {**theta, name: theta.get(name, 0.0) + step}
            behind = {**theta, name: theta.get(name, 0.0) - step}
            slopes[:, :, k] = -(self._full(ahead) - self._full(behind)) / (2 * step)
        return Linear(self._measured - now[:, self._chosen], slopes[:, self._chosen],
                      self._measured)

    @property
    def motion(self) -> dict[str, np.ndarray]:
        """Velocity (world), quaternion, position and tilts of the samples."""
        return self._inputs

    @property
    def time(self) -> np.ndarray:
        """(N,) times of the samples [s]."""
        return self._t

    def settle(self, theta: dict[str, float]) -> None:
        """Choose inputs that depend on deviations; a table has none."""

    def _full(self, theta):
        inputs, body_theta = self._at(theta)
        return self._sensed(self.body(inputs, body_theta), theta)


def _filled(values, period):
    """Values (N, n) with linear interpolation of missing ones, and (N,) where it is short."""
    t, filled = np.arange(len(values)), np.array(values)
    known = np.ones(len(values), dtype=bool)
    for k, column in enumerate(values.T):
        there = np.flatnonzero(np.isfinite(column))
        if not len(there):
            filled[:, k] = 0.0
            continue
        filled[:, k] = np.interp(t, there, column[there])
        after = np.clip(np.searchsorted(there, t), 0, len(there) - 1)
        before = np.clip(np.searchsorted(there, t, side='right') - 1, 0, None)
        gap = there[after] - there[before]
        known &= (gap * period <= BRIDGED) & (t >= there[0]) & (t <= there[-1])
    return filled, known


def _derivative(values, period):
    """Fourth-order central differences (N, n), NaN beside missing samples and at the ends."""
    out = np.full(values.shape, np.nan)
    out[2:-2] = (8 * (values[3:-1] - values[1:-3]) - (values[4:] - values[:-4])) / (12 * period)
    return out


def _signed(quaternion):
    """Quaternions (N, 4) with continuous signs."""
    out = np.array(quaternion)
    there = np.flatnonzero(np.isfinite(out).all(axis=1))
    flips = np.sign((out[there[1:]] * out[there[:-1]]).sum(axis=1))
    flips[flips == 0] = 1
    out[there] *= np.concatenate([[1.0], np.cumprod(flips)])[:, None]
    return out


def _along(thrust, yaw):
    """Quaternions (N, 4) whose z axis is along a vector (N, 3) in world, with this yaw (N,)."""
    z = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))], axis=1)
    y = np.cross(z, heading)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    matrix = np.stack([np.cross(y, z), y, z], axis=2)
    matrix[~np.isfinite(matrix).all(axis=(1, 2))] = np.eye(3)
    return Rotation.from_matrix(matrix).as_quat()
