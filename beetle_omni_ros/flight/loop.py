"""
The loop: components in one process, in simulated time, faster than real time.

Messages are delivered in the order of their publication. Nothing depends on wall time, so that a
seed determines all numbers but the CPU times.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
import gc
import math
from typing import Any

from beetle_omni_ros.bags.log import Recorder
from beetle_omni_ros.bags.topics import ALL, TARGETS
from beetle_omni_ros.control.base import Controller, error_text, PoseTarget, Target
from beetle_omni_ros.control.tasks import Task
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.flight.component import Component, DIAGNOSTICS_PERIOD, Timer
from beetle_omni_ros.flight.stack import (
    CANNOT_BE_FLOWN,
    ControllerComponent,
    Estimator,
    ProcessFaults,
    SupervisorComponent,
)
from beetle_omni_ros.flight.surroundings import DONE, SimulatedRobot, TaskReference, WAITING
from beetle_omni_ros.model.mode import FLYING, IN_FLIGHT, MOTORS_OFF, TAKEOFF
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError, RunError
from beetle_omni_ros.sim.faults import Fault
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.simulator import Simulator
from beetle_omni_ros.supervisor.interface import Event, SupervisorParameters

TAKEOFF_TIMEOUT = 30.0   # [s] simulated time for the take-off
ARMING_TIME = 0.5        # [s] on the ground before arming, for the start of the estimator
SWAP_CHARGE = 0.3        # [-] charge below which the pack is replaced at the next target
# [s] time of the stamps at the start. Every whole second from 2004 to 2038 rounds the floats of
# stamps equally, so that the digits of a flight do not depend on its date.
EPOCH = 2 ** 30
LATCHED_TOPICS = {topic.name for topic in ALL.values() if topic.qos.latched}
QUEUE = 10      # messages of a topic that wait for a process; older ones are dropped, as in ROS
ROUNDING = 1e-9     # [s]


@contextmanager
def collector_off():
    """
    Disable Python's cycle collector during a flight, as the nodes do.

    Its passes become longer with the log. A controller step that it interrupts would appear to
    take tens of milliseconds.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


class Loop:
    """
    Host of components and a simulated robot, advanced tick by tick.

    A recorder gets all messages. ``epoch`` is the time of the stamps at the start [s].

    Attributes:
        robot: the simulated robot.
        refusals: reasons of refused targets.

    """

    simulated = True

    def __init__(self, robot: SimulatedRobot, components: Sequence[Component],
                 recorder: Recorder | None = None, epoch: int = EPOCH):
        self.robot, self.refusals = robot, []       # type: ignore[var-annotated]
        robot.simulator.epoch = epoch
        self._elapsed = robot.simulator.time
        self._now = epoch + self._elapsed
        self._recorder = recorder or Recorder()
        self._queue: deque[tuple[str, Any, str]] = deque()
        self._readers: dict[str, list[Component]] = defaultdict(list)
        self._timers: list[tuple[Component, Timer]] = []
        self._due: dict[int, float] = {}    # id of a timer -> time of its next call [s]
        self._next_due = math.inf
        self._latched: dict[str, Any] = {}      # newest values of latched topics
        # component that is not scheduled -> topic -> newest messages
        self._waiting: dict[Component, dict[str, deque]] = {}
        for component in (*components, robot):
            self.add(component)

    def add(self, component: Component) -> None:
        """Connect a component; its timers start now."""
        for topic in component.inputs:
            self._readers[topic].append(component)
        for timer in (*component.timers, Timer(DIAGNOSTICS_PERIOD, partial(
                self._report, component))):
            self._timers.append((component, timer))
            timer.reset = partial(self._restart, timer)
            timer.reset()
        component.attach(self)
        for topic in component.inputs:
            if topic in self._latched:
                component.feed(topic, self._latched[topic], '',
                               math.nan if topic in TARGETS else None)

    def _restart(self, timer):
        self._due[id(timer)] = due = self.elapsed() + timer.period
        self._next_due = min(self._next_due, due)

    def _report(self, component):
        self.publish('diagnostics', component.diagnostics())

    # Host -------------------------------------------------------------------------------------

    def now(self) -> float:
        """Time on the flight computer's clock [s]."""
        return self._now

    def elapsed(self) -> float:
        """Simulated time [s]."""
        return self._elapsed

    def publish(self, topic: str, value: Any, source: str = '') -> None:
        """Queue a message."""
        self._queue.append((topic, value, source))

    def log(self, severity: str, text: str) -> None:
        """Lines of components are not printed."""

    def warn(self, kind: str, text: str) -> None:
        """Keep the reasons of refused targets."""
        if kind.endswith(CANNOT_BE_FLOWN):
            self.refusals.append(text)

    # Time -------------------------------------------------------------------------------------

    def step(self) -> None:
        """Advance the robot by one tick, call the timers, deliver all messages."""
        frame, simulator = self.robot.advance(), self.robot.simulator
        self._elapsed = simulator.time
        self._now = simulator.epoch + simulator.time
        self.before_messages()
        self.deliver()
        now = simulator.time + ROUNDING
        if now >= self._next_due:
            for component, timer in self._timers:
                if self._due[id(timer)] <= now:
                    self._due[id(timer)] += timer.period
                    if component not in self._waiting:
                        timer.call()
                        self.deliver()
            self._next_due = min(self._due.values())
        self.robot.publish(frame)
        self.deliver()

    def before_messages(self) -> None:
        """Hook after the robot's tick; overridden by subclasses."""

    def deliver(self) -> None:
        """Deliver the queued messages and those that follow from them."""
        queue, write, waiting = self._queue, self._recorder.write, self._waiting
        while queue:
            topic, value, source = queue.popleft()
            write(topic, value, self._now)
            published = None
            if topic in LATCHED_TOPICS:
                self._latched[topic] = value
                if topic in TARGETS:
                    published = math.nan
            for component in self._readers[topic]:
                if waiting and component in waiting:
                    waiting[component][topic].append((value, source, published))
                else:
                    component.feed(topic, value, source, published)

    def suspend(self, component: Component) -> None:
        """Do not schedule a component; its newest messages wait."""
        self._waiting.setdefault(component, defaultdict(partial(deque, maxlen=QUEUE)))

    def resume(self, component: Component) -> None:
        """Schedule a component again; it first gets the messages that waited."""
        for topic, messages in self._waiting.pop(component, {}).items():
            for message, source, published in messages:
                component.feed(topic, message, source, published)


class FlightLoop(Loop):
    """
    One flight with the shipped parameters; the supervisor selects the first controller.

    Args:
        robot: robot of estimator and supervisor.
        plant: simulated robot.
        controllers: name -> controller; all are stepped.
        recorder: LogRecorder, BagWriter or both.
        conditions: 'nominal' or 'published'.
        seed: seed of the simulation.
        faults: faults of robot, devices and processes; ``at`` counts from the task's start.
        others: further components, for example an observer.
        epoch: time of the stamps at the start of the simulation [s].

    Attributes:
        simulator, supervisor: parts of the loop.
        events: events of the supervisor, oldest first.
        recording: returns the flight so far, if its creator keeps one.
        epoch: time of the stamps at the start of the simulation [s].

    """

    start_timeout = 5.0     # [s] for the estimator; noisy poses can need longer than ARMING_TIME

    def __init__(self, robot: RobotParameters, plant: RobotParameters,
                 controllers: dict[str, Controller], recorder: Recorder, *,
                 conditions: str = 'nominal', seed: int = 0, faults: Sequence[Fault] = (),
                 others: Sequence[Component] = (), epoch: int = EPOCH):
        self.simulator = Simulator(plant, SimulatorParameters.load(), conditions=conditions,
                                   seed=seed, epoch=epoch)
        self.events: list[Event] = []
        parameters = replace(SupervisorParameters.load(), controller=next(iter(controllers)))
        self._supervision = SupervisorComponent(parameters, robot, tuple(controllers),
                                                self.events.append)
        self.supervisor = self._supervision.supervisor
        self._estimator = Estimator(EkfParameters.load(), robot)
        self._controllers = {name: ControllerComponent(name, controller, robot)
                             for name, controller in controllers.items()}
        self._faults = ProcessFaults(self.simulator.tick)
        self.recording: Callable[[], Any] = lambda: None
        self._given_faults, self.epoch, self._others = tuple(faults), epoch, tuple(others)
        self._before, self._crashed = '', False     # state of the supervisor
        super().__init__(
            SimulatedRobot(self.simulator, plant),
            [self._estimator, *self._controllers.values(), self._supervision, *others], recorder,
            epoch)
        self.deliver()

    def fly(self, task: Task, progress: Callable[..., None] | None = None) -> bool:
        """
        Take off and fly the task; return whether the robot was airborne to the end.

        ``progress`` gets the fraction ``completed``, 0 to 1; the flight is interrupted if it
        returns true. ParameterError and RunError: no take-off.
        """
        simulator = self.simulator
        reference = TaskReference(task, partial(setattr, simulator, 'payload'))
        with collector_off():
            self.add(reference)
            self.take_off()
            state, began = WAITING, simulator.time
            reported = began
            while not (self._crashed or reference.state.startswith(DONE)):
                self.step()
                if state == WAITING != reference.state:
                    began = simulator.time
                    self.start_faults()
                if reference.state != state:
                    state = reference.state
                    inputs = self.supervisor.inputs
                    if inputs.battery_low or simulator.battery.charge < SWAP_CHARGE:
                        simulator.battery.reset()
                if progress and simulator.time - reported >= DIAGNOSTICS_PERIOD:
                    reported += DIAGNOSTICS_PERIOD
                    if progress(completed=(simulator.time - began) / task.duration):
                        self._recorder.write_meta({'interrupted': True})
                        break
            for component in self._controllers.values():
                self._report(component)
            self.deliver()
        stayed = not (self._crashed or ':' in reference.state or simulator.truth.broken)
        self._recorder.write_meta({'crashed': not stayed, 'controller_error': '; '.join(
            f'{one.error}, {one.errors} times' for one in self._controllers.values()
            if one.errors)})
        return stayed

    def take_off(self) -> None:
        """
        Arm and climb until a controller flies.

        Raises:
            ParameterError: the active controller raised an exception.
            RunError: no take-off.

        """
        asked, supervisor = False, self.supervisor
        while supervisor.state != FLYING:
            self.step()
            if error := self._controllers[supervisor.active].error:
                raise ParameterError(error)
            now = self.simulator.time
            if asked and (now > TAKEOFF_TIMEOUT or supervisor.state == 'disarmed'):
                events = list(dict.fromkeys(     # the newest first, each once
                    event.text for event in reversed(self.events)))
                raise RunError(f'no take-off within {TAKEOFF_TIMEOUT:g} s, supervisor in '
                               f"'{supervisor.state}' ({'; '.join(events[2::-1])})")
            if not asked and now >= ARMING_TIME - ROUNDING and (
                    not supervisor.why_not_arm() or now >= self.start_timeout):
                asked = True
                answer = self.request('arm')
                if not answer:
                    raise RunError(answer.text)

    def run(self, duration: float, over: Callable[[], bool] = lambda: False) -> bool:
        """Step for ``duration`` [s] or until ``over`` is true; return whether it became true."""
        end = self.simulator.time + duration
        while self.simulator.time < end:
            self.step()
            if over():
                return True
        return False

    def close(self) -> None:
        """End the recording."""
        self._recorder.close()

    def request(self, name: str):
        """Call a service of the supervisor; returns its answer."""
        answer = self._supervision.request(name)
        self.deliver()
        return answer

    def select(self, controller: str):
        """Select another controller; returns the supervisor's answer."""
        answer = self._supervision.select(controller)
        self.deliver()
        return answer

    def aim(self, target: Target) -> None:
        """Publish a target; a pose is valid from now on if its stamp is 0."""
        self.publish('target_pose' if isinstance(target, PoseTarget) else 'target_trajectory',
                     target if target.stamp else target.delayed(self.now()))
        self.deliver()

    # Faults -----------------------------------------------------------------------------------

    def start_faults(self) -> None:
        """Start the time of the faults."""
        self.simulator.set_faults([one for one in self._given_faults if not one.is_process])
        self._faults.set([one for one in self._given_faults if one.is_process],
                         self.simulator.time)

    def publish(self, topic: str, value: Any, source: str = '') -> None:
        """Queue a message, or what the faults of its process make of it."""
        values = [value] if self._faults.empty else self._faults.passed(
            topic, value, self.supervisor.active, self.now())
        for one in values:
            super().publish(topic, one, source)

    def before_messages(self) -> None:
        """Apply the faults of processes that begin, last or end in this tick."""
        faults = self._faults
        if faults.empty:
            return
        faults.update(self.simulator.time)
        self.simulator.epoch = self.epoch + faults.clock_step
        self._now = self.simulator.epoch + self.simulator.time
        for topic, value in faults.messages(self.supervisor.active, self.now()):
            super().publish(topic, value)
        if faults.supervisor_waits:
            self.suspend(self._supervision)
        else:
            self.resume(self._supervision)

    def step(self) -> None:
        """
        Run one tick of the robot and of every component that is due in it.

        Raises:
            ParameterError: one of ``others`` raised an exception.

        """
        try:
            super().step()
        except (ParameterError, RunError):
            raise
        except Exception as error:
            if not self._others:
                raise
            raise ParameterError(f'a component raised {error_text(error)}') from error
        state = self.supervisor.state
        if state != self._before:
            self._crashed = self._crashed or (
                self._before in IN_FLIGHT and self._before != TAKEOFF and state in MOTORS_OFF)
            self._before = state
