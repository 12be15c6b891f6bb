"""No servo keeps its torque after any end of the driver's process."""

from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

import beetle_omni_ros
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

pytestmark = pytest.mark.real_time

DRIVER = """
from dataclasses import replace
import sys, time
from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.drivers.device_parameters import ServoBusParameters
from beetle_omni_ros.robot.parameters import RobotParameters
shipped = ServoBusParameters.load()
bus = ServoBus(replace(shipped, port=sys.argv[1], guard=sys.argv[2] == 'guard',
                       timing=replace(shipped.timing, reply=0.05)),
               RobotParameters.load().joints)
bus.open(); bus.configure(); bus.enable()
while True:
    bus.write_goals([1.0, 1.0, 1.0, 1.0]); bus.read(); bus.upkeep()
    print('tick', flush=True)
    time.sleep(0.005)
"""
ROOT = Path(beetle_omni_ros.__file__).parents[1]


def wait_for(condition, limit=10.0):
    end = time.monotonic() + limit
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    assert condition()


@contextmanager
def driven(guard):
    """Emulated servos and a process that drives them."""
    with EmulatedServoBus() as emulated:
        process = subprocess.Popen(
            [sys.executable, '-c', DRIVER, emulated.port, guard], cwd=ROOT,
            env={**os.environ, 'PYTHONPATH': str(ROOT)}, stdout=subprocess.PIPE, text=True)
        try:
            for _ in range(5):
                assert process.stdout.readline() == 'tick\n'
            assert emulated.torque_enabled.all() and not emulated.stopped.any()
            yield emulated, process
        finally:
            process.kill()
            process.communicate()


@pytest.mark.parametrize('how', [signal.SIGKILL, signal.SIGTERM])
def test_torque_is_off_after_the_process_is_killed(how):
    with driven('guard') as (emulated, process):
        process.send_signal(how)
        wait_for(lambda: not emulated.torque_enabled.any())


def test_the_watchdog_of_the_servos_stops_them_without_any_process():
    with driven('alone') as (emulated, process):
        process.kill()
        wait_for(lambda: emulated.stopped.all())
        # They hold the angle set by the plant.
        assert emulated.goals == pytest.approx([0, 0, 0, 0], abs=0.001)
