"""Motion that a model predicts from the commands of a flight, restarted periodically."""

from types import SimpleNamespace

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.body import Motion, motion
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.sim.simulator import Simulator

RESTART = 1.0           # [s] between two restarts from the flown state
HALF = 5e-7             # [s] half the resolution of rounded stamps


def free_runs(log: FlightLog, robot: RobotParameters, restart: float = RESTART) -> Motion:
    """
    Simulate the robot with the commands of a flight.

    Servos and rotors follow the commands from the first to the last one. The body starts from the
    flown state, and is reset to it after every ``restart``.

    Args:
        log: the flight.
        robot: the model.
        restart: time between two resets [s].

    Returns:
        the simulated motion at the ticks of the simulator, on the clock of the flight.

    Raises:
        ParameterError: the simulator lacks an effect of the robot.

    """
    simulator, flown = Simulator(robot), motion(log)
    if not len(log.command_t):
        return Motion(*(series[:0] for series in vars(flown).values()))
    start = log.command_t[0]
    # Unix times of today have a resolution of 0.2 us as float; ticks are compared exactly.
    stamps, flown_at = np.round(log.command_t - start, 6), np.round(flown.t - start, 6)
    first_target = round(log.targets[0].stamp - start, 6) if log.targets else 0.0
    due, row, states = 0.0, 0, []
    while simulator.time < stamps[-1]:
        while row < len(stamps) and stamps[row] <= simulator.time + HALF:
            simulator.command(SimpleNamespace(stamp=stamps[row], tilt=log.command_tilt[row],
                                              thrust=log.command_thrust[row]))
            row += 1
        if simulator.time >= due - 1e-6:
            # One reset coincides with the first target, at which films start.
            due = simulator.time + restart - (simulator.time - first_target) % restart
            k = min(np.searchsorted(flown_at, simulator.time - HALF), len(flown.t) - 1)
            simulator.set_body(flown.position[k], flown.quaternion[k], flown.velocity[k],
                               flown.angular_velocity[k])
        truth = simulator.truth
        states.append((start + simulator.time, truth.position, truth.quaternion, truth.velocity,
                       truth.angular_velocity))
        simulator.step()
    return Motion(*map(np.array, zip(*states, strict=True)))
