"""No servo keeps its torque after any end of the driver's process."""

import os
from pathlib import Path
import subprocess
import sys
import time

import pytest

import beetle_omni_ros
from beetle_omni_ros.drivers.servo_guard import HOLD
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

pytestmark = pytest.mark.real_time

DRIVER = """
from dataclasses import replace
import sys, time
from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.drivers.device_parameters import ServoBusParameters
from beetle_omni_ros.model.parameters import RobotParameters
shipped = ServoBusParameters.load()
bus = ServoBus(replace(shipped, port=sys.argv[1], reply_time=0.05),
               RobotParameters.load().joints)
bus.open(); bus.configure(); bus.enable()
while True:
    bus.write_goals([1.0, 1.0, 1.0, 1.0]); bus.read(); bus.upkeep()
    print('tick', flush=True)
    time.sleep(0.005)
"""
ROOT = Path(beetle_omni_ros.__file__).parents[1]


def test_torque_holds_for_a_landing_and_is_off_after_the_process_is_killed():
    with EmulatedServoBus() as emulated:
        process = subprocess.Popen(
            [sys.executable, '-c', DRIVER, emulated.port], cwd=ROOT, text=True,
            env={**os.environ, 'PYTHONPATH': str(ROOT)}, stdout=subprocess.PIPE)
        try:
            for _ in range(5):
                assert process.stdout.readline() == 'tick\n'
            assert all(emulated.drive()[1])
            process.kill()
            time.sleep(0.5 * HOLD)
            assert all(emulated.drive()[1])
            end = time.monotonic() + HOLD + 5.0
            while any(emulated.drive()[1]) and time.monotonic() < end:
                time.sleep(0.005)
            assert not any(emulated.drive()[1])
        finally:
            process.kill()
            process.communicate()
