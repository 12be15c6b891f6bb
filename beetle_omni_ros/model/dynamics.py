"""
The robot's dynamics in CasADi: x' = f(x, u, p).

The model is a rigid body with four tilted thrusts and their reaction torques, first-order rotor
lag and second-order tilt servos within limits. It includes the effects that the robot file names.
The NMPC predicts with it, C code is generated from it, and identification fits it. The simulated
plant has its own equations, in MuJoCo and :mod:`sim.forces`. It shares with this model the law of
joint friction, and the equations of effects that only the catalogue has.
"""

import casadi as ca
import numpy as np

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import CASADI, Servo
from beetle_omni_ros.model.terms import ServoTerms, Terms

# Slices of the full state (25): world position [m] and velocity [m/s], attitude (x, y, z, w) body
# to world, body rates [rad/s], tilt angles [rad] and rates [rad/s], thrusts [N].
POSITION, VELOCITY, QUATERNION, RATE = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)
TILT, TILT_RATE, THRUST = slice(13, 17), slice(17, 21), slice(21, 25)
STATE_SIZE, INPUT_SIZE = 25, 8
# Slices of the input (8): tilt targets [rad], thrust targets [N].
TILT_COMMAND, THRUST_COMMAND = slice(0, 4), slice(4, 8)
# Slices of the disturbance (10): force in world [N], torque in body [N m], offset of the resting
# angle of each servo from its target [rad].
FORCE, TORQUE, TILT_OFFSET = slice(0, 3), slice(3, 6), slice(6, 10)
DISTURBANCE_SIZE = 10
ZERO_3, ZERO_4 = ca.DM.zeros(3), ca.DM.zeros(4)


def rotation_matrix(quaternion):
    """Rotation matrix (3, 3) of a unit quaternion (x, y, z, w), body to world."""
    x, y, z, w = ca.vertsplit(quaternion)
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        ca.horzcat(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        ca.horzcat(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)))


def quaternion_rate(quaternion, angular_velocity):
    """Derivative of (x, y, z, w) for body rates [rad/s]: q' = q * (w, 0) / 2."""
    parts = (*ca.vertsplit(quaternion), *ca.vertsplit(angular_velocity), 0)
    return 0.5 * ca.vertcat(*rotations.product(*parts))


def thrust_direction(arm_yaw: float, tilt):
    """Unit thrust vector (3,) in base_link of a rotor at ``tilt`` [rad] about its arm."""
    return ca.vertcat(ca.sin(tilt) * np.sin(arm_yaw), -ca.sin(tilt) * np.cos(arm_yaw),
                      ca.cos(tilt))


def rigid_body(robot: RobotParameters, velocity, quaternion, angular_velocity, tilt, thrust,
               force_world=ZERO_3, torque_body=ZERO_3, tilt_acceleration=ZERO_4, effects=None, *,
               tilt_rate=ZERO_4, thrust_rate=ZERO_4, position=None, voltage_ratio=None,
               states=None, rotor_positions=None):
    """
    Newton-Euler equations of the robot as one rigid body.

    Forces are summed at base_link, and the body turns about its centre of mass. The acceleration
    is that of the origin of base_link. The two points differ only if an effect moves the centre
    of mass. Arguments are named as the fields of :class:`Terms`, ``quaternion`` is body to world.
    Without position, voltage_ratio or ``states`` (name -> (4,)) their effects are absent.
    ``effects`` (name -> parameter -> value or symbol) and ``rotor_positions`` (4, 3) [m] replace
    those of the robot file. Returned are the acceleration (3,) in world [m/s^2] and the angular
    acceleration (3,) in body [rad/s^2].
    """
    rotors = robot.rotors
    places = rotors.positions if rotor_positions is None else rotor_positions
    terms = Terms(
        mass=robot.mass, inertia=ca.DM(robot.inertia), centre_of_mass=ZERO_3,
        torque=torque_body, tilt=tilt, tilt_acceleration=tilt_acceleration,
        tilt_axes=[ca.DM(axis) for axis in robot.tilt_axes],
        thrust=thrust, velocity=velocity, angular_velocity=angular_velocity,
        rotation=rotation_matrix(quaternion),
        thrust_directions=[thrust_direction(rotors.arm_yaw[i], tilt[i]) for i in range(4)],
        rotor_positions=[ca.DM(places[i]) if rotor_positions is None else places[i, :].T
                         for i in range(4)],
        hover_thrust=robot.hover_thrust, force_world=force_world, rotor_forces=[0] * 4,
        torque_ratio=rotors.torque_to_thrust_ratio, tilt_rate=tilt_rate, thrust_rate=thrust_rate,
        spin=tuple(map(float, rotors.spin)), position=position, voltage_ratio=voltage_ratio)
    effects = robot.effects if effects is None else effects
    for name, effect in CATALOGUE.items():
        terms.state = (states or {}).get(name)
        needed = (*effect.measured, 'state') if effect.rate else effect.measured
        if name in effects and effect.apply is not None and not any(
                getattr(terms, term) is None for term in needed):
            effect.apply(terms, **effects[name])
    force, torque = 0, terms.torque
    for i in range(4):
        rotor_force = terms.thrust[i] * terms.thrust_directions[i] + terms.rotor_forces[i]
        force = force + rotor_force
        torque = torque + ca.cross(terms.rotor_positions[i], rotor_force) \
            - rotors.spin[i] * terms.torque_ratio * terms.thrust[i] * terms.thrust_directions[i]
    acceleration = (terms.rotation @ force + terms.force_world) / terms.mass \
        + ca.DM([0, 0, -robot.gravity])
    centre = terms.centre_of_mass
    torque = torque - ca.cross(centre, force + terms.rotation.T @ terms.force_world)
    angular_acceleration = (torque - ca.cross(angular_velocity, terms.inertia * angular_velocity)
                            ) / terms.inertia
    acceleration = acceleration - terms.rotation @ (
        ca.cross(angular_acceleration, centre)
        + ca.cross(angular_velocity, ca.cross(angular_velocity, centre)))
    return acceleration, angular_acceleration


def added_wrench(robot: RobotParameters, names: list[str]) -> ca.Function:
    """
    Force in world [N] and torque in base_link [N m] at base_link that the named effects add.

    The reference is the robot without these effects, with the mass and inertia of its file. It
    has the effect torque_coefficient, because added thrusts also turn the body.

    Returns:
        f(quaternion, velocity, rate, tilt, tilt_rate, tilt_acceleration, thrust, thrust_rate,
        position, voltage_ratio, states of each named effect with a rate (4,)) -> force and torque
        (6,).

    """
    sizes = {'quaternion': 4, 'velocity': 3, 'rate': 3, 'tilt': 4, 'tilt_rate': 4,
             'tilt_acceleration': 4, 'thrust': 4, 'thrust_rate': 4, 'position': 3,
             'voltage_ratio': 1}
    slow = [name for name in names if CATALOGUE[name].rate]
    sizes |= {f'state_of_{name}': 4 for name in slow}
    x = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    both = {name: robot.effects[name] for name in ('torque_coefficient',) if name in robot.effects}

    def wrench(effects):
        acceleration, turning = rigid_body(
            robot, x['velocity'], x['quaternion'], x['rate'], x['tilt'], x['thrust'],
            tilt_acceleration=x['tilt_acceleration'], effects=effects,
            states={name: x[f'state_of_{name}'] for name in slow}, **{name: x[name] for name in (
                'tilt_rate', 'thrust_rate', 'position', 'voltage_ratio')})
        return robot.mass * acceleration, ca.DM(robot.inertia) * turning

    without = wrench(both)
    acting = wrench(both | {name: robot.effects[name] for name in names})
    return ca.Function('added_wrench', list(x.values()), [
        ca.densify(ca.cse(ca.vertcat(*acting) - ca.vertcat(*without)))], list(x), ['wrench'])


def tilt_servo(robot: RobotParameters, joint: int, target,
               thrust=0.0) -> tuple[Servo, ServoTerms]:
    """
    Servo of a joint (0 to 3) and the terms that act on it, with the robot file's effects.

    ``target`` is the commanded angle [rad], ``thrust`` that of the joint's rotor [N].
    """
    terms = ServoTerms(target, thrust)
    for name, values in robot.effects.items():
        act = CATALOGUE[name].servo
        if act is not None:
            act(terms, joint, **values)
    stiction = None if terms.coulomb is None else max(terms.coulomb, terms.stiction)
    return Servo.of(robot.joints.of(joint), coulomb=terms.coulomb, stiction=stiction), terms


def full_model(robot: RobotParameters) -> ca.Function:
    """State derivative f(x (25), u (8), d (10)) -> (25,); slices of this module."""
    x, u, d = ca.SX.sym('x', STATE_SIZE), ca.SX.sym('u', INPUT_SIZE), \
        ca.SX.sym('d', DISTURBANCE_SIZE)
    limit = robot.joints.position_limit
    target = ca.fmin(ca.fmax(u[TILT_COMMAND], -limit), limit) + d[TILT_OFFSET]
    thrust_target = ca.fmin(ca.fmax(u[THRUST_COMMAND], robot.rotors.thrust_min),
                            robot.rotors.thrust_max)
    accelerations = []
    for i in range(4):
        servo, terms = tilt_servo(robot, i, target[i], x[THRUST][i])
        accelerations.append(servo.acceleration(
            CASADI, terms.target, x[TILT][i], x[TILT_RATE][i], terms.load))
    tilt_acceleration = ca.vertcat(*accelerations)
    thrust_rate = (thrust_target - x[THRUST]) / robot.rotors.time_constant
    acceleration, angular_acceleration = rigid_body(
        robot, x[VELOCITY], x[QUATERNION], x[RATE], x[TILT], x[THRUST], d[FORCE], d[TORQUE],
        tilt_acceleration, tilt_rate=x[TILT_RATE], thrust_rate=thrust_rate, position=x[POSITION])
    return ca.Function('dynamics', [x, u, d], [ca.vertcat(
        x[VELOCITY], acceleration, quaternion_rate(x[QUATERNION], x[RATE]), angular_acceleration,
        x[TILT_RATE], tilt_acceleration, thrust_rate)], ['x', 'u', 'd'], ['x_dot'])


def body_acceleration(robot: RobotParameters) -> ca.Function:
    """(velocity, quaternion, angular_velocity, tilt, thrust) -> world and angular acceleration."""
    v, q, w = ca.SX.sym('v', 3), ca.SX.sym('q', 4), ca.SX.sym('w', 3)
    tilt, thrust = ca.SX.sym('tilt', 4), ca.SX.sym('thrust', 4)
    return ca.Function('body_acceleration', [v, q, w, tilt, thrust],
                       list(rigid_body(robot, v, q, w, tilt, thrust)),
                       ['velocity', 'quaternion', 'angular_velocity', 'tilt', 'thrust'],
                       ['acceleration', 'angular_acceleration'])


def integrator(robot: RobotParameters, substeps: int = 2) -> ca.Function:
    """advance(x (25), u (8), d (10), dt) -> x after dt [s], by fourth-order Runge-Kutta."""
    x, u, d, dt = ca.SX.sym('x', STATE_SIZE), ca.SX.sym('u', INPUT_SIZE), \
        ca.SX.sym('d', DISTURBANCE_SIZE), ca.SX.sym('dt')
    f = full_model(robot)
    h, state = dt / substeps, x
    for _ in range(substeps):
        k1 = f(state, u, d)
        k2 = f(state + h / 2 * k1, u, d)
        k3 = f(state + h / 2 * k2, u, d)
        k4 = f(state + h * k3, u, d)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    quaternion = state[QUATERNION] / ca.norm_2(state[QUATERNION])
    state = ca.vertcat(state[:6], quaternion, state[10:])
    return ca.Function('advance', [x, u, d, dt], [state], ['x', 'u', 'd', 'dt'], ['x_next'])
