"""
Forces that effects add to the simulated plant, from the equations of their sources.

They are written in numpy and share no code with the CasADi model of :mod:`model.effects`, so that
an error in one of the two shows as a difference, see ``test/sim/test_agreement.py``. The thrust of
an effect is the one that the effects before it in the catalogue leave.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from beetle_omni_ros.model import dynamics, native, rotations
from beetle_omni_ros.model.effects import CATALOGUE, LEAST_HEIGHT, REFERENCE_HEIGHT
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.parts import RotorParameters

# Effects that only change a number of the plant's bodies, rotors and reaction torques.
BUILT_IN = ('mass', 'inertia', 'centre_of_mass', 'module_reaction', 'thrust_coefficient',
            'rotor_thrust_coefficient', 'torque_coefficient')
ONES = np.ones(4)
LEAST_SPEED = 0.1       # [1] of a rotor, relative to hover, for the rate of its angular momentum


@dataclass
class Instant:
    """
    The rotors and the air at one instant; effects change thrust, forces and torque in place.

    Rows of (4, 3) arrays are rotors, vectors are in base_link unless stated otherwise.
    """

    rotors: RotorParameters
    hover_thrust: float         # of each rotor [N]
    sideways: np.ndarray        # (4, 3) thrust directions at tilts of 90 deg
    rotation: np.ndarray        # (3, 3) body to world
    position: np.ndarray        # (3,) in world [m]
    velocity: np.ndarray        # (3,) in world [m/s]
    rate: np.ndarray            # (3,) of the body [rad/s]
    tilt: np.ndarray            # (4,) [rad]
    tilt_rate: np.ndarray       # (4,) [rad/s]
    thrust: np.ndarray          # (4,) [N]
    thrust_rate: np.ndarray     # (4,) [N/s]
    voltage_ratio: float        # of the pack over that of a full one
    force_world: Any = 0.0      # (3,) added, in world [N]; 0.0: none, as the next two
    force: Any = 0.0            # (4, 3) added at the rotors [N]
    torque: Any = 0.0           # (3,) added [N m]

    def __post_init__(self):
        """Set the thrust directions (4, 3)."""
        self.normals = directions(self.sideways, self.tilt)

    def speeds(self) -> np.ndarray:
        """(4,) rotor speeds relative to hover: thrust grows with the square of the speed."""
        return np.sqrt(np.maximum(self.thrust, 0.0) / self.hover_thrust)

    @cached_property
    def hubs(self) -> np.ndarray:
        """(4, 3) velocities of the hubs through still air [m/s]."""
        return self.velocity.dot(self.rotation) \
            - self.rotors.positions.dot(rotations.skew(self.rate))    # w x r

    def along(self) -> np.ndarray:
        """(4,) velocities of the hubs along the thrust directions [m/s]."""
        return np.einsum('ij,ij->i', self.hubs, self.normals)


def directions(sideways: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """(4, 3) thrust directions at tilts [rad]; ``sideways`` (4, 3) are those at +90 deg."""
    found = np.sin(tilt)[:, None] * sideways
    found[:, 2] = np.cos(tilt)
    return found


def axial(matrix: np.ndarray) -> np.ndarray:
    """Sum of the cross products a x b, from the sum (3, 3) of the outer products a b^T."""
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = matrix.tolist()
    return np.array([yz - zy, zx - xz, xy - yx])


def joint_offset(at, offset):
    """True tilt = encoder + offset."""
    at.tilt = at.tilt + offset
    at.normals = directions(at.sideways, at.tilt)


def wind(at, force):
    """Constant force in world."""
    at.force_world = at.force_world + np.array(force)


def wind_velocity(at, velocity):
    """Velocity against the air (Mahony et al. 2012)."""
    at.velocity = at.velocity - np.array(velocity)


def body_drag(at, coefficient):
    """F = -c |v| v."""
    speed = np.sqrt(at.velocity.dot(at.velocity))
    at.force_world = at.force_world - coefficient * speed * at.velocity


def rotor_drag(at, coefficient):
    """H-force, against the velocity in the plane of the rotor (Faessler et al. 2018)."""
    in_plane = at.hubs - at.along()[:, None] * at.normals
    at.force = at.force - (0.25 * coefficient * at.speeds())[:, None] * in_plane


def rotor_hub_moment(at, coefficient):
    """Moment -k s n x v of a disc that tilts back (Leishman 2006, ch. 4)."""
    at.torque = at.torque - 0.25 * coefficient * axial(
        (at.speeds()[:, None] * at.normals).T.dot(at.hubs))


def axial_inflow(at, per_rotor):
    """Thrust -k s v.n: linear part of the momentum theory (Leishman 2006, ch. 2)."""
    at.thrust = at.thrust - per_rotor * at.speeds() * at.along()


def translational_lift(at, per_rotor):
    """Thrust k |v|^2 by the flow along the disc (Leishman 2006, ch. 2)."""
    squared = np.einsum('ij,ij->i', at.hubs, at.hubs)
    at.thrust = at.thrust + per_rotor * (squared - at.along()**2)


def tilt_thrust_loss(at, loss_at_60deg):
    """Thrust (1 - L s(q)), s by sin^2 q, 1 at 60 deg."""
    at.thrust = at.thrust * (1 - loss_at_60deg * (1 - np.cos(2 * at.tilt)) / 1.5)


def ground_effect(at, **gain):
    """Thrust by the height of the rotor (Cheeseman and Bennett 1955)."""
    up = at.rotation[2]     # world's z axis in base_link
    height = np.maximum(at.position[2] + at.rotors.positions.dot(up), LEAST_HEIGHT)
    at.thrust = at.thrust * (1 + gain['gain_at_0.25m'] * (
        REFERENCE_HEIGHT / height * at.normals.dot(up))**2)


def propeller_gyroscopic_torque(at, angular_momentum_at_hover):
    """Torque -dH/dt of the propellers' angular momentum H, seen in an inertial frame."""
    # H = sum h n turns with the body and with the joints
    turned = directions(at.sideways, at.tilt + 0.5 * np.pi)     # derivative of n by the tilt
    momentum = angular_momentum_at_hover * at.rotors.spin * at.speeds()
    at.torque = at.torque - rotations.cross(at.rate, momentum.dot(at.normals)) \
        - (momentum * at.tilt_rate).dot(turned)
    rotor_acceleration_torque(at, angular_momentum_at_hover)


def rotor_acceleration_torque(at, angular_momentum_at_hover):
    """Torque -h' n of rotors that change their speed, h ~ sqrt(f)."""
    spin_up = 0.5 * at.thrust_rate / (at.hover_thrust * np.maximum(at.speeds(), LEAST_SPEED))
    at.torque = at.torque - (angular_momentum_at_hover * at.rotors.spin * spin_up).dot(at.normals)


def voltage_sag(at, exponent):
    """Thrust (V / V_full)^k."""
    at.thrust = at.thrust * at.voltage_ratio**exponent


LAWS = {law.__name__: law for law in (
    joint_offset, wind, wind_velocity, body_drag, rotor_drag, rotor_hub_moment, axial_inflow,
    translational_lift, tilt_thrust_loss, ground_effect, propeller_gyroscopic_torque,
    rotor_acceleration_torque, voltage_sag)}


class AddedForces:
    """
    Wrench of a robot's effects, and of a play between motors and rotors.

    MuJoCo applies the commanded thrusts along the motors' angles; the wrench is the difference to
    the true ones, and all further forces. An effect without an entry of ``LAWS``, as one that a
    user adds to the catalogue, acts by the model's equation; the others of this robot then too.
    """

    def __init__(self, robot: RobotParameters, has_play: bool):
        self._robot, self._has_play = robot, has_play
        names = [name for name, effect in CATALOGUE.items()
                 if name in robot.effects and effect.apply and name not in BUILT_IN]
        own = all(name in LAWS for name in names)
        self._laws = [(LAWS[name], robot.effects[name]) for name in names] if own else []
        self._model = None if own else native.buffered(native.compiled(
            dynamics.added_wrench(robot, names)))
        self._slow = [name for name in names if CATALOGUE[name].rate]
        self.restart()
        self.active = bool(names) or has_play
        self._sideways = np.cross(robot.tilt_axes, [0.0, 0.0, 1.0])
        # torque (3,) of forces (4, 3) at the rotors, as one product
        self._torques = np.hstack([rotations.skew(r) for r in robot.rotors.positions])
        self._reaction = robot.rotors.spin * robot.torque_ratio

    def restart(self) -> None:
        """Set the states of effects to zero."""
        self._states = {name: np.zeros(4) for name in self._slow}

    def advance(self, thrust: np.ndarray, step: float) -> None:
        """Integrate the states of effects over a ``step`` [s] with thrusts (4,) [N]."""
        for name, state in self._states.items():
            self._states[name] = CATALOGUE[name].advanced(
                self._robot.effects[name], state, thrust / self._robot.hover_thrust, step)

    def __call__(self, quaternion: np.ndarray, driven: np.ndarray, tilt_acceleration: np.ndarray,
                 **motion: Any) -> np.ndarray:
        """
        Force in world [N] and torque in base_link [N m] at base_link, (6,).

        ``driven`` are the motors' angles (4,) [rad], ``motion`` the fields of :class:`Instant`
        without the rotation.
        """
        at = Instant(self._robot.rotors, self._robot.hover_thrust, self._sideways,
                     rotations.matrix(quaternion), **motion)
        thrust, normals = at.thrust, at.normals
        if self._has_play:
            normals = directions(self._sideways, driven)
        for law, values in self._laws:
            law(at, **values)
        force, wrench = at.force, np.zeros(6)
        if at.thrust is not thrust or at.normals is not normals:
            change = at.thrust[:, None] * at.normals - thrust[:, None] * normals
            force = force + change
            wrench[3:] -= self._reaction.dot(change)
        if np.ndim(force):
            wrench[:3] = at.rotation.dot(ONES.dot(force))
            wrench[3:] += self._torques.dot(force.ravel())
        wrench[:3] += at.force_world
        wrench[3:] += at.torque
        if self._model:
            wrench += self._model(
                quaternion, at.velocity, at.rate, at.tilt, at.tilt_rate, tilt_acceleration, thrust,
                at.thrust_rate, at.position, at.voltage_ratio,
                *self._states.values())
        return wrench


class ServoLoads:
    """
    Shift of the servos' targets, and torque on the joints but for friction, by a robot's effects.

    With an effect of servos that has no equation here, those of the model act.
    """

    def __init__(self, robot: RobotParameters):
        self._robot = robot
        names = {name for name in robot.effects
                 if CATALOGUE[name].servo and name != 'joint_friction'}
        self._from_model = bool(names - {'joint_deflection'})
        self._deflection = robot.effect('joint_deflection.deflection_per_newton', 0.0)
        self.active = bool(names)

    def __call__(self, commanded: np.ndarray, thrust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Targets [rad] and torques [N m] (4,) at the true thrusts [N]."""
        if self._from_model:
            terms = [dynamics.tilt_servo(self._robot, i, commanded[i], thrust[i])[1]
                     for i in range(4)]
            return (np.array([each.target for each in terms], dtype=float),
                    np.array([each.load for each in terms], dtype=float))
        return commanded + self._deflection * thrust, np.zeros(4)
