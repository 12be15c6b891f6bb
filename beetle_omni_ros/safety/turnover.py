"""
A joint that is wound in the wrong direction turns over while its rotor is off.

Upside down each tilt may be +pi or -pi. On every way to level, one joint of an opposite pair turns
forwards and the other backwards. If both are wound in the same direction, one of them must turn
back by a full turn, during which its thrust points in wrong directions. While its arm is upright
this thrust is small, but it is needed to control the attitude. The robot therefore flies to an
attitude that the other three rotors hold with a margin, stops this rotor, turns its joint, and
continues with four rotors. If both pairs are wound so, this happens twice.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from beetle_omni_ros.robot.allocation import ActuatorHealth, Allocator, nearest_turn, ROTORS
from beetle_omni_ros.robot.degraded import Holding, leaned, up
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import parameter
from beetle_omni_ros.safety.levelling import LevellingParameters, lost_lift

TURN = 2 * np.pi


@dataclass(frozen=True, kw_only=True)
class TurnoverParameters:
    """Tuning of the turnover; params/supervisor.yaml gives the reasons."""

    lost_lift: float = parameter(
        0.3, doc='lost lift of a turn to level, in hover thrusts of one rotor, above which a '
        'joint turns over first', unit='s', low=0, high=100)
    room: float = parameter(
        0.3, doc='smallest distance of the other tilts from their stops meanwhile', unit='rad',
        low=0, high=0.8)
    farthest: float = parameter(
        1.3, doc='largest turn to the attitude in which the rotor is stopped', unit='rad', low=0,
        high=3.15)
    settling_time: float = parameter(
        0.5, doc='time in this attitude before the rotor stops', unit='s', low=0, high=10)
    fading_time: float = parameter(
        0.5, doc='duration of the decrease of its thrust to zero, and of the increase afterwards',
        unit='s', low=0.02, high=10)
    arrived: float = parameter(
        0.2, doc='distance from the target at which the joint has turned over', unit='rad',
        low=0.01, high=1)
    time_limit: float = parameter(4.0, doc='longest time for one joint', unit='s', low=0.5,
                                  high=60)


@dataclass(frozen=True)
class Turnover:
    """
    A planned turnover of a joint.

    Attributes:
        joint: index of the joint and its rotor.
        quaternion: (4,) attitude in which its rotor is off.
        tilt: angle at which the joint ends [rad].

    """

    joint: int
    quaternion: np.ndarray
    tilt: float

    def health(self, thrust: float = 0.0) -> ActuatorHealth:
        """Health of the actuators while the rotor gives ``thrust`` [N], or is off."""
        if thrust <= 0:
            return ActuatorHealth(rotors=tuple(i != self.joint for i in range(ROTORS)))
        return ActuatorHealth(held=tuple(thrust if i == self.joint else None
                                         for i in range(ROTORS)))


def find_turnover(quaternion: np.ndarray, tilt: np.ndarray, robot: RobotParameters,
                  allocator: Allocator, level: LevellingParameters,
                  p: TurnoverParameters) -> Turnover | None:
    """
    Find the first joint to turn over, so that no joint turns over under load on the way to level.

    Args:
        quaternion: (4,) present attitude, base_link to world, xyzw.
        tilt: (4,) present tilt angles [rad].
        robot: the robot.
        allocator: of the robot.
        level: of the levelling that follows.
        p: tuning.

    Returns:
        the first turnover, or None if none helps.

    """
    for joint in _wrong_joints(quaternion, tilt, allocator, level, p.lost_lift):
        found = _place(joint, quaternion, tilt, robot, allocator, p)
        if found is not None:
            return found
    return None


def _wrong_joints(quaternion, tilt, allocator, level, limit):
    """The smallest set of joints whose turnover gives a way to level without loss of lift."""
    turned = tilt - np.copysign(TURN, tilt)
    wound = np.flatnonzero(np.abs(turned) <= allocator.tilt_limit).tolist()
    sets = [joints for count in range(1, len(wound) + 1) for joints in combinations(wound, count)]
    if not sets:
        return ()
    tilts = np.array([np.where(np.isin(np.arange(ROTORS), joints), turned, tilt)
                      for joints in sets])
    lost = lost_lift(quaternion, tilts, allocator, level)
    good = [(len(joints), loss, joints) for joints, loss in zip(sets, lost.tolist())
            if loss <= limit]
    return min(good)[2] if good else ()


def _place(joint, quaternion, tilt, robot, allocator, p):
    """Nearest attitude that three rotors hold and where both joint angles are legal."""
    resting = Turnover(joint, quaternion, 0.0).health()
    holding = Holding(robot, resting)
    others = np.arange(ROTORS) != joint
    angles, _ = allocator.upright(holding.directions)
    healthy, three = (nearest_turn(one, tilt) for one in (angles, holding.tilts))
    limit = allocator.tilt_limit - p.room
    target = healthy[:, joint] - np.copysign(TURN, healthy[:, joint])
    fit = (np.abs(target) <= limit) & np.all(np.abs(healthy) <= limit, axis=1) \
        & np.all(np.abs(three[:, others]) <= limit, axis=1) \
        & np.all(np.abs(three - healthy)[:, others] <= np.pi / 2, axis=1)
    near = holding.directions @ up(quaternion) >= np.cos(p.farthest)
    best = np.argmax(np.where(fit & near, holding.margins, 0.0))
    if holding.margins[best] < holding.parameters.flying_margin or not (fit & near)[best]:
        return None
    return Turnover(joint, leaned(quaternion, holding.directions[best]), float(target[best]))
