"""
Forces of the effects on the plant.

Effects that only change a number of the model (mass, thrust and torque coefficients) are built
into the model by :mod:`beetle_omni_ros.sim.mjcf`. For common effects that depend on motion the
equations are implemented again in numpy, independently of CasADi. All others use the equations of
the catalogue.
"""

import numpy as np

from beetle_omni_ros.robot import dynamics, native, rotations
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.parameters import RobotParameters


class MotionForces:
    """Aerodynamic forces of one robot at base_link."""

    def __init__(self, robot: RobotParameters):
        effects = robot.effects
        self.wind = np.array(effects.get('wind', {}).get('force', (0.0,) * 3))
        self.body_drag = effects.get('body_drag', {}).get('coefficient', 0.0)
        self.rotor_drag = effects.get('rotor_drag', {}).get('coefficient', 0.0)
        self.loss = effects.get('tilt_thrust_loss', {})
        self.inflow = effects.get('axial_inflow', {}).get('per_rotor', 0.0)
        self.ground = effects.get('ground_effect', {})
        self._changes_thrust = bool(self.loss or self.inflow or self.ground)
        self.depends_on_motion = bool(self.body_drag or self.rotor_drag or self._changes_thrust)
        self._positions = robot.rotors.positions
        self._reaction = -robot.rotors.spin * effects.get('torque_coefficient', {}).get(
            'torque_to_thrust_ratio', robot.rotors.torque_to_thrust_ratio)
        self._hover_thrust = robot.hover_thrust
        # (12, 3), the matrices of r x f of the rotors: np.cross is slow on small arrays.
        self._levers = np.concatenate([rotations.skew(r) for r in robot.rotors.positions])
        axes = robot.tilt_axes
        self._up = np.array([0.0, 0.0, 1.0])
        self._sideways = np.cross(axes, self._up)   # direction of a rotor at +90 deg

    def __call__(self, rotation: np.ndarray, velocity: np.ndarray, angular_velocity: np.ndarray,
                 tilt: np.ndarray, thrust: np.ndarray,
                 height: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """
        Forces in one state.

        Args:
            rotation: (3, 3) base_link to world.
            velocity: (3,) of base_link in world [m/s].
            angular_velocity: (3,) in base_link [rad/s].
            tilt: (4,) [rad].
            thrust: (4,) true thrusts [N].
            height: height of base_link above the floor [m].

        Returns:
            force (3,) in world [N] and torque (3,) in base_link [N m].

        """
        force = self.wind.copy()
        torque = np.zeros(3)
        if self.body_drag:
            force -= self.body_drag * np.sqrt(velocity @ velocity) * velocity
        if self.rotor_drag:
            normal = np.cos(tilt)[:, None] * self._up + np.sin(tilt)[:, None] * self._sideways
            hub = rotation.T @ velocity - (self._levers @ angular_velocity).reshape(4, 3)
            in_plane = hub - (hub * normal).sum(axis=1)[:, None] * normal
            speed_ratio = np.sqrt(np.maximum(thrust, 0.0) / self._hover_thrust)
            drag = -0.25 * self.rotor_drag * speed_ratio[:, None] * in_plane
            force += rotation @ drag.sum(axis=0)
            torque -= drag.ravel() @ self._levers      # sum of r x f, with skew levers
        if self._changes_thrust:
            normal = np.cos(tilt)[:, None] * self._up + np.sin(tilt)[:, None] * self._sideways
            hub = rotation.T @ velocity - (self._levers @ angular_velocity).reshape(4, 3)
            along = self._thrust_change(rotation, hub, normal, tilt, thrust, height)
            change = along[:, None] * normal
            force += rotation @ change.sum(axis=0)
            torque += -change.ravel() @ self._levers + (self._reaction * along) @ normal
        return force, torque

    def turned(self, rotation: np.ndarray, before: np.ndarray, after: np.ndarray,
               thrust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Change of force in world [N] and torque [N m] by rotors that turn between tilts (4,)."""
        change = thrust[:, None] * (
            (np.cos(after) - np.cos(before))[:, None] * self._up
            + (np.sin(after) - np.sin(before))[:, None] * self._sideways)
        return rotation @ change.sum(axis=0), -change.ravel() @ self._levers \
            + self._reaction @ change

    def _thrust_change(self, rotation, hub, normal, tilt, thrust, height):
        """(4,) changes of the rotors' thrusts by the effects [N]."""
        part = np.ones(4)
        if self.ground:
            z = np.maximum(height + self._positions @ rotation[2], 0.08)
            share = self.ground['exponential_share']
            part *= 1 + self.ground['gain_at_0.25m'] * (normal @ rotation[2]) ** 2 * (
                (1 - share) * (0.25 / z) ** 2 + share * np.exp(1 - z / 0.25))
        if self.loss:
            share = self.loss['cosine_share']
            part *= 1 - self.loss['loss_at_60deg'] * (
                (1 - share) * np.sin(tilt) ** 2 / 0.75 + share * 4 * np.sin(tilt / 2) ** 2)
        lost = self.inflow * np.sqrt(np.maximum(thrust, 0) / self._hover_thrust) * (
            hub * normal).sum(axis=1)
        return (part - 1) * thrust - lost


class CatalogueForces:
    """
    Forces of the remaining effects by the equations of the catalogue.

    Attributes:
        names: names of those effects in the robot file.

    """

    def __init__(self, robot: RobotParameters):
        self.names = [name for name in robot.effects
                      if CATALOGUE[name].apply and not CATALOGUE[name].plant]
        if self.names:
            self._function = native.compiled(dynamics.added_wrench(robot, self.names))

    def __call__(self, quaternion: np.ndarray, velocity: np.ndarray, rate: np.ndarray,
                 tilt: np.ndarray, tilt_rate: np.ndarray, tilt_acceleration: np.ndarray,
                 thrust: np.ndarray, thrust_rate: np.ndarray, position: np.ndarray,
                 voltage_ratio: float,
                 charge_drawn: float) -> tuple[np.ndarray, np.ndarray]:
        """Force (3,) in world [N], torque (3,) in base_link [N m]; SI arguments, xyzw."""
        force, torque = self._function(quaternion, velocity, rate, tilt, tilt_rate,
                                       tilt_acceleration, thrust, thrust_rate, position,
                                       voltage_ratio, charge_drawn)
        return np.array(force).ravel(), np.array(torque).ravel()
