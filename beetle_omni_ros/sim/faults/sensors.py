"""Faults of motion capture and IMU."""

from dataclasses import replace

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.sim.faults.base import (
    Effect,
    Frozen,
    Late,
    Lost,
    Number,
    ROUNDING,
    share,
    vector,
)


class _MocapEffect(Effect):
    """Changes each pose of the motion capture by ``_change``."""

    def mocap(self, reading, now):
        return reading and self._change(reading)


class _ImuEffect(Effect):
    """Changes each IMU sample by ``_change``."""

    def imu(self, reading, now):
        return reading and self._change(reading)


class _ClockStep:
    """Mixin: the stamps are wrong by a constant."""

    numbers = {'step': Number('error of the stamps', 's', low=-100, high=100)}

    def _change(self, reading):
        return replace(reading, stamp=reading.stamp + self._numbers['step'])


class MocapLost(Lost, _MocapEffect, kind='mocap_lost'):
    """No pose arrives."""


class MocapDrops(_MocapEffect, kind='mocap_drops'):
    """A share of the poses is lost."""

    numbers = {'share': share('share of lost poses')}

    def _change(self, reading):
        return None if self._random.uniform() < self._numbers['share'] else reading


class MocapFrozen(Frozen, _MocapEffect, kind='mocap_frozen'):
    """The same pose arrives with new stamps."""


class MocapJumps(_MocapEffect, kind='mocap_jumps'):
    """The position jumps and keeps the offset."""

    numbers = vector('m', 'of the jump in world', x=0.0, y=0.0, z=0.0)

    def _change(self, reading):
        return replace(reading, position=reading.position + np.array(
            [self._numbers[axis] for axis in 'xyz']))


class MocapTurned(_MocapEffect, kind='mocap_turned'):
    """The orientation jumps about axes of base_link and keeps the offset."""

    numbers = vector('rad', 'of the rotation', roll=0.0, pitch=0.0, yaw=0.0)

    def _change(self, reading):
        turn = rotations.from_rpy(*(self._numbers[axis] for axis in ('roll', 'pitch', 'yaw')))
        return replace(reading, quaternion=rotations.multiply(reading.quaternion, turn))


class MocapNoisy(_MocapEffect, kind='mocap_noisy'):
    """The pose has additional noise; standard deviations of an axis."""

    numbers = {'position': Number('standard deviation', 'm', 0.0, 0, 10),
               'orientation': Number('standard deviation', 'rad', 0.0, 0, 3)}

    def _change(self, reading):
        noise = self._random.standard_normal(6)
        turn = rotations.exp(self._numbers['orientation'] * noise[3:])
        return replace(reading, position=reading.position + self._numbers['position'] * noise[:3],
                       quaternion=rotations.multiply(reading.quaternion, turn))


class MocapDelayed(Late, kind='mocap_delayed'):
    """Poses arrive late, stamped at capture."""

    def mocap(self, reading, now):
        return next(iter(self._delayed(reading, now, 1)), None)


class MocapLags(MocapDelayed, kind='mocap_lags'):
    """Poses arrive late, and their stamps do not contain the delay."""

    def mocap(self, reading, now):
        late = super().mocap(reading, now)
        return late and replace(late, stamp=late.stamp + self._numbers['delay'])


class MocapSlow(Effect, kind='mocap_slow'):
    """Poses arrive at a lower rate."""

    numbers = {'period': Number('time between two poses', 's', low=0.01, high=5)}
    _next = -np.inf

    def mocap(self, reading, now):
        if reading is None or now < self._next - ROUNDING:
            return None
        self._next = now + self._numbers['period']
        return reading


class MocapClock(_ClockStep, _MocapEffect, kind='mocap_clock'):
    """The stamps of the poses jump and keep the offset."""


class ImuLost(Lost, _ImuEffect, kind='imu_lost'):
    """No IMU sample arrives."""


class ImuFrozen(Frozen, _ImuEffect, kind='imu_frozen'):
    """The same IMU sample arrives with new stamps."""


class ImuClock(_ClockStep, _ImuEffect, kind='imu_clock'):
    """The stamps of the IMU jump and keep the offset."""


class _MotionEffect(_ImuEffect):
    """Changes the vector (6,) of specific force and angular velocity by ``_change_motion``."""

    def _change(self, reading):
        motion = self._change_motion(
            np.concatenate([reading.specific_force, reading.angular_velocity]))
        return replace(reading, specific_force=motion[:3], angular_velocity=motion[3:])


class GyroscopeBias(_MotionEffect, kind='gyroscope_bias'):
    """The gyroscope bias steps."""

    numbers = vector('rad/s', 'of the step', x=0.0, y=0.0, z=0.0)

    def _change_motion(self, motion):
        motion[3:] += [self._numbers[axis] for axis in 'xyz']
        return motion


class AccelerometerBias(_MotionEffect, kind='accelerometer_bias'):
    """The accelerometer bias steps."""

    numbers = vector('m/s^2', 'of the step', x=0.0, y=0.0, z=0.0)

    def _change_motion(self, motion):
        motion[:3] += [self._numbers[axis] for axis in 'xyz']
        return motion


class ImuSaturated(_MotionEffect, kind='imu_saturated'):
    """The IMU saturates."""

    numbers = {'specific_force': Number('largest value', 'm/s^2', 1000.0, 0, 1000),
               'rate': Number('largest value', 'rad/s', 1000.0, 0, 1000)}

    def _change_motion(self, motion):
        limit = np.repeat([self._numbers['specific_force'], self._numbers['rate']], 3)
        return np.clip(motion, -limit, limit)


class ImuNan(_MotionEffect, kind='imu_nan'):
    """The IMU samples are NaN."""

    def _change_motion(self, motion):
        return np.full(6, np.nan)


class ImuSpikes(_MotionEffect, kind='imu_spikes'):
    """Single IMU samples have an error in a random direction."""

    numbers = {'period': Number('mean time between two spikes', 's', 0.1, 0.005, 100),
               'specific_force': Number('error of an axis', 'm/s^2', 0.0, 0, 1000),
               'rate': Number('error of an axis', 'rad/s', 0.0, 0, 1000)}

    def _change_motion(self, motion):
        hit, *direction = self._random.uniform(-1, 1, 7)
        if abs(hit) < self._tick / self._numbers['period']:
            size = np.repeat([self._numbers['specific_force'], self._numbers['rate']], 3)
            motion += size * np.sign(direction)
        return motion


class ImuAxisDead(_MotionEffect, kind='imu_axis_dead'):
    """One axis of the IMU reads zero: 1 to 3 specific force, 4 to 6 rate."""

    numbers = {'axis': Number('number of the axis', '', None, 1, 6, whole=True)}

    def _change_motion(self, motion):
        motion[int(self._numbers['axis']) - 1] = 0.0
        return motion
