"""
Flights of the campaign: with a fault of the list, a landing from a random attitude, or healthy.

A flight is judged from the true motion and the commanded thrust alone.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from zlib import crc32

import numpy as np

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.tasks import pose_target, random_poses
from beetle_omni_ros.flight.campaign import flight_key
from beetle_omni_ros.flight.evaluate import prepared
from beetle_omni_ros.flight.loop import collector_off, FlightLoop
from beetle_omni_ros.model.mode import DISARMED, FALLBACK, FLYING, MOTORS_OFF
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.faults import Case, Fault
from beetle_omni_ros.sim.sensors import Impact, Truth
from beetle_omni_ros.supervisor.interface import INFO, SupervisorParameters

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
class FaultPlan:
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


PLAN = FaultPlan()


@dataclass(frozen=True)
class FaultFlight:
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
        return flight_key(fly_case, self.controller, self.case, self.start, str(self.seed),
                          self.conditions, self.listed, plant=self.plant)


def fly_case(flight: FaultFlight, case: Case, bags: Path | None = None,
             plan: FaultPlan = PLAN) -> dict:
    """
    Fly one flight of a case; ``bags`` is the folder for its bag.

    Returns:
        the flight's fields, flown_s, state, good, bag (its name or ''), error ('' without an
        exception), and the fields of :meth:`Watcher.observed` or, of a healthy flight, alarms
        (stamp, severity and text of every event above information and of every named fault).

    """
    result = {**asdict(flight), 'good': False, 'bag': flight.name if bags else '', 'error': '',
              'flown_s': 0.0}
    try:
        nominal, conditions = RobotParameters.load(), flight.conditions
        true = RobotParameters.load(flight.plant) if flight.plant else nominal
        if conditions == 'effects':
            true, conditions = replace(true, effects=true.effects | EFFECTS), 'nominal'
        with collector_off(), closing(prepared(
                flight.controller, robot=nominal, plant=true, conditions=conditions,
                seed=flight.seed, pilot=True, faults=case.strike, meta=asdict(flight),
                bag=bags / flight.name if bags else None)) as loop:
            loop.take_off()
            # With other moves for each fault, a seed is not one move.
            moves = np.random.default_rng(
                [flight.seed, crc32(flight.case.encode())] if flight.start else flight.seed)
            result.update(_fly_healthy(loop, moves, plan) if case == HEALTHY
                          else _fly_struck(loop, moves, flight, case, plan))
    except Exception as error:          # the campaign continues and reports the error
        text = f'{type(error).__name__}: {error}'[:200]
        result.update(outcome='error', error=text, failure=text)
    return result


def _fly_struck(loop, moves, flight, case, plan):
    """Fly to the start, start the fault, fly on with it unless it is a landing, and land."""
    simulator = loop.simulator
    left, moving = plan.watch_time, flight.start in ('moving', 'random')
    part = moves.uniform()
    if moving:
        pose_time, later = (plan.pose_time, plan.pose_time) if flight.start == 'random' \
            else (plan.move_time, plan.jitter)
        _aim(loop, *random_poses(1, moves))
        loop.run(pose_time)
        _aim(loop, *random_poses(1, moves))
        loop.run(part * later)
    elif flight.start:
        upside_down = flight.start == 'upside_down'
        _aim(loop, [0, 0, plan.height, 180.0 * upside_down, 0, 0])
        loop.run((plan.turn_time if upside_down else plan.hover_time) + plan.jitter * part)
    else:
        _aim(loop, [0, 0, plan.height, *np.degrees(attitude(flight.seed))])
        loop.run(plan.turn_time)
        left = 0.0
    watcher = Watcher(loop, plan)
    start = simulator.time
    loop.start_faults()
    over = False
    while left > 0 and not over:
        period = min(left, plan.move_time) if moving else left
        over = loop.run(period, watcher)
        left -= period
        if left > 0 and not over:
            _aim(loop, *random_poses(1, moves))
    asked = loop.supervisor.state in AIRBORNE
    if not over:
        loop.request('land')
        loop.run(plan.landing_time, watcher)
    seen = watcher.observed(asked=asked)
    good = seen['outcome'] in BETTER[case.expected]
    if good and not flight.start:
        good = bool(seen['impact_m_s'] <= plan.landing_speed
                    and np.radians(seen['inclination_deg']) <= plan.landing_inclination)
    return {**seen, 'expected': case.expected, 'flown_s': simulator.time - start, 'good': good}


def _aim(loop, pose):
    """Set a target: x, y, z in world [m], roll, pitch, yaw [deg]."""
    loop.aim(pose_target(np.array(pose, dtype=float), loop.now()))


def attitude(seed: int) -> np.ndarray:
    """Roll, pitch, yaw [rad] at the start of a landing; every fourth is upside down."""
    rpy = np.random.default_rng([seed, 1]).uniform(-np.pi, np.pi, 3)
    if seed % 4 == 3:
        rpy[:2] = np.pi, 0.0
    return rpy


def _fly_healthy(loop, moves, plan):
    """Fly random poses and land."""
    simulator, supervisor = loop.simulator, loop.supervisor
    start = simulator.time
    while simulator.time - start < plan.healthy_time and supervisor.state in AIRBORNE:
        if simulator.battery.charge < FRESH:
            simulator.battery.reset()
        _aim(loop, *random_poses(1, moves))
        loop.run(plan.pose_time)
    loop.request('land')
    loop.run(plan.landing_time, lambda: supervisor.state == DISARMED)
    alarms = [[event.stamp - loop.epoch, event.severity, event.text] for event in loop.events
              if event.severity != INFO]
    alarms += [[stamp - loop.epoch, 'fault', name] for name, stamp in supervisor.faults.items()]
    landed = supervisor.state == DISARMED
    return {'flown_s': simulator.time - start, 'state': supervisor.state, 'alarms': alarms,
            'outcome': 'flies_on' if landed else 'does not land', 'good': landed and not alarms}


class Watcher:
    """Follows a flight from the onset of its fault; a call returns whether the flight is over."""

    def __init__(self, loop: FlightLoop, plan: FaultPlan):
        """Start now."""
        own = SupervisorParameters.load()
        self._loop, self._plan = loop, plan
        self._fence = np.array([own.fence_half_width, own.fence_half_width, own.fence_height])
        self._place, self._start = loop.simulator.truth.position.copy(), loop.simulator.time
        self._past_events = len(loop.events)
        self._past_faults = set(loop.supervisor.faults)
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
        simulator, supervisor = self._loop.simulator, self._loop.supervisor
        truth, tick = simulator.truth, simulator.tick
        self.step(truth, float(simulator.link.thrust.sum()), tick)
        self.said = self.said or next((event.text for event in self._loop.events[
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
            'state': self._loop.supervisor.state}

    def outcome(self, asked: bool) -> str:
        """Outcome of the flight as one word of :data:`.page.OUTCOMES`."""
        stopped = self._loop.supervisor.state in MOTORS_OFF
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
        return 'refused' if self._loop.refusals else 'flies_on'
