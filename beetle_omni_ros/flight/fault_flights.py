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

from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.bags.log import Recorder
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.control.tasks import random_poses
from beetle_omni_ros.flight.campaign import flight_key
from beetle_omni_ros.flight.loop import collector_off, FlightLoop
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.mode import DISARMED, FALLBACK, FLYING, MOTORS_OFF
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.faults import Case, Fault
from beetle_omni_ros.sim.sensors import Impact, Truth
from beetle_omni_ros.supervisor.events import INFO
from beetle_omni_ros.supervisor.parameters import SupervisorParameters

STARTS = ('hover', 'moving', 'upside_down')      # default
ALL_STARTS = (*STARTS, 'random')
# Landings from a random attitude and healthy flights, which are no faults of a list.
LANDING = Case('landing', (), what='landing from a random attitude')
LANDING_BLIND = Case('landing_without_mocap', (Fault('mocap_lost'),),
                     what='landing from a random attitude, motion capture is lost')
HEALTHY = Case('healthy', (), what='poses without a fault')
CONDITIONS = ('nominal', 'published', 'effects')    # of healthy flights
EFFECTS = {     # of the plant of healthy flights; sizes of docs/gap.md
    'thrust_coefficient': {'scale': 0.95},
    'rotor_thrust_coefficient': {'scale': [0.96, 1.0, 1.04, 1.0]},      # half the size
    'rotor_drag': {'coefficient': 0.4}, 'body_drag': {'coefficient': 0.05},
    'tilt_thrust_loss': {'loss_at_60deg': 0.06}, 'axial_inflow': {'per_rotor': 0.4},
    'wind': {'force': [1.0, 0.0, 0.0]}, 'ground_effect': {'gain_at_0.25m': 0.08},
    'command_latency': {'delay': 0.01}}                                 # half the size
FRESH = 0.5     # [-] charge below which the pack is replaced before the next pose
AIRBORNE = (FLYING, FALLBACK)     # states without a landing
# Expected outcome -> outcomes that are equal or better.
BETTER = {'flies_on': ('flies_on', 'refused'), 'lands': ('flies_on', 'refused', 'lands'),
          'stops': ('flies_on', 'refused', 'lands', 'stops'), 'refused': ('refused',)}


@dataclass(frozen=True)
class Plan:
    """Flights of the campaign, and limits of their outcomes."""

    height: float = 1.5             # [m] of hover and inverted hover
    hover_time: float = 3.0         # [s] until the fault in hover
    turn_time: float = 6.0          # [s] until the fault upside down; half a turn takes 4 s
    move_time: float = 4.0          # [s] of a pose on the move; the fault occurs in the second
    pose_time: float = 8.0          # [s] of a pose at a random moment, and in healthy flights
    jitter: float = 1.0             # [s] range of the random delay of the fault
    watch_time: float = 8.0         # [s] from the fault to the landing request
    landing_time: float = 30.0      # [s] largest duration of a landing
    end_time: float = 1.5           # [s] of flight after the motors stopped or the robot broke
    healthy_time: float = 120.0     # [s] of a healthy flight before it lands
    impact_speed: float = 1.0       # [m/s] largest impact of a landing; above it the robot breaks
    inclination: float = 0.5235988  # [rad] 30 deg at touchdown: harmless for the feet; chosen
    stop_time: float = 0.3          # [s] from a crash until the motors are off
    fence_margin: float = 5.0       # [m] outside the fence: a flyaway
    distance: float = 30.0          # [m] from the start: also a flyaway
    rise: float = 0.5               # [m] above the floor after a rest there: a take-off; chosen
    rest_time: float = 0.5          # [s] of contact after which it lies on the floor; chosen
    idle_thrust: float = 0.5        # [N] of all rotors together; less means motors off; chosen
    landing_speed: float = 0.6      # [m/s] largest impact in the landing campaign
    landing_inclination: float = 0.3490659  # [rad] 20 deg, in the landing campaign


PLAN = Plan()


@dataclass(frozen=True)
class Trial:
    """Parameters of a flight."""

    case: str                   # name of the fault in the list, or of a landing or healthy flight
    start: str = 'hover'        # one of ALL_STARTS, '' for a landing or healthy flight
    seed: int = 0               # of the simulation and, with ``case``, of the moves
    conditions: str = 'nominal'     # of CONDITIONS; 'effects' is nominal with EFFECTS in the plant
    controller: str = registry.DEFAULT
    plant: str = ''             # robot file of the simulated robot; '' for the shipped one
    listed: str = ''            # digest of an own list of faults, '' for the shipped one
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


def fly_trial(trial: Trial, case: Case, bags: Path | None = None, plan: Plan = PLAN) -> dict:
    """
    Fly one trial of a case; ``bags`` is the folder for its bag.

    Returns:
        the trial's fields, flown_s, state, good, bag (its name or ''), error ('' without an
        exception), and the fields of :meth:`Watcher.observed` or, of a healthy flight, alarms
        (stamp, severity and text of every event above information and of every named fault).

    """
    result = {**asdict(trial), 'good': False, 'bag': trial.name if bags else '', 'error': '',
              'flown_s': 0.0}
    try:
        with collector_off(), ExitStack() as stack:
            recorder = stack.enter_context(BagWriter(
                bags / trial.name, asdict(trial))) if bags else Recorder()
            result.update(_fly_healthy(trial, recorder, plan) if case == HEALTHY
                          else _fly_fault(trial, case, recorder, plan))
    except Exception as error:          # the campaign continues and reports the error
        text = f'{type(error).__name__}: {error}'[:200]
        result.update(outcome='error', error=text, failure=text)
    return result


def _fly_fault(trial, case, recorder, plan):
    """Fly to the start, start the fault, fly on with it unless it is a landing, and land."""
    flight = Flight(trial, case, plan, recorder)
    left, moving = plan.watch_time, trial.start in ('moving', 'random')
    part = flight.random.uniform()
    if moving:
        pose_time, later = (plan.pose_time, plan.pose_time) if trial.start == 'random' \
            else (plan.move_time, plan.jitter)
        flight.aim_randomly()
        flight.fly(pose_time)
        flight.aim_randomly()
        flight.fly(part * later)
    elif trial.start:
        upside_down = trial.start == 'upside_down'
        flight.aim((0.0, 0.0, plan.height), (np.pi if upside_down else 0.0, 0, 0))
        flight.fly((plan.turn_time if upside_down else plan.hover_time) + plan.jitter * part)
    else:
        flight.aim((0.0, 0.0, plan.height), attitude(trial.seed))
        flight.fly(plan.turn_time)
        left = 0.0
    watcher = Watcher(flight)
    start = flight.simulator.time
    flight.loop.start_faults()
    over = False
    while left > 0 and not over:
        period = min(left, plan.move_time) if moving else left
        over = flight.fly(period, watcher)
        left -= period
        if left > 0 and not over:
            flight.aim_randomly()
    asked = flight.supervisor.state in AIRBORNE
    if not over:
        flight.land(watcher)
    seen = watcher.observed(asked=asked)
    good = seen['outcome'] in BETTER[case.expected]
    if good and not trial.start:
        good = bool(seen['impact_m_s'] <= plan.landing_speed
                    and np.radians(seen['inclination_deg']) <= plan.landing_inclination)
    return {**seen, 'expected': case.expected, 'flown_s': flight.simulator.time - start,
            'good': good}


def attitude(seed: int) -> np.ndarray:
    """Roll, pitch, yaw [rad] at the start of a landing; every fourth is upside down."""
    rpy = np.random.default_rng([seed, 1]).uniform(-np.pi, np.pi, 3)
    if seed % 4 == 3:
        rpy[:2] = np.pi, 0.0
    return rpy


def _fly_healthy(trial, recorder, plan):
    """Fly random poses and land."""
    flight = Flight(trial, HEALTHY, plan, recorder)
    simulator, supervisor = flight.simulator, flight.supervisor
    start = simulator.time
    while simulator.time - start < plan.healthy_time and supervisor.state in AIRBORNE:
        if simulator.battery.charge < FRESH:
            simulator.battery.reset()
        flight.aim_randomly()
        flight.fly(plan.pose_time)
    flight.land(lambda: supervisor.state == DISARMED)
    epoch = flight.loop.epoch
    alarms = [[event.stamp - epoch, event.severity, event.text] for event in flight.loop.events
              if event.severity != INFO]
    alarms += [[stamp - epoch, 'fault', name] for name, stamp in supervisor.faults.items()]
    landed = supervisor.state == DISARMED
    return {'flown_s': simulator.time - start, 'state': supervisor.state, 'alarms': alarms,
            'outcome': 'flies_on' if landed else 'does not land', 'good': landed and not alarms}


class Flight:
    """One robot with its flight stack, in the air; ``loop.start_faults`` starts its faults."""

    def __init__(self, trial: Trial, case: Case, plan: Plan, recorder: Recorder):
        nominal = RobotParameters.load()
        aboard = {entry.name: entry.make(nominal) for entry in map(
            registry.find, dict.fromkeys([trial.controller, registry.pilot()]))}
        true = RobotParameters.load(trial.plant) if trial.plant else nominal
        conditions = trial.conditions
        if conditions == 'effects':
            true, conditions = replace(true, effects=true.effects | EFFECTS), 'nominal'
        self.plan = plan
        self.loop = FlightLoop(nominal, true, aboard, recorder, conditions=conditions,
                               seed=trial.seed, faults=case.strike, epoch=int(time()))
        self.simulator, self.supervisor = self.loop.simulator, self.loop.supervisor
        # With other moves for each fault, a seed is not one move.
        self.random = np.random.default_rng(
            [trial.seed, crc32(trial.case.encode())] if trial.start else trial.seed)
        self.loop.take_off()

    def aim(self, position, rpy) -> None:
        """Set the target pose: (3,) in world [m], roll, pitch and yaw [rad]."""
        self.loop.aim(PoseTarget(np.array(position, dtype=float), rotations.from_rpy(*rpy),
                                 self.loop.now()))

    def aim_randomly(self) -> None:
        """Set a random target pose, as of random100."""
        pose = random_poses(1, self.random)[0]
        self.aim(pose[:3], np.radians(pose[3:]))

    def fly(self, duration: float, over: Callable[[], bool] = lambda: False) -> bool:
        """Fly for ``duration`` [s] or until ``over`` is true; returns whether it became true."""
        end = self.simulator.time + duration
        while self.simulator.time < end:
            self.loop.step()
            if over():
                return True
        return False

    def land(self, over: Callable[[], bool]) -> None:
        """Request a landing and fly on."""
        self.loop.request('land')
        self.fly(self.plan.landing_time, over)


class Watcher:
    """Follows a flight from the onset of its fault; a call returns whether the flight is over."""

    def __init__(self, flight: Flight):
        """Start now."""
        own = SupervisorParameters.load()
        self._flight, self._plan = flight, flight.plan
        self._fence = np.array([own.fence_half_width, own.fence_half_width, own.fence_height])
        self._place, self._start = flight.simulator.truth.position.copy(), flight.simulator.time
        self._past_events = len(flight.loop.events)
        self._past_faults = set(flight.supervisor.faults)
        self._still = self._down = 0.0
        self._floor: float | None = None
        self.impacts: list[Impact] = []             # touchdowns
        self.crash: float | None = None             # time at which the robot broke [s]
        self.overrun = 0.0      # longest time after the crash with motors still commanded [s]
        self.flyaway = False    # whether it left the fence, or its place by too much
        self.takeoffs = 0       # after it had lain on the floor
        self.said = ''          # first warning of the supervisor
        self.named: tuple[str, float | None] = ('', None)   # its first named fault, after [s]

    def __call__(self) -> bool:
        """Observe the last tick; returns whether the flight is over."""
        simulator, supervisor = self._flight.simulator, self._flight.supervisor
        truth, tick = simulator.truth, simulator.tick
        self.step(truth, float(simulator.link.thrust.sum()), tick)
        self.said = self.said or next((event.text for event in self._flight.loop.events[
            self._past_events:] if event.severity != INFO), '')
        if not self.named[0]:
            self.named = next(((name, simulator.time - self._start) for name in supervisor.faults
                               if name not in self._past_faults), self.named)
        ended = supervisor.state in MOTORS_OFF or truth.broken
        self._still = self._still + tick if ended else 0.0
        return self.flyaway or self._still >= self._plan.end_time

    def step(self, truth: Truth, thrust: float, tick: float) -> None:
        """Process a tick [s]: true state, commanded thrust of all rotors together [N]."""
        limits, place = self._plan, truth.position
        if truth.impact is not None and truth.impact not in self.impacts[-1:]:
            self.impacts.append(truth.impact)
        if truth.broken and self.crash is None:
            self.crash = truth.stamp
        if self.crash is not None and thrust > limits.idle_thrust:
            self.overrun = max(self.overrun, truth.stamp - self.crash)
        outside = max(abs(place[0]) - self._fence[0], abs(place[1]) - self._fence[1],
                      place[2] - self._fence[2])
        self.flyaway = self.flyaway or bool(outside > limits.fence_margin) \
            or bool(np.linalg.norm(place - self._place) > limits.distance)
        self._down = self._down + tick if truth.contact else 0.0
        if self._down >= limits.rest_time:
            self._floor = float(place[2])
        if self._floor is not None and place[2] > self._floor + limits.rise:
            self.takeoffs, self._floor = self.takeoffs + 1, None

    def observed(self, *, asked: bool) -> dict:
        """Observations; ``asked``: whether the robot flew when the landing was commanded."""
        inclined = max((impact.inclination for impact in self.impacts), default=None)
        return {
            'outcome': self.outcome(asked), 'broken': self.crash is not None,
            'impact_m_s': max((impact.speed for impact in self.impacts), default=None),
            'inclination_deg': None if inclined is None else float(np.degrees(inclined)),
            'overrun_s': self.overrun, 'flyaway': self.flyaway, 'takeoffs': self.takeoffs,
            'named': self.named[0], 'named_s': self.named[1], 'said': self.said,
            'state': self._flight.supervisor.state}

    def outcome(self, asked: bool) -> str:
        """Outcome of the flight as one word of :data:`.page.OUTCOMES`."""
        stopped = self._flight.supervisor.state in MOTORS_OFF
        if self.flyaway:
            return 'flyaway'
        if self.takeoffs:
            return 'takes off'
        if self.crash is not None:
            late = self.overrun > self._plan.stop_time
            return 'crash, motors on' if late or not stopped else 'stops'
        if not stopped or not self.impacts:
            return 'does not land'
        if max(impact.speed for impact in self.impacts) > self._plan.impact_speed:
            return 'hard'
        if max(impact.inclination for impact in self.impacts) > self._plan.inclination:
            return 'tilted'
        if not asked:
            return 'lands'
        return 'refused' if self._flight.loop.refusals else 'flies_on'
