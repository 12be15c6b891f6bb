"""
Flights of the campaign: with a fault of the list, a landing from a random attitude, or healthy.

A flight is judged from the true motion and the commanded thrust alone.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import time
from zlib import crc32

import numpy as np

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.evaluation.campaign import flight_key
from beetle_omni_ros.evaluation.loop import collector_off, FlightLoop
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.bag import read_bag
from beetle_omni_ros.runs.bag_writer import BagWriter
from beetle_omni_ros.runs.log import Recorder, Tee
from beetle_omni_ros.safety.events import INFO
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.sim.fault_lists import FaultList, FlightPlan
from beetle_omni_ros.sim.faults import Fault
from beetle_omni_ros.sim.readings import Impact, Truth

STARTS = ('hover', 'moving', 'upside_down')      # default
ALL_STARTS = (*STARTS, 'random')
LANDING, LANDING_BLIND, HEALTHY = 'landing', 'landing_without_mocap', 'healthy'
CONDITIONS = ('nominal', 'published', 'effects')    # of healthy flights
FRESH = 0.5     # [-] charge below which the pack is replaced before the next pose
OFF = ('disarmed', 'emergency_stop')
IN_FLIGHT = ('flying', 'fallback')
# Expected outcome -> outcomes that are equal or better.
BETTER = {'flies_on': ('flies_on', 'refused'), 'lands': ('flies_on', 'refused', 'lands'),
          'stops': ('flies_on', 'refused', 'lands', 'stops'), 'refused': ('refused',)}


@dataclass(frozen=True)
class Trial:
    """
    Parameters of a flight.

    Attributes:
        case: name of the fault in the list, LANDING, LANDING_BLIND or HEALTHY.
        start: one of ALL_STARTS, for a fault.
        seed: seed of the simulation and, together with ``case``, of poses and time of the fault.
        conditions: one of CONDITIONS; 'effects' is nominal with the list's effects in the plant.
        controller: the active controller.
        plant: robot file of the simulated robot; '' for the shipped one.
        listed: digest of an own list of faults, '' for the shipped one.

    """

    case: str
    start: str = 'hover'
    seed: int = 0
    conditions: str = 'nominal'
    controller: str = registry.DEFAULT
    plant: str = ''
    listed: str = ''
    cost = 1.0

    @property
    def name(self) -> str:
        """Name of its file and of its bag."""
        return '_'.join(filter(None, (
            self.case, self.start, self.conditions, registry.find(self.controller).name,
            str(self.seed), Path(self.plant).stem)))

    @property
    def key(self) -> str:
        """Digest of everything that determines its result."""
        return flight_key(fly_trial, self.controller, self.case, self.start, str(self.seed),
                          self.conditions, self.listed, plant=self.plant)


def fly_trial(trial: Trial, listed: FaultList, bags: Path | None = None) -> dict:
    """
    Fly one trial.

    Args:
        trial: the trial.
        listed: list with its case, limits and plan.
        bags: folder for its bag; None: no bag is recorded.

    Returns:
        the trial's fields, flown_s, state, good, bag_lost (None without a bag), error ('' without
        an exception), and the fields of :meth:`Watcher.observed` or, of a healthy flight, alarms
        (stamp, severity and text of every event above information and of every named fault).

    """
    result = {**asdict(trial), 'good': False, 'bag_lost': None, 'error': '', 'flown_s': 0.0}
    folder = bags / trial.name if bags else None
    try:
        with collector_off(), ExitStack() as stack:
            recorder = Tee()
            if folder:
                recorder = stack.enter_context(BagWriter(folder, asdict(trial), epoch=int(time())))
            result.update(_FLOWN.get(trial.case, _fly_fault)(trial, listed, recorder))
    except Exception as error:          # the campaign continues and reports the error
        text = f'{type(error).__name__}: {error}'[:200]
        result.update(outcome='error', error=text, failure=text, good=False)
    if folder:
        result['bag_lost'] = _is_lost(folder)
        result['good'] = result['good'] and not result['bag_lost']
    return result


def _is_lost(folder):
    """Whether a bag is unreadable or does not contain the flight."""
    try:
        return not len(read_bag(folder).truth_t)
    except Exception:       # any error means an unusable bag
        return True


def _fly_fault(trial, listed, recorder):
    """Take off, start of the fault, flight with the fault, landing."""
    plan, case = listed.flight, listed.cases[trial.case]
    flight = Flight(controller=trial.controller, conditions=trial.conditions, seed=trial.seed,
                    plant=trial.plant, strike=case.strike, recorder=recorder, moves=trial.case)
    flight.loop.take_off()
    fly_to_start(flight, trial.start, plan)
    watcher = Watcher(flight, listed)
    start = flight.simulator.time
    flight.loop.start_faults()
    left, over, moving = plan.watch_time, False, trial.start in ('moving', 'random')
    while left > 0 and not over:
        period = min(left, plan.move_time) if moving else left
        over = flight.fly(period, watcher)
        left -= period
        if left > 0 and not over:
            flight.aim_randomly(plan)
    asked = flight.supervisor.state in IN_FLIGHT
    if not over:
        flight.land(plan.landing_time, watcher)
    seen = watcher.observed(asked=asked)
    return {**seen, 'expected': case.expected, 'flown_s': flight.simulator.time - start,
            'good': seen['outcome'] in BETTER[case.expected]}


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


def _fly_landing(trial, listed, recorder):
    """Fly to an attitude and land."""
    plan, limits, rpy = listed.flight, listed.limits, attitude(trial.seed)
    flight = Flight(controller=trial.controller, conditions=trial.conditions, seed=trial.seed,
                    plant=trial.plant, recorder=recorder,
                    strike=(Fault('mocap_lost'),) if trial.case == LANDING_BLIND else ())
    flight.loop.take_off()
    flight.aim((0.0, 0.0, plan.height), rotations.from_rpy(*rpy))
    flight.fly(plan.turn_time)
    watcher = Watcher(flight, listed)
    asked = flight.supervisor.state in IN_FLIGHT
    flight.loop.start_faults()
    flight.land(plan.landing_time, watcher)
    seen = watcher.observed(asked=asked)
    return {**seen, 'attitude_deg': np.degrees(rpy).tolist(), 'expected': 'flies_on',
            'good': seen['outcome'] == 'flies_on' and bool(
                seen['impact_m_s'] <= limits.landing_speed
                and np.radians(seen['inclination_deg']) <= limits.landing_inclination)}


def attitude(seed: int) -> np.ndarray:
    """Roll, pitch, yaw [rad] at the start of a landing; every fourth is upside down."""
    rpy = np.random.default_rng([seed, 1]).uniform(-np.pi, np.pi, 3)
    if seed % 4 == 3:
        rpy[:2] = np.pi, 0.0
    return rpy


def _fly_healthy(trial, listed, recorder):
    """Fly random poses and land."""
    effects, plan = trial.conditions == 'effects', listed.healthy
    flight = Flight(controller=trial.controller, seed=trial.seed, plant=trial.plant,
                    recorder=recorder, effects=plan.effects if effects else None,
                    conditions='nominal' if effects else trial.conditions)
    simulator, supervisor = flight.simulator, flight.supervisor
    flight.loop.take_off()
    start = simulator.time
    while simulator.time - start < plan.flight_time and supervisor.state in IN_FLIGHT:
        if simulator.battery.charge < FRESH:
            simulator.battery.reset()
        flight.aim_randomly(listed.flight)
        flight.fly(plan.pose_time)
    flight.land(listed.flight.landing_time, lambda: supervisor.state == 'disarmed')
    alarms = [[event.stamp, event.severity, event.text] for event in supervisor.events
              if event.severity != INFO]
    alarms += [[stamp, 'fault', name] for name, stamp in supervisor.faults.items()]
    landed = supervisor.state == 'disarmed'
    return {'flown_s': simulator.time - start, 'state': supervisor.state, 'alarms': alarms,
            'outcome': 'flies_on' if landed else 'does not land', 'good': landed and not alarms}


_FLOWN = {LANDING: _fly_landing, LANDING_BLIND: _fly_landing, HEALTHY: _fly_healthy}


class Flight:
    """
    One robot with its flight stack.

    Attributes:
        simulator, supervisor, loop: parts of the stack.
        random: random numbers of the plan of the flight.

    """

    def __init__(self, *, controller: str, conditions: str, seed: int, plant: str = '',
                 effects: dict | None = None, strike: tuple[Fault, ...] = (),
                 recorder: Recorder | None = None, moves: str = ''):
        """
        Build robot and flight stack.

        Args:
            controller: the active controller.
            conditions: 'nominal' or 'published'.
            seed: seed of the plan and the simulation.
            plant: robot file of the simulated robot; '' for that of the flight stack.
            effects: further effects of the simulated robot.
            strike: faults, started by ``loop.start_faults``.
            recorder: recorder of the loop; by default nothing is recorded.
            moves: text that, beside the seed, decides the random numbers of the plan.

        """
        nominal = RobotParameters.load()
        aboard = {entry.name: entry.make(nominal) for entry in map(
            registry.find, dict.fromkeys([controller, registry.pilot()]))}
        true = RobotParameters.load(plant) if plant else nominal
        self.loop = FlightLoop(
            nominal, replace(true, effects=true.effects | (effects or {})), aboard,
            recorder or Tee(), conditions=conditions, seed=seed, faults=strike)
        self.simulator, self.supervisor = self.loop.simulator, self.loop.supervisor
        self.random = drawn(seed, moves)

    def aim(self, position, quaternion=(0.0, 0.0, 0.0, 1.0)) -> None:
        """Set the target pose: (3,) in world [m], (4,) xyzw."""
        self.loop.aim(PoseTarget(np.array(position, dtype=float), np.array(quaternion),
                                 self.loop.now))

    def aim_randomly(self, plan: FlightPlan) -> None:
        """Set a random target pose of any attitude."""
        x, y, z = self.random.uniform([-plan.spread, -plan.spread, plan.lowest],
                                      [plan.spread, plan.spread, plan.highest])
        self.aim((x, y, z), rotations.from_rpy(*self.random.uniform(-np.pi, np.pi, 3)))

    def fly(self, duration: float, over: Callable[[], bool] = lambda: False) -> bool:
        """Fly for ``duration`` [s] or until ``over`` is true; returns whether it became true."""
        end = self.simulator.time + duration
        while self.simulator.time < end:
            self.loop.step()
            if over():
                return True
        return False

    def land(self, duration: float, over: Callable[[], bool]) -> None:
        """Request a landing and fly on."""
        self.supervisor.land(self.loop.now)
        self.fly(duration, over)


def drawn(seed: int, moves: str) -> np.random.Generator:
    """Random numbers of a plan: other ones for each fault, so that a seed is not one move."""
    return np.random.default_rng([seed, crc32(moves.encode())] if moves else seed)


class Watcher:
    """
    Follows a flight from the onset of its fault; a call returns whether the flight is over.

    Attributes:
        impacts: touchdowns.
        crash: time at which the robot broke [s], or None.
        overrun: longest time after the crash with motors still commanded [s].
        flyaway: whether it left the fence, or its place by too much.
        takeoffs: number of take-offs after it had lain on the floor.
        farthest: largest distance from the start [m].
        said: first warning of the supervisor and its time [s].
        named: name of the first fault that the supervisor named, and its time [s].

    """

    def __init__(self, flight: Flight, listed: FaultList):
        """Start now."""
        own = SupervisorParameters.load()
        self._flight, self._limits, self._end_time = flight, listed.limits, listed.flight.end_time
        self._fence = np.array([own.fence_half_width, own.fence_half_width, own.fence_height])
        self._place, self._start = flight.simulator.truth.position.copy(), flight.simulator.time
        self._past_events = len(flight.supervisor.events)
        self._past_faults = set(flight.supervisor.faults)
        self._still = self._down = 0.0
        self._floor: float | None = None
        self.impacts: list[Impact] = []
        self.crash: float | None = None
        self.overrun, self.farthest, self.flyaway, self.takeoffs = 0.0, 0.0, False, 0
        self.said: tuple[str, float | None] = ('', None)
        self.named: tuple[str, float | None] = ('', None)

    def __call__(self) -> bool:
        """Observe the last tick; returns whether the flight is over."""
        simulator, supervisor = self._flight.simulator, self._flight.supervisor
        truth, tick = simulator.truth, simulator.tick
        self.step(truth, float(simulator.thrust_command.sum()), tick)
        after = simulator.time - self._start
        if not self.said[0]:
            self.said = next(((event.text, after) for event in
                              supervisor.events[self._past_events:] if event.severity != INFO),
                             self.said)
        if not self.named[0]:
            self.named = next(((name, after) for name in supervisor.faults
                               if name not in self._past_faults), self.named)
        ended = supervisor.state in OFF or truth.broken
        self._still = self._still + tick if ended else 0.0
        return self.flyaway or self._still >= self._end_time

    def step(self, truth: Truth, thrust: float, tick: float) -> None:
        """Process a tick [s]: true state, commanded thrust of all rotors together [N]."""
        limits, place = self._limits, truth.position
        if truth.impact is not None and truth.impact not in self.impacts[-1:]:
            self.impacts.append(truth.impact)
        if truth.broken and self.crash is None:
            self.crash = truth.stamp
        if self.crash is not None and thrust > limits.idle_thrust:
            self.overrun = max(self.overrun, truth.stamp - self.crash)
        self.farthest = max(self.farthest, float(np.linalg.norm(place - self._place)))
        outside = max(abs(place[0]) - self._fence[0], abs(place[1]) - self._fence[1],
                      place[2] - self._fence[2])
        self.flyaway = self.flyaway or bool(outside > limits.fence_margin) \
            or self.farthest > limits.distance
        self._down = self._down + tick if truth.contact else 0.0
        if self._down >= limits.rest_time:
            self._floor = float(place[2])
        if self._floor is not None and place[2] > self._floor + limits.rise:
            self.takeoffs, self._floor = self.takeoffs + 1, None

    def observed(self, *, asked: bool) -> dict:
        """Observations; ``asked``: whether the robot flew when the landing was commanded."""
        worst = max((impact.speed for impact in self.impacts), default=None)
        inclined = max((impact.inclination for impact in self.impacts), default=None)
        state = self._flight.supervisor.state
        return {
            'outcome': self.outcome(asked=asked, stopped=state in OFF,
                                    refused=bool(self._flight.loop.refusals)),
            'impact_m_s': worst,
            'inclination_deg': None if inclined is None else float(np.degrees(inclined)),
            'broken': self.crash is not None, 'overrun_s': self.overrun,
            'flyaway': self.flyaway, 'takeoffs': self.takeoffs, 'named': self.named[0],
            'named_s': self.named[1], 'said': self.said[0], 'said_s': self.said[1],
            'state': state, 'farthest_m': self.farthest}

    def outcome(self, *, asked: bool, stopped: bool, refused: bool) -> str:
        """
        Outcome of the flight as one word.

        Args:
            asked: whether the robot still flew when the landing was commanded.
            stopped: whether the motors were off at the end.
            refused: whether a target was refused, as expected.

        Returns:
            'flies_on', 'refused', 'lands' or 'stops'; or an outcome that is never expected:
            'flyaway', 'takes off', 'crash, motors on', 'hard', 'tilted' or 'does not land'.

        """
        if self.flyaway:
            return 'flyaway'
        if self.takeoffs:
            return 'takes off'
        if self.crash is not None:
            late = self.overrun > self._limits.stop_time
            return 'crash, motors on' if late or not stopped else 'stops'
        if not stopped or not self.impacts:
            return 'does not land'
        if max(impact.speed for impact in self.impacts) > self._limits.impact_speed:
            return 'hard'
        if max(impact.inclination for impact in self.impacts) > self._limits.inclination:
            return 'tilted'
        if not asked:
            return 'lands'
        return 'refused' if refused else 'flies_on'
