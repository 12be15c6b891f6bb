"""A driver with emulated servos, in a loop as in the bridge."""

from contextlib import contextmanager
from dataclasses import replace
import time

import numpy as np

from beetle_omni_ros.drivers.device_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

JOINTS = RobotParameters.load().joints
SHIPPED = ServoBusParameters.load()
# Driver and servos share this process and a busy machine: wait longer than on a robot.
PATIENT = replace(SHIPPED.timing, reply=0.03, probe=0.05, health=0.04,
                  reconnect=0.02)
COUNT = 2 * np.pi / 4096  # [rad]


@contextmanager
def bench(guard=False, timing=PATIENT, servos=None, **parameters):
    """Open a bus of emulated servos with their own motion, not configured."""
    with EmulatedServoBus(**{'speed': 10.0, 'reboot_time': 0.05, **(servos or {})}) as emulated:
        bus = ServoBus(replace(SHIPPED, port=emulated.port, guard=guard, timing=timing,
                               **parameters), JOINTS)
        bus.open()
        try:
            yield bus, emulated
        finally:
            bus.close()


@contextmanager
def running(**options):
    with bench(**options) as (bus, emulated):
        bus.configure()
        bus.enable()
        bus.take_events()
        yield bus, emulated


def tick(bus, goal):
    bus.write_goals(goal)
    readings = bus.read()
    bus.upkeep()
    return readings, bus.servos


def until(condition, bus, goal, limit=5.0):
    """Run the loop until ``condition(readings, servos)``; return the last of both."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        readings, servos = tick(bus, goal)
        if condition(readings, servos):
            return readings, servos
        time.sleep(0.002)
    raise AssertionError(f'not within {limit} s: {readings} {servos} {bus.take_events()}')


def arrived(goal):
    """Condition: all servos answer and are at the goal."""
    return lambda readings, _: (readings.valid.all() and np.allclose(readings.position, goal,
                                                                     atol=2 * COUNT))
