"""No servo keeps its torque after any end of the driver's process."""

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
from beetle_omni_ros.drivers.servo_parameters import ServoBusParameters
from beetle_omni_ros.robot.parameters import RobotParameters
shipped = ServoBusParameters.load()
bus = ServoBus(replace(shipped, port=sys.argv[1], guard=sys.argv[2] == 'guard',
                       timing=replace(shipped.timing, reply=0.05)),
               RobotParameters.load().joints)
bus.open(); bus.configure(); bus.enable()
while True:
    bus.write_goals([1.0, 1.0, 1.0, 1.0]); bus.read(); bus.poll_health()
    print('tick', flush=True)
    time.sleep(0.005)
"""
ROOT = Path(beetle_omni_ros.__file__).parents[1]


def wait_for(condition, limit=10.0):
    end = time.monotonic() + limit
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    assert condition()


def driver(port, guard):
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    process = subprocess.Popen([sys.executable, '-c', DRIVER, port, guard], cwd=ROOT,
                               env=environment, stdout=subprocess.PIPE, text=True)
    for _ in range(5):
        assert process.stdout.readline() == 'tick\n'
    return process


@pytest.mark.parametrize('how', [signal.SIGKILL, signal.SIGTERM, signal.SIGSEGV])
def test_torque_is_off_after_the_process_is_killed(how):
    with EmulatedServoBus() as emulated:
        process = driver(emulated.port, 'guard')
        try:
            assert emulated.torque_enabled.all()
            process.send_signal(how)
            process.wait(5)
            wait_for(lambda: not emulated.torque_enabled.any())
        finally:
            process.kill()
            process.communicate()


def test_the_watchdog_of_the_servos_stops_them_without_any_process():
    with EmulatedServoBus() as emulated:
        process = driver(emulated.port, 'alone')
        try:
            assert not emulated.stopped.any()
            process.kill()
            process.wait(5)
            wait_for(lambda: emulated.stopped.all())
            # They hold the angle set by the plant.
            assert emulated.goals == pytest.approx([0, 0, 0, 0], abs=0.001)
        finally:
            process.kill()
            process.communicate()


def test_the_servos_stop_while_the_process_is_frozen():
    with EmulatedServoBus() as emulated:
        process = driver(emulated.port, 'guard')
        try:
            process.send_signal(signal.SIGSTOP)
            wait_for(lambda: emulated.stopped.all())
            process.send_signal(signal.SIGCONT)
            wait_for(lambda: not emulated.stopped.any())
        finally:
            process.kill()
            process.communicate()
            wait_for(lambda: not emulated.torque_enabled.any())
