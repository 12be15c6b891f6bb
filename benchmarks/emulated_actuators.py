"""
CPU of the emulated devices beside a simulator: ``python benchmarks/emulated_actuators.py``.

The drivers run in their own process and do the work of the bridges in each cycle of 5 ms. Printed
are the CPU times of the two devices' threads and of their coupling with the simulator, in % of
one core, and the cycle times of the drivers.
"""

import argparse
from dataclasses import replace
import multiprocessing
import threading
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters, ServoBusParameters
from beetle_omni_ros.drivers.motor_board import MotorBoard
from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus
from beetle_omni_ros.sim.emulated_actuators import EmulatedActuators
from beetle_omni_ros.sim.simulator import Simulator

PERIOD = 0.005          # [s]
TARGET = 15.0           # [% of one core]


def drive(pipe, servo_port, board_port, seconds):
    """Do the work of the bridges; send 'begin' and then (times, incomplete readings)."""
    robot = RobotParameters.load()
    bus = ServoBus(replace(ServoBusParameters.load(), port=servo_port, guard=False), robot.joints)
    board = MotorBoard(replace(MotorBoardParameters.load(), port=board_port), robot)
    bus.open()
    bus.configure()
    bus.enable()
    board.open()
    time.sleep(1)
    answer = board.start(True).wait()
    if not answer.accepted:
        raise SystemExit(answer.reason)
    pipe.send('begin')
    begin, spent, incomplete = time.monotonic(), [], 0
    for k in range(round(seconds / PERIOD)):
        time.sleep(max(0.0, begin + k * PERIOD - time.monotonic()))
        start = time.monotonic()
        bus.write_goals(0.5 * np.sin(np.pi * k * PERIOD + np.arange(4)))
        board.send(np.full(4, robot.hover_thrust), time.time())
        incomplete += not bus.read().valid.all()
        bus.upkeep()
        board.poll()
        spent.append(time.monotonic() - start)
    pipe.send((spent, incomplete))
    board.close()
    bus.close()


def cpu_of(thread):
    """CPU time of a thread [s]."""
    return time.clock_gettime(time.pthread_getcpuclockid(thread.ident))


def simulate(actuators, plant_time, pipe):
    """Step until the drivers are done; return name -> CPU share, and their results."""
    due, began, before, result = time.monotonic(), None, None, None

    def times():
        return np.array([cpu_of(actuators.bus._thread), cpu_of(actuators.board._thread),
                         time.thread_time() - plant_time[0]])

    while result is None:
        if pipe.poll():
            message = pipe.recv()
            if began is None:
                began, before = time.monotonic(), times()
            else:
                result = message
        actuators.step()
        due += PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
    share = 100 * (times() - before) / (time.monotonic() - began)
    return dict(zip(('servo bus', 'motor board', 'coupling'), share, strict=True)), result


def main():
    """Measure and print a table."""
    arguments = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    arguments.add_argument('--seconds', type=float, default=10)
    seconds = arguments.parse_args().seconds
    robot = RobotParameters.load()
    simulator, plant_time = Simulator(robot), [0.0]
    step = simulator.step

    def timed(drive):
        start = time.thread_time()
        frame = step(drive)
        plant_time[0] += time.thread_time() - start
        return frame

    simulator.step = timed
    context = multiprocessing.get_context('spawn')
    here, there = context.Pipe()
    with EmulatedActuators(simulator, EmulatedServoBus(), EmulatedMotorBoard(robot)) as actuators:
        process = context.Process(target=drive, daemon=True, args=(
            there, actuators.bus.port, actuators.board.port, seconds))
        threading.Thread(target=process.start).start()
        shares, (spent, incomplete) = simulate(actuators, plant_time, here)
        process.join(5)
    table = Table('emulated actuators', 'measured', 'target')
    for name, share in shares.items():
        table.add_row(f'CPU {name} (%)', f'{share:.1f}', '')
    table.add_row('CPU together (%)', f'{sum(shares.values()):.1f}', f'{TARGET:g}')
    median, high = 1e3 * np.quantile(spent, [0.5, 0.99])
    table.add_row('drivers: a cycle, median / p99 (ms)', f'{median:.2f} / {high:.2f}', '')
    table.add_row('drivers: cycles without all angles', f'{incomplete} of {len(spent)}', '0')
    Console().print(table)


if __name__ == '__main__':
    main()
