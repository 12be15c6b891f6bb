"""The simulated robot with the interface of a real one: commands in, sensor readings out."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from beetle_omni_ros.robot.allocation import clipped
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.sim.battery import Battery
from beetle_omni_ros.sim.command_link import CommandLink
from beetle_omni_ros.sim.conditions import draw
from beetle_omni_ros.sim.crash import CrashWatch
from beetle_omni_ros.sim.faults import Actuation, Fault, READINGS, Schedule
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.plant import Plant, XYZW
from beetle_omni_ros.sim.readings import Drive, Frame, Truth
from beetle_omni_ros.sim.sensors import Sensors

POWERED, INTACT = (True,) * 4, np.ones(4)


class Simulator:
    """
    Plant, actuator timing, battery and sensors, advanced tick by tick.

    Equal robots, parameters, conditions, seeds and calls give equal results.

    Args:
        robot: the true robot.
        parameters: simulator parameters; default: params/simulator.yaml.
        conditions: 'nominal' or 'published'.

    Attributes:
        time: time since reset [s].
        tick: duration of one step [s].
        conditions: biases, latencies and variation of the robot, drawn from the seed.
        battery: true battery; its reset() inserts a new one, also in flight.

    Raises:
        ParameterError: the plant lacks an effect, impossible mass properties, unknown conditions,
            or a latency that is not a multiple of the tick.

    """

    def __init__(self, robot: RobotParameters, parameters: SimulatorParameters | None = None,
                 conditions: str = 'nominal', seed: int = 0):
        self._robot = robot
        self._parameters = parameters or SimulatorParameters.load()
        if not isinstance(seed, (int, np.integer)) or seed < 0:
            raise ParameterError(f'seed: expected a whole number from 0, found {seed!r}')
        self._seed = seed
        self.tick = self._parameters.plant.tick
        self.conditions = draw(conditions, self._parameters,
                               np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0]))
        self._plant = Plant(robot, self._parameters.plant, self.conditions.variation)
        self.battery = Battery(robot, self._parameters.battery)
        self._crash = CrashWatch(self._parameters.crash, self.tick)
        self._wrench, self._payload = np.zeros(6), 0.0
        self.reset()

    def reset(self, position: np.ndarray | None = None,
              quaternion: np.ndarray | None = None) -> None:
        """
        Restart at rest: intact robot, rotors off, initial charge, first noise values, no faults.

        Args:
            position: (3,) of base_link in world [m]; by default standing on the floor.
            quaternion: (4,) base_link to world, xyzw; by default level.

        Raises:
            ValueError: not finite, of another shape, or a zero quaternion.

        """
        if position is not None:
            position = _vector('position', position, 3)
        if quaternion is not None:
            quaternion = _vector('quaternion', quaternion, 4)
            if not quaternion.any():
                raise ValueError('quaternion: expected a rotation, found zeros')
        self._ticks = 0
        self.time = 0.0
        self._plant.reset(position, quaternion)
        self.battery.reset()
        self._crash.reset()
        self._wrench, self._payload = np.zeros(6), 0.0
        self._wear = INTACT
        self._link = CommandLink(self._robot, self._parameters.actuators, self.conditions)
        self.truth = self._truth()
        *seeds, fault_seed = np.random.SeedSequence(self._seed).spawn(7)[1:]
        self._schedule = Schedule(self.tick, fault_seed, self.battery)
        self._sensors = Sensors(self._parameters, self.conditions, seeds, self.truth,
                                self._plant.effort, self._robot.sensors)
        self._sensors.start_imu(self.truth, self._plant.specific_force)

    def set_body(self, position: np.ndarray, quaternion: np.ndarray, velocity: np.ndarray,
                 angular_velocity: np.ndarray) -> None:
        """Repair the robot and set its motion, see :meth:`.plant.Plant.set_body`."""
        self._plant.set_body(position, quaternion, velocity, angular_velocity)
        self._crash.reset()
        self.truth = self._truth()

    def command(self, command) -> bool:
        """
        Send a command (stamp, tilt (4,), thrust (4,)), which acts at its stamp plus the delay.

        Returns:
            whether it was accepted; :attr:`rejected` counts refusals.

        """
        accepted = True
        for one in self._schedule.through('command', command, self.time):
            accepted = self._link.push(one, self.time)
        return accepted

    def set_faults(self, faults: Sequence[Fault]) -> None:
        """
        Replace the faults; a fault that is also in the present list continues.

        Args:
            faults: faults of robot and devices; ``at`` counts from now.

        Raises:
            ParameterError: a fault of a process, which is not simulated here.

        """
        for fault in faults:
            if fault.is_process:
                raise ParameterError(f"fault '{fault.kind}': affects a process, not the simulated "
                                     'robot')
        self._schedule.set(faults, self.time)
        self._apply_wrench()

    @property
    def faults(self) -> list[str]:
        """Kinds of the active faults."""
        return self._schedule.names

    @property
    def thrust_command(self) -> np.ndarray:
        """(4,) thrusts commanded to the rotors [N]; zero after the command timeout."""
        return self._link.thrust

    @property
    def command_delays(self) -> tuple[float, float]:
        """Delays of tilt and thrust commands from their stamps [s], effects included."""
        return self.conditions.command_delays(self._robot)

    def _apply_wrench(self):
        """Set wrench and payload of the plant: those of the task and those of the faults."""
        wrench = sum(self._schedule.each('wrench'), self._wrench)
        self._plant.set_wrench(wrench[:3], wrench[3:])
        self._plant.set_payload(sum(self._schedule.each('payload'), self._payload))

    @property
    def rejected(self) -> Counter:
        """Reason -> number of refused commands since reset."""
        return self._link.rejected

    def set_wrench(self, force_world: np.ndarray, torque_body: np.ndarray) -> None:
        """
        Apply an external wrench at base_link.

        Args:
            force_world: (3,) [N].
            torque_body: (3,) in base_link [N m].

        Raises:
            ValueError: not three finite numbers each.

        """
        self._wrench = np.concatenate([_vector('wrench force', force_world, 3),
                                       _vector('wrench torque', torque_body, 3)])
        self._apply_wrench()

    def set_payload(self, mass: float) -> None:
        """
        Set the mass [kg] of the payload, a ball that is fixed below the body.

        Raises:
            ValueError: negative or not finite.

        """
        if not (np.isfinite(mass) and mass >= 0):
            raise ValueError(f'payload: expected a mass of 0 kg or more, found {mass!r}')
        self._payload = float(mass)
        self._apply_wrench()

    def step(self, drive: Drive | None = None) -> Frame:
        """
        Advance one tick; return the readings that arrive in it.

        Args:
            drive: inputs from external actuators, applied without delay or timeout; by default
                servos and rotors follow :meth:`command`.

        """
        plant, link, battery = self._plant, self._link, self.battery
        if not self._schedule.empty:
            self._switch_faults()
        if drive is None:
            link.update(self.time)
            wear = self._actuate(link.tilt, np.minimum(link.thrust, battery.thrust_limit), POWERED)
        else:
            wear = self._actuate(drive.tilt, drive.thrust, drive.powered)
        plant.voltage_ratio = battery.voltage / self._robot.battery.full_voltage
        plant.charge_drawn = battery.drawn
        plant.step()
        if wear is not self._wear:      # shows with the thrust, which follows with the rotors' lag
            wear = self._wear = self._wear - np.expm1(
                -self.tick / self._robot.rotors.time_constant) * (wear - self._wear)
        self._ticks += 1
        self.time = self._ticks * self.tick
        self._crash.step(self.truth, plant.contact)
        self.truth = truth = self._truth()
        battery.step(truth.thrust, self.tick)
        imu, mocap, joints, pack = self._sensors.read(self._ticks, truth, plant, battery,
                                                        devices=drive is not None)
        frame = Frame(self.time, imu, mocap, joints, pack, truth,
                      self._sensors.rotor_speeds(self._ticks, truth, wear))
        return self._with_sensor_faults(frame) if self._schedule.active else frame

    def _switch_faults(self):
        """Start and end faults, and send commands that faults have delayed."""
        before = self._schedule.active
        self._schedule.update(self.time, self.truth, self._link.tilt)
        if self._schedule.active is not before:
            self._apply_wrench()
        for command in self._schedule.through('command', None, self.time):
            self._link.push(command, self.time)

    def _actuate(self, tilt, thrust, powered):
        """Set the inputs of servos and rotors with faults and damage; return the rotors' wear."""
        plant, broken = self._plant, self._crash.broken
        if not (self._schedule.active or broken):
            plant.set_powered(powered)
            plant.set_targets(tilt, thrust)
            return INTACT
        drive = Actuation(np.array(tilt), np.array(thrust), np.array(powered), np.zeros(4, bool),
                          np.ones(4))
        self._schedule.each('drive', drive)
        if broken:
            drive.thrust[:], drive.powered[:] = 0.0, False
        limit = self._robot.joints.position_limit
        plant.set_powered(drive.powered, drive.jammed)
        plant.set_targets(clipped(drive.tilt, -limit, limit), drive.thrust)
        return drive.wear

    def _with_sensor_faults(self, frame):
        """Frame with the readings changed by sensor faults."""
        return replace(frame, **{name: next(iter(self._schedule.through(
            name, getattr(frame, name), self.time)), None) for name in READINGS})

    def _truth(self):
        qpos, qvel = self._plant.state
        return Truth(self.time, qpos[:3], qvel[:3], qpos[XYZW], qvel[3:6], self._plant.tilt,
                     qvel[6:],
                     self._plant.thrust, self._plant.contact, self._crash.impact,
                     self._crash.broken)


def _vector(name, value, length):
    try:
        vector = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (length,) or not np.isfinite(vector).all():
        raise ValueError(f'{name}: expected {length} finite numbers, found {value!r}')
    return vector
