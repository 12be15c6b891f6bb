"""A flight of the campaign in one process, from pose to pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.evaluation.loop import FlightLoop
from beetle_omni_ros.faults.watch import FlightWatch
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.log import Tee
from beetle_omni_ros.safety.events import INFO
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.sim.fault_lists import FaultList, FlightPlan
from beetle_omni_ros.sim.faults import Fault

STARTS = ('hover', 'moving', 'upside_down')      # default
ALL_STARTS = (*STARTS, 'random')
OFF = ('disarmed', 'emergency_stop')


class Flight:
    """
    One robot with its flight stack.

    Attributes:
        simulator, supervisor, loop: parts of the stack.
        random: random numbers of the plan of the flight.

    """

    def __init__(self, *, controller: str, conditions: str, seed: int,
                 plant: str | None = None, effects: dict | None = None,
                 strike: tuple[Fault, ...] = (), recorder=None):
        """
        Build robot and flight stack.

        Args:
            controller: the active controller.
            conditions: 'nominal' or 'published'.
            seed: seed of the plan and the simulation.
            plant: robot file of the simulated robot; None: that of the flight stack.
            effects: further effects of the simulated robot.
            strike: faults, started by ``loop.start_faults``.
            recorder: recorder of the loop; by default nothing is recorded.

        """
        nominal, envelope = RobotParameters.load(), SupervisorParameters.load().envelope
        aboard = {entry.name: entry.make(nominal) for entry in map(
            registry.find, dict.fromkeys([controller, registry.pilot()]))}
        true = RobotParameters.load(plant) if plant else nominal
        if effects:
            true = replace(true, effects=true.effects | effects)
        self.loop = FlightLoop.shipped(
            nominal, true, aboard, Tee() if recorder is None else recorder,
            conditions=conditions, seed=seed, faults=strike)
        self.simulator, self.supervisor = self.loop.simulator, self.loop.supervisor
        self.random = np.random.default_rng(seed)
        self._fence = envelope.half_width, envelope.height

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

    def watch(self, listed: FaultList) -> Watcher:
        """Start an observation of the flight."""
        return Watcher(self, FlightWatch(listed.limits, *self._fence,
                                         self.simulator.truth.position.copy()),
                       listed.flight.end_time)


class Watcher:
    """
    Observes a flight in each tick; a call returns whether the observation is complete.

    Attributes:
        seen: motion of the robot.
        said, said_after: first warning of the supervisor, '' for none, and its time [s].
        named, named_after: name of the first fault that the supervisor named, and its time [s].

    """

    def __init__(self, flight: Flight, seen: FlightWatch, end_time: float):
        """Start now; the flight is over ``end_time`` [s] after the motors stopped."""
        self._flight, self.seen, self._end_time = flight, seen, end_time
        self._past_events = len(flight.supervisor.events)
        self._past_faults = set(flight.supervisor.faults)
        self._start, self._still = flight.simulator.time, 0.0
        self.said, self.said_after = '', None
        self.named, self.named_after = '', None

    def __call__(self) -> bool:
        """Observe the last tick; returns whether the observation is complete."""
        flight = self._flight
        simulator, supervisor = flight.simulator, flight.supervisor
        self.seen.step(simulator.truth, float(simulator.thrust_command.sum()), simulator.tick)
        self._check_events(supervisor, simulator.time - self._start)
        ended = supervisor.state in OFF or simulator.truth.broken
        self._still = self._still + simulator.tick if ended else 0.0
        return self.seen.flyaway or self._still >= self._end_time

    def _check_events(self, supervisor, after):
        if not self.said:
            for event in supervisor.events[self._past_events:]:
                if event.severity != INFO:
                    self.said, self.said_after = event.text, after
                    break
        if not self.named:
            for name in supervisor.faults:
                if name not in self._past_faults:
                    self.named, self.named_after = name, after
                    break
