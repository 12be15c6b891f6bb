"""The multibody plant: free base, four hinged modules, actuators and floor in MuJoCo."""

from collections.abc import Sequence

import mujoco
import numpy as np

from beetle_omni_ros.model import dynamics, rotations
from beetle_omni_ros.model.allocation import clipped
from beetle_omni_ros.model.parameters import (
    combined,
    mass_properties,
    MassProperties,
    RigidPart,
    RobotParameters,
    Variation,
)
from beetle_omni_ros.model.schema import RunError
from beetle_omni_ros.model.servo import NUMPY
from beetle_omni_ros.sim.forces import AddedForces, ServoLoads
from beetle_omni_ros.sim.parameters import SimulatorParameters

# MuJoCo would write warnings into a file in the working directory; step() checks the state.
mujoco.set_mju_user_warning(lambda text: None)

NO_CONSTRAINT = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
XYZW = np.array([4, 5, 6, 3])       # indices of x, y, z, w in qpos
DIVERGED = 1e9                      # bound of the sum of accelerations in a valid state
FLOOR_SUBSTEPS = 2                  # integration steps in a tick at the floor: the solver is slow
JAM_STIFFNESS = 20.0    # [-] relative to the servo: 1 mrad under load, stable at 1 kHz
ALL, NONE = (True,) * 4, (False,) * 4       # servos
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


class Plant:
    """
    One true robot over a floor; :meth:`reset` places it.

    MuJoCo integrates by the Runge-Kutta method of order 4. The solver of contacts and joint stops
    runs only in ticks in which a contact is possible. The tilt rate is limited only in ticks in
    which a joint could reach the limit. Both conditions are conservative and together halve the
    computing time. A ParameterError is raised for impossible mass properties.

    Attributes:
        wrench: (6,) external force in world [N] and torque in base_link [N m] at base_link.
        voltage_ratio: of the battery, relative to a full one.
        state: position, quaternion wxyz, tilts (11,) and velocities (10,).
        tilt, encoder: (4,) true tilts of the rotors, and angles at the encoders, on the side of
            the motor or of the rotor [rad].
        thrust, effort: (4,) true thrusts [N] and torques of the servos [N m].
        contact: whether any part touches the floor.

    """

    def __init__(self, robot: RobotParameters, parameters: SimulatorParameters,
                 variation: Variation | None = None):
        self._robot, self._parameters = robot, parameters
        self._parts = mass_properties(robot, variation)
        play = robot.effects.get('joint_backlash', {'gap': 0.0, 'at_encoder': 0.0})
        self._half_gap = np.broadcast_to(play['gap'], 4) / 2
        self._has_play, self._at_encoder = bool(self._half_gap.any()), bool(play['at_encoder'])
        self._added = AddedForces(robot, self._has_play)
        self._loads = ServoLoads(robot)
        self._servo_terms = [dynamics.tilt_servo(robot, i, 0.0)[0] for i in range(4)]
        self._has_friction = self._servo_terms[0].coulomb is not None
        self._scale = robot.thrust_scale
        self.model = build_model(robot, parameters, self._parts)
        self.data = mujoco.MjData(self.model)
        self._tick, self._substeps = parameters.tick, parameters.substeps
        self._flags = int(self.model.opt.disableflags)
        # Bound of the distance of the robot's geometry from base_link with any tilts [m].
        joints = np.linalg.norm(self.model.body_pos[BASE + 1:], axis=1)
        sizes = np.linalg.norm(self.model.geom_pos[1:], axis=1) + self.model.geom_rbound[1:]
        self._reach = float(joints.max() + sizes.max())
        # Largest change of a servo's rate and of its limit in a tick for each rad of error.
        self._rate_gain = float(np.max(robot.joints.kp)) * (
            self._tick / robot.joints.inertia + robot.joints.speed_gradient)
        # Views of MuJoCo's state, stored because each access takes time.
        self._qpos, self._qvel = self.data.qpos, self.data.qvel
        self._tilt, self._rate, self._target = self._qpos[7:], self._qvel[6:], self.data.ctrl[4:]
        self._commanded_thrust, self._act = self.data.ctrl[:4], self.data.act
        self._acceleration, self._applied = self.data.qacc, self.data.qfrc_applied[:6]
        self.voltage_ratio = 1.0
        self.wrench = np.zeros(6)
        self._payload: float | None = None      # not yet set
        self._servos = ALL, NONE
        self._powered = ALL     # whether the motor and its limits act

    def reset(self, position: Sequence[float] | np.ndarray | None = None,
              quaternion: Sequence[float] | np.ndarray | None = None,
              velocity: Sequence[float] | np.ndarray = (0.0,) * 10,
              tilt: np.ndarray = np.zeros(4), thrust: np.ndarray = np.zeros(4)) -> None:
        """
        Place an intact robot, see :meth:`.simulator.Simulator.reset`.

        By default it is at rest. ``velocity`` (10,) is linear in world [m/s], angular in base_link
        and of the tilts [rad/s]; ``tilt`` [rad] and ``thrust`` [N] (4,) are also the targets.
        """
        if position is None:        # at rest on its feet
            self.reset((0.0, 0.0, self._parameters.foot_depth))
            settle = 100 * CONTACT_TIME
            mujoco.mj_step(self.model, self.data, int(np.ceil(settle / self.model.opt.timestep)))
            position = (0.0, 0.0, float(self._qpos[2]))
        self.set_payload(0.0)
        self.wrench[:] = 0.0
        mujoco.mj_resetData(self.model, self.data)
        self.model.opt.disableflags = self._flags
        self.model.opt.timestep = self._tick / self._substeps
        self._qpos[:3] = position
        if quaternion is not None:
            self._qpos[3:7] = rotations.normalized(quaternion)[[3, 0, 1, 2]]
        self._qvel[:], self._tilt[:], self.data.act[:] = velocity, tilt, thrust
        self.set_targets(tilt, thrust)
        self._shaft, self._friction = np.array(tilt), np.zeros(4)
        self._added.restart()
        self._update()

    def set_targets(self, tilt: np.ndarray, thrust: np.ndarray, powered: Sequence[bool] = ALL,
                    jammed: Sequence[bool] = NONE) -> None:
        """
        Set tilt targets (4,) [rad] and thrust commands (4,) [N], both within their limits.

        A joint that is not ``powered`` has only the damping of the servo. A ``jammed`` one is held
        at its target by a much stiffer, critically damped spring, so its target must not jump. The
        torque and rate limits of the motor apply to neither.
        """
        self.data.ctrl[:4] = thrust
        self._target[:] = self._commanded_tilt = np.array(tilt)
        servos = tuple(map(bool, powered)), tuple(map(bool, jammed))
        if servos == self._servos:
            return
        self._servos = servos
        on, stuck = map(np.array, servos)
        joints, model = self._robot.joints, self.model
        hard = joints.kp * JAM_STIFFNESS
        stiffness = np.where(stuck, hard, joints.kp * on)
        model.actuator_gainprm[4:, 0] = stiffness
        model.actuator_biasprm[4:, 1] = -stiffness
        model.actuator_biasprm[4:, 2] = -np.where(
            stuck, 2 * np.sqrt(hard * joints.inertia), joints.kd)
        self._powered = tuple(on & ~stuck)
        model.actuator_forcelimited[4:] = self._powered

    def set_payload(self, mass: float) -> None:
        """Set the mass [kg] of the payload, a ball below the body."""
        if mass != self._payload:
            self._payload = mass
            set_payload(self.model, self._parts, mass)

    def step(self) -> None:
        """Advance one tick with the present targets; a RunError reports a diverged state."""
        model, data = self.model, self.data
        if self._loads.active:
            self._target[:], load = self._loads(self._commanded_tilt, self._scale * data.act)
            data.qfrc_applied[6:] = load + self._friction
        touching, fast = self._near_limits()
        model.opt.disableflags = self._flags if touching else self._flags | NO_CONSTRAINT
        substeps = min(FLOOR_SUBSTEPS, self._substeps) if fast and data.ncon else self._substeps
        model.opt.timestep = self._tick / substeps
        self._apply_forces(0.5 * self._tick)
        if fast and not self._has_friction:
            mujoco.mj_step(model, data, substeps)
        else:
            # Torques on the joints at the end of the last tick, but for motor and friction.
            others = self._robot.joints.inertia * data.qacc[6:] - data.actuator_force[4:] \
                - self._friction
            held = -self._friction if touching else others      # forces of contacts are no load
            for _ in range(substeps):
                if not fast:
                    self._limit_rates(held + self._friction)
                if self._has_friction:
                    self._rub(others)
                mujoco.mj_step(model, data)
        self._added.advance(self._scale * data.act, self._tick)
        if self._has_play:
            self._shaft = clipped(self._shaft, self._tilt - self._half_gap,
                                  self._tilt + self._half_gap)
        if fast:
            self._update()
        else:
            # The acceleration must also use the limited torque: the full one would give
            # thousands of rad/s^2 at the rate limit.
            self._limit_rates(held + self._friction)
            self._update()
            effort = self._robot.joints.effort_limit
            model.actuator_forcerange[4:] = (-effort, effort)
        if not abs(np.add.reduce(data.qacc)) < DIVERGED:
            raise RunError(f'the simulated plant diverged: position {self._qpos[:3]} m, '
                           f'velocity {self._qvel[:3]} m/s, tilts {self._tilt} rad')

    def _near_limits(self):
        """Whether contact with floor or stops, and no rate limit is possible in the next tick."""
        joints, gain, ahead = self._robot.joints, self._rate_gain, 2 * self._tick
        touching = bool(self._qpos[2] < self._reach + ahead * abs(self._qvel[2]) + 0.01)
        stop, limit, fast = joints.position_limit - 0.01, 0.9 * joints.velocity_limit, True
        for tilt, rate, target, powered in zip(self._tilt.tolist(), self._rate.tolist(),
                                               self._target.tolist(), self._powered):
            if abs(tilt) + ahead * abs(rate) > stop:
                touching = True
            if powered and abs(rate) + gain * abs(target - tilt) > limit:
                fast = False
        return touching, fast

    def _limit_rates(self, load):
        """Limit each servo's torque to what its motor has at its speed, with a load (4,) [N m]."""
        joints, duration = self._robot.joints, self.model.opt.timestep
        after = self._servo_terms[0].fastest(NUMPY, self._rate, load, duration)
        self.model.actuator_forcerange[4:] = clipped(
            joints.inertia / duration * (np.transpose(after) - self._rate[:, None])
            - load[:, None], -joints.effort_limit, joints.effort_limit)

    def _apply_forces(self, ahead=0.0):
        """Apply the external wrench and the effects' forces, predicted ``ahead`` [s] from now."""
        # Those in the middle of a tick, held during it, are accurate to second order.
        applied = self._applied
        applied[:] = self.wrench
        if not self._added.active:
            return
        lag, commanded = self._robot.rotors.time_constant, self._scale * self._commanded_thrust
        thrust, quaternion = self._scale * self._act, self._qpos[XYZW]
        motion, driven = self._qvel, self._tilt
        if ahead:
            thrust = thrust - np.expm1(-ahead / lag) * (commanded - thrust)
            quaternion = rotations.multiply(quaternion, rotations.exp(ahead * motion[3:6]))
            driven = driven + ahead * self._rate
            motion = motion + ahead * self._acceleration
        tilt = clipped(self._shaft, driven - self._half_gap, driven + self._half_gap) \
            if self._has_play else driven
        applied += self._added(
            quaternion, driven, self._acceleration[6:],
            position=self._qpos[:3], velocity=motion[:3], rate=motion[3:6], tilt=tilt,
            tilt_rate=motion[6:], thrust=thrust, thrust_rate=(commanded - thrust) / lag,
            voltage_ratio=self.voltage_ratio)

    def _rub(self, others):
        """Set the friction of the joints for one substep: what stops them, within its limit."""
        # So a joint below its stiction rests without the solver of contacts.
        joints, model, rate = self._robot.joints, self.model, self._rate
        limits = model.actuator_forcerange[4:].T if model.actuator_forcelimited[4:].all() \
            else (-np.inf, np.inf)
        motor = clipped(model.actuator_gainprm[4:, 0] * (self._target - self._tilt)
                        + model.actuator_biasprm[4:, 2] * rate, *limits)
        stops = -joints.inertia * rate / model.opt.timestep - motor - others
        most = np.array([servo.friction(NUMPY, one) for servo, one in zip(
            self._servo_terms, rate.tolist(), strict=True)])
        friction = clipped(stops, -most, most)
        self.data.qfrc_applied[6:] += friction - self._friction
        self._friction = friction

    def _update(self):
        """Compute accelerations, contacts and the attributes of the present state."""
        data = self.data
        self._apply_forces()
        mujoco.mj_forward(self.model, data)
        self.state = self._qpos.copy(), self._qvel.copy()
        self.tilt = self._shaft if self._has_play else self.state[0][7:]
        self.encoder = self.tilt if self._at_encoder else self.state[0][7:]
        self.thrust, self.effort = self._scale * data.act, data.actuator_force[4:].copy()
        self.contact = data.ncon > 0

    @property
    def specific_force(self) -> np.ndarray:
        """(3,) acceleration of base_link minus gravity, in base_link [m/s^2]."""
        acceleration = self.data.qacc[:3].copy()
        acceleration[2] += self._robot.gravity
        return self.data.xmat[BASE].reshape(3, 3).T @ acceleration


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
