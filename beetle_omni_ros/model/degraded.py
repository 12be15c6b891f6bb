"""
Allocation for a robot with failed actuators, and the attitudes that it can hold.

A lost rotor has no column in the wrench map. A rotor with a stuck joint has one, and a thrust that
cannot be negative. A rotor with a fixed thrust pushes along its minimum-norm share. A rotor beyond
its limit is fixed there, and the others are solved again for the remaining wrench (active set).

The margin of an attitude is the radius of the largest ball of accelerations [m/s^2, rad/s^2] about
rest for which the minimum-norm change of thrusts and tilts stays within the reach of every
actuator: 1 / max_i |row i of J^+| with (a, alpha) = J (change / reach). The reach of a thrust is
its distance from zero or from its limit, that of a tilt the travel of its servo within the reach
time. It is zero where a direction cannot be pushed: level with a lost rotor, the opposite rotor
has no thrust, so that its tilt has no effect.
"""

import numpy as np

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import (
    ActuatorHealth,
    ALL_HEALTHY,
    Allocation,
    Allocator,
    clipped,
    nearest_turn,
    ROTORS,
    SINGULAR,
)
from beetle_omni_ros.model.parameters import RobotParameters

RESIDUAL = 1e-3  # [m/s^2, rad/s^2] below it a wrench counts as met
# Of the allocation near present tilts: weights of an angular against a linear acceleration [m/rad]
# and of the distance from target tilts [m/s^2/rad] and thrusts [1/kg], largest distance from the
# present tilts [rad], and Gauss-Newton iterations.
TURNING, TILT, THRUST, TILT_REACH, ITERATIONS = 1.0, 0.3, 0.05, 0.6, 6
# Of the attitudes to hold: time within which actuators must act [s], rate of the servos under load
# as a share of their limit, number of compared directions, required margin for flight [m/s^2,
# rad/s^2], rate of turns of the body [rad/s], time by which the rate is multiplied to give the
# angle in which a turn stops [s].
REACH_TIME, TILT_RATE_SHARE, DIRECTIONS, FLYING_MARGIN = 0.1, 0.7, 1000, 2.0
TURN_RATE, COAST_TIME = 6.0, 0.1
PATH_POINTS = 9         # evaluated points of the path to level, 22 deg apart at most
BISECTIONS = 5          # towards a desired attitude: 6 deg / 2^5
LITTLE = 1.0            # [N] a rotor with less may turn its joint later
NEARLY = 0.8            # [-] fraction of the largest margin, if none is large enough
GOLDEN = np.pi * (1 + np.sqrt(5))


class DegradedAllocator(Allocator):
    """
    :class:`Allocator` for a robot with failed actuators.

    If the wrench cannot be met, thrusts are the least-squares solution in linear and angular
    acceleration. Lost rotors get no thrust and keep their tilt. Stuck joints keep their angle.
    """

    def __init__(self, robot: RobotParameters, health: ActuatorHealth):
        super().__init__(robot)
        self._health = health
        self._thrust_max = health.limited(self._thrust_max)
        self.matrix[:, np.repeat(~np.array(health.rotors), 2)] = 0.0    # of lost rotors
        # (6,) accelerations for each unit of a wrench.
        self.scale = 1 / np.r_[np.full(3, self.mass), robot.inertia]
        # Rotor -> its fixed thrust [N]; rotors with a stuck joint, whose thrust is in the first of
        # its two columns (6, 8).
        self.held = {i: thrust for i, thrust in enumerate(health.held)
                     if thrust is not None and health.rotors[i]}
        self.stuck, self.columns = [], self.matrix.copy()
        for i, angle in enumerate(health.stuck):
            if angle is not None and health.rotors[i]:
                self.stuck.append(i)
                self.columns[:, 2 * i] = self.matrix[:, 2 * i] * np.cos(angle) \
                    + self.matrix[:, 2 * i + 1] * np.sin(angle)
                self.columns[:, 2 * i + 1] = 0.0
        self._inverses: dict[tuple, np.ndarray] = {}    # used rotors -> pseudo-inverse

    def _inverse(self, used):
        """Pseudo-inverse (8, 6) for the used rotors; beyond its rank, least squares."""
        key = tuple(used)
        if key not in self._inverses:
            columns = self.scale[:, None] * self.columns * np.repeat(used, 2)
            self._inverses[key] = np.linalg.pinv(columns, rcond=SINGULAR) * self.scale
        return self._inverses[key]

    def components(self, wrenches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Force components (N, 8) for wrenches (N, 6), without limits, and the used rotors (N, 4).

        A rotor of fixed thrust whose share vanishes pushes along its zero tilt.
        """
        used = np.ones((len(wrenches), ROTORS), dtype=bool)
        found = np.empty((len(wrenches), 2 * ROTORS))
        free = [i for i in self.stuck if i not in self.held]
        for _ in range(len(free) + 1):
            for chosen in {tuple(row) for row in used.tolist()}:
                rows = np.all(used == chosen, axis=1)
                found[rows] = self._with(chosen, wrenches[rows])
            for i in free:
                used[:, i] &= found[:, 2 * i] >= -self._negligible
        used[:, list(self.held)] = False
        return found, used

    def _with(self, used, wrenches):
        """Components by the used rotors (4,)."""
        found = wrenches @ self._inverse(used).T
        if not self.held:
            return found
        fixed, others = np.zeros_like(found), list(used)
        for i, thrust in self.held.items():
            pair, share = slice(2 * i, 2 * i + 2), found[:, 2 * i:2 * i + 2]
            length = np.linalg.norm(share, axis=1, keepdims=True)
            along = (length > self._negligible) & (i not in self.stuck)
            fixed[:, pair] = thrust * np.where(
                along, share / np.maximum(length, self._negligible), [1.0, 0.0])
            others[i] = False
        return fixed + (wrenches - fixed @ self.columns.T) @ self._inverse(others).T

    def error(self, components: np.ndarray, wrenches: np.ndarray) -> np.ndarray:
        """Error (...) of the accelerations by components (..., 8) [m/s^2, rad/s^2]."""
        return np.linalg.norm(self.scale * (components @ self.columns.T - wrenches), axis=-1)

    def allocate(self, force: np.ndarray, torque: np.ndarray,
                 present_tilt: np.ndarray) -> Allocation:
        """As :meth:`Allocator.allocate`, with the remaining actuators."""
        components = self._within_limits(np.concatenate([force, torque]))
        tilt, thrust = np.array(present_tilt, dtype=float), np.zeros(ROTORS)
        for i in range(ROTORS):
            angle, pair = self._health.stuck[i], components[2 * i:2 * i + 2]
            if angle is not None:
                tilt[i], thrust[i] = angle, pair[0]
                continue
            length = float(np.hypot(*pair))
            if length > self._negligible:
                tilt[i] = self._nearest_turn(float(np.arctan2(pair[1], pair[0])), tilt[i])
                thrust[i] = length
            else:
                tilt[i] = self._inside(float(tilt[i]))
        return Allocation(tilt, clipped(thrust, 0.0, self._thrust_max))

    def allocate_near(self, force: np.ndarray, torque: np.ndarray, tilt: np.ndarray,
                      aim: Allocation) -> Allocation:
        """
        Thrusts and tilts near the present tilts (4,) [rad] that approximate a wrench.

        The minimum-norm solution turns a joint by half a revolution when the share of its rotor
        passes through zero. This method instead takes damped Gauss-Newton steps in tilts and
        thrusts. They minimise the squared error of the accelerations and the weighted distance
        from ``aim``, within the thrust range and a reach of tilt.
        """
        scale = self.scale * np.repeat([1.0, TURNING], 3)
        matrix, wrench = scale[:, None] * self.matrix, scale * np.concatenate([force, torque])
        centre, _ = self._health.possible(tilt, aim.thrust)
        reach = np.where([angle is None for angle in self._health.stuck], TILT_REACH, 0.0)
        limit = self.tilt_limit
        low = np.concatenate([clipped(centre - reach, -limit, limit), np.zeros(ROTORS)])
        high = np.concatenate([clipped(centre + reach, -limit, limit),
                               np.where(self._health.rotors, self._thrust_max, 0.0)])
        for i, thrust in self.held.items():
            low[ROTORS + i] = high[ROTORS + i] = thrust
        pull = np.repeat([TILT, THRUST], ROTORS)
        goal = np.concatenate([aim.tilt, aim.thrust])
        z = clipped(np.concatenate([centre, aim.thrust]), low, high)
        made, cost = self._made(matrix, z), np.inf
        for _ in range(ITERATIONS):
            cos, sin = np.cos(z[:ROTORS]), np.sin(z[:ROTORS])
            along = matrix[:, 0::2] * cos + matrix[:, 1::2] * sin
            across = (matrix[:, 1::2] * cos - matrix[:, 0::2] * sin) * z[ROTORS:]
            step = bounded_step(np.hstack([across, along]), wrench - made, pull**2, goal - z,
                                low - z, high - z)
            for share in (1.0, 0.5, 0.25):
                tried = z + share * step
                new = self._made(matrix, tried)
                new_cost = np.sum((new - wrench) ** 2) + np.sum((pull * (goal - tried)) ** 2)
                if new_cost < cost:
                    break
            else:
                break
            z, made, cost = tried, new, new_cost
        return Allocation(z[:ROTORS], z[ROTORS:])

    @staticmethod
    def _made(matrix, z):
        """(6,) wrench of tilts and thrusts (8,) by a scaled matrix."""
        return matrix[:, 0::2] @ (z[ROTORS:] * np.cos(z[:ROTORS])) \
            + matrix[:, 1::2] @ (z[ROTORS:] * np.sin(z[:ROTORS]))

    def _within_limits(self, wrench):
        """Components (8,) with all rotors within their limit."""
        (components,), (used,) = self.components(wrench[None])
        limit = self._thrust_max
        for _ in range(ROTORS):
            lengths = np.hypot(components[0::2], components[1::2]) * used
            worst = int(np.argmax(lengths))
            if lengths[worst] <= limit * (1 + 1e-9):
                break
            used[worst] = False
            fixed = np.where(np.repeat(used, 2), 0.0, components)
            fixed[2 * worst:2 * worst + 2] *= limit / lengths[worst]
            components = fixed + self._inverse(used) @ (wrench - self.columns @ fixed)
            for i in self.stuck:
                components[2 * i] = max(components[2 * i], 0.0)
        return components


def bounded_step(jacobian: np.ndarray, error: np.ndarray, weight: np.ndarray,
                 towards: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """
    Damped least-squares step (n,) within bounds, by an active set.

    It minimises |jacobian step - error|^2 + sum(weight (step - towards)^2), from ``low`` to
    ``high``.
    """
    step, free = clipped(np.zeros(len(weight)), low, high), high > low
    for _ in range(ROTORS):
        columns = jacobian[:, free]
        rest = error - jacobian[:, ~free] @ step[~free]
        step[free] = np.linalg.solve(columns.T @ columns + np.diag(weight[free]),
                                     columns.T @ rest + weight[free] * towards[free])
        outside = (step < low) | (step > high)
        step = clipped(step, low, high)
        if not (outside & free).any():
            break
        free &= ~outside
    return step


def allocator(robot: RobotParameters, health: ActuatorHealth = ALL_HEALTHY) -> Allocator:
    """Allocator of a robot with this state of the actuators."""
    return Allocator(robot) if health.healthy else DegradedAllocator(robot, health)


class Holding:
    """
    Table of the attitudes that a robot can hold; computed in about 10 ms.

    Attributes:
        directions: (N, 3) unit vectors, up in base_link.
        margins: (N,) margin of each direction [m/s^2, rad/s^2], 0 if it cannot be held.
        tilts: (N, 4) tilts that hold each direction, within +-pi [rad].

    """

    def __init__(self, robot: RobotParameters, health: ActuatorHealth):
        self._health = health
        self._tilt_rate = TILT_RATE_SHARE * robot.joints.velocity_limit
        self._allocator = DegradedAllocator(robot, health)
        self._thrust_max = health.limited(robot.rotors.thrust_max)
        self.directions = sphere(DIRECTIONS)
        self.tilts, self._thrusts, met = self._held(self.directions)
        self.margins = self._margins(self.tilts, self._thrusts, met)
        self._attainable = NEARLY * float(self.margins.max())

    def margin(self, quaternion: np.ndarray) -> float:
        """Margin of one attitude (4,) [m/s^2, rad/s^2], 0 if it cannot be held."""
        return float(self._margins(*self._held(up(quaternion)[None]))[0])

    def nearest(self, quaternion: np.ndarray, margin: float) -> np.ndarray:
        """
        Nearest attitude (4,) with a margin: the desired one, turned about a horizontal axis.

        If no attitude has the margin [m/s^2, rad/s^2], the attitude has 80 % of the largest.
        """
        margin = min(margin, self._attainable)
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
        Attitude (4,) with a margin that body and joints reach soonest.

        It is the attitude at which the present turn [rad/s] stops, leaned. The unheld part of the
        path from there to level, at the levelling rate [rad/s], adds to the time.
        """
        quaternion = rotations.multiply(quaternion, rotations.exp(COAST_TIME * angular_velocity))
        firm = np.flatnonzero(self.margins >= min(margin, self._attainable))
        angle = np.arccos(np.clip(self.directions[firm] @ up(quaternion), -1.0, 1.0))
        turned, limit = nearest_turn(self.tilts[firm], tilt), self._allocator.tilt_limit
        travel = np.abs(np.where(np.abs(turned) > limit, turned - 2 * np.pi * np.sign(turned),
                                 turned) - tilt)
        travel[self._thrusts[firm] < LITTLE] = 0.0
        time = angle / TURN_RATE + travel.max(axis=1) / self._tilt_rate \
            + self._unheld_angle(self.directions[firm]) / levelling_rate
        return leaned(quaternion, self.directions[firm[np.argmin(time)]])

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

    def _margins(self, tilt, thrust, met):
        matrix = self._allocator.scale[:, None] * self._allocator.matrix
        up_part, side_part = matrix[:, 0::2], matrix[:, 1::2]
        cos, sin = np.cos(tilt)[:, None], np.sin(tilt)[:, None]
        room = np.minimum(thrust, self._thrust_max - thrust).clip(0)
        room[:, list(self._allocator.held)] = 0.0
        swing = thrust * min(self._tilt_rate * REACH_TIME, 1.0) \
            * [float(angle is None) for angle in self._health.stuck]
        # (N, 6, 8) accelerations for each actuator going to the end of its reach.
        jacobian = np.concatenate([(up_part * cos + side_part * sin) * room[:, None],
                                   (side_part * cos - up_part * sin) * swing[:, None]], axis=2)
        squared = jacobian @ jacobian.transpose(0, 2, 1) + 1e-9 * np.eye(6)
        needed = jacobian.transpose(0, 2, 1) @ np.linalg.inv(squared)
        margins = 1 / np.maximum(np.linalg.norm(needed, axis=2).max(axis=1), 1e-6)
        return np.where(met & (thrust.max(axis=1) <= self._thrust_max), margins, 0.0)

    def _held(self, directions):
        """Tilts (N, 4), thrusts (N, 4) that hold the weight, and whether they meet it (N,)."""
        weight = np.linalg.norm(self._allocator.weight)
        wrenches = np.pad(weight * directions, ((0, 0), (0, 3)))
        pairs, _ = self._allocator.components(wrenches)
        tilt = np.arctan2(pairs[:, 1::2], pairs[:, 0::2])
        thrust = np.hypot(pairs[:, 0::2], pairs[:, 1::2])
        for i, angle in enumerate(self._health.stuck):
            if angle is not None:
                tilt[:, i] = angle
        return tilt, thrust, self._allocator.error(pairs, wrenches) <= RESIDUAL


def sphere(count: int) -> np.ndarray:
    """(count, 3) unit vectors spread evenly: a Fibonacci lattice (Gonzalez 2010)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(GOLDEN * k), radius * np.sin(GOLDEN * k), z], axis=1)


def up(quaternion: np.ndarray) -> np.ndarray:
    """(3,) world z axis in the body, for a quaternion of any length."""
    return rotations.matrix(rotations.normalized(quaternion))[2]


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
