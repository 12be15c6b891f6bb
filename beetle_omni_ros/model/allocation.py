"""
Allocation of a body wrench to thrusts and tilts.

In the rotor force components u = (f_1 cos q_1, f_1 sin q_1, ..., f_4 cos q_4, f_4 sin q_4) the
wrench is linear, w = B u with B (6, 8). The minimum-norm components are u = B^+ w. The thrust of
a rotor is the length of its component pair, and its tilt is the angle of the pair.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import atan2, copysign, cos, hypot, pi, sin
from typing import TYPE_CHECKING

import numpy as np

from beetle_omni_ros.model import rotations

if TYPE_CHECKING:       # imports CasADi, which the help of the command line does not need
    from beetle_omni_ros.model.parameters import RobotParameters

ROTORS = 4
NEGLIGIBLE = 1e-6   # of the hover thrust: below it the direction of a rotor is rounding noise
SINGULAR = 1e-6     # of the largest singular value: below it the rotors cannot push a direction
OVERLAP = 0.05      # [rad] beyond a stop, for which a joint at the stop does not turn to the other
                    # side: ten deviations of the tilts of a held pose under published noise
NO_ZEROS = (0.0,) * 4


@dataclass(frozen=True)
class ActuatorHealth:
    """State of the four rotors and four tilt servos."""

    rotors: tuple[bool, ...] = (True,) * 4      # False: without thrust
    stuck: tuple[float | None, ...] = (None,) * 4   # true angle [rad]; None: the joint moves
    held: tuple[float | None, ...] = (None,) * 4    # thrust that ignores the command [N]
    zeros: tuple[float, ...] = NO_ZEROS     # reading minus true tilt, estimated in flight [rad]
    thrust_limit: float | None = None       # that the pack allows, if below the robot's own [N]

    @cached_property
    def healthy(self) -> bool:
        """Whether every actuator follows commands; a wrong joint zero counts as healthy."""
        return all(self.rotors) and self.stuck == self.held == (None,) * 4 \
            and self.thrust_limit is None

    def same_actuators(self, other: ActuatorHealth) -> bool:
        """Whether the same actuators have failed; angles, thrusts, limit and zeros may differ."""
        return self.rotors == other.rotors and all(
            (a is None) == (b is None) for a, b in zip(
                (*self.stuck, *self.held, self.thrust_limit),
                (*other.stuck, *other.held, other.thrust_limit)))

    def limited(self, thrust: float) -> float:
        """Thrust [N] that the pack allows."""
        return thrust if self.thrust_limit is None else min(thrust, self.thrust_limit)

    def possible(self, tilt: np.ndarray, thrust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Tilts (4,) [rad] and thrusts (4,) [N] that the failed actuators and the pack allow.

        Stuck joints keep their angle, and lost rotors have no thrust.
        """
        angles = [own if angle is None else angle for own, angle in zip(tilt, self.stuck)]
        thrusts = [self.limited(own) if held is None else held
                   for own, held in zip(thrust, self.held)]
        return np.array(angles, dtype=float), np.where(self.rotors, thrusts, 0.0)

    def true(self, tilt: np.ndarray) -> np.ndarray:
        """True tilts (4,) for readings or joint targets [rad]."""
        return tilt if self.zeros == NO_ZEROS else tilt - np.array(self.zeros)

    def read(self, tilt: np.ndarray) -> np.ndarray:
        """Readings (4,) for true tilts [rad]; these are also the joint targets for them."""
        return tilt if self.zeros == NO_ZEROS else tilt + np.array(self.zeros)


ALL_HEALTHY = ActuatorHealth()


@dataclass(frozen=True)
class Allocation:
    """Actuator targets for one wrench, within their limits."""

    tilt: np.ndarray        # (4,) [rad]
    thrust: np.ndarray      # (4,) [N]


class Allocator:
    """
    Precomputed minimum-norm allocation of one robot.

    It includes the known effects of the robot file: mass, thrust and torque coefficients, wind.

    Attributes:
        matrix: (6, 8) map from the components u to (force, torque) in base_link.
        inverse: (8, 6) pseudo-inverse of ``matrix``.
        mass: [kg].
        weight: (3,) force in world that balances gravity and steady wind [N].
        axes: (4, 3) unit tilt axes in base_link.
        tilt_limit: travel of the joints to each side [rad].

    """

    def __init__(self, robot: RobotParameters):
        rotors, scale = robot.rotors, robot.thrust_scale
        self.mass = robot.effect('mass.mass', robot.mass)
        self.weight = np.array([0.0, 0.0, self.mass * robot.gravity]) \
            - robot.effect('wind.force', (0.0, 0.0, 0.0))
        self.matrix = np.zeros((6, 2 * ROTORS))
        up = np.array([0.0, 0.0, 1.0])
        for i, axis in enumerate(robot.tilt_axes):
            for column, direction in ((2 * i, up), (2 * i + 1, np.cross(axis, up))):
                torque = np.cross(rotors.positions[i], direction) \
                    - rotors.spin[i] * robot.torque_ratio * direction
                self.matrix[:, column] = scale[i] * np.concatenate([direction, torque])
        self.axes = robot.tilt_axes
        self.inverse = np.linalg.pinv(self.matrix, rcond=SINGULAR)
        self._by_force, self._by_torque = map(np.ascontiguousarray, (self.inverse[:, :3],
                                                                     self.inverse[:, 3:]))
        self._negligible = NEGLIGIBLE * robot.hover_thrust
        self._thrust_min, self._thrust_max = rotors.thrust_min, rotors.thrust_max
        self.tilt_limit = robot.joints.position_limit

    def wrench(self, tilt: np.ndarray, thrust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Force (3,) [N] and torque (3,) [N m] at base_link of tilts [rad] and thrusts [N]."""
        components = np.empty(2 * ROTORS)
        components[0::2] = thrust * np.cos(tilt)
        components[1::2] = thrust * np.sin(tilt)
        wrench = self.matrix.dot(components)
        return wrench[:3], wrench[3:]

    def allocate(self, force: np.ndarray, torque: np.ndarray,
                 present_tilt: np.ndarray) -> Allocation:
        """
        Minimum-norm thrusts and tilts for a force [N] and a torque [N m] in base_link.

        A tilt is on the legal turn nearest the present angle. A rotor with negligible thrust
        keeps that angle. A tilt that is less than OVERLAP beyond a stop becomes the stop:
        otherwise noise would turn the joint to the other side.
        """
        pairs = (self._by_force.dot(force) + self._by_torque.dot(torque)).tolist()
        tilt, thrust = [], []
        for along, across, present in zip(pairs[0::2], pairs[1::2],
                                          np.asarray(present_tilt, dtype=float).tolist()):
            length = hypot(along, across)
            if length <= self._negligible:
                angle = self._inside(present)
                length = max(0.0, along * cos(angle) + across * sin(angle))
            else:
                angle = self._nearest_turn(atan2(across, along), present)
            tilt.append(angle)
            thrust.append(min(max(length, self._thrust_min), self._thrust_max))
        return Allocation(np.array(tilt), np.array(thrust))

    def hover(self, quaternion: np.ndarray, present_tilt: np.ndarray,
              extra_force_world: np.ndarray | None = None,
              extra_torque_body: np.ndarray | None = None) -> Allocation:
        """
        Allocate the wrench that holds the robot at rest at an attitude (4,), body to world.

        Forces (3,) in world [N] and torques (3,) in base_link [N m] are added to it.
        """
        force = self.weight if extra_force_world is None else self.weight + extra_force_world
        torque = np.zeros(3) if extra_torque_body is None else extra_torque_body
        return self.allocate(force.dot(rotations.matrix(quaternion)), torque, present_tilt)

    def upright(self, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Tilts (P, 4) within +-pi [rad] and thrusts (P, 4) [N] of hovering, without limits.

        ``up`` (P, 3) is the world z axis in base_link.
        """
        components = (np.linalg.norm(self.weight) * up) @ self.inverse[:, :3].T
        along, across = components[:, 0::2], components[:, 1::2]
        return np.arctan2(across, along), np.hypot(along, across)

    def _nearest_turn(self, angle, present):
        """Angle + 2 pi k nearest ``present`` inside the travel."""
        turned = angle + 2 * pi * round((present - angle) / (2 * pi))
        if abs(turned) > self.tilt_limit + OVERLAP:
            other = turned - copysign(2 * pi, turned)
            if abs(other) <= self.tilt_limit:
                return other
            turned = min(turned, other, key=abs)
        return self._inside(turned)

    def _inside(self, angle):
        limit = self.tilt_limit
        return angle if abs(angle) <= limit else copysign(limit, angle)


def nearest_turn(angle: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Angles + 2 pi k nearest the present ones [rad], without regard to stops."""
    return angle + 2 * np.pi * np.round((present - angle) / (2 * np.pi))


def clipped(values: np.ndarray, low: np.ndarray | float, high: np.ndarray | float) -> np.ndarray:
    """As np.clip, which takes three times as long for a few numbers."""
    return np.minimum(np.maximum(values, low), high)
