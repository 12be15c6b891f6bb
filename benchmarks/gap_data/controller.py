"""
The blind flights' own controller: PID on the pose, with own allocation.

Position and attitude errors give the wanted acceleration of the six directions. The thrust
vectors of the rotors are their least-norm solution plus a wander and, in lively flights, steps in
the null space, which the body does not feel but the tilts do.
"""

from math import atan2, hypot, pi

import numpy as np

from gap_data.truth import Robot


class Gains:
    """Gains, all per second or per second squared; drawn within 15 % for each flight."""

    def __init__(self, rng: np.random.Generator):
        scale = rng.uniform(0.85, 1.15, 6)
        self.position, self.velocity, self.sum = 4.0 * scale[0], 3.4 * scale[1], 1.5 * scale[2]
        self.attitude, self.rate, self.turn_sum = 26.0 * scale[3], 8.5 * scale[4], 14.0 * scale[5]


class PoseController:
    """Commands at a fixed period; knows only the described robot."""

    PERIOD = 0.010      # [s]
    LEAD = 0.06         # [s] of the thrust, against the rotors' lag
    WANDER = 0.55       # [N] of the null space
    JUMP = 1.5          # [N] of the null space, in a new direction from time to time
    JUMP_PAUSE = (1.5, 5.0)  # [s]
    JUMP_STEP = 0.18    # [rad] of a tilt at once when the null space jumps: work for the servos
    LEAST_VECTOR = 0.8  # [N] below this a thrust's direction says nothing
    FASTEST_TILT = 8.0  # [rad/s] of commanded tilts, below what the servos can

    def __init__(self, robot: Robot, rng: np.random.Generator, lively: bool):
        self.gains = Gains(rng)
        nominal = Robot()
        self._mass, self._inertia = nominal.mass, nominal.inertia
        self._gravity = robot.numbers['robot']['gravity']
        self._most, self._limit = nominal.thrust_max, nominal.position_limit - 0.06
        self._map = self._allocation(nominal)
        self._inverse = np.linalg.pinv(self._map)
        self._null = np.linalg.svd(self._map)[2][6:].T
        periods = rng.uniform(2.0, 7.0, (2, 2))
        self._wander = 2 * pi / periods, rng.uniform(0, 2 * pi, (2, 2))
        self._rng, self._lively = rng, lively
        self._jump, self._next_jump = np.zeros(2), 1.0
        self._sum, self._turn_sum = np.zeros(3), np.zeros(3)
        self._thrust = np.full(4, nominal.hover_thrust)
        self.tilt = np.zeros(4)

    @staticmethod
    def _allocation(robot):
        """(6, 8): wrench of sideways and upward thrust of each rotor."""
        columns = []
        for place, (ca, sa), spin in zip(robot.positions, robot.arms, robot.spin):
            for axis in (np.array([sa, -ca, 0.0]), np.array([0.0, 0.0, 1.0])):
                columns.append([*axis, *(np.cross(place, axis) - spin * robot.ratio * axis)])
        return np.array(columns).T

    def trim(self, force_body: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tilts and thrusts that give a body force without torque; the controller starts there."""
        vectors = (self._inverse @ [*force_body, 0, 0, 0]).reshape(4, 2)
        self.tilt = np.arctan2(vectors[:, 0], vectors[:, 1])
        self._thrust = np.linalg.norm(vectors, axis=1)
        return self.tilt.copy(), self._thrust.copy()

    def step(self, t, state, reference) -> tuple[np.ndarray, np.ndarray]:
        """
        Tilts (4,) [rad] and thrusts (4,) [N] to command.

        Args:
            t: [s].
            state: position (3,), velocity (3,) world, rotation (3, 3), rate (3,) body.
            reference: position, velocity, acceleration (3,) world, rotation (3, 3), rate (3,).

        """
        position, velocity, rotation, rate = state
        at, moving, pushed, facing, turning = reference
        g, dt = self.gains, self.PERIOD
        error = at - position
        self._sum = np.clip(self._sum + error * dt, -2.5, 2.5)
        wanted = (pushed + g.position * error + g.velocity * (moving - velocity)
                  + g.sum * self._sum)
        wanted[2] += self._gravity
        force = self._mass * (rotation.T @ wanted)
        away = facing.T @ rotation
        turn = 0.5 * np.array([away[2, 1] - away[1, 2], away[0, 2] - away[2, 0],
                               away[1, 0] - away[0, 1]])
        turn *= 2 / max(0.5, 1 + 0.5 * (np.trace(away) - 1))
        self._turn_sum = np.clip(self._turn_sum + turn * dt, -0.5, 0.5)
        spin = (-g.attitude * turn - g.rate * (rate - away.T @ turning)
                - g.turn_sum * self._turn_sum)
        torque = self._inertia * spin + np.cross(rate, self._inertia * rate)
        return self._allocate(t, force, torque)

    def _allocate(self, t, force, torque):
        speed, phase = self._wander
        most = self.FASTEST_TILT * self.PERIOD
        if self._lively and t >= self._next_jump:
            most = self.JUMP_STEP
            self._jump = self.JUMP * self._rng.uniform(-1, 1, 2)
            self._next_jump = t + self._rng.uniform(*self.JUMP_PAUSE)
        wander = self._jump + self.WANDER * np.sin(speed * t + phase).sum(axis=1)
        vectors = self._inverse @ np.concatenate([force, torque]) + self._null @ wander
        thrust = np.empty(4)
        for i in range(4):
            side, up = vectors[2 * i], vectors[2 * i + 1]
            size = hypot(side, up)
            if size > self.LEAST_VECTOR:
                now = self.tilt[i]
                change = (atan2(side, up) - now + pi) % (2 * pi) - pi
                if abs(now + change) > self._limit:
                    change -= 2 * pi * (1 if now + change > 0 else -1)
                self.tilt[i] = now + min(max(change, -most), most)
            thrust[i] = size
        lead = thrust + self.LEAD / self.PERIOD * 0.5 * (thrust - self._thrust)
        self._thrust += 0.5 * (thrust - self._thrust)
        return self.tilt.copy(), np.clip(lead, 0.3, self._most)
