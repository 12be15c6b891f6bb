"""
Hover: PD on the pose with a disturbance observer, then allocation; the supervisor's fallback.

    acceleration = Kp e_p + Kd e_v - d           (world)
    angular acceleration = Kp e_R + Kd e_w - d   (base_link)

with d the low-passed acceleration that the commands do not explain: a wrong mass, wind. It does
not depend on errors or targets, and is valid when this controller takes over from another. A rotor
whose joint is still turning gives only the thrust that is useful in its present direction.
"""

from dataclasses import dataclass
from math import exp, expm1, inf
from typing import Any

import numpy as np

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ActuatorHealth, ALL_HEALTHY, clipped, nearest_turn
from beetle_omni_ros.model.degraded import allocator, bounded_step, DegradedAllocator
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.rotations import shortened
from beetle_omni_ros.model.schema import parameter, ParameterFile

LONGEST_STEP = 0.1   # [s] between two states from which an acceleration is computed
PAUSE = 0.05         # [s] between two steps, after which the first is as long as one period
DAMPING = 1e-2   # [(1/kg)^2] keeps the thrusts near the plain projection where directions agree
DISTURBANCE_TIME = 0.3  # [s] of the observer: slower than the loop (0.1 s), faster than levelling
THRUST_RESPONSE = 0.04  # [s] time constant of the thrust with the lead
THRUST_RATE = 300.0     # [N/s] 3 N a period: no step at a take-over
TILT_RATE_SHARE = 0.9   # of the servos' velocity limit, so that they can follow
FULL_THRUST = 1.0       # [N] below it a joint turns more slowly: its direction is mostly noise
STOP_OVERLAP = 0.3      # [rad] beside the stop: the rotor keeps 95 % of its useful thrust
FAR = 0.6               # [rad] from its goal a joint needs 0.1 s: the wrench is not met meanwhile
# Errors and rate errors of position [m], [m/s] and attitude [rad], [rad/s] are shortened to these.
POSITION_LIMITS, ATTITUDE_LIMITS = (0.6, 3.0), (0.6, 6.0)
# Largest compensated acceleration [m/s^2] and angular acceleration [rad/s^2]: 2 N m, the hover
# thrust of one rotor on its arm. With 8 a robot with a propeller of 70 % landed tilted by 24 deg.
COMPENSATED = 4.0, 33.0


@dataclass(frozen=True, kw_only=True)
class HoverParameters(ParameterFile, file='hover.yaml'):
    """Gains as accelerations, so that they are valid for any mass and inertia."""

    position_kp: float = parameter(6.0, doc='acceleration for a position error', unit='1/s^2',
                                   low=0, high=100)
    position_kd: float = parameter(4.5, doc='acceleration for a velocity error', unit='1/s',
                                   low=0, high=50)
    attitude_kp: float = parameter(10.0, doc='angular acceleration for an attitude error',
                                   unit='1/s^2', low=0, high=100)
    attitude_kd: float = parameter(5.5, doc='angular acceleration for a rate error', unit='1/s',
                                   low=0, high=50)


class HoverController:
    """Holds a pose, from any attitude: translation and rotation do not couple on this robot."""

    name, Parameters = 'hover', HoverParameters
    period = 0.01   # [s]

    def __init__(self, robot: RobotParameters, parameters: HoverParameters | None = None):
        self.parameters = parameters or HoverParameters.load()
        self._robot = robot
        self.set_health(ALL_HEALTHY)
        self.reset()

    def set_health(self, health: ActuatorHealth) -> None:
        """Use only working actuators from the next step on; may be called in flight."""
        self._health = health
        self._allocator = allocator(self._robot, health)
        self._thrust_max = health.limited(self._robot.rotors.thrust_max)
        self._scaled = self._allocator.matrix / np.concatenate(
            [np.full(3, self._allocator.mass), self._robot.inertia])[:, None]
        arm = np.linalg.norm(self._robot.rotors.positions[0])
        self._arms = np.repeat([1.0, arm], 3)[:, None]

    def reset(self) -> None:
        """Reset disturbances and thrust model; the next step starts from state.command."""
        self._before: State | None = None
        self._disturbance = np.zeros(6)     # acceleration in world, angular in base_link
        self._command: Command | None = None
        self._thrust = np.zeros(4)          # modelled [N]

    def step(self, state: State, target: Any) -> Command:
        """One command for one state, at any rate; a repeated stamp repeats the command."""
        last = self._command
        if last is not None and state.stamp <= last.stamp:
            return last
        dt = self.period if last is None else state.stamp - last.stamp
        if dt > PAUSE:      # another controller flew: one period from its command
            dt = self.period
        in_force = state.command
        self.observe(state)
        force, torque = self._wrench(state, target)
        present = in_force.tilt if in_force is not None else state.tilt
        if isinstance(self._allocator, DegradedAllocator):
            goal = self._near(self._allocator, state, target, present, force, torque)
            tilt = goal.tilt
        else:
            goal = self._allocator.hover(state.quaternion, present, force, torque)
            tilt = self._waiting_at_stops(goal.tilt, state.quaternion, present)
        self._command = Command(state.stamp, *self._targets(state, goal, tilt, present, dt))
        return self._command

    def observe(self, state: State, free: bool = True) -> None:
        """
        Update the disturbance with one state; :meth:`step` does the same.

        It does not change while something else carries the robot, which is not ``free``.
        """
        before = self._before
        if before is not None and state.stamp <= before.stamp:
            return
        self._before = state
        if before is None or state.stamp - before.stamp > LONGEST_STEP:
            self._follow_thrust(state.command, inf if before is None else self.period)
            return
        dt = state.stamp - before.stamp
        self._follow_thrust(state.command, dt)
        if not free or state.command is None:
            return
        force, torque = self._allocator.wrench(state.tilt, self._thrust)
        rate, inertia = state.angular_velocity, self._robot.inertia
        gain = -expm1(-dt / DISTURBANCE_TIME)
        mass, weight = self._allocator.mass, self._allocator.weight.tolist()
        # plain floats, because each numpy operation takes longer than these together
        (x, y, z), (i, j, k), (a, b, c) = rate.tolist(), inertia.tolist(), torque.tolist()
        modelled = [(own - other) / mass for own, other in zip(
            rotations.matrix(state.quaternion).dot(force).tolist(), weight)]
        modelled += [(a - (y * (k * z) - z * (j * y))) / i, (b - (z * (i * x) - x * (k * z))) / j,
                     (c - (x * (j * y) - y * (i * x))) / k]
        changes = (state.velocity - before.velocity).tolist() \
            + (rate - before.angular_velocity).tolist()
        old = self._disturbance
        new = np.array([part + gain * (change / dt - model - part) for part, change, model in zip(
            old.tolist(), changes, modelled)])
        old[:3] = shortened(new[:3], COMPENSATED[0])
        old[3:] = shortened(new[3:], COMPENSATED[1])

    def _waiting_at_stops(self, goal, quaternion, present):
        """Tilt goals (4,) [rad]: a stop instead of a full turn that only a transient needs."""
        over = np.abs(goal - present) > np.pi       # the nearest turn is beyond the stop
        if not over.any():
            return goal
        steady = nearest_turn(self._allocator.hover(quaternion, present).tilt, present)
        limit = self._allocator.tilt_limit
        # From farther away it would turn back and forth while the attitude changes.
        near = np.abs(present) >= limit - STOP_OVERLAP
        waits = over & near & (np.abs(steady) <= limit + STOP_OVERLAP)
        return np.where(waits, np.copysign(limit, present), goal)

    def _near(self, degraded: DegradedAllocator, state, target, present, force, torque):
        """Allocation near the present tilts, towards tilts that hold a nearby attitude."""
        turn = rotations.log(rotations.multiply(rotations.conjugate(state.quaternion),
                                                target.at(state.stamp).quaternion))
        ahead = rotations.exp(shortened(turn, ATTITUDE_LIMITS[0]))
        aim = degraded.hover(rotations.multiply(state.quaternion, ahead), present)
        force = (degraded.weight + force) @ rotations.matrix(state.quaternion)
        return degraded.allocate_near(force, torque, present, aim)

    def _wrench(self, state, target):
        """Force without the support of the weight (world) and torque (base_link)."""
        reference = target.at(state.stamp)
        to_body = rotations.conjugate(state.quaternion)
        attitude_error = rotations.log(rotations.multiply(to_body, reference.quaternion))
        relative = rotations.matrix(rotations.multiply(to_body, reference.quaternion))
        p = self.parameters
        rate_error = relative @ reference.angular_velocity - state.angular_velocity
        acceleration = \
            p.position_kp * shortened(reference.position - state.position, POSITION_LIMITS[0]) \
            + p.position_kd * shortened(reference.velocity - state.velocity, POSITION_LIMITS[1]) \
            - self._disturbance[:3]
        angular = p.attitude_kp * shortened(attitude_error, ATTITUDE_LIMITS[0]) \
            + p.attitude_kd * shortened(rate_error, ATTITUDE_LIMITS[1]) - self._disturbance[3:]
        inertia, rate = self._robot.inertia, state.angular_velocity
        gyroscopic = rotations.cross(rate, inertia * rate)
        return self._allocator.mass * acceleration, inertia * angular + gyroscopic

    def _follow_thrust(self, in_force, dt):
        """First-order model of the thrusts at ``dt`` after a command."""
        if in_force is None:
            self._thrust = np.zeros(4)
        else:
            keep = exp(-dt / self._robot.rotors.time_constant)
            self._thrust = in_force.thrust + keep * (self._thrust - in_force.thrust)
        if not self._health.healthy:
            self._thrust = self._health.possible(self._thrust, self._thrust)[1]

    def _targets(self, state, goal, goal_tilt, present, dt):
        """Tilt and thrust targets after rate limits, projection and lead."""
        rotors = self._robot.rotors
        busy = np.minimum(1.0, goal.thrust / FULL_THRUST) if self._health.healthy else np.ones(4)
        joints = self._robot.joints
        limit = joints.position_limit
        reach = TILT_RATE_SHARE * joints.velocity_limit * dt * busy
        tilt = clipped(present + clipped(goal_tilt - present, -reach, reach), -limit, limit)
        thrust = self._thrust_on_the_way(goal, state.tilt)
        lead = rotors.time_constant / THRUST_RESPONSE
        thrust = self._thrust + max(lead, 1.0) * (thrust - self._thrust)
        if state.command is not None:
            reach = THRUST_RATE * dt
            thrust = clipped(thrust, state.command.thrust - reach, state.command.thrust + reach)
        thrust = clipped(thrust, rotors.thrust_min, self._thrust_max)
        return (tilt, thrust) if self._health.healthy else self._health.possible(tilt, thrust)

    def _thrust_on_the_way(self, goal, tilt):
        """Thrusts along the present rotor directions that are nearest to the desired wrench."""
        # Least squares of accelerations: a rotor that points in a wrong direction is throttled,
        # and also the rotors whose torque it should balance. If a joint is far from its goal, the
        # wrench cannot be met. An angular acceleration then counts as that of a rotor: otherwise
        # all rotors would stop for the sake of the torque.
        rotors, matrix = self._robot.rotors, self._scaled
        if np.abs(goal.tilt - tilt).max() > FAR:
            matrix = matrix * self._arms
        now = matrix[:, 0::2] * np.cos(tilt) + matrix[:, 1::2] * np.sin(tilt)
        wrench = matrix[:, 0::2] @ (goal.thrust * np.cos(goal.tilt)) \
            + matrix[:, 1::2] @ (goal.thrust * np.sin(goal.tilt))
        helpful = goal.thrust * np.maximum(0.0, np.cos(goal.tilt - tilt))
        low, high = np.full(4, rotors.thrust_min), np.full(4, self._thrust_max)
        for i, held in enumerate(self._health.held):
            if held is not None:
                low[i] = high[i] = held
        return bounded_step(now, wrench, np.full(4, DAMPING), helpful, low, high)
