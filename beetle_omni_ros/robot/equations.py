"""Terms of the equations of body and servos, and how each effect of the catalogue changes them."""

from dataclasses import dataclass
from typing import Any

import casadi as ca

UP = ca.DM([0, 0, 1])
REFERENCE_HEIGHT = 0.25     # [m] of the rotor, for which the gain of the ground effect is given
EXPONENTIAL_HEIGHT = 0.25   # [m] over which the exponential form falls to 1/e
LEAST_HEIGHT = 0.08         # [m] below which the forms are not valid


@dataclass
class Terms:
    """
    Terms of the body's equations at one instant, as CasADi expressions; effects change them.

    Vectors are in base_link, unless stated otherwise. Lists have an entry for each rotor.
    """

    mass: ca.SX                     # [kg]
    inertia: ca.SX                  # (3,) diagonal about the centre of mass [kg m^2]
    centre_of_mass: ca.SX           # (3,) [m]
    torque: ca.SX                   # (3,) added on the body [N m]
    tilt: ca.SX                     # (4,) [rad]
    tilt_acceleration: ca.SX        # (4,) [rad/s^2]
    tilt_axes: list                 # of (3,) unit vectors, outward along the arms
    thrust: ca.SX                   # (4,) after the rotors' lag [N]
    velocity: ca.SX                 # (3,) of the centre of gravity in world [m/s]
    angular_velocity: ca.SX         # (3,) [rad/s]
    rotation: ca.SX                 # (3, 3) body to world
    thrust_directions: list         # of (3,) unit vectors
    rotor_positions: list           # of (3,) [m]
    hover_thrust: float             # of each rotor [N]
    force_world: ca.SX              # (3,) added, in world [N]
    rotor_forces: list              # of (3,) added at the rotors [N]
    torque_ratio: ca.SX             # reaction torque for each newton [m]
    tilt_rate: ca.SX                # (4,) [rad/s]
    thrust_rate: ca.SX              # (4,) [N/s]
    spin: tuple[float, ...]         # (4,) +1 along the thrust
    position: ca.SX | None = None       # (3,) of base_link in world [m]; None: unknown
    voltage_ratio: ca.SX | None = None  # of the pack over that of a full pack; None: unknown
    # Drawn from the pack [A h], None: unknown. In the simulator since the pack was inserted, in a
    # recording since its first battery message.
    charge_drawn: ca.SX | None = None

    def rotor_speeds(self) -> list:
        """Rotor speeds relative to hover, computed from thrust; list of four scalars."""
        return [ca.sqrt(ca.fmax(self.thrust[i], 0) / self.hover_thrust + 1e-9) for i in range(4)]

    def hub_velocities(self) -> list:
        """List of four (3,) velocities of the rotor hubs through still air in base_link [m/s]."""
        body = self.rotation.T @ self.velocity
        return [body + ca.cross(self.angular_velocity, r) for r in self.rotor_positions]


@dataclass
class ServoTerms:
    """Terms that act on one tilt servo at one instant, numbers of any namespace."""

    target: Any             # commanded angle [rad]
    thrust: Any = 0.0       # of the joint's rotor [N]
    gyroscopic: Any = 0.0   # load for each N m s of the rotor's momentum in hover [rad/s]
    load: Any = 0.0         # torque beside the motor's [N m]
    coulomb: Any = None     # sliding friction [N m]
    stiction: Any = None    # friction at rest [N m]


def vector(values):
    """(n,) column of a tuple of numbers or symbols; any other value unchanged."""
    return ca.vertcat(*ca.vertsplit(ca.SX(ca.vertcat(*values)))) if isinstance(values, tuple) \
        else values


def sets(term):
    """Equation of an effect whose one parameter replaces a term."""
    def act(terms, **values):
        value, = values.values()
        setattr(terms, term, vector(value))
    return act


def centre_of_mass(terms, offset):
    terms.centre_of_mass = terms.centre_of_mass + vector(offset)


def module_reaction(terms, module_inertia, mass_moment):
    for i in range(4):
        rate, acceleration = terms.tilt_rate[i], terms.tilt_acceleration[i]
        n, e = terms.thrust_directions[i], terms.tilt_axes[i]
        terms.torque = terms.torque - module_inertia * acceleration * e
        # The centre of mass of the module is below the joint axis. It moves against the thrust,
        # and its acceleration pushes back on the axis.
        terms.centre_of_mass = terms.centre_of_mass - mass_moment / terms.mass * (n - UP)
        sideways = ca.cross(e, n)
        terms.rotor_forces[i] = terms.rotor_forces[i] + mass_moment * (
            acceleration * sideways - rate * rate * n
            + 2 * rate * ca.cross(terms.angular_velocity, sideways))


def thrust_coefficient(terms, scale):
    terms.thrust = vector(scale) * terms.thrust


def wind(terms, force):
    terms.force_world = terms.force_world + vector(force)


def body_drag(terms, coefficient):
    speed = ca.sqrt(ca.sumsqr(terms.velocity) + 1e-12)
    terms.force_world = terms.force_world - coefficient * speed * terms.velocity


def rotor_drag(terms, coefficient):
    speeds = terms.rotor_speeds()
    for i, v in enumerate(terms.hub_velocities()):
        n = terms.thrust_directions[i]
        in_plane = v - n * ca.dot(n, v)
        terms.rotor_forces[i] = terms.rotor_forces[i] - coefficient / 4 * speeds[i] * in_plane


def axial_inflow(terms, per_rotor):
    speeds = terms.rotor_speeds()
    loss = [per_rotor * speeds[i] * ca.dot(terms.thrust_directions[i], v)
            for i, v in enumerate(terms.hub_velocities())]
    terms.thrust = terms.thrust - ca.vertcat(*loss)


def translational_lift(terms, per_rotor):
    gain = []
    for i, v in enumerate(terms.hub_velocities()):
        n = terms.thrust_directions[i]
        gain.append(per_rotor * ca.sumsqr(v - n * ca.dot(n, v)))
    terms.thrust = terms.thrust + ca.vertcat(*gain)


def tilt_thrust_loss(terms, loss_at_60deg, cosine_share=0.0):
    sine, cosine = ca.sin(terms.tilt), ca.cos(terms.tilt)
    shape = (1 - cosine_share) * sine * sine / 0.75 + cosine_share * 2 * (1 - cosine)
    terms.thrust = terms.thrust * (1 - loss_at_60deg * shape)


def ground_effect(terms, exponential_share=0.0, **values):
    if terms.position is None:
        return
    scale = []
    for i in range(4):
        height = ca.fmax(terms.position[2] + (terms.rotation @ terms.rotor_positions[i])[2],
                         LEAST_HEIGHT)
        upright = (terms.rotation @ terms.thrust_directions[i])[2]
        ratio = REFERENCE_HEIGHT / height
        shape = (1 - exponential_share) * ratio * ratio + exponential_share * ca.exp(
            (REFERENCE_HEIGHT - height) / EXPONENTIAL_HEIGHT)
        scale.append(1 + values['gain_at_0.25m'] * shape * upright * upright)
    terms.thrust = terms.thrust * ca.vertcat(*scale)


def gyroscopic_load(servo, joint, angular_momentum_at_hover, spin_up_share=1.0,
                     joint_share=0.0):
    servo.load = servo.load + joint_share * angular_momentum_at_hover * servo.gyroscopic


def propeller_gyroscopic_torque(terms, angular_momentum_at_hover, spin_up_share=1.0,
                                 joint_share=0.0):
    speeds = terms.rotor_speeds()
    for i in range(4):
        momentum = angular_momentum_at_hover * terms.spin[i] * speeds[i]
        turning = terms.angular_velocity + terms.tilt_rate[i] * terms.tilt_axes[i]
        terms.torque = terms.torque - momentum * ca.cross(turning, terms.thrust_directions[i])
    rotor_acceleration_torque(terms, spin_up_share * angular_momentum_at_hover)


def rotor_acceleration_torque(terms, angular_momentum_at_hover):
    speeds = terms.rotor_speeds()
    for i in range(4):
        # h ~ sqrt(f), so h' = h f' / 2 f; the floor keeps a stopped rotor finite
        rate = terms.thrust_rate[i] / (2 * terms.hover_thrust * ca.fmax(speeds[i], 0.1))
        terms.torque = terms.torque - angular_momentum_at_hover * terms.spin[i] * rate \
            * terms.thrust_directions[i]


def voltage_sag(terms, exponent):
    terms.thrust = terms.thrust * ca.exp(exponent * ca.log(terms.voltage_ratio))


def joint_offset(terms, offset):
    offset = vector(offset)
    turned = []
    for i in range(4):
        n, e = terms.thrust_directions[i], terms.tilt_axes[i]
        turned.append(ca.cos(offset[i]) * n + ca.sin(offset[i]) * ca.cross(e, n))
    terms.tilt, terms.thrust_directions = terms.tilt + offset, turned


def joint_deflection(servo, joint, deflection_per_newton):
    servo.target = servo.target + per_joint(deflection_per_newton, joint) * servo.thrust


def per_joint(value, joint: int):
    """Value of a joint, from one number for all joints or a tuple of four."""
    return value[joint] if isinstance(value, tuple) else value


def joint_friction(servo, joint, coulomb, stiction):
    servo.coulomb = per_joint(coulomb, joint)
    servo.stiction = per_joint(stiction, joint)
