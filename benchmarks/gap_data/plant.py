"""One robot in the air: MuJoCo for bodies and servos, the rest in plain floats."""

from math import cos, exp, sin

import mujoco

from gap_data.hidden import Hidden, Snapshot
from gap_data.mjcf import model_xml
from gap_data.rotors import DelayLine, Pack, Rotors
from gap_data.truth import Robot

HEAT_TIME = 25.0  # [s] in which a motor warms up, chosen
ZERO3 = (0.0, 0.0, 0.0)


class Plant:
    """
    The true robot; :meth:`step` advances it by one step of ``numbers.yaml``.

    Attributes:
        time: [s] since the flight began.
        snapshot: state at the start of the last step.
        specific_force: (3,) of the IMU's place, body axes, at that start.

    """

    def __init__(self, robot: Robot, hidden: Hidden, *, multibody: bool, position, quaternion,
                 tilt, thrust, charge: float = 0.9, command_age: float = 0.0,
                 rate=ZERO3):
        """
        Put the robot into the air.

        Args:
            robot: what is true.
            hidden: the effects.
            multibody: which description.
            position: (3,) [m].
            quaternion: (4,) w x y z.
            tilt: (4,) [rad] at the start.
            thrust: (4,) [N] at the start.
            charge: of the pack, 0 to 1.
            command_age: [s] from a command's stamp until it acts.
            rate: (3,) [rad/s] in base_link.

        """
        self.robot, self.hidden, self.multibody = robot, hidden, multibody
        self.model = mujoco.MjModel.from_xml_string(model_xml(
            robot, multibody=multibody, imu_position=hidden.imu_position,
            friction=hidden.friction is not None, slosh=hidden.slosh))
        self.data = mujoco.MjData(self.model)
        self.step_length = float(self.model.opt.timestep)
        name = mujoco.mj_name2id
        joints = [name(self.model, mujoco.mjtObj.mjOBJ_JOINT, f'gimbal{i + 1}') for i in range(4)]
        self._q = [int(self.model.jnt_qposadr[j]) for j in joints]
        self._v = [int(self.model.jnt_dofadr[j]) for j in joints]
        self._body = name(self.model, mujoco.mjtObj.mjOBJ_BODY, 'base_link')
        self.data.qpos[:7] = [*position, *quaternion]
        self.data.qvel[3:6] = rate
        self.data.qpos[self._q] = tilt
        self.tilts = DelayLine(command_age + hidden.tilt_delay, [float(q) for q in tilt])
        self.thrusts = DelayLine(command_age + hidden.thrust_delay, [float(f) for f in thrust])
        self.rotors = Rotors(robot, hidden, self.step_length, thrust)
        self.pack = Pack(robot, charge)
        self._heat = [0.0] * 4
        self._warming = 1 - exp(-self.step_length / HEAT_TIME)
        self._places = [tuple(float(x) for x in r) for r in robot.positions]
        self._arms = [(float(a[0]), float(a[1])) for a in robot.arms]
        self._scale = [float(s) for s in robot.thrust_scale]
        self._reaction = [float(-s * robot.ratio) for s in robot.spin]
        self._limits = [(float(v), float(e)) for v, e in zip(robot.velocity_limit,
                                                            robot.effort_limit)]
        self._slope = robot.numbers['speed_torque_slope']
        self._count = 0
        self.time = 0.0
        self.snapshot = Snapshot()
        self.specific_force = None

    def command(self, stamp: float, tilt, thrust) -> None:
        """Send tilts (4,) [rad] and thrusts (4,) [N]."""
        limit = self.robot.position_limit
        self.tilts.send(stamp, [min(max(float(q), -limit), limit) for q in tilt])
        self.thrusts.send(stamp, [float(f) for f in thrust])

    def step(self, force=ZERO3, torque=ZERO3) -> Snapshot:
        """Advance under an external wrench: force in world [N], torque in base_link [N m]."""
        data = self.data
        s = self._look(data.qpos.tolist(), data.qvel.tolist())
        targets = self.tilts.at(self.time)
        s.command = self.thrusts.at(self.time)
        middle = self.rotors.advance(s.command)
        s.thrust, s.thrust_rate = middle, self.rotors.rate
        s.voltage = self.pack.load(middle, self.step_length, self._count % 100 == 0)
        for i in range(4):
            self._heat[i] += (min(middle[i] / 8.0, 2.0) - self._heat[i]) * self._warming
        s.heat = self._heat
        wrench, joint = self._rotor_wrench(s)
        fx, fy, fz = force
        tx, ty, tz = torque
        for hook in self.hidden.body:
            (ax, ay, az), (bx, by, bz) = hook(s)
            fx, fy, fz, tx, ty, tz = fx + ax, fy + ay, fz + az, tx + bx, ty + by, tz + bz
        r = s.rotation
        wrench[0] += r[0] * fx + r[3] * fy + r[6] * fz
        wrench[1] += r[1] * fx + r[4] * fy + r[7] * fz
        wrench[2] += r[2] * fx + r[5] * fy + r[8] * fz
        wrench[3] += tx
        wrench[4] += ty
        wrench[5] += tz
        data.ctrl[:] = wrench + targets
        self._servos(s, joint)
        mujoco.mj_step(self.model, data)
        self.specific_force = data.sensordata[:3]
        self._count += 1
        self.time = self._count * self.step_length
        return s

    def _look(self, p, v):
        """Fill the snapshot from positions and velocities."""
        s = self.snapshot
        s.quaternion = w, x, y, z = p[3:7]
        r = (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
             2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
             2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        a, b, c = v[0:3]
        s.t, s.position, s.rotation = self.time, p[0:3], r
        s.velocity_world, s.rate = (a, b, c), v[3:6]
        s.velocity = (r[0] * a + r[3] * b + r[6] * c, r[1] * a + r[4] * b + r[7] * c,
                      r[2] * a + r[5] * b + r[8] * c)
        s.tilt = [p[k] for k in self._q]
        s.tilt_rate = [v[k] for k in self._v]
        return s

    def _rotor_wrench(self, s):
        """Sum of the rotors' wrenches in base_link, and the torques that weigh on the joints."""
        hidden = self.hidden
        total, joint = [0.0] * 6, [0.0] * 4
        vx, vy, vz = s.velocity
        wx, wy, wz = s.rate
        half = 0.5 * self.step_length
        s.axes = axes = []
        for i in range(4):
            angle = s.tilt[i] + s.tilt_rate[i] * half
            for hook in hidden.tilt_errors:
                angle += hook(i, s.tilt[i], s.tilt_rate[i], s)
            ca, sa = self._arms[i]
            up = sin(angle)
            axes.append((up * sa, -up * ca, cos(angle)))
        for i in range(4):
            axis = nx, ny, nz = axes[i]
            px, py, pz = self._places[i]
            speed = (vx + wy * pz - wz * py, vy + wz * px - wx * pz, vz + wx * py - wy * px)
            f = s.thrust[i] * self._scale[i]
            for hook in hidden.gains:
                f *= hook(i, s, f, axis, speed)
            fx, fy, fz = f * nx, f * ny, f * nz
            spin = self._reaction[i] * f
            tx, ty, tz = spin * nx, spin * ny, spin * nz
            for hook in hidden.wrenches:
                ax, ay, az, bx, by, bz = hook(i, s, f, axis, speed)
                fx, fy, fz, tx, ty, tz = fx + ax, fy + ay, fz + az, tx + bx, ty + by, tz + bz
            ca, sa = self._arms[i]
            joint[i] = ca * tx + sa * ty
            total[0] += fx
            total[1] += fy
            total[2] += fz
            total[3] += tx + py * fz - pz * fy
            total[4] += ty + pz * fx - px * fz
            total[5] += tz + px * fy - py * fx
        return total, joint

    def _servos(self, s, loads):
        """Torque on the shafts, their speed-dependent torque limit and dry friction."""
        model, hidden = self.model, self.hidden
        for i in range(4):
            rate = s.tilt_rate[i]
            fastest, strongest = self._limits[i]
            model.actuator_forcerange[6 + i] = (
                max(-strongest, self._slope * (-fastest - rate)),
                min(strongest, self._slope * (fastest - rate)))
            torque = loads[i] if self.multibody else 0.0
            for hook in hidden.joint_torques:
                torque += hook(i, s.tilt[i], rate, s)
            self.data.qfrc_applied[self._v[i]] = torque
            if hidden.friction is not None:
                model.dof_frictionloss[self._v[i]] = hidden.friction(i, rate)
