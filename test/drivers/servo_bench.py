"""A driver with emulated servos, in a loop as in the bridge."""

from contextlib import contextmanager
from dataclasses import replace
import time
from types import SimpleNamespace

import numpy as np

from beetle_omni_ros.drivers.device_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

JOINTS = RobotParameters.load().joints
SHIPPED = ServoBusParameters.load()
# Driver and servos share this process and a busy machine: wait longer than on a robot.
PATIENT = 0.03  # [s]
COUNT = 2 * np.pi / 4096  # [rad]


@contextmanager
def bench(guard=False, reply_time=PATIENT, servos=None, **parameters):
    """Open a bus of emulated servos with their own motion, not configured."""
    with EmulatedServoBus(**{'speed': 10.0, 'reboot_time': 0.05, **(servos or {})}) as emulated:
        bus = ServoBus(replace(SHIPPED, port=emulated.port, guard=guard,
                               reply_time=reply_time, **parameters), JOINTS)
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


def read(bus):
    """Reading of all servos, with `valid`: whose feedback is new."""
    valid = bus.read()
    return SimpleNamespace(valid=valid, position=bus.reading(np.ones(4, bool)).position)


def tick(bus, goal):
    bus.write_goals(goal)
    readings = read(bus)
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
