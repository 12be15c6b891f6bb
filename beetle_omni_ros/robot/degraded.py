"""
Allocation for a robot with failed actuators, and the attitudes that it can hold.

A lost rotor has no column in the wrench map. A rotor with a stuck joint has one column, along its
present direction, and a thrust that cannot be negative. Every other rotor keeps its two force
components. Under the sign constraints each stuck rotor of the minimum-norm solution either pushes
or is off. The solution is therefore the best of at most 2^stuck pseudo-inverses.

A rotor beyond its limit is fixed at the limit in its direction, and the others are solved again
for the remaining wrench (active set). A rotor with a fixed thrust pushes along its minimum-norm
share. The others are solved for the remaining wrench.

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
from itertools import combinations

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import (
    ActuatorHealth,
    ALL_HEALTHY,
    Allocation,
    Allocator,
    clipped,
    nearest_turn,
    ROTORS,
    SINGULAR,
)
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import parameter, ParameterFile

RESIDUAL = 1e-3  # [m/s^2, rad/s^2] below it a wrench counts as met
PATH_POINTS = 9         # evaluated points of the path to level, 22 deg apart at most
BISECTIONS = 5          # towards a desired attitude: 6 deg / 2^5
LITTLE = 1.0            # [N] a rotor with less may turn its joint later
NEARLY = 0.8            # [-] fraction of the largest margin, if none is large enough
GOLDEN = np.pi * (1 + np.sqrt(5))


@dataclass(frozen=True, kw_only=True)
class LocalWeights:
    """Weights of the allocation near present tilts."""

    turning: float = parameter(1.0, doc='weight of an angular against a linear acceleration',
                               unit='m/rad', low=0.1, high=100)
    tilt: float = parameter(0.3, doc='weight of the distance from the target tilts',
                            unit='m/s^2/rad', low=1e-4, high=100)
    thrust: float = parameter(0.05, doc='weight of the distance from the target thrusts',
                              unit='1/kg', low=1e-4, high=100)
    tilt_reach: float = parameter(0.6, doc='largest distance from the present tilts', unit='rad',
                                  low=0.01, high=4)
    iterations: int = parameter(6, doc='Gauss-Newton iterations at most', low=1, high=20)
    missed: float = parameter(3.0, doc='error of the acceleration that counts as saturation',
                              unit='m/s^2', low=0, high=20)


class DegradedAllocator(Allocator):
    """
    :class:`Allocator` for a robot with failed actuators.

    If the wrench cannot be met, thrusts are the least-squares solution in linear and angular
    acceleration. Lost rotors get no thrust and keep their tilt. Stuck joints keep their angle.

    Args:
        robot: parameters of the robot.
        health: state of the actuators.

    Attributes:
        matrix: (6, 8) map of the base class, with zero columns for lost rotors.
        stuck: list of rotors with a stuck joint.
        held: rotor -> its fixed thrust [N].
        choices: list of (columns (6, 8), inverse (8, 6), rest (8, 6)) for each choice of stuck
            rotors that are off. Columns are the map, with the thrust of a stuck rotor in its
            first component. The inverses are the pseudo-inverses with and without the rotors of
            fixed thrust.

    """

    def __init__(self, robot: RobotParameters, health: ActuatorHealth):
        super().__init__(robot)
        self._health = health
        self._thrust_max = health.limited(self._thrust_max)
        lost = np.repeat(~np.array(health.rotors), 2)
        self.matrix[:, lost] = 0.0
        self._scale = 1 / np.r_[np.full(3, self.mass), robot.inertia]
        self.stuck = [i for i, angle in enumerate(health.stuck)
                      if angle is not None and health.rotors[i]]
        self.held = {i: thrust for i, thrust in enumerate(health.held)
                     if thrust is not None and health.rotors[i]}
        free = [i for i in self.stuck if i not in self.held]
        columns = self.matrix.copy()
        for i in self.stuck:
            columns[:, 2 * i] = self._along(i, health.stuck[i])
            columns[:, 2 * i + 1] = 0.0
        self.choices = []
        for count in range(len(free) + 1):
            for off in combinations(free, count):
                chosen = columns.copy()
                chosen[:, [2 * i for i in off]] = 0.0
                inverse = self._pseudo_inverse(chosen)
                self.choices.append((chosen, inverse, self._pseudo_inverse(
                    self._without_held(chosen)) if self.held else inverse))

    def _without_held(self, columns):
        """Map with zero columns for rotors of fixed thrust."""
        columns = columns.copy()
        columns[:, [k for i in self.held for k in (2 * i, 2 * i + 1)]] = 0.0
        return columns

    def components(self, columns: np.ndarray, inverse: np.ndarray, rest: np.ndarray,
                   wrenches: np.ndarray) -> np.ndarray:
        """
        Force components (..., 8) for wrenches (..., 6) by one of the ``choices``.

        A rotor of fixed thrust pushes along its minimum-norm share. It pushes along its zero tilt
        if this share vanishes.
        """
        found = wrenches @ inverse.T
        if not self.held:
            return found
        fixed = np.zeros_like(found)
        for i, thrust in self.held.items():
            pair, share = slice(2 * i, 2 * i + 2), found[..., 2 * i:2 * i + 2]
            length = np.linalg.norm(share, axis=-1, keepdims=True)
            along = (length > self._negligible) & (i not in self.stuck)
            fixed[..., pair] = thrust * np.where(
                along, share / np.maximum(length, self._negligible), [1.0, 0.0])
        return fixed + (wrenches - fixed @ columns.T) @ rest.T

    def _along(self, rotor, angle):
        """(6,) wrench of 1 N of a rotor at a tilt [rad]."""
        return self.matrix[:, 2 * rotor] * np.cos(angle) \
            + self.matrix[:, 2 * rotor + 1] * np.sin(angle)

    def _pseudo_inverse(self, columns):
        """Minimum norm; if the rank is not full, least squares in accelerations."""
        return np.linalg.pinv(self._scale[:, None] * columns, rcond=SINGULAR) * self._scale

    def allocate(self, force: np.ndarray, torque: np.ndarray,
                 present_tilt: np.ndarray) -> Allocation:
        """As :meth:`Allocator.allocate`, with the remaining actuators."""
        wrench = np.concatenate([force, torque])
        components, met = self._within_limits(*self._solved(wrench), wrench)
        tilt, thrust = np.array(present_tilt, dtype=float), np.zeros(ROTORS)
        cut = np.zeros(ROTORS, dtype=bool)
        for i in range(ROTORS):
            angle, pair = self._health.stuck[i], components[2 * i:2 * i + 2]
            if angle is not None:
                tilt[i], thrust[i] = angle, pair[0]
                continue
            length = float(np.hypot(*pair))
            if length > self._negligible:
                tilt[i], cut[i] = self._nearest_turn(float(np.arctan2(pair[1], pair[0])), tilt[i])
                thrust[i] = length
            else:
                tilt[i], cut[i] = self._inside(float(tilt[i]))
        held = clipped(thrust, 0.0, self._thrust_max)
        return Allocation(tilt, held, cut | (not met))

    def allocate_near(self, force: np.ndarray, torque: np.ndarray, tilt: np.ndarray,
                      aim: Allocation, weights: LocalWeights) -> Allocation:
        """
        Thrusts and tilts near the present tilts that approximate a wrench.

        The minimum-norm solution turns a joint by half a revolution when the share of its rotor
        passes through zero. This method instead takes damped Gauss-Newton steps in tilts and
        thrusts. They minimise the squared error of the accelerations and the weighted distance
        from the target, within the thrust range and a reach of tilt.

        Args:
            force: (3,) in base_link [N].
            torque: (3,) in base_link [N m].
            tilt: (4,) present tilts [rad].
            aim: target of tilts and thrusts.
            weights: weights of the terms.

        """
        scale = self._scale * np.repeat([1.0, weights.turning], 3)
        matrix, wrench = scale[:, None] * self.matrix, scale * np.concatenate([force, torque])
        still = [angle is not None for angle in self._health.stuck]
        centre, _ = self._health.possible(tilt, aim.thrust)
        reach = np.where(still, 0.0, weights.tilt_reach)
        lost = ~np.array(self._health.rotors)
        limit = self.tilt_limit
        low = np.concatenate([clipped(centre - reach, -limit, limit), np.zeros(ROTORS)])
        high = np.concatenate([clipped(centre + reach, -limit, limit),
                               np.where(lost, 0.0, self._thrust_max)])
        for i, thrust in self.held.items():
            low[ROTORS + i] = high[ROTORS + i] = thrust
        pull = np.repeat([weights.tilt, weights.thrust], ROTORS)
        goal = np.concatenate([aim.tilt, aim.thrust])
        z = clipped(np.concatenate([centre, aim.thrust]), low, high)
        made, cost = self._made(matrix, z), np.inf
        for _ in range(weights.iterations):
            cos, sin = np.cos(z[:ROTORS]), np.sin(z[:ROTORS])
            along = matrix[:, 0::2] * cos + matrix[:, 1::2] * sin
            across = (matrix[:, 1::2] * cos - matrix[:, 0::2] * sin) * z[ROTORS:]
            step = _bounded_step(np.hstack([across, along]), wrench - made, pull, goal - z,
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
        missed = np.linalg.norm(made - wrench) > weights.missed
        return Allocation(z[:ROTORS], z[ROTORS:], np.full(ROTORS, missed))

    @staticmethod
    def _made(matrix, z):
        """(6,) wrench of tilts and thrusts (8,) by a scaled matrix."""
        return matrix[:, 0::2] @ (z[ROTORS:] * np.cos(z[:ROTORS])) \
            + matrix[:, 1::2] @ (z[ROTORS:] * np.sin(z[:ROTORS]))

    def _solved(self, wrench) -> tuple[np.ndarray, np.ndarray]:
        """Columns and (8,) components of the best choice of stuck rotors."""
        found = []      # never empty: one choice has all stuck rotors off
        for columns, inverse, others in self.choices:
            components = self.components(columns, inverse, others, wrench)
            if any(components[2 * i] < -self._negligible for i in self.stuck):
                continue
            rest = self._rest(columns, components, wrench)
            cost = (rest if rest > RESIDUAL else 0.0, float(components @ components))
            found.append((cost, columns, components))
        _, columns, components = min(found, key=lambda one: one[0])
        return columns, components

    def _rest(self, columns, components, wrench):
        return float(np.linalg.norm(self._scale * (columns @ components - wrench)))

    def _within_limits(self, columns, components, wrench):
        """Components with all rotors within their limit, and whether they meet the wrench."""
        limit, free = self._thrust_max, self._without_held(columns)
        for _ in range(ROTORS):
            lengths = np.hypot(components[0::2], components[1::2])
            over = lengths > limit * (1 + 1e-9)
            over[list(self.held)] = False
            if not over.any():
                break
            worst = int(np.argmax(lengths))
            pair = slice(2 * worst, 2 * worst + 2)
            free[:, pair] = 0.0
            held = np.where(np.repeat(free.any(axis=0).reshape(ROTORS, 2).any(axis=1), 2),
                            0.0, components)
            held[pair] *= limit / lengths[worst]
            components = held + self._pseudo_inverse(free) @ (wrench - columns @ held)
            for i in self.stuck:
                components[2 * i] = max(components[2 * i], 0.0)
        return components, self._rest(columns, components, wrench) < RESIDUAL


def _bounded_step(jacobian, error, pull, towards, low, high):
    """Damped least-squares step (8,) within bounds, by an active set."""
    step = np.zeros(len(pull))
    free = high > low
    for _ in range(ROTORS):
        columns, weight = jacobian[:, free], pull[free] ** 2
        rest = error - jacobian[:, ~free] @ step[~free]
        step[free] = np.linalg.solve(columns.T @ columns + np.diag(weight),
                                     columns.T @ rest + weight * towards[free])
        outside = (step < low) | (step > high)
        step = clipped(step, low, high)
        if not (outside & free).any():
            break
        free &= ~outside
    return step


def allocator(robot: RobotParameters, health: ActuatorHealth = ALL_HEALTHY) -> Allocator:
    """Allocator of a robot with this state of the actuators."""
    return Allocator(robot) if health.healthy else DegradedAllocator(robot, health)


@dataclass(frozen=True, kw_only=True)
class HoldingParameters(ParameterFile, file='degraded.yaml'):
    """Selection of attitudes."""

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
