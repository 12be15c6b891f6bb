"""The multibody plant: MuJoCo's equations of motion."""

from collections.abc import Sequence

import mujoco
import numpy as np

from beetle_omni_ros.robot import dynamics, native, rotations
from beetle_omni_ros.robot.allocation import clipped
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.parameters import RobotParameters, Variation
from beetle_omni_ros.robot.servo import NUMPY
from beetle_omni_ros.sim.mjcf import BASE, base_part, build_model, CONTACT_TIME, set_base_part
from beetle_omni_ros.sim.parameters import SimulatorParameters

# MuJoCo would write warnings into a file in the working directory; step() checks the state.
mujoco.set_mju_user_warning(lambda text: None)

NO_CONSTRAINT = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
WXYZ = np.array([6, 3, 4, 5])       # indices of w, x, y, z in (position, quaternion xyzw)
XYZW = np.array([4, 5, 6, 3])       # indices of x, y, z, w in qpos
DIVERGED = 1e9                      # bound of the sum of accelerations in a valid state
FLOOR_SUBSTEPS = 2                  # integration steps in a tick at the floor: the solver is slow
JAM_STIFFNESS = 20.0    # [-] relative to the servo: 1 mrad under load, stable at 1 kHz


class Plant:
    """
    One true robot over a floor; :meth:`reset` places it.

    MuJoCo integrates by the Runge-Kutta method of order 4. The solver of contacts and joint stops
    runs only in ticks in which a contact is possible. The tilt rate is limited only in ticks in
    which a joint could reach the limit. Both conditions are conservative and together halve the
    computing time. A ParameterError is raised for impossible mass properties.
    """

    def __init__(self, robot: RobotParameters, parameters: SimulatorParameters,
                 variation: Variation | None = None):
        self._robot, self._parameters, self._variation = robot, parameters, variation
        # Effects that only change a number of the model are built into it.
        forces = [name for name in robot.effects
                  if CATALOGUE[name].apply and CATALOGUE[name].plant != 'model']
        self._added_wrench = AddedWrench(robot, forces) if forces else None
        play = robot.effects.get('joint_backlash', {'gap': 0.0, 'at_encoder': 0.0})
        self._half_gap = np.broadcast_to(play['gap'], 4) / 2
        self._has_play, self._at_encoder = bool(self._half_gap.any()), bool(play['at_encoder'])
        self._has_motion_forces = bool(forces or self._has_play)
        self._sideways = np.cross(robot.tilt_axes, [0.0, 0.0, 1.0])     # of a rotor at +90 deg
        self._reaction = -robot.rotors.spin * robot.torque_ratio
        self._has_servo_loads = any(CATALOGUE[name].servo for name in robot.effects
                                    if name != 'joint_friction')
        self._servo_terms = [dynamics.tilt_servo(robot, i, 0.0)[0] for i in range(4)]
        self._has_friction = self._servo_terms[0].coulomb is not None
        self._friction = np.zeros(4)
        self._scale, self.gravity = robot.thrust_scale, robot.gravity
        self.model = build_model(robot, parameters, variation)
        self.data = mujoco.MjData(self.model)
        self._tick, self._substeps = parameters.tick, parameters.substeps
        self._flags = int(self.model.opt.disableflags)
        self._reach = _reach(self.model)
        # Largest change of a servo's rate in a tick for each rad of error.
        self._rate_gain = float(np.max(robot.joints.kp)) * self._tick / robot.joints.inertia
        # Views of MuJoCo's state, stored because each access takes time.
        self._qpos, self._qvel = self.data.qpos, self.data.qvel
        self._tilt, self._rate, self._target = self._qpos[7:], self._qvel[6:], self.data.ctrl[4:]
        self._commanded_tilt = np.zeros(4)
        # Of the battery, set by its owner: voltage relative to a full one, charge drawn [A h].
        self.voltage_ratio, self.charge_drawn = 1.0, 0.0
        self._wrench = np.zeros(6)
        self._payload: float | None = None      # not yet set
        self._servos = (True,) * 4, (False,) * 4
        self._powered = (True,) * 4     # whether the motor and its limits act
        self._shaft = np.zeros(4)

    def reset(self, position: np.ndarray | None = None,
              quaternion: np.ndarray | None = None) -> None:
        """Place an intact robot at rest, see :meth:`.simulator.Simulator.reset`."""
        self.set_payload(0.0)
        self.set_powered((True,) * 4)
        self._wrench[:] = 0.0
        if position is None:
            # At rest on its feet.
            self._place((0.0, 0.0, self._parameters.foot_depth), (0.0, 0.0, 0.0, 1.0))
            settle = 100 * CONTACT_TIME
            mujoco.mj_step(self.model, self.data, int(np.ceil(settle / self.model.opt.timestep)))
            position = (0.0, 0.0, float(self.data.qpos[2]))
        self._place(position, (0.0, 0.0, 0.0, 1.0) if quaternion is None else quaternion)

    def _place(self, position, quaternion):
        mujoco.mj_resetData(self.model, self.data)
        self.model.opt.disableflags = self._flags
        self.model.opt.timestep = self._tick / self._substeps
        self._friction[:] = 0.0
        self._shaft = np.zeros(4)
        self.data.qpos[:3] = position
        self.data.qpos[3:7] = rotations.normalized(quaternion)[[3, 0, 1, 2]]
        self._update()

    def set_targets(self, tilt: np.ndarray, thrust: np.ndarray) -> None:
        """Set tilt targets (4,) [rad] and thrust commands (4,) [N], both within their limits."""
        self.data.ctrl[:4] = thrust
        self.data.ctrl[4:] = tilt
        self._commanded_tilt = np.array(tilt)

    def set_powered(self, powered: Sequence[bool],
                    jammed: Sequence[bool] = (False,) * 4) -> None:
        """
        Switch the torque of each servo (4,), or jam its joint at its target.

        A joint without torque has only the damping of the servo. A jammed joint is a much stiffer,
        critically damped spring, so its target must not jump. The torque and rate limits of the
        motor apply to neither.
        """
        powered, jammed = tuple(map(bool, powered)), tuple(map(bool, jammed))
        if (powered, jammed) == self._servos:
            return
        self._servos = powered, jammed
        stuck = np.array(jammed)
        joints, model = self._robot.joints, self.model
        hard = joints.kp * JAM_STIFFNESS
        stiffness = np.where(stuck, hard, joints.kp * np.array(powered))
        damping = np.where(stuck, 2 * np.sqrt(hard * joints.inertia), joints.kd)
        model.actuator_gainprm[4:, 0] = stiffness
        model.actuator_biasprm[4:, 1] = -stiffness
        model.actuator_biasprm[4:, 2] = -damping
        self._powered = tuple(on and not stop for on, stop in zip(powered, jammed))
        model.actuator_forcelimited[4:] = self._powered

    def set_wrench(self, force: np.ndarray, torque: np.ndarray) -> None:
        """Set external force (3,) in world [N] and torque (3,) in base_link [N m] at base_link."""
        self._wrench[:3] = force
        self._wrench[3:] = torque

    def set_payload(self, mass: float) -> None:
        """Set the mass [kg] of the payload, a ball below the body."""
        if mass != self._payload:
            self._payload = mass
            set_base_part(self.model, base_part(self._robot, self._variation, mass))

    def step(self) -> None:
        """Advance one tick with the present targets; a RuntimeError reports a diverged state."""
        model, data = self.model, self.data
        if self._has_servo_loads:
            self._load_servos()
        touching = self._may_touch()
        model.opt.disableflags = self._flags if touching else self._flags | NO_CONSTRAINT
        fast = not self._may_reach_rate_limit()
        substeps = min(FLOOR_SUBSTEPS, self._substeps) if fast and data.ncon else self._substeps
        model.opt.timestep = self._tick / substeps
        self._apply_forces(0.5 * self._tick)
        if fast and not self._has_friction:
            mujoco.mj_step(model, data, substeps)
        else:
            others = self._other_torques()
            for _ in range(substeps):
                if not fast:
                    self._limit_rates()
                if self._has_friction:
                    self._rub(others)
                mujoco.mj_step(model, data)
        if self._has_play:
            self._shaft = clipped(self._shaft, self._tilt - self._half_gap,
                                  self._tilt + self._half_gap)
        if fast:
            self._update()
        else:
            # The acceleration must also use the limited torque: the full one would give
            # thousands of rad/s^2 at the rate limit.
            self._limit_rates()
            self._update()
            effort = self._robot.joints.effort_limit
            model.actuator_forcerange[4:] = (-effort, effort)
        if not abs(np.add.reduce(data.qacc)) < DIVERGED:
            raise RuntimeError(f'the simulated plant diverged: position {self._qpos[:3]} m, '
                               f'velocity {self._qvel[:3]} m/s, tilts {self._tilt} rad')

    def _may_touch(self):
        """Whether a contact with floor or joint stop is possible within the next tick."""
        drop = self._reach + 2 * self._tick * abs(self._qvel[2]) + 0.01
        if self._qpos[2] < drop:
            return True
        stop, ahead = self._robot.joints.position_limit - 0.01, 2 * self._tick
        for tilt, rate in zip(self._tilt.tolist(), self._rate.tolist()):
            if abs(tilt) + ahead * abs(rate) > stop:
                return True
        return False

    def _may_reach_rate_limit(self):
        """Whether a servo could reach the rate limit within the next tick."""
        limit, gain = 0.9 * self._robot.joints.velocity_limit, self._rate_gain
        for tilt, rate, target, powered in zip(self._tilt.tolist(), self._rate.tolist(),
                                               self._target.tolist(), self._powered):
            if powered and abs(rate) + gain * abs(target - tilt) > limit:
                return True
        return False

    def _limit_rates(self):
        """Limit each servo's torque so that its joint does not exceed the rate limit."""
        joints = self._robot.joints
        gain = joints.inertia / self.model.opt.timestep
        rate = self._rate
        limits = self.model.actuator_forcerange
        effort, rate_limit = joints.effort_limit, joints.velocity_limit
        limits[4:, 0] = clipped(gain * (-rate_limit - rate), -effort, effort)
        limits[4:, 1] = clipped(gain * (rate_limit - rate), -effort, effort)

    def _apply_forces(self, ahead=0.0):
        """
        Apply the external wrench and the effects' forces, predicted ``ahead`` [s] from now.

        Those in the middle of a tick, held during it, are accurate to second order.
        """
        data = self.data
        applied = data.qfrc_applied[:6]
        applied[:] = self._wrench
        if not self._has_motion_forces:
            return
        lag = self._robot.rotors.time_constant
        thrust = data.act - np.expm1(-ahead / lag) * (data.ctrl[:4] - data.act)
        quaternion = rotations.multiply(self._qpos[XYZW],
                                        rotations.exp(ahead * self._qvel[3:6]))
        motion = self._qvel + ahead * data.qacc
        driven = tilt = self._tilt + ahead * self._rate
        if self._has_play:
            # MuJoCo's thrust acts along the motor's angle, the true one along the shaft's.
            tilt = clipped(self._shaft, driven - self._half_gap, driven + self._half_gap)
            force, torque = self._turned(driven, tilt, self._scale * thrust)
            applied[:3] += rotations.matrix(quaternion) @ force
            applied[3:] += torque
        if self._added_wrench:
            applied += self._added_wrench(
                quaternion, motion[:3], motion[3:6], tilt, motion[6:], data.qacc[6:],
                self._scale * thrust, self._scale * (data.ctrl[:4] - thrust) / lag,
                self._qpos[:3], self.voltage_ratio, self.charge_drawn)

    def _turned(self, before, after, thrust):
        """Change of force and torque in base_link by rotors that turn between two tilts (4,)."""
        change = thrust[:, None] * (
            (np.cos(after) - np.cos(before))[:, None] * [0.0, 0.0, 1.0]
            + (np.sin(after) - np.sin(before))[:, None] * self._sideways)
        return change.sum(axis=0), \
            np.cross(self._robot.rotors.positions, change).sum(axis=0) + self._reaction @ change

    def _load_servos(self):
        """Set servo targets and joint torques from the commands by the effects on servos."""
        thrust = self._scale * self.data.act
        for i in range(4):
            load = dynamics.gyroscopic_load(self._robot, self._qvel[3:6], self._tilt[i],
                                            thrust[i], i)
            _, terms = dynamics.tilt_servo(self._robot, i, self._commanded_tilt[i], thrust[i],
                                           float(load))
            self._target[i] = terms.target
            self.data.qfrc_applied[6 + i] = terms.load + self._friction[i]

    def _other_torques(self):
        """Torques on the joints (4,) at the end of the last tick, but for motor and friction."""
        if not self._has_friction:
            return None
        return self._robot.joints.inertia * self.data.qacc[6:] - self.data.actuator_force[4:] \
            - self._friction

    def _rub(self, others):
        """
        Set the friction of the joints for one substep: what stops them, within its limit.

        So a joint below its stiction rests without the solver of contacts.
        """
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
        """Compute accelerations and contacts of the present state."""
        if self._has_motion_forces:
            self._apply_forces()
        mujoco.mj_forward(self.model, self.data)

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Copies of position, quaternion wxyz, tilts (11,) and velocities (10,)."""
        return self._qpos.copy(), self._qvel.copy()

    @property
    def tilt(self) -> np.ndarray:
        """(4,) true tilts of the rotors [rad]."""
        return self._shaft.copy() if self._has_play else self._tilt.copy()

    @property
    def encoder(self) -> np.ndarray:
        """(4,) angles [rad] at the encoders, on the side of the motor or of the rotor."""
        return self.tilt if self._at_encoder else self._tilt.copy()

    @property
    def thrust(self) -> np.ndarray:
        """(4,) true thrusts [N]."""
        return self._scale * self.data.act

    @property
    def effort(self) -> np.ndarray:
        """(4,) servo torques [N m]."""
        return self.data.actuator_force[4:].copy()

    @property
    def contact(self) -> bool:
        """Whether any part touches the floor."""
        return self.data.ncon > 0

    @property
    def specific_force(self) -> np.ndarray:
        """(3,) acceleration of base_link minus gravity, in base_link [m/s^2]."""
        acceleration = self.data.qacc[:3].copy()
        acceleration[2] += self.gravity
        return self.data.xmat[BASE].reshape(3, 3).T @ acceleration

    def acceleration(self, position: np.ndarray, quaternion: np.ndarray, velocity: np.ndarray,
                     angular_velocity: np.ndarray, tilt: np.ndarray, tilt_velocity: np.ndarray,
                     thrust: np.ndarray, tilt_target: np.ndarray | None = None) -> np.ndarray:
        """
        Accelerations in a given state away from the floor, as of :class:`.sensors.Truth`.

        The ``thrust`` is before the effects' scales, ``tilt_target`` (4,) [rad] by default the
        present tilt. Returned are (10,) linear in world [m/s^2], angular in base_link and of
        tilts [rad/s^2]. The plant remains in the state.
        """
        data = self.data
        data.qpos[:] = np.concatenate([position, quaternion, tilt])[
            np.concatenate([np.arange(3), WXYZ, np.arange(7, 11)])]
        data.qvel[:] = np.concatenate([velocity, angular_velocity, tilt_velocity])
        data.act[:] = thrust
        self.set_targets(tilt if tilt_target is None else tilt_target, thrust)
        self.model.opt.disableflags = self._flags | NO_CONSTRAINT
        self._apply_forces()
        self._update()
        return data.qacc.copy()


class AddedWrench:
    """:func:`.dynamics.added_wrench` through fixed buffers, tens of times as fast as without."""

    def __init__(self, robot: RobotParameters, names: list[str]):
        function = native.compiled(dynamics.added_wrench(robot, names))
        self._inputs = [np.zeros(function.numel_in(k)) for k in range(function.n_in())]
        self._result = np.zeros(6)
        self._buffer, self._evaluate = function.buffer()
        for k, values in enumerate(self._inputs):
            self._buffer.set_arg(k, values.data)
        for k in range(2):
            self._buffer.set_res(k, self._result[3 * k:3 * k + 3].data)

    def __call__(self, *values) -> np.ndarray:
        """Force and torque (6,), valid until the next call."""
        for place, value in zip(self._inputs, values, strict=True):
            place[:] = value
        self._evaluate()
        return self._result


def _reach(model):
    """Bound of the distance of the robot's geometry from base_link with any tilts [m]."""
    joints = np.linalg.norm(model.body_pos[BASE + 1:], axis=1)
    sizes = np.linalg.norm(model.geom_pos[1:], axis=1) + model.geom_rbound[1:]
    return float(joints.max() + sizes.max())
