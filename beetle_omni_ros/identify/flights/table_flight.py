"""
Residuals of a flight that was read from a table, with their slopes.

Two groups of channels compare the measurements with the body equations: specific force along
the body's axes, and angular acceleration about them. Two compare the IMU with MoCap: specific
force (acceleration) and angular velocity (rate), up to the frequency up to which their clocks
agree. Without accelerometer, the specific force is that of MoCap's positions. Without quaternion,
the attitude follows from the direction of the measured acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.flights.body import BodyModel
from beetle_omni_ros.identify.flights.keys import Key, names_of
from beetle_omni_ros.identify.flights.spectrum import blocks_of, Linear, warm
from beetle_omni_ros.identify.recording.series import (
    aligned,
    along,
    derivative,
    derivatives,
    FASTEST,
    filled,
    rising,
    slow,
    turning,
    wander,
)
from beetle_omni_ros.identify.recording.table import Table, turned_to_world
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

COMPARED = ('acceleration', 'rate')
GROUPS = ('force', 'torque', *COMPARED)
CHANNELS = tuple(f'{group}_{axis}' for group in GROUPS for axis in 'xyz')
FAR = 100.0             # [m] height without position, at which the ground has no effect
AIRBORNE = 0.15         # [m] above the floor, one rotor diameter: no contact; the floor is where
                        # the flight begins, or at zero if it begins above
MEMORY = 2.0            # rotor time constants after which a lost command is forgotten
FULL = 0.995            # share of full duty from which a command is saturated
PHASE = 0.1             # [rad] error by wrong stamps up to which a frequency counts
HELD = 2.0              # [s] blocks of the balance of torques, so below 0.25 Hz
SLOWEST = 0.25          # [Hz] clocks that do not agree up to here are not compared
TILTS = 20.0            # [Hz] edge of the filter of tilts: servos are slower
# Signal -> what the comparison of MoCap and IMU lacks without it.
NEEDED = {'position': 'position', 'quaternion': 'quaternion', 'specific_force': 'accelerometer',
          'angular_velocity': 'gyroscope'}
DELAYS = ('rotor_dead_time.delay', 'command_latency.delay')


@dataclass(eq=False)
class TableFlight:
    """
    Measurements and inputs of a flight on its grid.

    Attributes:
        channels: names of the channels that can be formed.
        mask: (N, C) samples that count.
        reasons: channel -> why it is not used; '' if it is used.
        motion: velocity (world), quaternion, position, tilts, rates, thrusts of the samples.
        time: (N,) times of the samples [s].
        apart: why IMU and MoCap of this flight are not compared although both are there, or ''.
        by_mocap: whether forces are those of MoCap's positions.

    """

    turning: ClassVar[str] = ''     # each group of channels shows its own motion
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
        self.time = np.arange(n) * self.period
        self.highest = _highest(table.format.clock_deviation)
        self.by_mocap = by_mocap(table.values)
        # groups whose noise reaches the commands: a controller flies by MoCap
        self.fed_back = ('force', 'torque') if self.by_mocap else ('torque',)
        self._command, known = self._commands()
        self.motion, measured, reasons = self._states()
        self._seen, felt, more = self._compared()
        measured, reasons = np.concatenate([measured, felt], axis=1), [*reasons, *more]
        chosen = [k for k, why in enumerate(reasons) if not why]
        self.channels = tuple(CHANNELS[k] for k in chosen)
        self.reasons = dict(zip(CHANNELS, reasons, strict=True))
        self._readings = measured[:, chosen]
        self._chosen = chosen
        self._airborne = known & self._flying()
        self.mask = np.isfinite(self._readings) & self._airborne[:, None]
        self._readings = np.nan_to_num(self._readings)

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
        command, known = filled(values[name], self.period)
        if name == 'thrust':    # more is commanded than the rotors deliver
            known &= (command <= self.robot.rotors.thrust_max).all(axis=1)
        else:
            known &= values[name].max(axis=1, initial=0, where=np.isfinite(values[name])) < FULL
            self._volts = filled(values['voltage'], self.period)[0][:, 0] if (
                'voltage' in values) else np.full(len(command), self._motor.nominal_voltage)
        past = int(round(MEMORY * self.robot.rotors.time_constant / self.period))
        lost = np.convolve(~known, np.ones(past + 1))[:len(known)] > 0
        return command, ~lost

    def _states(self):
        """Inputs of the body equations, (N, 6) measurements, and why a channel lacks one."""
        v, n, h = self.table.values, len(self.table), self.period
        reasons = [''] * 6
        position, quaternion, self._wander = poses(self.table, FAR)
        velocity = filled(v['velocity'], h)[0] if 'velocity' in v else rising(position, h)
        acceleration = v.get('acceleration')
        if quaternion is None and acceleration is not None:
            quaternion = along(acceleration + [0, 0, self.robot.gravity],
                               v['attitude'][:, 2] if 'attitude' in v else np.zeros(n))
        elif quaternion is None:
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
        elif self.by_mocap:
            self.highest = min(self.highest, _highest(self._wander), FASTEST)
            force = self._force_by_mocap(position, rotation)
        else:
            force = np.full((n, 3), np.nan)
        for k in range(3):
            if not np.isfinite(force[:, k]).any():
                reasons[k] = 'no specific force or acceleration along this axis'
        if 'angular_velocity' in v:
            rate, _ = filled(v['angular_velocity'], h)
            turned = derivative(v['angular_velocity'], h)
            self._turned = np.nan_to_num(derivative(rate, h))
        else:
            rate, turned = np.zeros((n, 3)), np.full((n, 3), np.nan)
            self._turned = rate
            reasons[3:] = ['no gyroscope'] * 3
        tilt = derivatives(filled(v['tilt'], h)[0], TILTS, h) if 'tilt' in v \
            else np.zeros((3, n, 4))
        if 'tilt' in v:     # above it filters of readings and tilts differ, as in bags
            self.highest = min(self.highest, FASTEST)
        inputs = {'velocity': velocity, 'quaternion': quaternion, 'rate': rate, 'tilt': tilt[0],
                  'thrust': self._thrust({})[0], 'tilt_rate': tilt[1],
                  'tilt_acceleration': tilt[2], 'thrust_rate': np.zeros((n, 4)),
                  'position': position, 'voltage': self._charge(), 'modules': np.ones(n),
                  **{f'state of {name}': np.zeros((n, 4)) for name in self.body.slow}}
        return inputs, np.concatenate([force, turned], axis=1), reasons

    def _charge(self):
        """(N,) pack over full voltage; with duty, the voltage acts in the motor map instead."""
        v = self.table.values
        ratio = filled(v['voltage'], self.period)[0][:, 0] / self.robot.battery.full_voltage \
            if {'thrust', 'voltage'} <= set(v) else np.ones(len(self.table))
        return ratio if 0.5 < ratio.min() and ratio.max() < 1.5 else np.ones(len(ratio))

    def _force_by_mocap(self, position, rotation):
        """(N, 3) specific force of positions and attitudes; NaN: they are not measured."""
        h = self.period
        up = derivative(derivative(slow(position, h, self.highest), h), h)
        force = np.einsum('nji,nj->ni', rotation, up + [0, 0, self.robot.gravity])
        for name in ('position', 'quaternion'):
            force[~filled(self.table.values[name], h)[1]] = np.nan
        return force

    def _compared(self):
        """(N, 6) specific force and rate by MoCap, the same by the IMU, and why one lacks."""
        v, inputs, n = self.table.values, self.motion, len(self.time)
        reasons = [next((f'no {NEEDED[s]}' for s in need if s not in v), '') for need in (
            ('position', 'quaternion', 'specific_force'), ('quaternion', 'angular_velocity'))]
        if 'angular_velocity' in turned_to_world(self.table.format.signals):
            reasons[1] = reasons[1] or 'turned by the attitude, so that they do not show its axes'
        limit = _highest(self._wander)
        self.apart = '' if limit >= SLOWEST or all(reasons) else (
            f'the clocks of MoCap and IMU wander by {1e3 * self._wander:.0f} ms' if np.isfinite(
                self._wander) else 'MoCap and IMU show no common motion')
        rotation = Rotation.from_quat(inputs['quaternion']).as_matrix()
        up = rising(rising(inputs['position'], self.period), self.period)
        seen = np.concatenate([
            np.einsum('nji,nj->ni', rotation, up + [0, 0, self.robot.gravity]),
            turning(inputs['quaternion'], self.period)], axis=1)
        felt = np.concatenate([v.get(name, np.full((n, 3), np.nan)) for name in (
            'specific_force', 'angular_velocity')], axis=1)
        there = np.isfinite(felt) & ~np.repeat([bool(self.apart or why) for why in reasons], 3)
        for name in ('position', 'quaternion'):
            if name in v:
                there &= filled(v[name], self.period)[1][:, None]
        felt = np.where(there, slow(filled(felt, self.period)[0], self.period, limit), np.nan)
        axes = [reasons[k // 3] or ('' if self.apart or there[:, k].any() else (
            'not recorded along this axis')) for k in range(6)]
        return slow(seen, self.period, limit), felt, axes

    def _flying(self):
        """(N,) whether the robot is in the air."""
        height = self.motion['position'][:, 2]
        lifted = self._thrust({})[0].sum(axis=1) > 0.5 * self.robot.mass * self.robot.gravity
        first = height[:10].mean()
        high = height > (0.0 if lifted[:10].all() and first > AIRBORNE else first) + AIRBORNE
        high |= 'position' not in self.table.values
        edge = int(round(0.5 / self.period))    # half a second of transients at both ends
        return np.convolve(~(high & lifted), np.ones(2 * edge + 1), 'same') == 0

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
            t = self.time
            command = np.stack([np.interp(t - delay, t, c) for c in command.T], axis=1)
        keep, ramp = np.exp(-h / tau), (1 - np.exp(-h / tau)) * tau / h
        # exact for commands that are linear between samples; begins settled
        lagged = lfilter([1 - ramp, ramp - keep], [1, -keep], command, axis=0,
                         zi=ramp * command[:1])[0]
        return lagged, (command - lagged) / tau

    def ranges(self) -> str:
        """What decides whether it flies, in words."""
        total, weight = self._thrust({})[0].sum(axis=1), self.robot.mass * self.robot.gravity
        height = self.motion['position'][:, 2]
        return (f'heights are {height.min():.3g} to {height.max():.3g} m, '
                if 'position' in self.table.values else '') + (
            f'thrusts {np.quantile(total, 0.01) / weight:.2g} to '
            f'{np.quantile(total, 0.99) / weight:.2g} of the weight')

    @property
    def usable(self) -> bool:
        """Whether it has a block of samples in the air."""
        return bool(self.channels) and len(blocks_of(
            warm(self.mask, self.period), self.period)) > 0

    def without(self, groups: tuple[str, ...], reason: str) -> None:
        """Leave groups of channels out, for this ``reason``."""
        keep = [k for k, name in enumerate(self.channels) if not name.startswith(groups)]
        self.reasons |= {name: reason for name in self.channels if name.startswith(groups)}
        self.mask, self._readings = self.mask[:, keep], self._readings[:, keep]
        self._chosen = [self._chosen[k] for k in keep]
        self.channels = tuple(self.channels[k] for k in keep)

    def _at(self, theta):
        thrust, thrust_rate = self._thrust(theta)
        inputs = {**self.motion, 'thrust': thrust, 'thrust_rate': thrust_rate}
        if 'duty' in self.table.values:     # the voltage acts in the motor map
            theta = {**theta, 'voltage_sag.exponent': -self.robot.effect(
                'voltage_sag.exponent', 0.0)}
        return inputs, theta

    def _sensed(self, out, theta):
        """What the IMU reads by the body equations and by MoCap: misalignment, then bias."""
        imu, mocap, force, rate, lever = (
            np.array([self.keys[name].base + theta.get(name, 0.0) for name in names_of(*key)])
            for key in (('imu_misalignment', 'rotation'), ('mocap_misalignment', 'rotation'),
                        ('imu_accelerometer_bias', 'bias'), ('imu_gyroscope_bias', 'bias'),
                        ('imu_lever_arm', 'offset')))
        if lever.any():
            rates = self.motion['rate']
            force = force + np.cross(self._turned, lever) + np.cross(rates, np.cross(rates, lever))
        matrix = Rotation.from_rotvec(imu).as_matrix()
        # what MoCap states of its axes is turned back into the body
        seen = Rotation.from_rotvec(mocap).as_matrix().T @ matrix
        felt = out[:, :3] @ Rotation.from_rotvec(mocap).as_matrix() if self.by_mocap \
            else out[:, :3] @ matrix + force
        return np.concatenate([
            felt, out[:, 3:] @ matrix, self._seen[:, :3] @ seen + force,
            self._seen[:, 3:] @ seen + rate], axis=1)

    def linear(self, theta: dict[str, float], names: list[str]) -> Linear:
        """Residual and its slopes at deviations ``theta``."""
        inputs, body_theta = self._at(theta)
        now = self._sensed(self.body(inputs, body_theta), theta)
        slopes = np.zeros((len(now), len(CHANNELS), len(names)))
        # the voltage of a table with duty is no term of the body equations
        outside = {'voltage_sag.exponent'} if 'duty' in self.table.values else set()
        exact = [name for name in names if self.keys[name].body and name not in outside]
        if exact:
            slopes[:, :6, [names.index(name) for name in exact]] = -self.body.derivatives(
                inputs, body_theta, tuple(exact))
        for k, name in enumerate(names):
            if name in exact:
                continue
            key = self.keys[name]
            step = 0.5 * self.period if key.parameter == 'delay' else key.step
            ahead = {**theta, name: theta.get(name, 0.0) + step}
            behind = {**theta, name: theta.get(name, 0.0) - step}
            slopes[:, :, k] = -(self._full(ahead) - self._full(behind)) / (2 * step)
        return Linear(self._readings - now[:, self._chosen], slopes[:, self._chosen])

    def measured(self, theta: dict[str, float]) -> np.ndarray:
        """(N, C) measurements of the channels, which depend on no deviation."""
        return self._readings

    def balance(self, names: list[str]) -> tuple[np.ndarray, np.ndarray] | None:
        """
        Means of B blocks of roll and pitch accelerations by the attitude [rad/s^2].

        They are (B, 2) less the expected ones, and (B, 2, K) slopes of these; None if not shown.
        """
        there, rows = set(self.table.values), np.flatnonzero(self._airborne)
        parts = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
        blocks = [block for part in parts if (count := round(len(part) * self.period / HELD))
                  for block in np.array_split(part, count)]
        if 'angular_velocity' in there or len(blocks) < 2 or not (
                there & {'quaternion', 'acceleration'} and there & {'position', 'velocity'}):
            return None
        turned = rising(turning(self.motion['quaternion'], self.period), self.period)
        inputs, at = self._at({})
        left = turned - self.body(inputs, at)[:, 3:]
        slopes = self.body.derivatives(inputs, at, tuple(names))
        return (np.array([left[block, :2].mean(axis=0) for block in blocks]),
                np.array([slopes[block, 3:5].mean(axis=0) for block in blocks]))

    def settle(self, theta: dict[str, float]) -> None:
        """Choose inputs that depend on deviations; a table has none."""

    def _full(self, theta):
        inputs, body_theta = self._at(theta)
        return self._sensed(self.body(inputs, body_theta), theta)


def by_mocap(signals) -> bool:
    """Whether forces are those of MoCap: positions and attitudes, but no acceleration."""
    return {'position', 'quaternion'} <= set(signals) \
        and not {'specific_force', 'acceleration'} & set(signals)


def _highest(deviation):
    """Frequency [Hz] up to which stamps with this deviation [s] turn the phase too little."""
    return PHASE / (2 * np.pi * deviation) if deviation else np.inf


def poses(table, far):
    """
    Positions (N, 3) and quaternions (N, 4) or None, on the clock of the IMU.

    Two clocks are compared by the rates of quaternion and gyroscope, and the median of their
    shifts is taken out.

    Args:
        table: the flight.
        far: height without position [m].

    Returns:
        positions, quaternions, RMS deviation of the clocks [s].

    """
    v, signals, h = table.values, table.format.signals, table.period
    position = filled(v['position'], h)[0] if 'position' in v else np.tile(
        [0.0, 0.0, far], (len(table), 1))
    if 'quaternion' not in v:
        return position, None, np.inf
    quaternion, seen = filled(aligned(v['quaternion']), h)
    deviation = table.format.clock_deviation
    imu = next((signals[name].clock for name in (
        'angular_velocity', 'specific_force', 'duty', 'thrust') if name in v), None)
    if imu not in (None, signals['quaternion'].clock):
        late, deviation = np.nan, np.inf
        if 'angular_velocity' in v:
            felt, known = filled(v['angular_velocity'], h)
            late, deviation = wander(slow(turning(quaternion, h), h, FASTEST),
                                     slow(felt, h, FASTEST), seen & known, h)
        if np.isfinite(late):
            t = np.arange(len(table)) * h
            position, quaternion = (np.stack([np.interp(t + late, t, c) for c in x.T], axis=1)
                                    for x in (position, quaternion))
    return position, quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True), deviation
