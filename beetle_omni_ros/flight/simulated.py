"""The simulated robot as a component."""

from collections.abc import Callable
from dataclasses import replace
from math import degrees

import numpy as np

from beetle_omni_ros.bags.messages import MessageError
from beetle_omni_ros.flight.component import COMMAND_AGE, Component, Distribution, ERROR, OK, WARN
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.emulated.actuators import EmulatedActuators
from beetle_omni_ros.sim.sensors import Frame
from beetle_omni_ros.sim.simulator import Simulator

HOPELESS = 10.0     # times what all rotors produce: a larger disturbance is a mistake
# Delayed readings first: the IMU sample triggers the estimate, which should include them.
SENSORS = {'mocap': 'mocap/pose', 'joints': 'joint_states', 'imu': 'imu/data_raw',
           'rotors': 'rotor_states', 'battery': 'battery_state'}
OF_ACTUATORS = ('joints', 'rotors', 'battery')      # the bridges publish those of real devices


class SimulatedRobot(Component):
    """
    Steps the simulator; commands come from the topic, or through emulated ``devices``.

    Attributes:
        simulator: its ``epoch`` is the time of the stamps at which simulated time is zero.
        on_answer: called with 'command' and the stamp of each command.

    """

    def __init__(self, simulator: Simulator, robot: RobotParameters,
                 devices: EmulatedActuators | None = None):
        super().__init__('sim_node')
        self.simulator = simulator
        self.on_answer: Callable[[str, float], None] = lambda topic, stamp: None
        self._devices: EmulatedActuators | None = None
        self._latency = Distribution()
        lift = HOPELESS * 4 * robot.rotors.thrust_max
        self._most_wrench = lift, lift * np.linalg.norm(robot.rotors.positions, axis=1).max()
        self._sensors = dict(SENSORS)
        if devices is None:
            self.reads('command', self.on_command, max_age=COMMAND_AGE)
            self.report('latency', lambda: self._latency.status(
                'stamp of the answered IMU sample to the arrival of its command'))
        else:
            self.use(devices)
        self.writes(*self._sensors.values(), 'ground_truth/odom')
        self.reads('disturbance', self._on_disturbance, expected=False)
        self.track_compute(simulator.tick)
        self.report('robot', self._robot_status)

    def use(self, devices: EmulatedActuators) -> None:
        """Let the plant follow emulated devices; the bridges then publish their readings."""
        self._devices = devices
        for name in OF_ACTUATORS:
            del self._sensors[name]
        self.report('devices', self._devices_status)

    def close(self) -> None:
        """Switch the devices off."""
        if self._devices is not None:
            self._devices.close()

    def advance(self) -> Frame:
        """Simulate one tick; return the readings that arrive in it."""
        return self.timed((self._devices or self.simulator).step)

    def publish(self, frame: Frame) -> None:
        """Publish readings and truth."""
        for name, topic in self._sensors.items():
            reading = getattr(frame, name)
            if reading is not None:
                self.send(topic, reading)
        self.send('ground_truth/odom', frame.truth)

    def on_command(self, command):
        """Let the actuators follow a command."""
        self._latency.add(self.host.now() - command.stamp)
        self.on_answer('command', command.stamp)
        self.simulator.command(replace(command, stamp=command.stamp - self.simulator.epoch))

    def _on_disturbance(self, wrench):
        size, most = np.linalg.norm([wrench.force, wrench.torque], axis=1), self._most_wrench
        if (size > most).any():
            raise MessageError('{:.3g} N and {:.3g} N m, expected at most {:.3g} N and {:.3g} N m'
                               .format(*size, *most), 'too large')
        self.simulator.wrench = np.concatenate([wrench.force, wrench.torque])

    def _robot_status(self):
        simulator = self.simulator
        faults, impact = simulator.faults, simulator.truth.impact
        values = {'faults': ', '.join(faults), 'broken': int(simulator.truth.broken)}
        if impact is not None:
            values.update(impact_m_s=impact.speed, impact_s=impact.stamp,
                          inclination_deg=degrees(impact.inclination))
        if simulator.truth.broken:
            return ERROR, 'broken by a crash', values
        return WARN if faults else OK, values['faults'] or 'whole', values

    def _devices_status(self):
        faults = self._devices.faults
        level = WARN if faults else OK
        return level, 'faults: ' + (', '.join(faults) or 'none'), self._devices.status()
