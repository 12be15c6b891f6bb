"""Responses of the actuators that the intervals of a robot file allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.robot.effects import delaying
from beetle_omni_ros.robot.parameters import RobotParameters


@dataclass(frozen=True)
class Responses:
    """
    Limits of the response of any servo and rotor of one robot, (lowest, highest).

    Attributes:
        servo_lag: time constant of the first-order reduction [s].
        servo_delay: delay of tilt commands and encoders by the effects [s].
        rotor_lag: time constant of the thrust [s].
        rotor_delay: delay of thrust commands by the effects [s].
        friction: largest angle at which friction holds a servo beside its target [rad].

    """

    servo_lag: tuple[float, float]
    servo_delay: tuple[float, float]
    rotor_lag: tuple[float, float]
    rotor_delay: tuple[float, float]
    friction: float

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
            rotor_lag=_pair(_range(robot, 'rotors.time_constant', 'rotor_lag')),
            rotor_delay=_delay(robot, 'thrust'), friction=friction)


def _range(robot, key, effect):
    """Interval of a number of the file, or of the effect that replaces it."""
    return robot.interval(f"effects.{effect}.{key.split('.')[1]}" if effect in robot.effects
                          else key)


def _delay(robot, *what):
    return _pair(sum(np.array(robot.interval(f'effects.{name}.delay'))
                     for name in delaying(*what) if name in robot.effects) + np.zeros(2))


def _pair(interval):
    low, high = interval
    return float(low), float(high)
