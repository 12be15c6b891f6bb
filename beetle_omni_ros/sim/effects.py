"""
The named effects as the plant feels them: plain numpy, written apart from the CasADi terms.

Effects that only change a number of the model (mass, thrust and torque coefficients) are
built into it by :mod:`beetle_omni_ros.sim.mjcf`; here are the forces that depend on motion.
"""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

# The plant's modules turn and swing as bodies of their own, whatever the file says of them.
BUILT_IN = ('mass', 'inertia', 'centre_of_mass', 'module_reaction', 'thrust_coefficient',
            'rotor_thrust_coefficient', 'torque_coefficient')
FORCES = ('wind', 'body_drag', 'rotor_drag')


def check_supported(robot: RobotParameters) -> None:
    """
    Refuse a robot with an effect that this plant cannot simulate.

    Raises:
        ParameterError: naming the effect.

    """
    for name in robot.effects:
        if name not in BUILT_IN + FORCES:
            raise ParameterError(f'effects.{name}: the simulated plant does not have this effect; '
                                 f"it has {', '.join(BUILT_IN + FORCES)}")


class MotionForces:
    """Aerodynamic forces of one robot, to be added at its base_link."""

    def __init__(self, robot: RobotParameters):
        """Take the coefficients from the robot's effects."""
        effects = robot.effects
        self.wind = np.array(effects.get('wind', {}).get('force', (0.0,) * 3))
        self.body_drag = effects.get('body_drag', {}).get('coefficient', 0.0)
        self.rotor_drag = effects.get('rotor_drag', {}).get('coefficient', 0.0)
        self.depends_on_motion = bool(self.body_drag or self.rotor_drag)
        self._hover_thrust = robot.hover_thrust
        # r x f for each rotor as a matrix, stacked (12, 3): np.cross is slow on small arrays.
        self._levers = np.concatenate([rotations.skew(r) for r in robot.rotors.positions])
        axes = robot.tilt_axes
        self._level = np.array([0.0, 0.0, 1.0])
        self._sideways = np.cross(axes, self._level)   # where a rotor at +90 deg points

    def __call__(self, rotation: np.ndarray, velocity: np.ndarray, angular_velocity: np.ndarray,
                 tilt: np.ndarray, thrust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Forces of one instant.

        Args:
            rotation: (3, 3) base_link to world.
            velocity: (3,) of base_link in world [m/s].
            angular_velocity: (3,) in base_link [rad/s].
            tilt: (4,) [rad].
            thrust: (4,) true thrusts [N].

        Returns:
            force (3,) in world [N] and torque (3,) in base_link [N m].

        """
        force = self.wind.copy()
        torque = np.zeros(3)
        if self.body_drag:
            force -= self.body_drag * np.sqrt(velocity @ velocity) * velocity
        if self.rotor_drag:
            normal = np.cos(tilt)[:, None] * self._level + np.sin(tilt)[:, None] * self._sideways
            hub = rotation.T @ velocity - (self._levers @ angular_velocity).reshape(4, 3)
            in_plane = hub - (hub * normal).sum(axis=1)[:, None] * normal
            speed_ratio = np.sqrt(np.maximum(thrust, 0.0) / self._hover_thrust)
            drag = -0.25 * self.rotor_drag * speed_ratio[:, None] * in_plane
            force += rotation @ drag.sum(axis=0)
            torque -= drag.ravel() @ self._levers      # sum of r x f: each lever is skew
        return force, torque
