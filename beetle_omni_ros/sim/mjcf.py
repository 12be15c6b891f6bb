"""MuJoCo model of the robot: free base, four hinged modules, actuators, floor."""

import mujoco
import numpy as np

from beetle_omni_ros.model.parameters import combined, MassProperties, RigidPart, RobotParameters
from beetle_omni_ros.sim.parameters import SimulatorParameters

BASE = 1                        # body index of base_link; 0 is the world
TINY_MASS = 1e-12               # [kg] MuJoCo requires mass and inertia of a moving body
TINY_INERTIA = 1e-13            # [kg m^2]
MOTOR_HEIGHT = 0.02             # [m] half height of the contact disc of a propeller
FLOOR_FRICTION = 0.8            # [-] rubber foot on a gym mat, chosen
CONTACT_TIME = 0.01             # [s] time constant of the contact with the floor: soft enough for
                                # 1 kHz, sinks less than 1 mm at rest; chosen
CONTACT_DAMPING = 1.0           # [-] damping ratio: lands without bouncing, chosen
PAYLOAD_DEPTH = 0.08            # [m] a payload's centre below base_link, between the legs; chosen
PAYLOAD_DENSITY = 2700.0        # [kg/m^3] an aluminium ball

# solref and solimp of the joint stops, as stiff as is stable with steps of 1 ms.
STOP_SOFTNESS = 0.002, 1.0
STOP_IMPEDANCE = 0.99, 0.999, 0.001


def build_model(robot: RobotParameters, plant: SimulatorParameters,
                parts: MassProperties) -> mujoco.MjModel:
    """
    Compile the plant; :func:`set_payload` gives base_link its mass.

    Generalised velocities: base_link's velocity in world (3) and angular velocity in
    base_link (3), then the four tilt rates. Controls: four thrust commands [N], four tilt
    targets [rad]; activations: the four lagged thrusts [N].

    An unloaded joint has the dynamics J q'' = Kp (q* - q) - Kd q'. J was identified from step
    responses of a servo with its module, but the module's own inertia about the joint axis is
    larger. The negative difference is the armature of the joint, an internal torque between module
    and body, so that the response is as identified and the momentum is conserved.
    """
    model = mujoco.MjModel.from_xml_string(_mjcf(robot, plant, parts))
    module = robot.parts.module
    sideways, up = module.centre_of_mass[1:]
    own = module.inertia[0] + module.mass * (sideways ** 2 + up ** 2)
    model.dof_armature[6:] = robot.joints.inertia - own
    return model


def set_payload(model: mujoco.MjModel, parts: MassProperties, payload: float) -> None:
    """Give base_link the mass of main body, end-effector and a ``payload`` [kg]."""
    rigid = [parts.main_body, parts.end_effector]
    if payload:
        radius = (3 * payload / (4 * np.pi * PAYLOAD_DENSITY)) ** (1 / 3)
        rigid.append(RigidPart(payload, np.array([0.0, 0.0, -PAYLOAD_DEPTH]),
                               0.4 * payload * radius ** 2 * np.eye(3)))
    whole = combined(rigid)
    moments, axes = np.linalg.eigh(whole.inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    model.body_mass[BASE] = whole.mass
    model.body_ipos[BASE] = whole.centre
    model.body_inertia[BASE] = moments
    mujoco.mju_mat2Quat(model.body_iquat[BASE], axes.ravel())
    model.body_sameframe[BASE] = 0      # the inertial frame may differ from the compiled one
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _text(*numbers):
    return ' '.join(repr(float(x)) for x in np.ravel(numbers))


def _module(robot, plant, parts, k):
    module, joints = robot.parts.module, robot.joints
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, parts.module_rotations[k].ravel())
    inertia = np.maximum(module.inertia, TINY_INERTIA)
    return f"""
      <body name="module{k + 1}" pos="{_text(parts.joint_origins[k])}" quat="{_text(quaternion)}">
        <joint name="gimbal{k + 1}" axis="1 0 0" limited="true"
               solreflimit="{_text(*STOP_SOFTNESS)}" solimplimit="{_text(*STOP_IMPEDANCE)}"
               range="{_text(-joints.position_limit, joints.position_limit)}"/>
        <inertial pos="{_text(module.centre_of_mass)}" mass="{max(module.mass, TINY_MASS)!r}"
                  diaginertia="{_text(inertia)}"/>
        <site name="rotor{k + 1}" pos="{_text(module.rotor_offset, 0, 0)}"/>
        <geom name="propeller{k + 1}" type="cylinder" pos="{_text(module.rotor_offset, 0, 0)}"
              size="{_text(plant.propeller_radius, MOTOR_HEIGHT)}"/>
      </body>"""


def _mjcf(robot, plant, parts):
    joints, rotors = robot.joints, robot.rotors
    scale, limit = robot.thrust_scale, joints.effort_limit
    actuators = [
        f'<general name="rotor{k + 1}" site="rotor{k + 1}" dyntype="filter" '
        f'dynprm="{rotors.time_constant!r}" gear="{_text(0, 0, scale[k], 0, 0)} '
        f'{_text(-rotors.spin[k] * robot.torque_ratio * scale[k])}"/>' for k in range(4)]
    actuators += [
        f'<general name="servo{k + 1}" joint="gimbal{k + 1}" gainprm="{joints.of(k).kp!r}" '
        f'biastype="affine" biasprm="{_text(0, -joints.of(k).kp, -joints.of(k).kd)}" '
        f'forcelimited="true" forcerange="{_text(-limit, limit)}"/>' for k in range(4)]
    foot_z = plant.foot_radius - plant.foot_depth
    feet = ''.join(f'<geom name="foot{k + 1}" type="sphere" size="{plant.foot_radius!r}" '
                   f'pos="{_text(x * plant.foot_spread, y * plant.foot_spread, foot_z)}"/>\n'
                   for k, (x, y) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]))
    modules = ''.join(_module(robot, plant, parts, k) for k in range(4))
    ball = parts.main_origin + [0, 0, robot.parts.end_effector.height]
    return f"""
<mujoco model="{robot.name}">
  <compiler angle="radian" autolimits="true" inertiafromgeom="false"/>
  <option timestep="{plant.tick / plant.substeps!r}" integrator="RK4"
          gravity="{_text(0, 0, -robot.gravity)}">
    <flag midphase="disable" island="disable" sensor="disable" autoreset="disable"/>
  </option>
  <default>
    <geom contype="1" conaffinity="0" condim="3"
          friction="{_text(FLOOR_FRICTION, 0.005, 1e-4)}"
          solref="{_text(CONTACT_TIME, CONTACT_DAMPING)}"
          rgba="0.3 0.3 0.32 1"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" contype="0" conaffinity="1"/>
    <body name="base_link">
      <freejoint name="base"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <geom name="main_body" type="cylinder" size="{_text(0.5 * plant.foot_spread, 0.03)}"/>
      <geom name="end_effector" type="sphere" size="{plant.end_effector_radius!r}"
            pos="{_text(ball)}"/>
      {feet}{modules}
    </body>
  </worldbody>
  <actuator>{''.join(actuators)}</actuator>
</mujoco>"""
