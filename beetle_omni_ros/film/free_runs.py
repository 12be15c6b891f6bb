"""What a model expects of a flight: simulated from its commands, put right again and again."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.body import Motion, motion
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.sim.simulator import Simulator

RESTART = 1.0           # [s] between two starts from the flown state
HALF = 5e-7             # [s] of what stamps are rounded to


def free_runs(log: FlightLog, robot: RobotParameters, restart: float = RESTART) -> Motion:
    """
    Simulate the robot under the commands of a flight.

    Servos and rotors follow the commands from the first to the last one. The body starts from
    the flown state, and again from it after every ``restart``; in between it moves freely.

    Args:
        log: the flight.
        robot: the model.
        restart: [s].

    Returns:
        The simulated motion at the ticks of the simulator, on the clock of the flight.

    Raises:
        ParameterError: an effect of the robot that the simulator lacks.

    """
    simulator, flown = Simulator(robot), motion(log)
    if not len(log.command_t):
        return Motion(*(series[:0] for series in vars(flown).values()))
    start = log.command_t[0]
    # Dates of today are known to 0.2 us; ticks are compared exactly.
    stamps, flown_at = np.round(log.command_t - start, 6), np.round(flown.t - start, 6)
    first_target = round(log.targets[0].stamp - start, 6) if log.targets else 0.0
    due, row, states = 0.0, 0, []
    while simulator.time < stamps[-1]:
        while row < len(stamps) and stamps[row] <= simulator.time + HALF:
            simulator.command(SimpleNamespace(stamp=stamps[row], tilt=log.command_tilt[row],
                                              thrust=log.command_thrust[row]))
            row += 1
        if simulator.time >= due - 1e-6:
            # Restarts fall on the first target, so that no film begins within a run.
            due = simulator.time + restart - (simulator.time - first_target) % restart
            k = min(np.searchsorted(flown_at, simulator.time - HALF), len(flown.t) - 1)
            simulator.set_body(flown.position[k], flown.quaternion[k], flown.velocity[k],
                               flown.angular_velocity[k])
        truth = simulator.truth
        states.append((start + simulator.time, truth.position, truth.quaternion, truth.velocity,
                       truth.angular_velocity))
        simulator.step()
    return Motion(*map(np.array, zip(*states, strict=True)))
