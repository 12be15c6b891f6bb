"""From a target to the NMPC's reference over its horizon."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.control.ocp import REFERENCE_SIZE
from beetle_omni_ros.robot import dynamics as model
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.robot.parameters import RobotParameters

DIFFERENCE_STEP = 1e-3  # [s] for the reference's acceleration


class ReferencePlanner:
    """
    Poses, rates, tilts and thrusts over the horizon.

    Tilts and thrusts are what holds the target pose (or follows the trajectory) with the
    estimated disturbances cancelled, each tilt on the legal turn nearest the present angle.

    Args:
        robot: what the controller believes.
        times: (N + 1,) node times from the horizon's start [s].
        nearest_turn: whether tilts are unwound towards the present ones.

    """

    def __init__(self, robot: RobotParameters, times: np.ndarray, nearest_turn: bool):
        """See the class."""
        self._robot, self._times, self._nearest = robot, times, nearest_turn
        self._allocator = Allocator(robot)
        self._inertia = np.asarray(robot.inertia)

    def plan(self, target: Target, start: float, tilt: np.ndarray,
             disturbance: np.ndarray) -> np.ndarray:
        """
        Reference (N + 1, 21): position, velocity, quaternion, rates, tilts, thrusts.

        Args:
            target: pose or trajectory.
            start: time of the horizon's first node [s].
            tilt: (4,) present tilts [rad].
            disturbance: (10,) as in :mod:`robot.dynamics`.

        """
        references = np.zeros((len(self._times), REFERENCE_SIZE))
        if isinstance(target, PoseTarget):
            references[:] = self._node(target.at(start), np.zeros(3), np.zeros(3), tilt,
                                       disturbance)
            return references
        for k, time in enumerate(start + self._times):
            sample, ahead = target.at(time), target.at(time + DIFFERENCE_STEP)
            acceleration = (ahead.velocity - sample.velocity) / DIFFERENCE_STEP
            angular = (ahead.angular_velocity - sample.angular_velocity) / DIFFERENCE_STEP
            references[k] = self._node(sample, acceleration, angular, tilt, disturbance)
            tilt = references[k, 13:17]
        return references

    def _node(self, sample, acceleration, angular_acceleration, tilt, disturbance):
        rate = sample.angular_velocity
        torque = self._inertia * angular_acceleration \
            + np.cross(rate, self._inertia * rate) - disturbance[model.TORQUE]
        allocation = self._allocator.hover(
            sample.quaternion, tilt if self._nearest else np.zeros(4),
            self._allocator.mass * acceleration - disturbance[model.FORCE], torque)
        return np.concatenate([sample.position, sample.velocity,
                               rotations.normalized(sample.quaternion), rate, allocation.tilt,
                               allocation.thrust])
