"""All detectors of one vehicle: detected faults, and the health of the actuators."""

from dataclasses import replace

import numpy as np

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.robot.allocation import ActuatorHealth, ALL_HEALTHY, Allocator, ROTORS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.thrust_map import ThrustMap
from beetle_omni_ros.safety.watch.joints import JointWatch
from beetle_omni_ros.safety.watch.mocap import MocapWatch
from beetle_omni_ros.safety.watch.pack import PackWatch
from beetle_omni_ros.safety.watch.parameters import Detection
from beetle_omni_ros.safety.watch.speeds import SpeedWatch
from beetle_omni_ros.safety.watch.wrench import ContactWatch, WrenchWatch

CRASH, DISPLACED = 'crash', 'mocap_jumped'
BUILD_UP = 0.5          # [s] five time constants of a rotor
RACES = 2.0             # [-] of the largest thrust: the speed of a motor without propeller
NOTICEABLE = 0.3        # [N] change of a held thrust or of the pack's limit that is not reported


class FaultWatch:
    """
    Runs the detectors and stores the detected faults.

    A detected fault stays until :meth:`reset`: an actuator that has failed once is not used again
    in the same flight.

    Args:
        parameters: thresholds.
        robot: nominal robot.
        allocator: of the robot.

    Attributes:
        faults: name -> time of detection [s].
        health: which actuators work, and the zeros of encoders that jumped.

    """

    def __init__(self, parameters: Detection, robot: RobotParameters, allocator: Allocator):
        self._p, self._limit = parameters, robot.joints.position_limit
        self._thrust_max = self._limit_now = robot.rotors.thrust_max
        self._map = ThrustMap(robot.rotors) if len(robot.rotors.map) > 1 else None
        self._wrench = WrenchWatch(parameters.rotor, parameters.contact, robot, allocator)
        self._contact = ContactWatch(parameters.contact, robot.gravity)
        self._joints = JointWatch(parameters.servo, robot)
        self._speeds = SpeedWatch(parameters.rotor, robot)
        self._mocap = MocapWatch(parameters.mocap)
        self._pack = None if self._map is None else PackWatch(parameters.battery, robot, allocator,
                                                              self._map)
        self.reset()

    def reset(self) -> None:
        """Reset for a new flight without faults."""
        self.faults: dict[str, float] = {}
        self.health: ActuatorHealth = ALL_HEALTHY
        self._new: list[str] = []
        if self._pack is not None:
            self._pack.reset()
        self.restart(-np.inf)

    def restart(self, now: float) -> None:
        """
        Restart the detectors after a pause or a step of the clock; detected faults stay.

        For BUILD_UP seconds the thrusts differ from the commands.
        """
        self._stamp, self._blind_until = -np.inf, now + BUILD_UP
        for watch in (self._wrench, self._contact, self._joints, self._speeds, self._mocap):
            watch.reset()

    @property
    def contact(self) -> str:
        """'' or the reason why the robot is treated as on the ground."""
        return self._contact.reason

    def news(self) -> list[str]:
        """Texts of faults that were detected since the last call."""
        news, self._new = self._new, []
        return news

    def on_voltage(self, stamp: float, voltage: float) -> None:
        """Receive the pack's voltage [V]: a low voltage limits all rotors."""
        if self._map is None or self._pack is None:
            return
        self._limit_now = self._map.thrust_limit_below(voltage)
        self._pack.on_voltage(stamp, voltage)
        limit, known = self._pack.limit, self.health.thrust_limit
        if limit is not None and (known is None or abs(limit - known) > NOTICEABLE):
            self._name('battery_weak', stamp, f'the pack sags to {voltage:.1f} V under load: it '
                       f'allows {limit:.1f} N a rotor, too little for some attitudes')
            self.health = replace(self.health, thrust_limit=limit)

    def _possible(self, thrust):
        """Thrusts (4,) [N] that the present voltage allows."""
        return thrust if max(thrust.tolist()) <= self._limit_now \
            else np.minimum(thrust, self._limit_now)

    def on_imu(self, stamp: float, force: np.ndarray, rate: np.ndarray, tilt: np.ndarray | None,
               command: Command | None, height: float | None) -> None:
        """
        Receive an IMU sample of a robot in the air.

        Args:
            stamp: [s].
            force: (3,) specific force in base_link [m/s^2].
            rate: (3,) in base_link [rad/s].
            tilt: (4,) measured [rad], None: unknown, and only an impact can be detected.
            command: the executed command, None: rotors off.
            height: of base_link above its height on the ground [m], None: unknown.

        """
        dt, self._stamp = stamp - self._stamp, stamp
        thrust = np.zeros(ROTORS) if command is None else self._possible(command.thrust)
        self._wrench.supported = self._speeds.slow
        self._wrench.on_imu(stamp, force, rate, tilt, thrust, self.health)
        self._contact.update(min(max(dt, 0.0), 0.05), height, self._wrench)
        if height is not None and height < self._p.contact.near_ground:
            return      # the floor also exerts a force
        if stamp < self._blind_until:
            return self._wrench.forget()
        lost = self._wrench.lost
        if lost is not None and self.health.rotors[lost] and self.health.held[lost] is None:
            # A rotor that holds its thrust also gives less than commanded, while more is asked.
            if lost in self._speeds.suspected and self._speeds.thrust[lost] > \
                    self._p.rotor.least_thrust:
                self._ignore_commands_of(lost, stamp)
            else:
                self._lose_rotor(lost, stamp, 'the wrench')
        if self._wrench.slipped is not None:
            joint, angle = self._wrench.slipped
            text = f'the thrust of rotor {joint + 1} points {angle:+.2f} rad from the reading ' \
                   f'of gimbal{joint + 1}'
            known = {f'joint{joint + 1}_encoder_jump', f'joint{joint + 1}_astray'}
            if not known & self.faults.keys():
                self._name(f'joint{joint + 1}_slipped', stamp, text)

    def on_command(self, command: Command) -> None:
        """Receive the executed command."""
        self._joints.on_command(command.stamp, command.tilt)
        thrust = self._possible(command.thrust)
        self._speeds.on_command(command.stamp, thrust)
        if self._pack is not None:
            self._pack.on_command(command.stamp, thrust)

    @property
    def joint_stamp(self) -> float:
        """Time of the last reading of the joints [s]."""
        return self._joints.stamp

    def on_joints(self, stamp: float, tilt: np.ndarray, trusted: bool) -> None:
        """
        Receive a complete reading.

        If an encoder jumps, the joint angle is assumed unchanged: the zero moves by the jump.

        Args:
            stamp: [s].
            tilt: (4,) as read [rad].
            trusted: whether the joints are driven and in the air.

        """
        watch = self._joints
        if not watch.on_joints(stamp, tilt) or not trusted:
            return
        if watch.well and self.health.stuck == ALL_HEALTHY.stuck:
            return
        for joint in np.flatnonzero(watch.jump):
            self._name(f'joint{joint + 1}_encoder_jump', stamp, f'the encoder of '
                       f'gimbal{joint + 1} jumped by {watch.jump[joint]:+.2f} rad at once')
            self._move_zero(joint, float(watch.jump[joint]))
        tilt = self.health.true(tilt)
        for joint in np.flatnonzero(watch.jammed | watch.astray):
            if self.health.stuck[joint] is not None:
                continue
            kind = 'jammed' if watch.jammed[joint] else 'astray'
            if self._name(f'joint{joint + 1}_{kind}', stamp, f'gimbal{joint + 1} '
                          + ('stands still beside' if kind == 'jammed' else 'does not follow')
                          + f' its command, at {tilt[joint]:.2f} rad'):
                self._stick(joint, float(tilt[joint]))
        self._follow(tilt)

    def silent_joints(self, now: float) -> np.ndarray | None:
        """True tilts (4,) [rad] at ``now`` [s] by the servo model, if there are no readings."""
        self._joints.advance(now)
        model = self._joints.model
        return None if model is None else self.health.true(model)

    def without_imu(self, stamp: float, position: np.ndarray, height: float | None) -> None:
        """Check a MoCap position (3,) [m] for a crash, see :meth:`ContactWatch.on_pose`."""
        self._contact.on_pose(stamp, position, height)

    def on_mocap(self, stamp: float, position: np.ndarray, quaternion: np.ndarray,
                 attitude: np.ndarray | None, rate: np.ndarray | None,
                 place: np.ndarray | None = None, velocity: np.ndarray | None = None) -> bool:
        """
        Receive a MoCap pose, see :meth:`MocapWatch.on_pose`.

        Returns:
            whether it may be used.

        """
        watch = self._mocap
        watch.on_pose(stamp, position, quaternion, attitude, rate, place, velocity)
        if watch.frozen:
            self._name('mocap_frozen', stamp, 'MoCap repeats the same pose')
        elif watch.displaced:
            self._name(DISPLACED, stamp, 'the position of MoCap jumped, and the IMU does not '
                       'show it')
        elif watch.contradicts and watch.jumped:
            self._name('mocap_flipped', stamp, 'the attitude of MoCap jumped, and the gyroscope '
                       'does not show it')
        elif watch.contradicts:
            self._name('estimator_wrong', stamp, 'the estimate contradicts MoCap, which did not '
                       'jump')
        return watch.good

    def on_speeds(self, stamp: float, speed: np.ndarray) -> None:
        """Receive ESC speeds (4,) [rad/s], nan where unknown."""
        self._speeds.on_speeds(stamp, speed)
        if stamp < self._blind_until:
            return self._speeds.forget()
        if self._speeds.lost is not None:
            self._lose_rotor(self._speeds.lost, stamp, 'its ESC')
        for racing in np.flatnonzero(self._speeds.thrust > RACES * self._thrust_max):
            self._lose_rotor(int(racing), stamp, 'the speed at which it races')
        deaf = self._speeds.deaf
        if deaf is not None and self.health.rotors[deaf]:
            self._ignore_commands_of(deaf, stamp)
        for rotor, held in enumerate(self.health.held):
            if held is not None and abs(self._speeds.thrust[rotor] - held) > NOTICEABLE:
                self._hold(rotor, self._speeds.thrust[rotor])

    def name(self, name: str, now: float, text: str) -> bool:
        """Add a fault detected elsewhere; False if it is already known."""
        return self._name(name, now, text)

    def _ignore_commands_of(self, rotor, stamp):
        thrust = self._speeds.thrust[rotor]
        if self._name(f'rotor{rotor + 1}_deaf', stamp, f'rotor {rotor + 1} does not follow its '
                      f'commands, by its ESC; it gives {thrust:.1f} N'):
            self._hold(rotor, thrust)

    def _lose_rotor(self, rotor, stamp, by):
        rotors = self.health.rotors
        if self._name(f'rotor{rotor + 1}_lost', stamp, f'rotor {rotor + 1} gives less thrust than '
                      f'commanded, by {by}'):
            self.health = replace(self.health, rotors=tuple(
                works and k != rotor for k, works in enumerate(rotors)))

    def _stick(self, joint, angle):
        self.health = replace(self.health, stuck=tuple(
            angle if k == joint else old for k, old in enumerate(self.health.stuck)))

    def _hold(self, rotor, thrust):
        thrust = float(np.clip(thrust, 0.0, self._thrust_max))
        self.health = replace(self.health, held=tuple(
            thrust if k == rotor else old for k, old in enumerate(self.health.held)))

    def _move_zero(self, joint, by):
        self.health = replace(self.health, zeros=tuple(
            zero + by if k == joint else zero for k, zero in enumerate(self.health.zeros)))

    def _follow(self, tilt):
        """Update the angles of joints that do not follow commands."""
        for joint, angle in enumerate(self.health.stuck):
            if angle is not None and abs(angle - tilt[joint]) > 0.02:
                self._stick(joint, float(np.clip(tilt[joint], -self._limit, self._limit)))

    def _name(self, name, stamp, text):
        if name in self.faults:
            return False
        self.faults[name] = float(stamp)
        if text:
            self._new.append(text)
        return True
