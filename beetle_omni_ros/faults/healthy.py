"""Healthy flights, and everything that is said of them as if they were not."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

from beetle_omni_ros.control import registry
from beetle_omni_ros.evaluation.compute import collector_off
from beetle_omni_ros.faults.flight import Flight, told_faults
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.events import INFO
from beetle_omni_ros.sim.faults.listed import FaultList

CONDITIONS = ('nominal', 'published', 'effects')
FRESH = 0.5     # [-] of a charge: a pack below it is swapped before the next pose


@dataclass(frozen=True)
class HealthyTrial:
    """
    Which flight.

    Attributes:
        seed: of poses and simulation.
        conditions: one of CONDITIONS; 'effects' is nominal with the list's effects in the plant.
        controller: the active one.

    """

    seed: int
    conditions: str = 'nominal'
    controller: str = registry.DEFAULT


def fly_healthy(trial: HealthyTrial, listed: FaultList) -> dict:
    """
    Fly random poses and land.

    Returns:
        the trial's fields, flown_s, alarms (a list of stamp, severity and text of every event
        beyond information, and of named faults), state and error.

    """
    result = {**asdict(trial), 'flown_s': 0.0, 'alarms': [], 'state': '', 'error': ''}
    try:
        with collector_off():
            _fly(trial, listed, result)
    except Exception as error:          # a campaign goes on, and tells what was raised
        result['error'] = f'{type(error).__name__}: {error}'[:200]
    return result


def _fly(trial, listed, result):
    effects = trial.conditions == 'effects'
    robot = replace(RobotParameters.load(), effects=listed.healthy.effects) if effects else None
    flight = Flight(controller=trial.controller, seed=trial.seed, true_robot=robot,
                    conditions='nominal' if effects else trial.conditions)
    plan = listed.healthy
    flight.loop.take_off()
    start = flight.simulator.time
    while flight.simulator.time - start < plan.flight_time \
            and flight.supervisor.state in ('flying', 'fallback'):
        if flight.simulator.charge < FRESH:
            flight.simulator.swap_battery()
        flight.aim_anywhere(listed.flight)
        flight.fly(plan.pose_time)
    flight.supervisor.land(flight.loop.now)
    flight.fly(listed.flight.landing_time, lambda: flight.supervisor.state == 'disarmed')
    supervisor = flight.supervisor
    result.update(
        flown_s=flight.simulator.time - start, state=supervisor.state,
        alarms=[[event.stamp, event.severity, event.text] for event in supervisor.events
                if event.severity != INFO]
        + [[stamp, 'fault', name] for name, stamp in told_faults(supervisor).items()])
