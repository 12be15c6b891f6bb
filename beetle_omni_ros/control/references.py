"""From a target to the NMPC's reference over its horizon."""

import casadi as ca
import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target, TrajectoryTarget
from beetle_omni_ros.control.ocp import REFERENCE_SIZE
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ActuatorHealth, Allocator
from beetle_omni_ros.model.degraded import allocator
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters

DIFFERENCE_STEP = 1e-3  # [s] for the reference's acceleration
HALF_TURN = 0.5         # [rad] from half a turn of a joint, where errors decide its direction:
                        # 0.1 of the encoder, 0.2 to 0.3 of a joint not yet at rest
TILT, THRUST, TILT_LEAD, THRUST_LEAD = (slice(13, 17), slice(17, 21), slice(21, 25),
                                        slice(25, 29))


class ReferencePlanner:
    """
    Poses, rates, tilts and thrusts over the horizon.

    Tilts and thrusts hold the target pose (or follow the trajectory) and cancel the estimated
    disturbances. A moving command that is held over an interval h must lead: a first-order lag
    reaches the next node's value if the command exceeds the first value by the
    change / (1 - exp(-h / lag)).

    Args:
        robot: the controller's model of the robot.
        times: (N + 1,) node times from the horizon's start [s].
        unwind: largest extra travel [rad] for which a tilt is chosen within +-pi.
        servo_lag: time constant of the servos [s].

    """

    def __init__(self, robot: RobotParameters, times: np.ndarray, unwind: float,
                 servo_lag: float):
        self._times, self._unwind, self._robot = times, unwind, robot
        self._allocator = Allocator(robot)
        self._movable = np.ones(4, dtype=bool)
        self._effects = effect_wrench(robot, self._allocator, len(times))
        # force and torque of the effects at each node, of the plan before
        self._beside = np.zeros((2, len(times), 3))
        self._turned_to: PoseTarget | None = None
        self._towards: np.ndarray | None = None     # tilts in the middle of a half turn
        length = np.diff(times)[:, None]
        self._tilt_lead = 1 / -np.expm1(-length / servo_lag)
        self._thrust_lead = 1 / -np.expm1(-length / robot.rotors.time_constant)

    def set_health(self, health: ActuatorHealth) -> None:
        """Allocate with the working actuators from now on; a stuck joint keeps its angle."""
        self._allocator = allocator(self._robot, health)
        self._movable = np.array([angle is None for angle in health.stuck])

    def plan(self, target: Target, start: float, quaternion: np.ndarray, tilt: np.ndarray,
             disturbance: np.ndarray) -> np.ndarray:
        """
        Reference (N + 1, 29): position, velocity, quaternion, rates, tilts, thrusts, leads.

        From the time ``start`` [s], the present attitude (4,) and tilts (4,) [rad], and the
        estimated disturbance (10,) of :mod:`robot.dynamics`.
        """
        references = np.zeros((len(self._times), REFERENCE_SIZE))
        if isinstance(target, PoseTarget):
            force, torque = self._beside[:, 0]
            allocation = self._allocator.hover(target.quaternion, tilt,
                                               -disturbance[model.FORCE] - force,
                                               -disturbance[model.TORQUE] - torque)
            references[:, 0:3] = target.position
            references[:, 6:10] = rotations.normalized(target.quaternion)
            references[:, TILT] = self._turned(target, self._unwound(allocation.tilt, tilt),
                                               quaternion, tilt)
            references[:, THRUST] = allocation.thrust
        else:
            self._follow(target, start + self._times, tilt, disturbance, references)
        if self._effects is not None:
            columns = references.T
            self._beside = np.stack([np.array(part).T for part in self._effects(
                columns[:13], columns[TILT], columns[THRUST])])
        return references

    def _turned(self, target, tilt, quaternion, present):
        """Joints that have half a turn to go turn with the body, in directions chosen once."""
        # Otherwise errors decide the direction of each joint. Joints that turn against each other
        # cost up to a metre of height.
        if self._turned_to is None or not target.same_pose(self._turned_to):
            self._turned_to, self._towards = target, None
            tied = np.abs(np.abs(tilt - present) - np.pi) < HALF_TURN
            if tied.any():
                turn = rotations.log(rotations.multiply(
                    rotations.conjugate(quaternion), target.quaternion))
                half = rotations.multiply(quaternion, rotations.exp(0.5 * turn))
                self._towards = np.where(tied, self._allocator.hover(half, present).tilt, np.nan)
        if self._towards is None:
            return tilt
        other = tilt - 2 * np.pi * np.sign(tilt)
        nearer = np.abs(other - self._towards) < np.abs(tilt - self._towards)
        legal = np.abs(other) <= self._robot.joints.position_limit
        return np.where(nearer & legal & self._movable, other, tilt)

    def _unwound(self, tilt, present):
        """Choose the tilts within +-pi unless the joint would have to travel much farther."""
        # A joint near its stop would have to turn far for the next pose: the robot would fall.
        if max(map(abs, tilt.tolist())) <= np.pi:
            return tilt
        other = tilt - 2 * np.pi * np.sign(tilt)
        detour = np.abs(other - present) - np.abs(tilt - present)
        better = (np.abs(tilt) > np.pi) & (detour < self._unwind) & self._movable
        return np.where(better, other, tilt)

    def _follow(self, target: TrajectoryTarget, times, present, disturbance, references):
        now, ahead = target.sample(times), target.sample(times + DIFFERENCE_STEP)
        rate = now.angular_velocity
        acceleration = (ahead.velocity - now.velocity) / DIFFERENCE_STEP
        angular_acceleration = (ahead.angular_velocity - rate) / DIFFERENCE_STEP
        force = self._allocator.mass * acceleration - disturbance[model.FORCE] - self._beside[0]
        inertia = self._robot.inertia
        torque = inertia * angular_acceleration + np.cross(rate, inertia * rate) \
            - disturbance[model.TORQUE] - self._beside[1]
        references[:, 0:3], references[:, 3:6] = now.position, now.velocity
        references[:, 6:10], references[:, 10:13] = now.quaternion, rate
        for k, quaternion in enumerate(now.quaternion):
            allocation = self._allocator.hover(quaternion, present, force[k], torque[k])
            references[k, TILT] = self._unwound(allocation.tilt, present)
            references[k, THRUST] = allocation.thrust
            present = references[k, TILT]
        references[:-1, TILT_LEAD] = self._tilt_lead * np.diff(references[:, TILT], axis=0)
        references[:-1, THRUST_LEAD] = self._thrust_lead * np.diff(references[:, THRUST], axis=0)


def effect_wrench(robot: RobotParameters, allocator: Allocator, nodes: int) -> ca.Function | None:
    """
    Model less allocation, without which the plan would have a steady error.

    Returns:
        (pose with velocity, tilt, thrust) -> force in world [N] and torque in base_link [N m],
        each with a column for a node; None if the allocation has all effects of the robot file.

    """
    if all(CATALOGUE[name].apply is None or CATALOGUE[name].allocated for name in robot.effects):
        return None
    pose, tilt, thrust = ca.SX.sym('pose', 13), ca.SX.sym('tilt', 4), ca.SX.sym('thrust', 4)
    velocity, quaternion, rate = pose[3:6], pose[6:10], pose[10:13]
    acceleration, angular = model.rigid_body(robot, velocity, quaternion, rate, tilt, thrust,
                                             position=pose[0:3])
    components = ca.vertcat(*[part for i in range(4) for part in (
        thrust[i] * ca.cos(tilt[i]), thrust[i] * ca.sin(tilt[i]))])
    wrench = ca.DM(allocator.matrix) @ components
    inertia = ca.DM(robot.inertia)
    force = allocator.mass * acceleration + ca.DM(allocator.weight) \
        - model.rotation_matrix(quaternion) @ wrench[:3]
    torque = inertia * angular + ca.cross(rate, inertia * rate) - wrench[3:]
    return ca.Function('effect_wrench', [pose, tilt, thrust], [force, torque]).map(nodes)
