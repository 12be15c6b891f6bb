"""
Model of the robot in the training environment, as one CasADi function.

To :mod:`robot.dynamics` it adds the integration over a short substep, the limits of the servos and
the quantities that differ between robots. With a multibody section in the robot file it includes
the reaction of the tilting modules and their shift of the centre of mass, without which a policy
does not hold level attitudes on the multibody plant.
"""

from dataclasses import replace

import casadi as ca
import numpy as np

from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import CASADI, SLIDING_RATE, Step

# Quantities of each robot: mass [kg], inertia (3) [kg m^2], centre of mass (3) [m]; for the four
# joints stiffness [N m/rad], damping [N m s/rad], Coulomb friction and stiction [N m] and play
# [rad]; lag of the rotors [s]; for the rotors their distance from the centre of gravity as a
# fraction of the robot file's, and thrust for a command (4).
MASS, INERTIA, CENTRE = slice(0, 1), slice(1, 4), slice(4, 7)
STIFFNESS, DAMPING, COULOMB, STICTION, PLAY = (slice(k, k + 4) for k in range(7, 27, 4))
LAG, ACTUATORS = slice(27, 28), slice(7, 28)
ARM, GAIN = slice(28, 29), slice(29, 33)
BODY_SIZE = 33
SERVO_STEPS = 2    # servo steps in a substep; a servo reaches its rate limit within 1 ms
WRENCH_SIZE = 6    # external force in world [N], torque in body [N m]


def module_reaction(robot: RobotParameters) -> dict[str, float]:
    """Parameters of the effect ``module_reaction`` from the multibody section [kg m^2], [kg m]."""
    module = robot.multibody.module
    depth = -float(module.centre_of_mass[2])
    return {'module_inertia': float(module.inertia[0] + module.mass * depth ** 2),
            'mass_moment': float(module.mass * depth)}


def nominal_body(robot: RobotParameters) -> list[float]:
    """(33,) quantities of the robot file, with its effects."""
    return [robot.effect('mass.mass', robot.mass), *robot.effect('inertia.inertia', robot.inertia),
            *robot.effect('centre_of_mass.offset', (0.0, 0.0, 0.0)), *actuators(robot), 1.0,
            *robot.effect('rotor_thrust_coefficient.scale', (1.0,) * 4)]


def actuators(robot: RobotParameters) -> np.ndarray:
    """(21,) quantities ``ACTUATORS`` of a robot."""
    joints = [robot.effect(key, neutral) for key, neutral in (
        ('joint_bandwidth.kp', robot.joints.kp), ('joint_bandwidth.kd', robot.joints.kd),
        ('joint_friction.coulomb', 0.0), ('joint_friction.stiction', 0.0),
        ('joint_backlash.gap', 0.0))]
    lag = robot.effect('rotor_lag.time_constant', robot.rotors.time_constant)
    return np.hstack([*(np.broadcast_to(value, 4) for value in joints), lag])


def _servos(robot, x, target, h, body):
    """Tilts (4,) and rates (4,) after ``h`` seconds, within rate limit and stops."""
    tilts, rates = [], []
    for i in range(4):
        tilt, rate, thrust = x[model.TILT][i], x[model.TILT_RATE][i], x[model.THRUST][i]
        servo, terms = model.tilt_servo(robot, i, target[i], thrust)
        coulomb = body[COULOMB][i]
        step = Step(CASADI, replace(
            servo, kp=body[STIFFNESS][i], kd=body[DAMPING][i], coulomb=coulomb,
            stiction=ca.fmax(coulomb, body[STICTION][i]),
            position_limit=robot.joints.position_limit), h / SERVO_STEPS)
        for _ in range(SERVO_STEPS):
            tilt, rate = step(terms.target, tilt, rate, terms.load)
        tilts.append(tilt)
        rates.append(rate)
    return ca.vertcat(*tilts), ca.vertcat(*rates)


def _behind_play(gap, tilt, rate):
    """
    Tilts of the rotors (4,) behind the play of the joints.

    A turning motor leads by half the gap. The state has no side of contact at rest, so the rotor
    is then in the middle.
    """
    speed = rate / SLIDING_RATE
    return tilt - 0.5 * gap * speed / ca.sqrt(1 + speed * speed)


def substep(robot: RobotParameters, duration: float) -> ca.Function:
    """
    One integration step of ``duration`` [s]: x (25), u (8), wrench (6), body (33) -> x_next (25).

    The servos take shorter steps within rate limit and stops. The rotor lag is exact. The body
    uses the acceleration at the mean thrust and the new tilt. The slices are those of
    :mod:`robot.dynamics` and of this module.
    """
    x, u = ca.SX.sym('x', model.STATE_SIZE), ca.SX.sym('u', model.INPUT_SIZE)
    wrench, body = ca.SX.sym('wrench', WRENCH_SIZE), ca.SX.sym('body', BODY_SIZE)
    h, joints, rotors = duration, robot.joints, robot.rotors

    def clip(value, low, high):
        return ca.fmin(ca.fmax(value, low), high)

    rate = x[model.TILT_RATE]
    target = clip(u[model.TILT_COMMAND], -joints.position_limit, joints.position_limit)
    new_tilt, new_rate = _servos(robot, x, target, h, body)

    thrust_target = clip(u[model.THRUST_COMMAND], rotors.thrust_min, rotors.thrust_max)
    thrust = x[model.THRUST]
    new_thrust = thrust + (1 - ca.exp(-h / body[LAG])) * (thrust_target - thrust)

    effects = dict(robot.effects)
    if robot.multibody is not None:
        effects.setdefault('module_reaction', module_reaction(robot))
    effects.update(mass={'mass': body[MASS]}, inertia={'inertia': body[INERTIA]},
                   centre_of_mass={'offset': body[CENTRE]},
                   rotor_thrust_coefficient={'scale': body[GAIN]})
    order = ['mass', *(name for name in effects if name != 'mass')]
    acceleration, angular_acceleration = model.rigid_body(
        robot, x[model.VELOCITY], x[model.QUATERNION], x[model.RATE],
        _behind_play(body[PLAY], new_tilt, new_rate),
        (thrust + new_thrust) / 2, wrench[:3], wrench[3:], (new_rate - rate) / h,
        {name: effects[name] for name in order}, tilt_rate=new_rate,
        thrust_rate=(new_thrust - thrust) / h, position=x[model.POSITION],
        rotor_positions=body[ARM] * ca.DM(rotors.positions))
    velocity = x[model.VELOCITY] + h * acceleration
    angular_velocity = x[model.RATE] + h * angular_acceleration
    position = x[model.POSITION] + h * (x[model.VELOCITY] + velocity) / 2
    quaternion = x[model.QUATERNION] + h * model.quaternion_rate(
        x[model.QUATERNION], (x[model.RATE] + angular_velocity) / 2)
    quaternion = quaternion / ca.norm_2(quaternion)
    after = ca.vertcat(position, velocity, quaternion, angular_velocity, new_tilt, new_rate,
                       new_thrust)
    return ca.Function('substep', [x, u, wrench, body], [ca.cse(after)],
                       ['x', 'u', 'wrench', 'body'], ['x_next'])
