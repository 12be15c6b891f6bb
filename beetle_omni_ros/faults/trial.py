"""One flight of the campaign: take-off, start of the fault, flight with the fault, landing."""

from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from time import time

import numpy as np

from beetle_omni_ros.control import registry
from beetle_omni_ros.evaluation.compute import collector_off
from beetle_omni_ros.faults.flight import ALL_STARTS, Flight, OFF, Watcher
from beetle_omni_ros.faults.watch import as_expected
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.runs.bag import read_bag
from beetle_omni_ros.runs.bag_writer import BagWriter
from beetle_omni_ros.sim.fault_lists import FaultList, FlightPlan

IN_FLIGHT = ('flying', 'fallback')


@dataclass(frozen=True)
class Trial:
    """
    Parameters of a flight.

    Attributes:
        case: name of the fault in the list.
        start: one of ALL_STARTS.
        seed: seed of poses, time of the fault and simulation.
        conditions: 'nominal' or 'published'.
        controller: the active controller.
        plant: robot file of the simulated robot; None: the shipped one.

    """

    case: str
    start: str = 'hover'
    seed: int = 0
    conditions: str = 'nominal'
    controller: str = registry.DEFAULT
    plant: str | None = None

    def __str__(self) -> str:
        """Name of its bag."""
        controller = registry.find(self.controller).name
        plant = f'_{Path(self.plant).stem}' if self.plant else ''
        return f'{self.case}_{self.start}_{self.conditions}_{controller}_{self.seed}{plant}'


def fly_trial(trial: Trial, listed: FaultList, bags: Path | None = None) -> dict:
    """
    Fly one trial.

    Args:
        trial: the trial.
        listed: list with its case, limits and plan.
        bags: folder for its bag; None: no bag is recorded.

    Returns:
        the trial's fields, expected, outcome, good, impact_m_s, inclination_deg, overrun_s,
        flyaway, takeoffs, named and named_s, said and said_s, state, farthest_m, flown_s,
        bag_lost (None without a bag) and error ('' without an exception).

    """
    case = listed.cases[trial.case]
    result = {**asdict(trial), 'expected': case.expected, 'bag_lost': None, 'error': ''}
    folder = bags / str(trial) if bags else None
    try:
        with collector_off(), ExitStack() as stack:
            recorder = None
            if folder:
                recorder = stack.enter_context(BagWriter(
                    folder, epoch=int(time()),
                    meta={**asdict(trial), 'faults': [str(one) for one in case.strike]}))
            result.update(_fly(trial, listed, recorder))
    except Exception as error:          # the campaign continues and reports the error
        result.update(outcome='error', error=f'{type(error).__name__}: {error}'[:200])
    if folder:
        result['bag_lost'] = _is_lost(folder)
    result['good'] = as_expected(case.expected, result['outcome']) and not result['bag_lost']
    return result


def _fly(trial, listed, recorder):
    plan = listed.flight
    flight = Flight(controller=trial.controller, conditions=trial.conditions, seed=trial.seed,
                    plant=trial.plant, strike=listed.cases[trial.case].strike,
                    recorder=recorder)
    loop, supervisor = flight.loop, flight.supervisor
    loop.take_off()
    fly_to_start(flight, trial.start, plan)
    watcher = flight.watch(listed)
    start = flight.simulator.time
    loop.start_faults()
    over = _fly_on(flight, trial.start, plan, watcher)
    asked = supervisor.state in IN_FLIGHT
    if not over:
        supervisor.land(loop.now)
        flight.fly(plan.landing_time, watcher)
    return {**observed(flight, watcher, asked=asked), 'flown_s': flight.simulator.time - start}


def fly_to_start(flight: Flight, start: str, plan: FlightPlan):
    """Fly to the state in which the fault starts."""
    part = flight.random.uniform()
    later = plan.jitter * part
    if start in ('moving', 'random'):
        random = start == 'random'
        flight.aim_randomly(plan)
        flight.fly(plan.pose_time if random else plan.move_time)
        flight.aim_randomly(plan)
        flight.fly(part * plan.pose_time if random else later)
        return
    upside_down = start == 'upside_down'
    flight.aim((0.0, 0.0, plan.height), rotations.from_rpy(np.pi if upside_down else 0.0, 0, 0))
    flight.fly((plan.turn_time if upside_down else plan.hover_time) + later)


def _fly_on(flight: Flight, start: str, plan: FlightPlan, watcher: Watcher) -> bool:
    """Fly on with the fault; returns whether the flight ended."""
    left = plan.watch_time
    while left > 0:
        time = min(left, plan.move_time) if start in ('moving', 'random') else left
        if flight.fly(time, watcher):
            return True
        left -= time
        if left > 0:
            flight.aim_randomly(plan)
    return False


def observed(flight: Flight, watcher: Watcher, *, asked: bool) -> dict:
    """Observations of a flight, see :func:`fly_trial`."""
    seen, supervisor = watcher.seen, flight.supervisor
    worst = seen.worst
    inclined = max((impact.inclination for impact in seen.impacts), default=None)
    return {
        'outcome': seen.outcome(asked=asked, stopped=supervisor.state in OFF,
                                refused=bool(flight.loop.refusals)),
        'impact_m_s': worst.speed if worst else None,
        'inclination_deg': None if inclined is None else float(np.degrees(inclined)),
        'broken': flight.simulator.truth.broken, 'overrun_s': seen.overrun,
        'flyaway': seen.flyaway, 'takeoffs': seen.takeoffs, 'named': watcher.named,
        'named_s': watcher.named_after, 'said': watcher.said, 'said_s': watcher.said_after,
        'state': supervisor.state, 'farthest_m': seen.farthest}


def _is_lost(folder):
    """Whether a bag is unreadable or does not contain the flight."""
    try:
        return not len(read_bag(folder).truth_t)
    except Exception:       # any error means an unusable bag
        return True


__all__ = ['ALL_STARTS', 'fly_trial', 'observed', 'Trial']
