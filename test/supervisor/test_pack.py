"""The pack's resistance and the thrust that it allows, against the simulated pack."""

import numpy as np
import pytest

from beetle_omni_ros.model.allocation import Allocator
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.parts import ThrustMap
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.sensors import VOLTAGE_NOISE
from beetle_omni_ros.sim.simulator import Battery
from beetle_omni_ros.supervisor.detectors import PackWatch

ROBOT = RobotParameters.load()
PACK = SimulatorParameters.load()
TICK = 0.01
LAG = ROBOT.rotors.time_constant


class Flight:
    """A simulated pack with four rotors, and the watch of its readings."""

    def __init__(self, seed=0):
        self.battery = Battery(ROBOT, PACK)
        self.watch = PackWatch(ROBOT, Allocator(ROBOT), ThrustMap(ROBOT.rotors))
        self.random, self.ticks = np.random.default_rng(seed), 0
        self.thrust = np.zeros(4)

    def fly(self, duration, command, faster=1.0):
        """Fly with ``command`` (4,) [N] or a function of time; charge falls ``faster``."""
        for _ in range(round(duration / TICK)):
            time = self.ticks * TICK
            asked = command(time) if callable(command) else command
            given = np.minimum(asked, self.battery.thrust_limit)
            self.thrust = self.thrust - np.expm1(-TICK / LAG) * (given - self.thrust)
            self.battery.step(self.thrust, TICK * faster)
            self.ticks += 1
            if self.ticks % 10 == 0:
                seen = self.battery.voltage + VOLTAGE_NOISE * self.random.normal()
                self.watch.on_voltage(self.ticks * TICK, seen, self.thrust)
            if self.watch.limit is not None:
                return self.ticks * TICK - time
        return None


def hover(time=0.0):
    return np.full(4, ROBOT.hover_thrust)


def manoeuvres(time):
    """Between half and twice the hover thrust, faster and slower than the rotors' lag."""
    phases = np.array([0.0, 1.0, 2.5, 4.0])
    return ROBOT.hover_thrust * (1.2 + 0.5 * np.sin(2.0 * time + phases)
                                 + 0.3 * np.sin(9.0 * time + 2 * phases))


def turns(time):
    """Every 5 s more load for half a second than the most demanding attitude needs."""
    return np.array([17.0, 14.0, 19.0, 13.0]) if time % 5 > 4.5 else hover()


def all_together(extra):
    """Thrust of four saturated rotors [N] with the simulated pack."""
    battery = Battery(ROBOT, PACK)
    battery.extra_resistance = extra
    thrust = np.full(4, ROBOT.hover_thrust)
    for _ in range(2000):
        battery.step(thrust, 1e-6)
        thrust = thrust + 0.05 * (battery.thrust_limit - thrust)
    return float(thrust[0])


@pytest.mark.parametrize('command', [hover, manoeuvres])
@pytest.mark.parametrize('extra', [0.2, 0.3])
def test_a_worn_contact_is_reported_within_half_a_second_with_the_remaining_thrust(command, extra):
    flight = Flight()
    assert flight.fly(0.5, np.zeros(4)) is None
    assert flight.fly(6.0, command) is None
    start = flight.ticks
    flight.battery.extra_resistance = extra
    flight.fly(2.0, command)
    assert flight.watch.limit is not None
    assert (flight.ticks - start) * TICK <= 0.5
    for _ in range(150):        # the watch continues; the loop of fly() stops at a limit
        flight.fly(0.01, command)
    assert flight.watch.limit == pytest.approx(all_together(extra), rel=0.1)


@pytest.mark.parametrize('command', [hover, manoeuvres, turns])
@pytest.mark.parametrize('charge', [1.0, 0.3])
def test_a_good_pack_is_not_weak_while_discharging(command, charge):
    flight = Flight()
    flight.battery.charge = charge
    assert flight.fly(0.5, np.zeros(4)) is None
    # Four times the simulated current: a real pack of this size is empty after 12 minutes. Hover
    # at 9 % of the charge is at 3.4 V a cell, of which the supervisor warns.
    while flight.battery.charge > 0.09:
        assert flight.fly(20.0, command, faster=4.0) is None
