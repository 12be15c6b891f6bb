"""
Whether a computer is fast enough for real time, decided before any process starts.

Plant and estimator run in this process for a simulated second. The nodes do the same work and
move its messages, mostly in Python, too. So their CPU time is a multiple of it on any computer.
"""

from collections.abc import Sequence
import time

import numpy as np

from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.nodes.plan import BRIDGES
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.simulator import Simulator

MAX_LOAD = 0.9          # part of a core that the composed nodes may need
PROBED = 1.0            # s of simulated time
PER_NODE = 1.8          # CPU of a node relative to plant and estimator: seven nodes needed 12.8
                        # times as much, six 11.9 times, on two busy cores of a Xeon


def load(nodes: Sequence[str]) -> float:
    """
    Predict the CPU of composed nodes without bridges, as a part of a core.

    The median of CPU times ignores other programs.
    """
    robot = RobotParameters.load()
    simulator = Simulator(robot, SimulatorParameters.load())
    estimator = ErrorStateEkf(EkfParameters.load().of_robot(robot), robot.gravity)
    used = []
    for _ in range(round(PROBED / simulator.tick)):
        begin = time.thread_time()
        frame = simulator.step()
        if frame.mocap is not None:
            estimator.pose(frame.mocap)
        if frame.imu is not None:
            estimator.imu(frame.imu)
        used.append(time.thread_time() - begin)
    return PER_NODE * len(set(nodes) - set(BRIDGES)) * float(np.median(used)) / simulator.tick
