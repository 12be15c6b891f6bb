"""Faults of rotors and servos."""

from dataclasses import replace
from math import exp

import numpy as np

from beetle_omni_ros.sim.faults.base import Effect, Number, one_of_four, share


class RotorEffect(Effect):
    """A fault of one rotor."""

    numbers = {'rotor': one_of_four('rotor')}

    @property
    def _k(self):
        return int(self._numbers['rotor']) - 1


class RotorStops(RotorEffect, kind='rotor_stops'):
    """A rotor stops; its thrust fades with the rotor lag."""

    def drive(self, drive):
        drive.thrust[self._k] = 0.0


class RotorWeak(RotorEffect, kind='rotor_weak'):
    """A rotor turns slower and gives only a share of the commanded thrust."""

    numbers = {**RotorEffect.numbers, 'share': share('share of the commanded thrust')}

    def drive(self, drive):
        drive.thrust[self._k] *= self._numbers['share']


class PropellerBroken(RotorEffect, kind='propeller_broken'):
    """A rotor has the commanded speed, and its propeller gives only a share of the thrust."""

    numbers = {**RotorEffect.numbers, 'share': share('share of the thrust at that speed')}

    def drive(self, drive):
        drive.thrust[self._k] *= self._numbers['share']
        drive.wear[self._k] *= max(self._numbers['share'], 1e-6)


class RotorSticks(RotorEffect, kind='rotor_sticks'):
    """A rotor keeps its present thrust."""

    def start(self, world):
        self._thrust = float(world.truth.thrust[self._k])

    def drive(self, drive):
        drive.thrust[self._k] = self._thrust


class RotorSlow(RotorEffect, kind='rotor_slow'):
    """A rotor follows its commands through a second lag."""

    numbers = {**RotorEffect.numbers,
               'time_constant': Number('time constant of the second lag', 's', low=0.005, high=10)}

    def start(self, world):
        self._thrust = float(world.truth.thrust[self._k])
        self._gain = 1 - exp(-self._tick / self._numbers['time_constant'])

    def drive(self, drive):
        self._thrust += self._gain * (drive.thrust[self._k] - self._thrust)
        drive.thrust[self._k] = self._thrust


class ServoEffect(Effect):
    """A fault of one servo."""

    numbers = {'servo': one_of_four('servo')}

    @property
    def _k(self):
        return int(self._numbers['servo']) - 1

    def _shown(self, reading, position=None, velocity=None):
        """Copy of a reading with another angle [rad] and rate [rad/s] of this servo."""
        changed = {}
        for name, value in (('position', position), ('velocity', velocity)):
            if value is not None:
                changed[name] = getattr(reading, name).copy()
                changed[name][self._k] = value
        return replace(reading, **changed)


class ServoJammed(ServoEffect, kind='servo_jammed'):
    """A joint jams at its present angle, or after a slip by an angle."""

    numbers = {**ServoEffect.numbers,
               'offset': Number('angle of the slip', 'rad', 0.0, -8, 8),
               'rate': Number('rate of the slip', 'rad/s', 10.0, 0.1, 100)}

    def start(self, world):
        self._angle = float(world.truth.tilt[self._k])
        self._remaining = self._numbers['offset']

    def drive(self, drive):
        limit = self._numbers['rate'] * self._tick
        step = float(np.clip(self._remaining, -limit, limit))
        self._remaining -= step
        self._angle += step
        drive.tilt[self._k] = self._angle
        drive.jammed[self._k] = True


class ServoLimp(ServoEffect, kind='servo_limp'):
    """A servo loses its torque, so that the joint swings freely."""

    def drive(self, drive):
        drive.powered[self._k] = False


class ServoSlow(ServoEffect, kind='servo_slow'):
    """The rate of a servo is limited."""

    numbers = {**ServoEffect.numbers,
               'rate': Number('largest rate', 'rad/s', low=0.01, high=100)}

    def start(self, world):
        self._angle = float(world.truth.tilt[self._k])

    def drive(self, drive):
        step = self._numbers['rate'] * self._tick
        self._angle += float(np.clip(drive.tilt[self._k] - self._angle, -step, step))
        drive.tilt[self._k] = self._angle


class ServoDeaf(ServoEffect, kind='servo_deaf'):
    """A servo ignores new targets and holds the last one."""

    def start(self, world):
        self._target = float(world.tilt[self._k])

    def drive(self, drive):
        drive.tilt[self._k] = self._target


class EncoderShifted(ServoEffect, kind='encoder_shifted'):
    """An encoder has an offset, with which its servo controls the joint."""

    numbers = {**ServoEffect.numbers,
               'angle': Number('reading minus true tilt', 'rad', low=-8, high=8)}

    def drive(self, drive):
        drive.tilt[self._k] -= self._numbers['angle']

    def joints(self, reading, now):
        return reading and self._shown(reading,
                                       reading.position[self._k] + self._numbers['angle'])


class EncoderFrozen(ServoEffect, kind='encoder_frozen'):
    """The angle reported by a servo is frozen; the servo itself works."""

    _angle: float | None = None

    def joints(self, reading, now):
        if reading is None:
            return None
        if self._angle is None:
            self._angle = float(reading.position[self._k])
        return self._shown(reading, self._angle, 0.0)


class JointsLost(Effect, kind='joints_lost'):
    """No joint feedback arrives."""

    def joints(self, reading, now):
        return None


class RotorSpeedLost(Effect, kind='rotor_speed_lost'):
    """No rotor speed arrives."""

    def rotors(self, reading, now):
        return None
