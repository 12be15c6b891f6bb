"""
All detectors of one vehicle: detected faults, and the health of the actuators.

docs/safety.md has the table of detectors with signal, limit, persistence and reaction. The limits
are constants beside each detector. They follow from the noise of healthy flights and from both
ends of the lags that the robot file allows.
"""

from dataclasses import replace

import numpy as np

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.model.allocation import (
    ActuatorHealth,
    ALL_HEALTHY,
    Allocator,
    clipped,
    ROTORS,
)
from beetle_omni_ros.model.degraded import sphere
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.parts import ThrustMap
from beetle_omni_ros.supervisor.readings import JointWatch, MocapWatch, SpeedWatch
from beetle_omni_ros.supervisor.wrench import ContactWatch, NEAR_GROUND, WrenchWatch

NOTICEABLE = 0.3        # [N] change of a held thrust or of the pack's limit that is not reported
MOVED = 0.02            # [rad] the same for the angle of a stuck joint
# Of the pack
DIRECTIONS = 200        # of up in the body, with a computed hover load, 14 deg apart
STEPS = 500             # between no and full thrust, for the thrust of all rotors together
TIME = 0.2              # [s] three readings; full thrust in a manoeuvre is shorter
REST_TIME = 10.0        # [s] of the filtered rest voltage, which falls by 0.1 V meanwhile at most


class FaultWatch:
    """
    Runs the detectors and stores the detected faults.

    A detected fault stays until :meth:`reset`: an actuator that has failed once is not used again
    in the same flight.

    Attributes:
        faults: name -> time of detection [s].
        health: which actuators work, and the zeros of encoders that jumped.
        news: texts of faults, emptied by the reader.
        paused: whether no rotor and no joint is suspected, because commands were late.

    """

    def __init__(self, robot: RobotParameters, allocator: Allocator):
        self._robot, self._allocator = robot, allocator
        self._limit = robot.joints.position_limit
        self._thrust_max = self._limit_now = robot.rotors.thrust_max
        self._map = ThrustMap(robot.rotors) if len(robot.rotors.map) > 1 else None
        self.faults: dict[str, float] = {}
        self.reset()

    def reset(self) -> None:
        """Reset for a new flight without faults, perhaps with another pack."""
        self.faults.clear()
        self.health: ActuatorHealth = ALL_HEALTHY
        self.news: list[str] = []
        self.paused = False
        self._thrust = np.zeros(ROTORS)     # executed [N]
        self._pack = None if self._map is None else PackWatch(self._robot, self._allocator,
                                                              self._map)
        self.restart()

    def restart(self) -> None:
        """Restart the detectors after a pause or a step of the clock; detected faults stay."""
        self._stamp = -np.inf
        self._wrench = WrenchWatch(self._robot, self._allocator)
        self.contact = ContactWatch(self._robot.gravity)
        self._joints, self._speeds = JointWatch(self._robot), SpeedWatch(self._robot)
        self._mocap = MocapWatch()

    def name(self, name: str, stamp: float, text: str = '') -> bool:
        """Add a fault; False if it is already known."""
        if name in self.faults:
            return False
        self.faults[name] = float(stamp)
        if text:
            self.news.append(text)
        return True

    def on_command(self, command: Command) -> None:
        """Receive the executed command."""
        self._thrust = clipped(command.thrust, 0.0, self._limit_now)
        self._joints.commands.append((command.stamp, command.tilt))
        self._speeds.commands.append((command.stamp, self._thrust))

    def on_imu(self, stamp: float, force: np.ndarray, rate: np.ndarray, tilt: np.ndarray | None,
               height: float | None) -> None:
        """Receive an IMU sample of a robot in the air, see the two detectors."""
        dt, self._stamp = stamp - self._stamp, stamp
        self._wrench.supported = self._speeds.slow
        self._wrench.on_imu(stamp, force, rate, tilt, self._thrust, self.health)
        self.contact.update(min(max(dt, 0.0), 0.05), height, self._wrench)
        if height is not None and height < NEAR_GROUND:
            return      # the floor also exerts a force
        lost = self._wrench.lost
        if lost is None or self.paused or not self.health.rotors[lost] \
                or self.health.held[lost] is not None:
            return
        self._lose_rotor(lost, stamp, 'the wrench')

    def on_speeds(self, stamp: float, speed: np.ndarray) -> None:
        """Receive ESC speeds (4,) [rad/s], nan where unknown."""
        self._speeds.on_speeds(stamp, speed)
        if self.paused:
            self._speeds.forget()
        lost, deaf, thrust = self._speeds.lost, self._speeds.deaf, self._speeds.thrust
        if lost is not None:
            self._lose_rotor(lost, stamp, 'its ESC')
        if deaf is not None and self.health.rotors[deaf] and self.name(
                f'rotor{deaf + 1}_deaf', stamp, f'rotor {deaf + 1} does not follow its commands, '
                f'by its ESC; it gives {thrust[deaf]:.1f} N'):
            self._set('held', deaf, min(thrust[deaf], self._thrust_max))
        for rotor, held in enumerate(self.health.held):
            if held is not None and abs(thrust[rotor] - held) > NOTICEABLE:
                self._set('held', rotor, min(max(thrust[rotor], 0.0), self._thrust_max))

    def _lose_rotor(self, rotor, stamp, by):
        if self.name(f'rotor{rotor + 1}_lost', stamp, f'rotor {rotor + 1} gives less thrust than '
                     f'commanded, by {by}'):
            self._set('rotors', rotor, False)

    def on_joints(self, stamp: float, tilt: np.ndarray, trusted: bool) -> None:
        """
        Receive a complete reading (4,) [rad], which is judged only if ``trusted``, in the air.

        If an encoder jumps, the joint angle is assumed unchanged: the zero moves by the jump.
        """
        watch = self._joints
        watch.on_joints(stamp, tilt)
        if not trusted or not watch.suspects and not any(watch.jump) \
                and self.health.stuck == ALL_HEALTHY.stuck:
            return
        for joint, jump in enumerate(watch.jump):
            if jump:
                self.name(f'joint{joint + 1}_encoder_jump', stamp, f'the encoder of '
                          f'gimbal{joint + 1} jumped by {jump:+.2f} rad at once')
                self._set('zeros', joint, self.health.zeros[joint] + jump)
        true = clipped(self.health.true(tilt), -self._limit, self._limit).tolist()
        for joint, angle in enumerate(true):
            stuck = self.health.stuck[joint]
            if stuck is not None and abs(stuck - angle) > MOVED:
                self._set('stuck', joint, angle)
            elif stuck is None and watch.astray[joint] and not self.paused:
                self.name(f'joint{joint + 1}_astray', stamp, f'gimbal{joint + 1} does not follow '
                          f'its command, at {angle:.2f} rad')
                self._set('stuck', joint, angle)

    def on_mocap(self, stamp: float, position: np.ndarray, quaternion: np.ndarray,
                 state: State | None) -> bool:
        """Receive a pose and the estimate of about its time; whether the pose may be used."""
        watch = self._mocap
        watch.on_pose(stamp, position, quaternion, state)
        if watch.frozen:
            self.name('mocap_frozen', stamp, 'MoCap repeats the same pose')
        elif watch.contradicts and watch.jumped:
            self.name('mocap_jumped', stamp, 'MoCap jumped, and the IMU does not show it')
        elif watch.contradicts:
            self.name('estimator_wrong', stamp, 'the estimate contradicts MoCap, which did not '
                      'jump')
        return watch.good

    def on_voltage(self, stamp: float, voltage: float) -> None:
        """Receive the pack's voltage [V]: a low voltage limits all rotors."""
        if self._map is None or self._pack is None:
            return
        self._limit_now = self._map.thrust_limit_below(voltage)
        self._pack.on_voltage(stamp, voltage, self._wrench.thrust[1])
        limit, known = self._pack.limit, self.health.thrust_limit
        if limit is not None and (known is None or abs(limit - known) > NOTICEABLE):
            self.name('battery_weak', stamp, f'the pack sags to {voltage:.1f} V under load: it '
                      f'allows {limit:.1f} N a rotor, too little for some attitudes')
            self.health = replace(self.health, thrust_limit=limit)

    def _set(self, field, index, value):
        """Change one entry of the health."""
        old = getattr(self.health, field)
        self.health = replace(self.health, **{  # type: ignore[arg-type]
            field: (*old[:index], value, *old[index + 1:])})


class PackWatch:
    """
    A pack is weak if at the load of some hover attitude it allows too little thrust for it.

    A rotor draws power with thrust to the power of 1.5, so the voltage under load is ``V = rest -
    drop * load / V`` with the load being the sum of those powers. The changes between readings
    give ``drop``, because the charge does not change meanwhile. It converts a reading to the load
    of each attitude, so that a manoeuvre with a larger one is no sign of weakness.

    A pack that becomes worse loses voltage at the same load, which this ``drop`` does not include.
    The slowly filtered ``rest`` then gives the present one, and this the thrust of all rotors
    together.

    Attributes:
        limit: thrust that all rotors can give at the same time [N], None while the pack is strong
            enough; it only falls.

    """

    def __init__(self, robot: RobotParameters, allocator: Allocator, rotor_map: ThrustMap):
        self._map, self._thrust_max = rotor_map, robot.rotors.thrust_max
        _, thrusts = allocator.upright(sphere(DIRECTIONS))
        self._needs = np.minimum(thrusts.max(axis=1), self._thrust_max)
        self._loads = (thrusts ** 1.5).sum(axis=1)
        self.limit: float | None = None
        self._rest, self._read_at, self._weak_for = 0.0, -np.inf, 0.0
        self._before = 0.0, 0.0     # voltage, and load over voltage, of the last reading
        self._products = self._squares = 0.0    # sums over the changes between readings

    def on_voltage(self, stamp: float, voltage: float, thrust: np.ndarray) -> None:
        """Receive a reading [V] under modelled thrusts (4,) [N], zero before lift-off."""
        since, self._read_at = min(stamp - self._read_at, 1.0), stamp
        load = float((thrust ** 1.5).sum())
        if load == 0:
            self._rest = max(self._rest, voltage)
            self._before = self._rest, 0.0
            return
        ratio = load / voltage
        change = ratio - self._before[1]
        self._products += change * (self._before[0] - voltage)
        self._squares += change * change
        self._before = voltage, ratio
        drop = max(0.0, self._products / self._squares)
        rest = voltage + drop * ratio
        self._rest += min(1.0, since / REST_TIME) * (rest - self._rest)
        allowed = self._map.thrust_limit_below(loaded(rest, drop, self._loads))
        weak = bool((allowed < self._needs).any())
        self._weak_for = self._weak_for + since if weak else 0.0
        allowed = float(self._map.thrust_limit_below(voltage))
        if self.limit is not None:
            self.limit = min(self.limit, allowed)
        elif self._weak_for > TIME:
            thrusts = np.linspace(0.0, self._thrust_max, STEPS)     # of all rotors together
            voltages = loaded(self._rest, voltage * (self._rest - voltage) / load,
                              ROTORS * thrusts ** 1.5)
            self.limit = min(allowed, float(
                thrusts[self._map.thrust_limit_below(voltages) >= thrusts].max()))


def loaded(rest, drop, loads):
    """Voltages [V] from ``V (rest - V) = drop * load``; beyond the largest power half of rest."""
    return 0.5 * (rest + np.sqrt(np.maximum(rest ** 2 - 4 * drop * loads, 0.0)))
