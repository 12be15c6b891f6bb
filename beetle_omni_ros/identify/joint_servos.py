"""
The four tilt servos of a robot file as one point of a fit.

A robot file has one stiffness, damping, delay and limit for all joints, but friction and zero of
each joint. A fit with these parameters can be written to the file.
"""

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.inference.least_squares import Coordinates, Steps
from beetle_omni_ros.identify.servo_model import INDEX, OFF, TERMS
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.effects_actuator import per_joint
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.servo import SLIDING_RATE

# Catalogue entry -> parameters that a response log can determine.
GROUPS = {name: parameters for name, effect in CATALOGUE.items() if (parameters := tuple(
    parameter for parameter, spec in effect.parameters.items() if spec.log))}


@dataclass(frozen=True)
class Number:
    """
    One coordinate of a point.

    Attributes:
        name: parameter of the catalogue, or 'stiction' and 'dead_band_held'.
        joint: index in the log, None if shared by all joints.
        scale: relevant change; of the logarithm if ``logarithmic``.
        low: smallest value.
        high: largest value.
        logarithmic: whether the point contains the logarithm.

    """

    name: str
    joint: int | None
    scale: float
    low: float
    high: float
    logarithmic: bool = False


def _numbers(count):
    shared: list[Number] = []
    own: list[Number] = []
    for name, parameters in GROUPS.items():
        for parameter in parameters:
            log = CATALOGUE[name].parameters[parameter].log
            if log is None:
                continue
            for joint in range(count) if log.each else (None,):
                (own if log.each else shared).append(Number(
                    parameter, joint, log.scale, log.low, log.high, log.logarithmic))
    return [*shared, Number('stiction', None, 0.002, 0.0, 0.4),
            Number('dead_band_held', None, 1.0, 0.0, 1.0), *own]


class Servos:
    """
    Servos of a robot file and deviations from them.

    Friction and stiction of a point are dead bands [rad] at the stiffness of the file, because a
    log without torque determines only ratios to the stiffness. If the stiffness changes and
    friction is not fitted, ``dead_band_held`` selects what is constant: torque (0) or dead band
    (1).

    Args:
        robot: parameters of the robot file with effects.
        joints: numbers of the log's joints, 1 to 4.

    """

    # Shared parameters are much better determined than others: shorter steps, more damping.
    steps = Steps(2e-4, 8.0, (0.2, 20.0), 5.0, 50.0)

    def __init__(self, robot: RobotParameters, joints: tuple[int, ...]):
        self.robot, self.joints = robot, joints
        self.numbers = _numbers(len(joints))
        self.coordinates = Coordinates(self.numbers)
        self.values, self.scale = self.coordinates.decode, self.coordinates.scale
        self.owner = np.array([-1 if n.joint is None else n.joint for n in self.numbers])
        self.file_point = self.coordinates.encode(self._file_values())

    def _file_values(self):
        servo, effects = self.robot.joints, self.robot.effects
        friction = effects.get('joint_friction', {'coulomb': 0.0, 'stiction': 0.0})
        coulomb = np.array([per_joint(friction['coulomb'], j - 1) for j in self.joints])
        extra = np.array([per_joint(friction['stiction'], j - 1) for j in self.joints]) - coulomb
        offset = effects.get('joint_offset', {}).get('offset', (0.0,) * 4)
        values = {'kp': servo.kp, 'kd': max(servo.kd, 1e-5), 'delay': self.own_delay + self.delays,
                  'velocity_limit': servo.velocity_limit, 'effort_limit': servo.effort_limit,
                  'gap': effects.get('joint_backlash', {}).get('gap', 0.0),
                  'stiction': max(float(np.median(extra)), 0.0) / servo.kp,
                  'dead_band_held': 0.0, 'coulomb': coulomb / servo.kp,
                  'offset': np.array([offset[j - 1] for j in self.joints])}
        return np.array([values[n.name] if n.joint is None else values[n.name][n.joint]
                         for n in self.numbers])

    @property
    def own_delay(self) -> float:
        """The file's ``joint_command_latency`` [s]."""
        return self.robot.effects.get('joint_command_latency', {}).get('delay', 0.0)

    @property
    def delays(self) -> float:
        """Sum of the other delays [s], which a log does not separate from it."""
        effects = self.robot.effects
        return sum(effects.get(name, {}).get('delay', 0.0)
                   for name in ('command_latency', 'joint_feedback_delay'))

    def index(self, name: str, joint: int | None = None) -> int:
        """Index of a parameter in a point."""
        return next(k for k, n in enumerate(self.numbers) if (n.name, n.joint) == (name, joint))

    def mask(self, group: str, joint: int | None = None) -> np.ndarray:
        """(P,) parameters of a catalogue entry, optionally of one joint only."""
        return np.array([n.name in GROUPS[group] and joint in (None, n.joint)
                         for n in self.numbers])

    def sets(self, points: np.ndarray) -> np.ndarray:
        """(M, J, len(NAMES)) parameter sets of the servo model for points (M, P)."""
        values = self.values(points)
        count, joint = len(self.joints), self.robot.joints
        shared = {n.name: values[:, k, None] for k, n in enumerate(self.numbers)
                  if n.joint is None}
        coulomb, offset = (values[:, [self.index(name, j) for j in range(count)]]
                           for name in ('coulomb', 'offset'))
        softer = (joint.kp / shared['kp'])**(1 - shared['dead_band_held'])
        result = {'natural_frequency': np.sqrt(shared['kp'] / joint.inertia),
                'damping_ratio': shared['kd'] / (2 * np.sqrt(shared['kp'] * joint.inertia)),
                'delay': shared['delay'], 'offset': -offset, 'coulomb_friction': coulomb * softer,
                'stiction': shared['stiction'] * softer,
                'stribeck_velocity': np.full((1, 1), SLIDING_RATE),
                'backlash': shared['gap'] / 2, 'velocity_limit': shared['velocity_limit'],
                'torque_limit': shared['effort_limit'] / shared['kp']}
        sets = np.tile(OFF, (len(points), count, 1))
        for name, value in result.items():
            sets[:, :, INDEX[name]] = np.clip(value, TERMS[name].low, TERMS[name].high)
        return sets

    def friction(self, point: np.ndarray) -> np.ndarray:
        """(J,) Coulomb friction of a point [N m]."""
        coulomb = self.sets(point[None])[0, :, INDEX['coulomb_friction']]
        return coulomb * self.values(point)[self.index('kp')]


def file_sets(robot: RobotParameters, joints: tuple[int, ...]) -> np.ndarray:
    """
    Parameter sets (J, len(NAMES)) of the servos of a robot file with effects.

    Sign of the zero: the true tilt is the encoder's plus ``joint_offset``. A servo at rest has the
    commanded true tilt, so its encoder reads the command minus ``joint_offset``. Deflection is not
    included, because it needs a thrust.
    """
    servos = Servos(robot, joints)
    return servos.sets(servos.file_point[None])[0]


@dataclass(frozen=True)
class FileServos:
    """
    Servos of a robot file for the joints of a log.

    Attributes:
        sets: (J, len(NAMES)) parameter sets.
        held: whether a command is held until the next one. The shipped gains come from logs with
            interpolated commands; delays from `gap` and `identify` hold for held ones.

    """

    sets: np.ndarray
    held: bool


def file_servos(robot: RobotParameters, joints: tuple[int, ...]) -> FileServos:
    """Servos of a robot file for the joints of a log."""
    return FileServos(file_sets(robot, joints),
                      any(name in robot.effects for name in (*GROUPS, 'command_latency',
                                                             'joint_feedback_delay')))
