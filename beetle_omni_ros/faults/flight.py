"""A flight of the campaign in one process, and how it goes from one pose to the next."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.evaluation.loop import FlightLoop
from beetle_omni_ros.faults.watch import FlightWatch
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.recorder import Tee
from beetle_omni_ros.runs.target_checks import TargetChecks
from beetle_omni_ros.safety.events import INFO
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.supervisor import Supervisor
from beetle_omni_ros.sim.faults import Fault
from beetle_omni_ros.sim.faults.listed import FaultList, FlightPlan
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.simulator import Simulator

STARTS = ('hover', 'moving', 'upside_down')      # of the list
ALL_STARTS = (*STARTS, 'random')
OFF = ('disarmed', 'emergency_stop')


class Flight:
    """
    One robot with its flight stack.

    Attributes:
        simulator, supervisor, loop: its parts.
        random: for what is random in the plan of the flight.

    """

    def __init__(self, *, controller: str, conditions: str, seed: int,
                 true_robot: RobotParameters | None = None, strike: tuple[Fault, ...] = (),
                 recorder=None):
        """
        Build everything anew.

        Args:
            controller: the active one.
            conditions: 'nominal' or 'published'.
            seed: of everything random.
            true_robot: in the simulation; by default what the flight stack believes.
            strike: faults, for ``loop.start_faults``.
            recorder: as of the loop; by default nothing is recorded.

        """
        believed = RobotParameters.load()
        estimator = EkfParameters.load().of_robot(believed)
        safety = SupervisorParameters.load()
        aboard = {entry.name: entry.make(believed) for entry in map(
            registry.find, dict.fromkeys([controller, registry.pilot()]))}
        name = next(iter(aboard))
        self.supervisor = Supervisor(safety, believed, HoverController(believed),
                                     tuple(dict.fromkeys((*registry.names(), name))))
        self.simulator = Simulator(true_robot or believed, SimulatorParameters.load(),
                                   conditions=conditions, seed=seed)
        self.loop = FlightLoop(
            self.simulator, ErrorStateEkf(estimator, believed.gravity), aboard, self.supervisor,
            Tee() if recorder is None else recorder, estimator.imu.gyroscope_noise, strike,
            TargetChecks(believed).why_not)
        self.supervisor.select(name)
        self.random = np.random.default_rng(seed)
        self._fence = safety.envelope.half_width, safety.envelope.height

    def aim(self, position, quaternion=(0.0, 0.0, 0.0, 1.0)) -> None:
        """Ask for a pose: (3,) in world [m], (4,) xyzw."""
        self.loop.aim(PoseTarget(np.array(position, dtype=float), np.array(quaternion),
                                 self.loop.now))

    def aim_anywhere(self, plan: FlightPlan) -> None:
        """Ask for a random pose, any attitude."""
        x, y, z = self.random.uniform([-plan.spread, -plan.spread, plan.lowest],
                                      [plan.spread, plan.spread, plan.highest])
        self.aim((x, y, z), rotations.from_rpy(*self.random.uniform(-np.pi, np.pi, 3)))

    def fly(self, duration: float, over: Callable[[], bool] = lambda: False) -> bool:
        """Go on for ``duration`` [s], or until ``over`` says so; return whether it did."""
        end = self.simulator.time + duration
        while self.simulator.time < end:
            self.loop.step()
            if over():
                return True
        return False

    def watch(self, listed: FaultList) -> Watcher:
        """Begin to watch."""
        return Watcher(self, FlightWatch(listed.limits, *self._fence,
                                         self.simulator.truth.position.copy()),
                       listed.flight.end_time)


class Watcher:
    """
    Looks and listens at each tick; called, it says whether there is nothing more to see.

    Attributes:
        seen: what the robot did.
        said: first complaint of the supervisor, '' for none, and when it came [s].
        named: name of the first fault that the supervisor told, and when.

    """

    def __init__(self, flight: Flight, seen: FlightWatch, end_time: float):
        """Begin now; the flight is over ``end_time`` [s] after the motors stopped."""
        self._flight, self.seen, self._end_time = flight, seen, end_time
        self._heard = len(flight.supervisor.events)
        self._known = set(told_faults(flight.supervisor))
        self._start, self._still = flight.simulator.time, 0.0
        self.said, self.said_after = '', None
        self.named, self.named_after = '', None

    def __call__(self) -> bool:
        """Look at the tick that just was; whether it is over."""
        flight = self._flight
        simulator, supervisor = flight.simulator, flight.supervisor
        self.seen.step(simulator.truth, float(simulator.thrust_command.sum()), simulator.tick)
        self._listen(supervisor, simulator.time - self._start)
        ended = supervisor.state in OFF or simulator.broken
        self._still = self._still + simulator.tick if ended else 0.0
        return self.seen.flyaway or self._still >= self._end_time

    def _listen(self, supervisor, after):
        if not self.said:
            for event in supervisor.events[self._heard:]:
                if event.severity != INFO:
                    self.said, self.said_after = event.text, after
                    break
        if not self.named:
            for name in told_faults(supervisor):
                if name not in self._known:
                    self.named, self.named_after = name, after
                    break


def told_faults(supervisor: Supervisor) -> dict[str, float]:
    """Name -> time [s] of the faults that the supervisor has named."""
    return supervisor.faults
