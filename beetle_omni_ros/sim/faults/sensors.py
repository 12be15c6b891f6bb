"""Faults of motion capture and IMU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.sim.faults.base import Effect, kind, Late, Number, ROUNDING, share, vector


@kind('mocap_lost')
class MocapLost(Effect):
    """No pose arrives."""

    def mocap(self, reading, now):
        return None


@kind('mocap_drops')
class MocapDrops(Effect):
    """A share of the poses is lost."""

    numbers = {'share': share('of the poses that are lost')}

    def mocap(self, reading, now):
        if reading is None or self._random.uniform() < self._numbers['share']:
            return None
        return reading


@kind('mocap_frozen')
class MocapFrozen(Effect):
    """The same pose arrives with new stamps."""

    _first = None

    def mocap(self, reading, now):
        if reading is None:
            return None
        self._first = self._first or reading
        return replace(self._first, stamp=reading.stamp)


@kind('mocap_jumps')
class MocapJumps(Effect):
    """The position jumps and stays off."""

    numbers = vector('m', 'of the jump in world', x=0.0, y=0.0, z=0.0)

    def mocap(self, reading, now):
        return reading and replace(reading, position=reading.position + np.array(
            [self._numbers[axis] for axis in 'xyz']))


@kind('mocap_turned')
class MocapTurned(Effect):
    """The orientation jumps about base_link axes and stays off."""

    numbers = vector('rad', 'of the turn', roll=0.0, pitch=0.0, yaw=0.0)

    def mocap(self, reading, now):
        if reading is None:
            return None
        turn = rotations.from_rpy(*(self._numbers[axis] for axis in ('roll', 'pitch', 'yaw')))
        return replace(reading, quaternion=rotations.multiply(reading.quaternion, turn))


@kind('mocap_noisy')
class MocapNoisy(Effect):
    """More noise on the pose, standard deviations of an axis."""

    numbers = {'position': Number('noise', 'm', 0.0, 0, 10),
               'orientation': Number('noise', 'rad', 0.0, 0, 3)}

    def mocap(self, reading, now):
        if reading is None:
            return None
        noise = self._random.standard_normal(6)
        turn = rotations.exp(self._numbers['orientation'] * noise[3:])
        return replace(reading, position=reading.position + self._numbers['position'] * noise[:3],
                       quaternion=rotations.multiply(reading.quaternion, turn))


@kind('mocap_delayed')
class MocapDelayed(Late):
    """Poses arrive late, stamped at capture."""

    def mocap(self, reading, now):
        return next(iter(self._arrived(reading, now, 1)), None)


@kind('mocap_lags')
class MocapLags(MocapDelayed):
    """Poses arrive late, and their stamps do not tell."""

    def mocap(self, reading, now):
        late = super().mocap(reading, now)
        return late and replace(late, stamp=late.stamp + self._numbers['delay'])


@kind('mocap_slow')
class MocapSlow(Effect):
    """Poses arrive at a lower rate."""

    numbers = {'period': Number('between two poses', 's', low=0.01, high=5)}
    _next = -np.inf

    def mocap(self, reading, now):
        if reading is None or now < self._next - ROUNDING:
            return None
        self._next = now + self._numbers['period']
        return reading


@kind('mocap_clock')
class MocapClock(Effect):
    """The stamps of the poses jump and stay off."""

    numbers = {'step': Number('of the stamps', 's', low=-100, high=100)}

    def mocap(self, reading, now):
        return reading and replace(reading, stamp=reading.stamp + self._numbers['step'])


@kind('imu_lost')
class ImuLost(Effect):
    """No IMU sample arrives."""

    def imu(self, reading, now):
        return None


@kind('imu_frozen')
class ImuFrozen(Effect):
    """The same IMU sample arrives with new stamps."""

    _first = None

    def imu(self, reading, now):
        if reading is None:
            return None
        self._first = self._first or reading
        return replace(self._first, stamp=reading.stamp)


@kind('imu_clock')
class ImuClock(Effect):
    """The stamps of the IMU jump and stay off."""

    numbers = {'step': Number('of the stamps', 's', low=-100, high=100)}

    def imu(self, reading, now):
        return reading and replace(reading, stamp=reading.stamp + self._numbers['step'])


class _Motion(Effect):
    """Changes the six numbers of a sample."""

    def imu(self, reading, now):
        if reading is None:
            return None
        changed = self._change(np.concatenate([reading.specific_force, reading.angular_velocity]),
                               now)
        return replace(reading, specific_force=changed[:3], angular_velocity=changed[3:])


@kind('gyroscope_bias')
class GyroscopeBias(_Motion):
    """The gyroscope bias steps."""

    numbers = vector('rad/s', 'of the step', x=0.0, y=0.0, z=0.0)

    def _change(self, motion, now):
        motion[3:] += [self._numbers[axis] for axis in 'xyz']
        return motion


@kind('accelerometer_bias')
class AccelerometerBias(_Motion):
    """The accelerometer bias steps."""

    numbers = vector('m/s^2', 'of the step', x=0.0, y=0.0, z=0.0)

    def _change(self, motion, now):
        motion[:3] += [self._numbers[axis] for axis in 'xyz']
        return motion


@kind('imu_saturated')
class ImuSaturated(_Motion):
    """The IMU saturates."""

    numbers = {'specific_force': Number('largest value', 'm/s^2', 1000.0, 0, 1000),
               'rate': Number('largest value', 'rad/s', 1000.0, 0, 1000)}

    def _change(self, motion, now):
        limit = np.repeat([self._numbers['specific_force'], self._numbers['rate']], 3)
        return np.clip(motion, -limit, limit)


@kind('imu_nan')
class ImuNan(_Motion):
    """The IMU gives NaN."""

    def _change(self, motion, now):
        return np.full(6, np.nan)


@kind('imu_spikes')
class ImuSpikes(_Motion):
    """Single IMU samples are off, each in a random direction."""

    numbers = {'period': Number('mean time between two', 's', 0.1, 0.005, 100),
               'specific_force': Number('of a spike', 'm/s^2', 0.0, 0, 1000),
               'rate': Number('of a spike', 'rad/s', 0.0, 0, 1000)}

    def _change(self, motion, now):
        hit, *direction = self._random.uniform(-1, 1, 7)
        if abs(hit) < self._tick / self._numbers['period']:
            size = np.repeat([self._numbers['specific_force'], self._numbers['rate']], 3)
            motion += size * np.sign(direction)
        return motion


@kind('imu_axis_dead')
class ImuAxisDead(_Motion):
    """One axis of the IMU reads zero: 1 to 3 specific force, 4 to 6 rate."""

    numbers = {'axis': Number('of six', '', None, 1, 6, whole=True)}

    def _change(self, motion, now):
        motion[int(self._numbers['axis']) - 1] = 0.0
        return motion
