"""The drivers fly the simulated robot through the emulated devices in real time."""

from dataclasses import replace
import time

import numpy as np
import pytest

pytest.importorskip('dynamixel_sdk')
pytest.importorskip('pymavlink')

from board_bench import driver, QUICK, until
from servo_bench import PATIENT, SHIPPED
from sim_robots import HIGH, ROBOT, WORLD

from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.sim.emulated import BoardFaults, ServoFaults
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus
from beetle_omni_ros.sim.emulated_actuators import EmulatedActuators
from beetle_omni_ros.sim.simulator import Simulator

pytestmark = pytest.mark.real_time

HOVER = np.full(4, ROBOT.hover_thrust)
TICK = 0.005


class Flight:
    """Simulator, devices, drivers and the loop of a bridge in one thread, without the devices."""

    def __init__(self):
        self.simulator = Simulator(ROBOT, WORLD)
        self.simulator.reset(HIGH)
        self.actuators = EmulatedActuators(
            self.simulator, EmulatedServoBus(reboot_time=0.05),
            EmulatedMotorBoard(ROBOT, QUICK))
        self.bus = ServoBus(replace(SHIPPED, port=self.actuators.bus.port, guard=False,
                                    timing=PATIENT, reboot_after_overload=False), ROBOT.joints)
        self.board = driver(self.actuators.board.port)
        self.tilt, self.thrust = np.zeros(4), HOVER
        self.readings = self.reports = None
        self.latest = {}

    def __enter__(self):
        """Switch the torque on and arm."""
        self.bus.open()
        self.bus.configure()
        self.bus.enable()
        self.board.open()
        assert until(lambda: not self.board.ready), self.board.ready
        result = self.board.start(True).wait()
        assert result.accepted, result.reason
        return self

    def __exit__(self, *_):
        """Disarm and switch the torque off."""
        self.bus.close()
        self.board.close()
        self.actuators.close()

    def cycle(self):
        """Run one cycle of 5 ms."""
        began = time.monotonic()
        self.frame = self.actuators.step()
        self.bus.write_goals(self.tilt)
        if self.thrust is not None:
            self.board.send(self.thrust, time.time())
        self.readings, self.reports = self.bus.read(), self.bus.servos
        self.bus.upkeep()
        battery, rotors, _ = self.board.poll()
        for name, news in (('battery', battery), ('rotors', rotors),
                           ('status', self.board.state.status)):
            if news is not None:
                self.latest[name] = news
        time.sleep(max(0.0, began + TICK - time.monotonic()))

    def run(self, seconds):
        """Fly for a time [s]."""
        for _ in range(round(seconds / TICK)):
            self.cycle()
        return self

    def until(self, condition, seconds=3.0):
        """Fly until a condition is true."""
        for _ in range(round(seconds / TICK)):
            self.cycle()
            if condition():
                return self
        raise AssertionError(f'not within {seconds} s: tilt {self.simulator.truth.tilt}, thrust '
                             f'{self.simulator.truth.thrust}, {self.reports}')

    def switch(self, servo=None, board=None):
        """Set faults."""
        self.actuators.set_faults(ServoFaults(**servo or {}),
                                  BoardFaults(**board or {}))

    @property
    def truth(self):
        return self.simulator.truth


@pytest.fixture
def flight():
    """A robot that hovers, 20 m up."""
    with Flight() as made:
        made.until(lambda: np.allclose(made.truth.thrust, HOVER, rtol=0.02), 3.0)
        yield made


def test_thrusts_and_tilts_act_and_are_measured(flight):
    flight.tilt = np.array([0.3, -0.3, 0.3, -0.3])
    flight.run(0.7)
    np.testing.assert_allclose(flight.truth.thrust, HOVER, rtol=0.01)
    np.testing.assert_allclose(flight.truth.tilt, flight.tilt, atol=0.07)   # bent by the module
    np.testing.assert_allclose(flight.readings.position, flight.truth.tilt, atol=0.05)
    read, battery = flight.latest['battery'], flight.simulator.battery
    assert read.voltage == pytest.approx(battery.voltage, abs=0.1)
    assert -read.current == pytest.approx(battery.current, abs=1.0)
    rpm = QUICK.rpm_at_1_newton * np.sqrt(ROBOT.hover_thrust)
    np.testing.assert_allclose(flight.latest['rotors'].rpm, rpm, rtol=0.02)


def test_without_the_servos_cable_the_joints_hold(flight):
    flight.tilt = np.full(4, 0.4)
    flight.until(lambda: np.all(flight.truth.tilt > 0.35))
    flight.switch({'unplugged': True})
    flight.tilt = np.full(4, -0.4)
    flight.run(0.4)
    assert flight.actuators.bus.stopped.all()
    assert np.all(flight.truth.tilt > 0.25) and not flight.readings.valid.any()
    flight.switch()
    flight.until(lambda: np.all(flight.truth.tilt < -0.3))


def test_a_lossy_bus_still_flies(flight):
    flight.switch({'bad_crc': 0.05, 'dropped': 0.05, 'delayed': 0.05},
                  {'corrupt_in': 0.05, 'drop_in': 0.05, 'corrupt_out': 0.05, 'drop_out': 0.05})
    flight.tilt = np.full(4, 0.3)
    flight.until(lambda: np.all(flight.truth.tilt > 0.25))
    np.testing.assert_allclose(flight.truth.thrust, HOVER, rtol=0.05)
