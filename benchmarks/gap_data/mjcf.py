"""
MuJoCo models of the robot, rigid and multibody, written from the interface's numbers.

Rigid: one free body; the four tilts are shafts of their own that obey the servo's equation and
load nothing. Multibody: main body, ball and four tilting modules that weigh on their servos.
Either way ``base_link`` is the free body's frame, three forces and three torques act on it in
its own axes (actuators ``base0..5``), and ``servo1..4`` are PD torques.
"""

import numpy as np

from gap_data.truth import Robot

FRICTION_SWITCH = 1e-12  # [N m] keeps the friction constraint in the model, to be set in flight


def _vector(values) -> str:
    return ' '.join(f'{float(v):.12g}' for v in np.atleast_1d(values))


def _shift(mass, offset):
    """Inertia matrix [kg m^2] of a point mass at an offset."""
    offset = np.asarray(offset, float)
    return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))


def model_xml(robot: Robot, *, multibody: bool, imu_position=(0.0, 0.0, 0.0),
              friction: bool = False, slosh: dict | None = None) -> str:
    """
    The whole model.

    Args:
        robot: what is true.
        multibody: which of the two descriptions.
        imu_position: (3,) [m] of the IMU in base_link.
        friction: whether joints have dry friction (its size is set in flight).
        slosh: a loose mass within the body: mass [kg], stiffness [N/m], damping [N s/m],
            position (3,) [m]; its mass is taken from the body's.

    """
    # MuJoCo's dry friction creeps; hard enough that it creeps by micrometres of the rim only
    loss = (f' frictionloss="{FRICTION_SWITCH}" solreffriction="0.002 1" '
            'solimpfriction="0.9999 0.9999 0.001"' if friction else '')
    loose, taken = _loose_mass(slosh)
    inside, outside = (_modules(robot, loss), '') if multibody else ('', _shafts(robot, loss))
    inertial = _main_inertial(robot, taken) if multibody else _rigid_inertial(robot, taken)
    base = ''.join(f'<general name="base{k}" site="base" gear="{_vector(axes)}"/>'
                   for k, axes in enumerate(np.eye(6)))
    servos = ''.join(
        f'<general name="servo{i + 1}" joint="gimbal{i + 1}" gainprm="{robot.kp[i]:.9g}" '
        f'biastype="affine" biasprm="0 {-robot.kp[i]:.9g} {-robot.kd[i]:.9g}" '
        f'forcelimited="true" forcerange="{-robot.effort_limit[i]:.9g} '
        f'{robot.effort_limit[i]:.9g}"/>' for i in range(4))
    numbers = robot.numbers
    return f"""<mujoco>
  <compiler angle="radian" autolimits="false" inertiafromgeom="false"/>
  <option timestep="{numbers['step']}" integrator="RK4"
          gravity="0 0 {-numbers['robot']['gravity']}"
          solver="Newton" iterations="20" tolerance="1e-10">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body name="base_link"><freejoint/>{inertial}
      <site name="base"/><site name="imu" pos="{_vector(imu_position)}"/>{inside}{loose}</body>
    {outside}</worldbody>
  <actuator>{base}{servos}</actuator>
  <sensor><accelerometer site="imu"/></sensor>
</mujoco>"""


def _rigid_inertial(robot, taken):
    mass = robot.mass - taken
    return (f'<inertial pos="{_vector(robot.centre * robot.mass / mass)}" mass="{mass:.9g}" '
            f'diaginertia="{_vector(robot.inertia)}"/>')


def _shafts(robot, loss):
    return ''.join(
        f'<body name="shaft{i + 1}"><joint name="gimbal{i + 1}" type="hinge" axis="1 0 0"{loss}/>'
        f'<inertial pos="0 0 0" mass="1" diaginertia="{_vector([robot.joint_inertia] * 3)}"/>'
        '</body>' for i in range(4))


def main_body(robot, taken=0.0):
    """The main body, what the modules and the ball leave of the totals: mass, place, inertia."""
    parts = robot.numbers['parts']
    others = [(parts['ball_mass'], np.array([0, 0, parts['ball_height']]), _ball_inertia(parts))]
    for arm in robot.arms:
        turn = np.array([[arm[0], -arm[1], 0], [arm[1], arm[0], 0], [0, 0, 1]])
        place = _joint_place(parts, arm) + turn @ np.array(parts['module_centre'])
        others.append((parts['module_mass'], place,
                       turn @ np.diag(parts['module_inertia']) @ turn.T))
    centre = robot.centre + [0, 0, parts['gravity_centre_height']]
    mass = robot.mass - sum(m for m, _, _ in others) - taken
    place = (robot.mass * centre - sum(m * p for m, p, _ in others)
             - taken * np.array([0, 0, parts['gravity_centre_height']])) / mass
    inertia = np.diag(robot.inertia) - sum(j + _shift(m, p - centre) for m, p, j in others)
    inertia -= _shift(mass, place - centre)
    return mass, place - [0, 0, parts['gravity_centre_height']], inertia


def _ball_inertia(parts):
    return 0.4 * parts['ball_mass'] * parts['ball_radius'] ** 2 * np.eye(3)


def _main_inertial(robot, taken):
    parts = robot.numbers['parts']
    mass, place, inertia = main_body(robot, taken)
    full = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2],
            inertia[1, 2]]
    height = parts['ball_height'] - parts['gravity_centre_height']
    ball = _vector(np.diag(_ball_inertia(parts)))
    return (f'<inertial pos="{_vector(place)}" mass="{mass:.9g}" fullinertia="{_vector(full)}"/>'
            f'<body name="ball" pos="0 0 {height:.9g}"><inertial pos="0 0 0" '
            f'mass="{parts["ball_mass"]}" diaginertia="{ball}"/></body>')


def _joint_place(parts, arm):
    return np.array([np.sign(arm[0]) * parts['module_offset'],
                     np.sign(arm[1]) * parts['module_offset'], parts['module_height']])


def _modules(robot, loss):
    parts = robot.numbers['parts']
    text = ''
    for i, arm in enumerate(robot.arms):
        place = _joint_place(parts, arm) - [0, 0, parts['gravity_centre_height']]
        yaw = np.arctan2(arm[1], arm[0])
        text += (f'<body name="module{i + 1}" pos="{_vector(place)}" '
                 f'quat="{_vector([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])}">'
                 f'<joint name="gimbal{i + 1}" type="hinge" axis="1 0 0"{loss}/>'
                 f'<inertial pos="{_vector(parts["module_centre"])}" '
                 f'mass="{parts["module_mass"]}" '
                 f'diaginertia="{_vector(parts["module_inertia"])}"/></body>')
    return text


def _loose_mass(slosh):
    """A mass on springs in three directions, as a battery that is not tied down."""
    if not slosh:
        return '', 0.0
    slides = ''.join(
        f'<joint name="slosh{k}" type="slide" axis="{axis}" stiffness="{slosh["stiffness"]}" '
        f'damping="{slosh["damping"]}"/>'
        for k, axis in enumerate(('1 0 0', '0 1 0', '0 0 1')))
    return (f'<body name="loose" pos="{_vector(slosh["position"])}">{slides}'
            f'<inertial pos="0 0 0" mass="{slosh["mass"]}" diaginertia="1e-4 1e-4 1e-4"/></body>',
            slosh['mass'])
