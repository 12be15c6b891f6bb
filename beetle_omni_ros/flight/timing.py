"""`beetle_omni check --timing`: times of a control cycle on this computer."""

from collections import deque
from contextlib import suppress
import os
import time

import numpy as np

from beetle_omni_ros.bags.log import FlightLog, hold
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import Command, ControllerHost, State
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.drivers.check import Findings
from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.flight.evaluate import fly
from beetle_omni_ros.flight.loop import collector_off
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.readings import ImuReading, JointReading, PoseReading

PERIOD, LATENCY = 0.005, 0.01   # [s] of the IMU; of a MoCap pose
MISSED, LONG = 0.001, 0.5       # share of missed cycles that fails; p99 over period that warns
REMEDY = 'governor, isolated cores: first_hover.md'


def check_timing(robot: RobotParameters,
                 controllers: tuple[str, ...] = ('rl', 'nmpc')) -> Findings:
    """Replay a simulated flight in real time; a cycle that ends after its period is missed."""
    findings, log = Findings(), fly('nmpc', make_task('random2'), robot=robot, plant=robot)
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    with suppress(OSError):     # as the nodes
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    real_time = os.sched_getscheduler(0) == os.SCHED_RR
    findings.add('priority', 'real-time' if real_time else 'ordinary, real-time is not permitted',
                 warn='' if real_time else 'sudo deploy/install.sh, then log in again')
    try:
        for name in controllers:
            host = ControllerHost(name, registry.find(name).make(robot))
            for item, times, period in zip((f'estimator beside {name}', name), replay(
                    log, host, robot), (PERIOD, host.controller.period)):
                median, high = np.percentile(times[:, 0], (50, 99)).tolist()
                missed = int(np.count_nonzero(times[:, 1] > period))
                findings.add(
                    f'{item}, {1 / period:.0f} Hz', f'median {1e3 * median:.2f}, p99 '
                    f'{1e3 * high:.2f} ms, {missed} of {len(times)} cycles missed',
                    fail=REMEDY * (missed > MISSED * len(times)),
                    warn=REMEDY * (high > LONG * period), median_s=median, p99_s=high,
                    missed=missed, cycles=len(times))
    finally:
        os.sched_setscheduler(0, *before)
    return findings


def replay(log: FlightLog, host: ControllerHost, robot: RobotParameters) -> list[np.ndarray]:
    """Replay at the stamps' pace: (N, 2) durations and ends after the due times [s] of each."""
    ekf = ErrorStateEkf(EkfParameters.load().of_robot(robot), robot.gravity)
    imu, every = log.imu, round(host.controller.period / PERIOD)
    poses = deque(map(PoseReading, log.mocap.t, log.mocap.position, log.mocap.quaternion))
    held = [hold(series.t, getattr(series, name), imu.t) for series, names in (
        (log.joint, ('position', 'velocity')), (log.command, ('tilt', 'thrust')))
        for name in names]
    targets, estimated, stepped = list(log.targets), [], []
    with collector_off():
        origin = time.perf_counter() - imu.t[0]
        for k, stamp in enumerate(imu.t):
            time.sleep(max(0.0, origin + stamp - time.perf_counter()))
            begin = time.perf_counter()
            if poses and poses[0].stamp + LATENCY <= stamp:
                ekf.pose(poses.popleft())
            ekf.imu(ImuReading(stamp, imu.specific_force[k], imu.angular_velocity[k]))
            estimate, end = ekf.estimate, time.perf_counter()
            estimated.append((end - begin, end - stamp - origin))
            while targets and targets[0].stamp <= stamp:
                host.target = targets.pop(0)
            if host.target and estimate and k % every == 0:
                row = [values[k] for values in held]
                host.step(State.join(estimate, JointReading(stamp, *row[:2]),
                                     Command(stamp, *row[2:])))
                now = time.perf_counter()
                stepped.append((now - end, now - stamp - origin))
    return [np.array(estimated), np.array(stepped)]
