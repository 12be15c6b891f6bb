"""Landings from random attitudes, and healthy flights with their alarms."""

from dataclasses import asdict, dataclass

import numpy as np

from beetle_omni_ros.control import registry
from beetle_omni_ros.evaluation.compute import collector_off
from beetle_omni_ros.faults.flight import Flight
from beetle_omni_ros.faults.trial import observed
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.safety.events import INFO
from beetle_omni_ros.sim.fault_lists import FaultList
from beetle_omni_ros.sim.faults import Fault

CONDITIONS = ('nominal', 'published', 'effects')
FRESH = 0.5     # [-] charge below which the pack is replaced before the next pose


@dataclass(frozen=True)
class LandingTrial:
    """
    Parameters of a landing.

    Attributes:
        seed: seed of attitude and simulation; every fourth landing starts upside down.
        conditions: 'nominal' or 'published'.
        controller: the active controller.
        without_mocap: whether motion capture is lost at the start of the landing.
        plant: robot file of the simulated robot; None: the shipped one.

    """

    seed: int
    conditions: str = 'nominal'
    controller: str = registry.DEFAULT
    without_mocap: bool = False
    plant: str | None = None


def fly_landing(trial: LandingTrial, listed: FaultList) -> dict:
    """
    Fly to an attitude and land.

    Returns:
        the trial's fields, roll, pitch and yaw of the attitude [deg], good, and the fields of
        :func:`~beetle_omni_ros.faults.trial.observed`.

    """
    plan, limits = listed.flight, listed.limits
    rpy = attitude(trial.seed)
    result = {**asdict(trial), 'attitude_deg': np.degrees(rpy).tolist(), 'error': ''}
    try:
        with collector_off():
            result.update(_fly(trial, listed, plan, rpy))
    except Exception as error:          # the campaign continues and reports the error
        result.update(outcome='error', error=f'{type(error).__name__}: {error}'[:200])
    speed, inclined = (result.get(key) for key in ('impact_m_s', 'inclination_deg'))
    result['good'] = result['outcome'] == 'flies_on' and bool(
        speed <= limits.landing_speed and np.radians(inclined) <= limits.landing_inclination)
    return result


def attitude(seed: int) -> np.ndarray:
    """Roll, pitch, yaw [rad] at the start of a landing; every fourth is upside down."""
    rpy = np.random.default_rng([seed, 1]).uniform(-np.pi, np.pi, 3)
    if seed % 4 == 3:
        rpy[:2] = np.pi, 0.0
    return rpy


def _fly(trial, listed, plan, rpy):
    strike = (Fault('mocap_lost'),) if trial.without_mocap else ()
    flight = Flight(controller=trial.controller, conditions=trial.conditions, seed=trial.seed,
                    plant=trial.plant, strike=strike)
    flight.loop.take_off()
    flight.aim((0.0, 0.0, plan.height), rotations.from_rpy(*rpy))
    flight.fly(plan.turn_time)
    watcher = flight.watch(listed)
    asked = flight.supervisor.state in ('flying', 'fallback')
    flight.loop.start_faults()
    flight.supervisor.land(flight.loop.now)
    flight.fly(plan.landing_time, watcher)
    return observed(flight, watcher, asked=asked)


@dataclass(frozen=True)
class HealthyTrial:
    """
    Parameters of a healthy flight.

    Attributes:
        seed: seed of poses and simulation.
        conditions: one of CONDITIONS; 'effects' is nominal with the list's effects in the plant.
        controller: the active controller.
        plant: robot file of the simulated robot; None: the shipped one.

    """

    seed: int
    conditions: str = 'nominal'
    controller: str = registry.DEFAULT
    plant: str | None = None


def fly_healthy(trial: HealthyTrial, listed: FaultList) -> dict:
    """
    Fly random poses and land.

    Returns:
        the trial's fields, flown_s, alarms (list of stamp, severity and text of every event above
        information and of every named fault), state and error.

    """
    result = {**asdict(trial), 'flown_s': 0.0, 'alarms': [], 'state': '', 'error': ''}
    try:
        with collector_off():
            _fly_on(trial, listed, result)
    except Exception as error:          # the campaign continues and reports the error
        result['error'] = f'{type(error).__name__}: {error}'[:200]
    return result


def _fly_on(trial, listed, result):
    effects = trial.conditions == 'effects'
    flight = Flight(controller=trial.controller, seed=trial.seed, plant=trial.plant,
                    effects=listed.healthy.effects if effects else None,
                    conditions='nominal' if effects else trial.conditions)
    plan = listed.healthy
    flight.loop.take_off()
    start = flight.simulator.time
    while flight.simulator.time - start < plan.flight_time \
            and flight.supervisor.state in ('flying', 'fallback'):
        if flight.simulator.battery.charge < FRESH:
            flight.simulator.battery.reset()
        flight.aim_randomly(listed.flight)
        flight.fly(plan.pose_time)
    flight.supervisor.land(flight.loop.now)
    flight.fly(listed.flight.landing_time, lambda: flight.supervisor.state == 'disarmed')
    supervisor = flight.supervisor
    result.update(
        flown_s=flight.simulator.time - start, state=supervisor.state,
        alarms=[[event.stamp, event.severity, event.text] for event in supervisor.events
                if event.severity != INFO]
        + [[stamp, 'fault', name] for name, stamp in supervisor.faults.items()])
