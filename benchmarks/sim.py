"""Speed of the simulator on one core, and its integration error: ``python benchmarks/sim.py``."""

from dataclasses import replace
import time

import numpy as np

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.plant import Plant, XYZW
from beetle_omni_ros.sim.simulator import Simulator

SECONDS = 20.0          # simulated time of each case
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


def end_state(robot: RobotParameters, refinement: int) -> tuple[np.ndarray, np.ndarray]:
    """Position and quaternion after an open-loop flight with ``refinement`` times the substeps."""
    parameters = SimulatorParameters.load()
    plant = Plant(robot, replace(parameters, substeps=refinement * parameters.substeps))
    plant.reset((0.0, 0.0, 4 * HEIGHT))
    generator = np.random.default_rng(0)
    for k in range(int(FLIGHT / parameters.tick)):
        if k % COMMAND_TICKS == 0:
            noise = generator.normal(size=(2, 4))
            plant.set_targets(2 * SWING * np.sin(0.02 * k + np.arange(4)) + 0.05 * noise[0],
                              robot.hover_thrust * (1 + 0.1 * noise[1]))
        plant.step()
    qpos, _ = plant.state
    return qpos[:3], qpos[XYZW]


def main():
    """Print the real-time factor of each case, and the error of the integration step."""
    robot = RobotParameters.load()
    dragged = replace(robot, effects={'rotor_drag': {'coefficient': 0.4},
                                      'body_drag': {'coefficient': 0.1}})
    print(f"{'conditions':<12}{'where':<16}{'us/tick':>9}{'x real time':>13}")
    for conditions, where, plant in [
            ('nominal', 'air', robot), ('nominal', 'floor', robot), ('published', 'air', robot),
            ('nominal', 'air, with drag', dragged)]:
        simulator = Simulator(plant, conditions=conditions)
        cpu = min(fly(simulator, plant, SECONDS / 2, where != 'floor') for _ in range(2))
        print(f'{conditions:<12}{where:<16}{2e6 * cpu * simulator.tick / SECONDS:>9.1f}'
              f'{SECONDS / 2 / cpu:>13.0f}')
    (p, q), (p_fine, q_fine) = end_state(robot, 1), end_state(robot, 4)
    print(f'error of the integration step after {FLIGHT:g} s of open-loop tumbling: '
          f'{1e3 * np.linalg.norm(p - p_fine):.3f} mm, '
          f'{np.rad2deg(rotations.geodesic_angle(q, q_fine)):.4f} deg (against a quarter of it)')


if __name__ == '__main__':
    main()
