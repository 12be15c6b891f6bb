"""The simulated robot as the flight stack meets it: commands in, sensor readings out."""

from __future__ import annotations

from collections import Counter

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.sim.battery import Battery
from beetle_omni_ros.sim.command_link import CommandLink
from beetle_omni_ros.sim.conditions import draw
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.plant import Plant, XYZW
from beetle_omni_ros.sim.readings import Drive, Frame, Truth
from beetle_omni_ros.sim.sensors import Sensors

POWERED = (True,) * 4


class Simulator:
    """
    Plant, actuator timing, battery and sensors, advanced tick by tick.

    The same robot, parameters, conditions, seed and calls give the same numbers.

    Attributes:
        time: since reset [s].
        tick: of one step [s].
        conditions: what the seed made of biases, latencies and the robot.

    """

    def __init__(self, robot: RobotParameters, parameters: SimulatorParameters | None = None,
                 conditions: str = 'nominal', seed: int = 0):
        """
        Build the world and reset it.

        Args:
            robot: what is true in the simulation.
            parameters: by default params/simulator.yaml.
            conditions: 'nominal' or 'published'.
            seed: of everything random.

        Raises:
            ParameterError: an effect that the plant lacks, impossible mass properties, unknown
                conditions, a latency that is no multiple of the tick.

        """
        self._robot = robot
        self._parameters = parameters or SimulatorParameters.load()
        if not isinstance(seed, (int, np.integer)) or seed < 0:
            raise ParameterError(f'seed: expected a whole number from 0, found {seed!r}')
        self._seed = seed
        self.tick = self._parameters.plant.tick
        self.conditions = draw(conditions, self._parameters,
                               np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0]))
        self._plant = Plant(robot, self._parameters.plant, self.conditions.variation)
        self._battery = Battery(robot, self._parameters.battery)
        self.reset()

    def reset(self, position: np.ndarray | None = None,
              quaternion: np.ndarray | None = None) -> None:
        """
        Begin anew: at rest, rotors off, full battery, the seed's noise from its start.

        Args:
            position: (3,) of base_link in world [m]; by default standing on the floor.
            quaternion: (4,) base_link to world, xyzw; by default level.

        Raises:
            ValueError: not finite numbers of these shapes, or a quaternion of length zero.

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
        self._battery.reset()
        self._link = CommandLink(self._robot, self._parameters.actuators, self.conditions)
        self.truth = self._truth()
        seeds = np.random.SeedSequence(self._seed).spawn(5)[1:]
        self._sensors = Sensors(self._parameters, self.conditions, seeds, self.truth,
                                self._plant.effort)
        self._sensors.start_imu(self.truth, self._plant.specific_force)

    def command(self, command) -> bool:
        """
        Send a command (stamp, tilt (4,), thrust (4,)); it acts at its stamp plus the delay.

        Returns:
            whether it was taken; refusals are counted in :attr:`rejected`.

        """
        return self._link.push(command, self.time)

    @property
    def rejected(self) -> Counter:
        """Reason -> number of commands refused since reset."""
        return self._link.rejected

    def set_wrench(self, force_world: np.ndarray, torque_body: np.ndarray) -> None:
        """
        Apply an external wrench at base_link until changed.

        Args:
            force_world: (3,) [N].
            torque_body: (3,) in base_link [N m].

        Raises:
            ValueError: not three finite numbers each.

        """
        self._plant.set_wrench(_vector('wrench force', force_world, 3),
                               _vector('wrench torque', torque_body, 3))

    def set_payload(self, mass: float) -> None:
        """
        Attach a ball of ``mass`` [kg] rigidly below the body, in place of the one before.

        Raises:
            ValueError: negative or not finite.

        """
        if not (np.isfinite(mass) and mass >= 0):
            raise ValueError(f'payload: expected a mass of 0 kg or more, found {mass!r}')
        self._plant.set_payload(float(mass))

    @property
    def charge(self) -> float:
        """What is left in the pack, 1 is full."""
        return self._battery.charge

    @property
    def voltage(self) -> float:
        """True pack voltage under load [V]."""
        return self._battery.voltage

    @property
    def current(self) -> float:
        """True current drawn from the pack [A], positive."""
        return self._battery.current

    def swap_battery(self) -> None:
        """Put in a fresh pack, also in flight: a task may be longer than a charge."""
        self._battery.reset()

    def step(self, drive: Drive | None = None) -> Frame:
        """
        Advance one tick; return what became available in it.

        Args:
            drive: what actuators outside do, without further delay or timeout; by default
                servos and rotors follow :meth:`command`.

        """
        plant, link, battery = self._plant, self._link, self._battery
        if drive is None:
            link.update(self.time)
            plant.set_powered(POWERED)
            plant.set_targets(link.tilt, np.minimum(link.thrust, battery.thrust_limit))
        else:
            plant.set_powered(drive.powered)
            plant.set_targets(drive.tilt, drive.thrust)
        plant.step()
        self._ticks += 1
        self.time = self._ticks * self.tick
        self.truth = truth = self._truth()
        battery.step(truth.thrust, self.tick)
        imu, mocap, joints, pack = self._sensors.read(self._ticks, truth, plant, battery,
                                                        devices=drive is not None)
        return Frame(self.time, imu, mocap, joints, pack, truth)

    def _truth(self):
        qpos, qvel = self._plant.state
        return Truth(self.time, qpos[:3], qvel[:3], qpos[XYZW], qvel[3:6], qpos[7:], qvel[6:],
                     self._plant.thrust, self._plant.contact)


def _vector(name, value, length):
    try:
        vector = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (length,) or not np.isfinite(vector).all():
        raise ValueError(f'{name}: expected {length} finite numbers, found {value!r}')
    return vector
