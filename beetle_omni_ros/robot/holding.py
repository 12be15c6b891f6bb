"""
Attitudes that a robot with failed actuators can hold, and the margin of each.

Whether an attitude can be held depends on the direction of up in the body, not on heading. For a
grid of directions the allocation of the weight gives tilts and thrusts. About these the
accelerations [m/s^2, rad/s^2] are linear in small changes of tilt and thrust,

    (a, alpha) = J (thrust change / thrust reach, tilt change / tilt reach).

The reach of a thrust is its distance from zero or from its limit. The reach of a tilt is the
travel of its servo within the reach time. The margin is the radius of the largest ball of
accelerations for which the minimum-norm change stays within every reach:
1 / max_i |row i of J^+|. It is zero if the weight cannot be held, or if one of the six directions
cannot be pushed. An example is level flight with a lost rotor: the opposite rotor has no thrust,
so that its tilt has no effect.
"""

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.actuator_health import ActuatorHealth
from beetle_omni_ros.robot.allocation import nearest_turn
from beetle_omni_ros.robot.degraded_allocation import DegradedAllocator, RESIDUAL
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import parameter, ParameterFile

PATH_POINTS = 9         # evaluated points of the path to level, 22 deg apart at most
BISECTIONS = 5          # towards a desired attitude: 6 deg / 2^5
LITTLE = 1.0            # [N] a rotor with less may turn its joint later
NEARLY = 0.8            # [-] fraction of the largest margin, if none is large enough
GOLDEN = np.pi * (1 + np.sqrt(5))


@dataclass(frozen=True, kw_only=True)
class HoldingParameters(ParameterFile, file='degraded.yaml'):
    """Selection of attitudes; params/degraded.yaml gives the reasons."""

    reach_time: float = parameter(0.1, doc='time within which actuators must act', unit='s',
                                  low=0.01, high=1)
    tilt_rate_share: float = parameter(
        0.7, doc='rate of the servos under load, as a share of their velocity limit', low=0.01,
        high=1)
    directions: int = parameter(1000, doc='number of compared directions of gravity in the body',
                                low=50, high=10000)
    flying_margin: float = parameter(2.0, doc='required margin of the attitude for flight',
                                     unit='m/s^2, rad/s^2', low=0, high=20)
    turn_rate: float = parameter(6.0, doc='rate of turns of the body', unit='rad/s', low=0.1,
                                 high=50)
    coast_time: float = parameter(
        0.1, doc='time by which the rate is multiplied to give the angle in which a turn stops',
        unit='s', low=0, high=1)
    escape_time: float = parameter(
        1.5, doc='time for which the attitude of an escape is held before a landing turns the '
        'body further', unit='s', low=0.01, high=20)


class Holding:
    """
    Table of the attitudes that a robot can hold.

    Args:
        robot: parameters of the robot.
        health: state of the actuators.
        parameters: selection of attitudes, by default params/degraded.yaml.

    Attributes:
        directions: (N, 3) unit vectors, up in base_link.
        margins: (N,) margin of each direction [m/s^2, rad/s^2], 0 if it cannot be held.
        tilts: (N, 4) tilts that hold each direction, within +-pi [rad].

    """

    def __init__(self, robot: RobotParameters, health: ActuatorHealth,
                 parameters: HoldingParameters | None = None):
        """Compute the table in about 10 ms."""
        self.parameters = parameters or HoldingParameters.load()
        self._robot, self._health = robot, health
        self._tilt_rate = self.parameters.tilt_rate_share * robot.joints.velocity_limit
        self._allocator = DegradedAllocator(robot, health)
        self._scale = 1 / np.r_[np.full(3, self._allocator.mass), robot.inertia]
        self._thrust_max = health.limited(robot.rotors.thrust_max)
        self.directions = sphere(self.parameters.directions)
        self.tilts, self._thrusts, met = self._held(self.directions)
        self.margins = self._margins(self.tilts, self._thrusts, met)

    def margin(self, quaternion: np.ndarray) -> float:
        """Margin of one attitude (4,) [m/s^2, rad/s^2], 0 if it cannot be held."""
        return float(self._margins(*self._held(up(quaternion)[None]))[0])

    def nearest(self, quaternion: np.ndarray, margin: float) -> np.ndarray:
        """
        Nearest attitude with a margin.

        Args:
            quaternion: (4,) desired attitude.
            margin: required margin [m/s^2, rad/s^2]; if no attitude has it, 80 % of the largest.

        Returns:
            (4,) quaternion: the desired attitude, turned about a horizontal axis.

        """
        margin = self._attainable(margin)
        if self.margin(quaternion) >= margin:
            return rotations.normalized(quaternion)
        desired = up(quaternion)
        firm = np.flatnonzero(self.margins >= margin)
        best = firm[np.argmax(self.directions[firm] @ desired)]
        turn = leaned(quaternion, self.directions[best])
        whole = rotations.log(rotations.multiply(rotations.conjugate(quaternion), turn))
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            between = rotations.multiply(quaternion, rotations.exp(middle * whole))
            low, high = (low, middle) if self.margin(between) >= margin else (middle, high)
        return rotations.normalized(rotations.multiply(quaternion, rotations.exp(high * whole)))

    def quickest(self, quaternion: np.ndarray, angular_velocity: np.ndarray, tilt: np.ndarray,
                 margin: float, levelling_rate: float) -> np.ndarray:
        """
        Attitude with a margin that body and joints reach soonest.

        The unheld part of the path from there to level adds to the time.

        Args:
            quaternion: (4,) present attitude.
            angular_velocity: (3,) in base_link [rad/s]; includes the turn until the body stops.
            tilt: (4,) present [rad].
            margin: as of :meth:`nearest`.
            levelling_rate: rate of the later turn to level [rad/s].

        Returns:
            (4,) quaternion: attitude at which the present turn stops, leaned.

        """
        p = self.parameters
        quaternion = rotations.multiply(quaternion,
                                        rotations.exp(p.coast_time * angular_velocity))
        firm = np.flatnonzero(self.margins >= self._attainable(margin))
        angle = np.arccos(np.clip(self.directions[firm] @ up(quaternion), -1.0, 1.0))
        travel = np.abs(self._on_nearest_turn(self.tilts[firm], tilt) - tilt)
        travel[self._thrusts[firm] < LITTLE] = 0.0
        time = angle / p.turn_rate + travel.max(axis=1) / self._tilt_rate \
            + self._unheld_angle(self.directions[firm]) / levelling_rate
        return leaned(quaternion, self.directions[firm[np.argmin(time)]])

    def unheld_angle(self, quaternion: np.ndarray) -> float:
        """Part of the turn from an attitude (4,) to level that cannot be held [rad]."""
        return float(self._unheld_angle(up(quaternion)[None])[0])

    def _attainable(self, margin):
        """Limit a margin [m/s^2, rad/s^2] to 80 % of the largest one."""
        return min(margin, NEARLY * float(self.margins.max()))

    def _unheld_angle(self, directions):
        """Unheld part (N,) [rad] of the shortest paths from directions of up (N, 3) to level."""
        angle = np.arccos(np.clip(directions[:, 2], -1.0, 1.0))
        side = directions[:, :2] / np.maximum(np.linalg.norm(directions[:, :2], axis=1), 1e-9)[
            :, None]
        passed = angle[:, None] * np.linspace(0.0, 1.0, PATH_POINTS)
        path = np.concatenate([np.sin(passed)[:, :, None] * side[:, None],
                               np.cos(passed)[:, :, None]], axis=2).reshape(-1, 3)
        nearest = np.argmax(path @ self.directions.T, axis=1)
        return angle * (self.margins[nearest] <= 0.0).reshape(passed.shape).mean(axis=1)

    def _on_nearest_turn(self, tilt, present):
        """Tilts (N, 4) on the legal turn nearest the present ones (4,)."""
        limit = self._robot.joints.position_limit
        turned = nearest_turn(tilt, present)
        return np.where(np.abs(turned) > limit, turned - 2 * np.pi * np.sign(turned), turned)

    def _margins(self, tilt, thrust, met):
        jacobian = self._jacobian(tilt, thrust)
        squared = jacobian @ jacobian.transpose(0, 2, 1) + 1e-9 * np.eye(6)
        needed = jacobian.transpose(0, 2, 1) @ np.linalg.inv(squared)
        margins = 1 / np.maximum(np.linalg.norm(needed, axis=2).max(axis=1), 1e-6)
        return np.where(met & (thrust.max(axis=1) <= self._thrust_max), margins, 0.0)

    def _held(self, directions):
        """Tilts (N, 4), thrusts (N, 4) that hold the weight, and whether they meet it (N,)."""
        weight = np.linalg.norm(self._allocator.weight)
        wrenches = np.pad(weight * directions, ((0, 0), (0, 3)))
        pairs, cost = np.zeros((len(directions), 8)), np.full(len(directions), np.inf)
        rest = cost.copy()
        for choice in self._allocator.choices:
            columns, tried = choice[0], self._allocator.components(*choice, wrenches)
            error = np.linalg.norm((tried @ columns.T - wrenches) * self._scale, axis=1)
            pushing = np.all([tried[:, 2 * i] > -RESIDUAL for i in self._allocator.stuck]
                             or [np.full(len(directions), True)], axis=0)
            norm = np.linalg.norm(tried, axis=1) + 1e6 * (error > RESIDUAL)
            better = pushing & (norm < cost)
            pairs[better], cost[better], rest[better] = tried[better], norm[better], error[better]
        tilt = np.arctan2(pairs[:, 1::2], pairs[:, 0::2])
        thrust = np.hypot(pairs[:, 0::2], pairs[:, 1::2])
        for i, angle in enumerate(self._health.stuck):
            if angle is not None:
                tilt[:, i] = angle
        return tilt, thrust, rest <= RESIDUAL

    def _jacobian(self, tilt, thrust):
        """(N, 6, 8) accelerations for each actuator going to the end of its reach."""
        matrix, p = self._scale[:, None] * self._allocator.matrix, self.parameters
        up_part, side_part = matrix[:, 0::2], matrix[:, 1::2]
        cos, sin = np.cos(tilt)[:, None], np.sin(tilt)[:, None]
        room = np.minimum(thrust, self._thrust_max - thrust).clip(0)
        room[:, list(self._allocator.held)] = 0.0
        swing = thrust * min(self._tilt_rate * p.reach_time, 1.0) \
            * [float(angle is None) for angle in self._health.stuck]
        return np.concatenate([(up_part * cos + side_part * sin) * room[:, None],
                               (side_part * cos - up_part * sin) * swing[:, None]], axis=2)


def sphere(count: int) -> np.ndarray:
    """(count, 3) unit vectors spread evenly: a Fibonacci lattice (Gonzalez 2010)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(GOLDEN * k), radius * np.sin(GOLDEN * k), z], axis=1)


def up(quaternion: np.ndarray) -> np.ndarray:
    """(3,) world z axis in the body, for a quaternion of any length."""
    return rotations.up(rotations.normalized(quaternion))


def leaned(quaternion: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Attitude (4,) by the shortest turn from ``quaternion`` with up at ``direction`` (3,)."""
    present = up(quaternion)
    axis = np.cross(direction, present)
    length = float(np.linalg.norm(axis))
    angle = float(np.arctan2(length, present @ direction))
    if length < 1e-9:
        axis, length = np.cross(present, np.eye(3)[np.argmin(np.abs(present))]), 1.0
    axis = axis / np.linalg.norm(axis)
    return rotations.normalized(rotations.multiply(quaternion, rotations.exp(angle * axis)))
