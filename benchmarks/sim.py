"""Speed of the simulator on one core: ``python benchmarks/sim.py [--seconds N]``."""

import argparse
import time

import numpy as np

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.simulator import Simulator

FLIGHT = 2.0            # [s] of open-loop flight before a reset, so that it stays in the air
HEIGHT = 5.0            # [m]
SWING = 0.3             # [rad] of the commanded tilts
COMMAND_TICKS = 2       # commands at 100 Hz


def fly(simulator: Simulator, robot: RobotParameters, seconds: float, airborne: bool) -> float:
    """CPU time [s] of ``seconds`` of simulated time with all sensors and 100 Hz commands."""
    thrust = np.full(4, robot.hover_thrust if airborne else 0.0)
    ticks, per_flight = int(seconds / simulator.tick), int(FLIGHT / simulator.tick)
    began = time.process_time()
    for k in range(ticks):
        if k % per_flight == 0:
            simulator.reset((0.0, 0.0, HEIGHT) if airborne else None)
        if k % COMMAND_TICKS == 0:
            phase = 6.28 * simulator.time + np.arange(4)
            simulator.command(Command(simulator.time, SWING * np.sin(phase), thrust))
        simulator.step()
    return time.process_time() - began


def main():
    """Print the real-time factor in the air and on the floor, for each kind of conditions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=20.0, help='simulated time of each case')
    seconds = parser.parse_args().seconds
    robot = RobotParameters.load()
    print(f"{'conditions':<12}{'where':<8}{'us/tick':>9}{'x real time':>13}")
    for conditions in ('nominal', 'published'):
        simulator = Simulator(robot, conditions=conditions)
        for where in ('air', 'floor'):
            cpu = min(fly(simulator, robot, seconds / 2, where == 'air') for _ in range(2))
            print(f'{conditions:<12}{where:<8}{1e6 * cpu * 2 * simulator.tick / seconds:>9.1f}'
                  f'{seconds / 2 / cpu:>13.0f}')


if __name__ == '__main__':
    main()
