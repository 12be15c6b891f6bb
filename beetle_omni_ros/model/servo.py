"""
Equation and time step of the tilt servo, for numpy, CasADi and torch.

    J q'' = clip(Kp (q* - q) - Kd q', effort limit, line) + load - friction

The line is that of a DC motor at full voltage: its torque falls with the speed, by one over the
gradient, to zero at the rate limit. So a load changes the largest rate by gradient times load. A
gradient of zero is a motor that holds every load there. Friction is Coulomb friction, and at low
rates up to the stiction (Armstrong-Helouvry 1994). Torch and C code for training and control are
generated from CasADi.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from beetle_omni_ros.model.effects import delaying
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.parts import JointParameters

SLIDING_RATE = 0.05     # [rad/s] over which friction falls from stiction to Coulomb friction
TINY = 1e-9             # [rad/(N m s)] gradient of a motor that holds every load
# Functions in which the libraries differ, by numpy's names.
NUMPY: Any = np
CASADI: Any = SimpleNamespace(minimum=ca.fmin, maximum=ca.fmax, exp=ca.exp, sqrt=ca.sqrt,
                              where=ca.if_else, sin=ca.sin, cos=ca.cos)


@dataclass(frozen=True)
class Servo:
    """Numbers of a servo, or arrays of them; None disables a limit or friction."""

    inertia: Any                # [kg m^2]
    kp: Any                     # stiffness [N m/rad]
    kd: Any                     # damping [N m s/rad]
    velocity_limit: Any = None  # [rad/s]
    effort_limit: Any = None    # largest torque of the motor [N m]
    position_limit: Any = None  # travel to each side [rad]
    coulomb: Any = None         # sliding friction [N m]
    stiction: Any = None        # friction at rest [N m]
    speed_gradient: Any = 0.0   # loss of speed at the rate limit for each torque [rad/(N m s)]

    @classmethod
    def of(cls, joints: JointParameters, **more) -> Servo:
        """Servo of a robot file; ``more`` adds or replaces numbers."""
        return cls(**{name: getattr(joints, name) for name in (
            'inertia', 'kp', 'kd', 'velocity_limit', 'effort_limit', 'speed_gradient')} | more)

    def friction(self, space, rate):
        """Largest friction at a rate [N m]."""
        return self.coulomb + (self.stiction - self.coulomb) * self.fading(space, rate)

    def fading(self, space, rate):
        """Remaining fraction of the excess of stiction at a rate."""
        x = rate / SLIDING_RATE
        return space.exp(-x * x)

    def motor(self, space, error, rate):
        """Torque of the motor [N m] at a position error [rad] and a rate [rad/s]."""
        torque = self.kp * error - self.kd * rate
        return torque if self.effort_limit is None else _within(space, torque, self.effort_limit)

    def fastest(self, space, rate, load, duration):
        """Rates after ``duration`` [s] at full voltage to either side, with a ``load`` [N m]."""
        # exact solutions of J q'' = (+-limit - q') / gradient + load
        slope = space.maximum(self.speed_gradient, TINY)
        keep = space.exp(-duration / (self.inertia * slope))
        middle, most = keep * rate + (1 - keep) * slope * load, (1 - keep) * self.velocity_limit
        return middle - most, middle + most

    def acceleration(self, space, target, tilt, rate, load=0.0):
        """Acceleration [rad/s^2] at one instant, smooth except at the limits."""
        torque = self.motor(space, target - tilt, rate) + load
        if self.coulomb is not None:
            speed = rate / SLIDING_RATE
            torque = torque - speed / space.sqrt(1 + speed * speed) * self.friction(space, rate)
        if self.velocity_limit is None:
            return torque / self.inertia
        fast = space.maximum(rate, -rate) >= self.velocity_limit
        return space.where(fast * (torque * rate > 0), 0, torque / self.inertia)


class Step:
    """
    Motion of servos over one step: leapfrog, second order, stable for any damping.

    Damping and friction are implicit, so that a joint below its stiction is exactly at rest.
    ``space`` has the functions for the type of the numbers, ``duration`` is in s.
    """

    def __init__(self, space, servo: Servo, duration: float):
        self._space, self._servo, self._half = space, servo, 0.5 * duration
        self._duration = duration
        per_torque = duration / servo.inertia
        damping = 0.5 * per_torque * servo.kd
        self.gain = per_torque / (1 + damping)      # change of rate for each N m [rad/s]
        self._loss = 2 * damping / (1 + damping)    # fraction of the rate lost by damping
        self._stiff = servo.kp * self.gain
        self._per_torque, self._damping = per_torque, damping
        if servo.coulomb is not None:
            self._slides = self.gain * servo.coulomb
            self._sticks = self.gain * (servo.stiction - servo.coulomb)

    def kick(self, target, tilt, rate, load=None):
        """
        Rate after the step [rad/s].

        ``tilt`` is the angle in the middle of the step [rad], ``rate`` that before the step, and
        ``load`` the torque beside the motor's [N m].
        """
        space, servo = self._space, self._servo
        push = self._stiff * (target - tilt) - self._loss * rate
        if load is not None:
            push = push - self._damping * self.gain * load
        if servo.effort_limit is not None:
            push = _within(space, push, self._per_torque * servo.effort_limit)
        after, load = rate + push, 0.0 if load is None else load
        after = after + self._per_torque * load
        if servo.coulomb is not None:
            lost = _within(space, after, self._slides + self._sticks * servo.fading(space, rate))
            after, load = after - lost, load - lost / self.gain
        if servo.velocity_limit is not None:
            low, high = servo.fastest(space, rate, load, self._duration)
            after = space.minimum(space.maximum(after, low), high)
        return after

    def __call__(self, target, tilt, rate, load=None):
        """Angle [rad] and rate [rad/s] after the step; arguments as of :meth:`kick`."""
        space, limit = self._space, self._servo.position_limit
        tilt = tilt + self._half * rate
        rate = self.kick(target, tilt, rate, load)
        tilt = tilt + self._half * rate
        if limit is None:
            return tilt, rate
        held = _within(space, tilt, limit)
        return held, space.where(held == tilt, rate, 0.0)


def play(positions: np.ndarray, half: float | np.ndarray) -> np.ndarray:
    """
    Positions (K, ...) of a shaft that is driven with a play of ``half`` to each side [rad].

    ``positions`` (K, ...) are those of the driving side, on which the shaft begins.
    """
    low, high = positions - half, positions + half
    low[0] = high[0] = positions[0]
    span = 1        # clamps in a row are one clamp: doubling takes log K steps
    while span < len(low):
        least, most = low[span:], high[span:]
        low[span:], high[span:] = (np.minimum(np.maximum(end, least), most)
                                   for end in (low[:-span], high[:-span]))
        span *= 2
    return low


def _within(space, value, limit):
    return space.minimum(space.maximum(value, -limit), limit)


@dataclass(frozen=True)
class Responses:
    """Limits of the response of any servo and rotor of one robot, (lowest, highest)."""

    servo_lag: tuple[float, ...]    # time constant of the first-order reduction [s]
    servo_delay: tuple[float, ...]  # of tilt commands and encoders by the effects [s]
    rotor_lag: tuple[float, ...]    # time constant of the thrust [s]
    rotor_delay: tuple[float, ...]  # of thrust commands by the effects [s]
    friction: float     # largest angle at which friction holds a servo beside its target [rad]

    @classmethod
    def of(cls, robot: RobotParameters) -> Responses:
        """Limits by a robot file with or without intervals and effects."""
        kp = _range(robot, 'joints.kp', 'joint_bandwidth')
        kd = _range(robot, 'joints.kd', 'joint_bandwidth')
        fastest, slowest = (np.maximum(damping / stiff, np.sqrt(robot.joints.inertia / stiff))
                            for damping, stiff in zip(kd, kp[::-1]))
        friction = 0.0
        if 'joint_friction' in robot.effects:
            friction = max(float(np.max(robot.interval(f'effects.joint_friction.{name}')[1]
                                        / kp[0]))
                           for name in ('coulomb', 'stiction'))
        return cls(
            servo_lag=(float(np.min(fastest)), float(np.max(slowest))),
            servo_delay=_delay(robot, 'tilt', 'encoders'),
            rotor_lag=tuple(map(float, _range(robot, 'rotors.time_constant', 'rotor_lag'))),
            rotor_delay=_delay(robot, 'thrust'), friction=friction)


def _range(robot, key, effect):
    """Interval of a number of the file, or of the effect that replaces it."""
    return robot.interval(f"effects.{effect}.{key.split('.')[1]}" if effect in robot.effects
                          else key)


def _delay(robot, *what):
    return tuple(map(float, sum((np.array(robot.interval(f'effects.{name}.delay'))
                                 for name in delaying(*what) if name in robot.effects),
                                np.zeros(2))))
