"""The simulated robot with the interface of a real one: commands in, sensor readings out."""

from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from math import isfinite, sqrt

import numpy as np

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import clipped
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.sim.fault_kinds import Drive, ROUNDING
from beetle_omni_ros.sim.faults import Fault, READINGS, Schedule
from beetle_omni_ros.sim.parameters import draw, SimulatorParameters
from beetle_omni_ros.sim.plant import Plant, XYZW
from beetle_omni_ros.sim.sensors import Frame, Impact, Sensors, Truth

STAMP_ROUNDING = 1e-6   # [s] floats of UNIX time have a resolution of 0.24 us
FUTURE_LIMIT = 0.1  # [s] stamps further ahead come from a wrong clock and are refused
INTACT = np.ones(4)     # wear of four propellers
AIRBORNE_TIME = 0.3     # [s] without contact, after which a contact is a touchdown; chosen
# Charge of a pack, and its open-circuit voltage relative to a full one: a typical lithium-polymer
# cell, over 4.2 V.
CHARGES = [0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
VOLTAGES = [0.78, 0.86, 0.88, 0.89, 0.90, 0.905, 0.915, 0.925, 0.94, 0.955, 0.975, 1.0]


class Battery:
    """Charge, voltage and current of one battery."""

    def __init__(self, robot: RobotParameters, parameters: SimulatorParameters):
        self._parameters = parameters
        self._resistance = robot.battery.resistance
        self._curve = CHARGES, [robot.battery.full_voltage * part for part in VOLTAGES]
        rows = sorted(robot.rotors.map, key=lambda row: row.voltage)
        self._limits = [row.voltage for row in rows], [row.thrust_max for row in rows]
        self._thrust_max = robot.rotors.thrust_max
        self.reset()

    def reset(self) -> None:
        """Set the initial charge and no load."""
        self.charge = self._parameters.battery_charge   # [-] of a full battery
        self.extra_resistance = 0.0         # [ohm] of a bad contact or cell
        self.current = 0.0      # [A] positive
        self.voltage = self.rest_voltage    # [V] under the present load

    @property
    def rest_voltage(self) -> float:
        """Open-circuit voltage [V]."""
        return _interpolate(*self._curve, self.charge)

    def step(self, thrust: np.ndarray, duration: float) -> None:
        """Supply the power for ``thrust`` (4,) [N] during ``duration`` [s]."""
        parameters = self._parameters
        power = parameters.idle_power + parameters.rotor_power * sum(
            f * sqrt(f) for f in thrust.tolist() if f > 0)
        rest = self.rest_voltage
        # power = V (rest - V) / R, limited to the largest power, which is at V = rest / 2
        resistance = self._resistance + self.extra_resistance
        self.voltage = 0.5 * (rest + sqrt(max(0.0, rest * rest - 4 * resistance * power)))
        self.current = power / self.voltage
        if resistance:
            self.current = min(self.current, (rest - self.voltage) / resistance)
        self.charge = max(0.0, self.charge - self.current * duration
                          / (3600 * parameters.battery_capacity))

    @property
    def thrust_limit(self) -> float:
        """Largest thrust of a rotor at the present voltage [N], by the rotor map if given."""
        voltages, thrusts = self._limits
        if len(voltages) < 2:
            return self._thrust_max
        limit = _interpolate(voltages, thrusts, min(self.voltage, voltages[-1]))
        return min(self._thrust_max, max(0.0, limit))


def _interpolate(xs, ys, x):
    """Piecewise linear interpolation with linear extrapolation."""
    k = min(max(bisect_right(xs, x) - 1, 0), len(xs) - 2)
    return ys[k] + (ys[k + 1] - ys[k]) * (x - xs[k]) / (xs[k + 1] - xs[k])


class CommandLink:
    """
    Checks and delays commands, and stops the rotors if none arrives.

    ``tilt`` (4,) [rad] and ``thrust`` (4,) [N] are the present targets.
    """

    def __init__(self, robot: RobotParameters, timeout: float, delays: tuple[float, float]):
        self._limit = robot.joints.position_limit
        self._thrust_range = robot.rotors.thrust_min, robot.rotors.thrust_max
        self._timeout, self._delays = timeout, delays
        self._pending: tuple[deque, deque] = (deque(), deque())
        self._last_stamp = self._last_arrival = -np.inf
        self.tilt, self.thrust = np.zeros((2, 4))

    def push(self, command, now: float) -> bool:
        """
        Accept or refuse a command (stamp, tilt (4,), thrust (4,)) at ``now`` [s].

        It acts at its stamp plus the delay, or now if that has passed. It is refused if it is not
        finite, older than the last one or from the future. One with the same stamp replaces it.
        """
        if not all(map(isfinite, (command.stamp, *command.tilt, *command.thrust))) \
                or not self._last_stamp <= command.stamp <= now + FUTURE_LIMIT:
            return False
        self._last_stamp, self._last_arrival = command.stamp, now
        tilt = clipped(np.asarray(command.tilt), -self._limit, self._limit)
        thrust = clipped(np.asarray(command.thrust), *self._thrust_range)
        for queue, delay, value in zip(self._pending, self._delays, (tilt, thrust)):
            queue.append((max(command.stamp + delay, now), value))
        return True

    def update(self, now: float) -> None:
        """Set the targets that are due at ``now``; stop the rotors after the timeout."""
        tilts, thrusts = self._pending
        while tilts and tilts[0][0] <= now + STAMP_ROUNDING:
            self.tilt = tilts.popleft()[1]
        while thrusts and thrusts[0][0] <= now + STAMP_ROUNDING:
            self.thrust = thrusts.popleft()[1]
        if now - self._last_arrival >= self._timeout - ROUNDING:
            self.thrust = np.zeros(4)


class Simulator:
    """
    Plant, actuator timing, battery and sensors of the true robot, advanced tick by tick.

    Equal robots, parameters, conditions ('nominal' or 'published'), seeds and calls give equal
    results. ``time`` is that since reset [s], ``tick`` the duration of one step [s], ``epoch`` the
    time of the stamps at reset [s], which may change like a clock that is set. The reset of
    ``battery`` inserts a new one, also in flight. In flight ``wrench`` may be set, an external
    force in world [N] and torque in base_link [N m] there (6,), and ``payload``, the mass [kg] of
    a ball that is fixed below the body. ``link`` has the present targets of the actuators.

    Raises:
        ParameterError: impossible mass properties, unknown conditions, or a latency that is not a
            multiple of the tick.

    """

    def __init__(self, robot: RobotParameters, parameters: SimulatorParameters | None = None,
                 conditions: str = 'nominal', seed: int = 0, epoch: float = 0.0):
        self._robot, self.epoch = robot, epoch
        self._parameters = parameters or SimulatorParameters.load()
        self._seed = seed
        self.tick = self._parameters.tick
        self.conditions = draw(conditions, self._parameters,
                               np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0]))
        # Of tilt and thrust commands from their stamps [s], effects included.
        self.command_delays = self.conditions.command_delays(robot)
        self._rotor_gain = -np.expm1(-self.tick / robot.rotors.time_constant)
        self._plant = Plant(robot, self._parameters, self.conditions.variation)
        self.battery = Battery(robot, self._parameters)
        self.reset()

    def reset(self, position: np.ndarray | None = None,
              quaternion: np.ndarray | None = None) -> None:
        """
        Restart at rest: intact robot, rotors off, initial charge, first noise values, no faults.

        ``position`` (3,) is that of base_link in world [m], by default standing on the floor;
        ``quaternion`` (4,) is base_link to world, xyzw, by default level.
        """
        self._ticks = 0
        self.time = 0.0
        self._plant.reset(position, quaternion)
        self.battery.reset()
        self._impact: Impact | None = None
        self._airborne, self._flown, self._broken = 0.0, False, False
        self.wrench, self.payload, self._wear = np.zeros(6), 0.0, INTACT
        self.link = CommandLink(self._robot, self._parameters.command_timeout,
                                self.command_delays)
        self.truth = self._truth()
        *seeds, fault_seed = np.random.SeedSequence(self._seed).spawn(7)[1:]
        self._schedule = Schedule(self.tick, fault_seed)
        self._sensors = Sensors(self._parameters, self.conditions, seeds, self.truth,
                                self._plant, self._robot)

    def command(self, command) -> None:
        """Send a command, see :meth:`CommandLink.push`."""
        for one in self._schedule.through('command', command, self.time):
            self.link.push(one, self.time)

    def set_faults(self, faults: Sequence[Fault]) -> None:
        """
        Replace the faults of robot and devices; ``at`` counts from now.

        A fault that is also in the present list continues. A ParameterError is raised for a fault
        of a process, which is not simulated here.
        """
        for fault in faults:
            if fault.is_process:
                raise ParameterError(f"fault '{fault.kind}': affects a process, not the simulated "
                                     'robot')
        self._schedule.set(faults, self.time)

    @property
    def faults(self) -> list[str]:
        """Kinds of the active faults."""
        return [state.fault.kind for _, state in self._schedule.active]

    def step(self, drive: Drive | None = None) -> Frame:
        """
        Advance one tick; return the readings that arrive in it.

        Servos and rotors follow :meth:`command`, or ``drive`` of external actuators, without
        delay or timeout.
        """
        plant, link, battery, schedule = self._plant, self.link, self.battery, self._schedule
        devices = drive is not None
        if not schedule.empty:
            schedule.update(self.time, self.truth, link.tilt)
            for late in schedule.through('command', None, self.time):
                link.push(late, self.time)
        if drive is None:
            link.update(self.time)
            drive = Drive(link.tilt, np.minimum(link.thrust, battery.thrust_limit))
        struck = bool(schedule.active)
        if struck or self._broken:
            drive = Drive(*map(np.array, (drive.tilt, drive.thrust, drive.powered, drive.jammed,
                                          drive.wear)))
            schedule.each('drive', drive)
            limit = self._robot.joints.position_limit
            drive.tilt = clipped(drive.tilt, -limit, limit)
        if self._broken:
            drive.thrust, drive.powered = np.zeros(4), np.zeros(4, dtype=bool)
        plant.set_targets(drive.tilt, drive.thrust, drive.powered, drive.jammed)
        plant.wrench[:] = sum(schedule.each('wrench'), self.wrench)
        plant.set_payload(sum(schedule.each('payload'), self.payload))
        plant.voltage_ratio = battery.voltage / self._robot.battery.full_voltage
        plant.step()
        if struck or self._wear is not INTACT:
            # Wear shows with the thrust, which follows with the rotors' lag.
            self._wear = self._wear + self._rotor_gain * (drive.wear - self._wear)
        self._ticks += 1
        self.time = self._ticks * self.tick
        self._watch_contact(self.truth, plant.contact)
        self.truth = self._truth()
        battery.extra_resistance = sum(schedule.each('resistance'))
        battery.charge = min(battery.charge, *schedule.each('charge'), 1.0)
        battery.step(self.truth.thrust, self.tick)
        frame = self._sensors.read(self._ticks, self.truth, battery, self._wear, devices)
        if struck:
            frame = replace(frame, **{name: next(iter(schedule.through(
                name, getattr(frame, name), self.time)), None) for name in READINGS})
        return frame

    def _watch_contact(self, before, contact):
        """Update touchdown and damage by the contact after a tick."""
        # A robot that has flown breaks if its first contact is too fast, or a contact too
        # inclined. One that has not flown may be placed on its side. In the state ``before`` the
        # tick the floor has not slowed the robot yet.
        limits = self._parameters
        if not contact:
            self._airborne += self.tick
            self._flown = self._flown or self._airborne >= AIRBORNE_TIME
            return
        vertical = rotations.matrix(before.quaternion)[2, 2]   # cosine of the inclination
        breaks = vertical < np.cos(limits.crash_inclination)
        if self._airborne > 0:
            speed = float(np.linalg.norm(before.velocity))
            breaks = breaks or speed > limits.crash_speed
            if self._airborne >= AIRBORNE_TIME:
                self._impact = Impact(before.stamp, speed,
                                      float(np.arccos(np.clip(vertical, -1.0, 1.0))))
        self._broken = self._broken or bool(self._flown and breaks)
        self._airborne = 0.0

    def _truth(self):
        qpos, qvel = self._plant.state
        return Truth(self.epoch + self.time, qpos[:3], qvel[:3], qpos[XYZW], qvel[3:6],
                     self._plant.tilt, qvel[6:], self._plant.thrust, self._plant.contact,
                     self._impact, self._broken)
