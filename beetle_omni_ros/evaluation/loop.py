"""
One flight in one process: plant, sensors, estimator, controllers and supervisor.

The parts are those of the ROS graph, called in the order in which messages would arrive. A tick of
the simulator produces readings, and the estimator uses them. In every second tick the controllers
compute a command from the estimate. The supervisor selects and checks the command, and the
actuators execute it after its delay. Nothing depends on wall time, so that a seed determines all
numbers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import replace
import gc
import time

import numpy as np

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import (
    Command,
    Controller,
    ControllerHost,
    PoseTarget,
    State,
    Target,
)
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.estimation.state import pose_covariance, twist_covariance
from beetle_omni_ros.messages.values import Odom, Wrench
from beetle_omni_ros.robot.allocation import ALL_HEALTHY
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError, RunError
from beetle_omni_ros.runs.log import Recorder
from beetle_omni_ros.runs.targets import TargetChecks
from beetle_omni_ros.runs.tasks import Task, TaskPlayer
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.supervisor import Supervisor
from beetle_omni_ros.sim.faults import Fault, Schedule
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.sensors import Frame
from beetle_omni_ros.sim.simulator import Simulator

START_TIMEOUT = 5.0      # [s] for the estimator; noisy poses can need longer than SETTLE_TIME
TAKEOFF_TIMEOUT = 30.0   # [s] simulated time for the take-off
COMPUTE_REPORT = 1.0     # [s] between two records of compute times, as of the nodes
SWAP_CHARGE = 0.3         # [-] charge below which the pack is replaced at the next target
CLOCK_SET_BACK = 0.1     # [s] least age of a command that shows that the clock was set back
QUEUE = 10      # messages of a topic that wait for a process; older ones are dropped, as in ROS
SETTLE_TIME = 0.5        # [s] on the ground before arming, for the start of the estimator


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


class ComputeTimer:
    """
    CPU times of all steps of one controller; a deadline miss takes longer than ``period`` [s].

    The CPU time of the calling thread is measured, because wall time on a shared computer includes
    other programs.
    """

    def __init__(self, period: float):
        self._period, self._times = period, []

    def call(self, function, *arguments):
        """Run ``function(*arguments)`` and store its CPU time."""
        start = time.thread_time()
        result = function(*arguments)
        self._times.append(time.thread_time() - start)
        return result

    def summary(self) -> dict[str, float | int]:
        """Median, 99th percentile and maximum [ms], deadline misses, number of steps."""
        times = 1e3 * np.array(self._times or [0.0])
        return {'median': float(np.median(times)), 'p99': float(np.percentile(times, 99)),
                'max': float(times.max()),
                'deadline_misses': int(np.sum(times > 1e3 * self._period)),
                'count': len(self._times)}


class Processes:
    """
    Messages from and to estimator, controllers and supervisor, modified by faults of processes.

    Without a fault all messages pass unchanged.

    Attributes:
        clock_step: error of the flight computer's clock [s].

    """

    def __init__(self, tick: float, supervisor: Supervisor):
        """``tick``: time between two calls of :meth:`frame` [s]."""
        self._supervisor = supervisor
        self._schedule = Schedule(tick, np.random.SeedSequence(0))
        self._waiting: dict[str, deque] = {}
        self._reported: dict[str, str] = {}     # bridge -> last reported state
        self.clock_step = 0.0

    def set_faults(self, faults: Sequence[Fault], now: float) -> None:
        """Set the faults of processes; their ``at`` counts from ``now`` [s]."""
        self._schedule.set(faults, now)

    def frame(self, frame: Frame) -> Frame:
        """Start a tick; returns the frame with stamps of the flight computer's clock."""
        if self._schedule.empty:
            return frame
        self._schedule.update(frame.time)
        self.clock_step = sum(self._schedule.each('clock'))
        if not self.supervisor_waits:
            waiting, self._waiting = self._waiting, {}
            for method, messages in waiting.items():
                for message in messages:
                    getattr(self._supervisor, method)(*message)
        if not self.clock_step:
            return frame
        shifted = {name: replace(reading, stamp=reading.stamp + self.clock_step)
                   for name in ('imu', 'mocap', 'joints', 'rotors', 'battery')
                   if (reading := getattr(frame, name)) is not None}
        return replace(frame, time=frame.time + self.clock_step, **shifted)

    @property
    def supervisor_waits(self) -> bool:
        """Whether the supervisor is not scheduled at present."""
        return bool(self._schedule.each('waits'))

    def send(self, method: str, *message) -> None:
        """Call one of the supervisor's ``on_`` methods, or queue the message."""
        if not self._schedule.empty and self.supervisor_waits:
            self._waiting.setdefault(method, deque(maxlen=QUEUE)).append(message)
        else:
            getattr(self._supervisor, method)(*message)

    def estimate(self, state: State) -> State | None:
        """Estimate after the faults; None if it is not sent."""
        return next(iter(self._schedule.through('estimate', state, 0.0)), None)

    def requests(self, command: Command | None, now: float) -> list[Command]:
        """Commands of the active controller that arrive now; None: delayed ones only."""
        return self._schedule.through('request', command, now)

    def target(self, target: Target) -> PoseTarget | None:
        """Target of a fault while ``target`` is in force, or None."""
        for pose in self._schedule.each('target'):
            return PoseTarget(*pose, stamp=target.stamp)
        return None

    @property
    def bridges(self) -> dict[str, str]:
        """Bridge -> its reported state, if that has changed."""
        if self._schedule.empty:
            return {}
        states = {name: text for bridges in self._schedule.each('bridges')
                  for name, text in bridges.items()}
        new = {name: text for name, text in states.items() if self._reported.get(name) != text}
        self._reported.update(new)
        return new


class FlightLoop:
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

    Attributes:
        simulator, supervisor: parts of the loop.
        refusals: reasons of refused targets.
        ending: time in the task and reason of an early end of the flight by the supervisor, or ''.

    """

    def __init__(self, robot: RobotParameters, plant: RobotParameters,
                 controllers: dict[str, Controller], recorder: Recorder, *,
                 conditions: str = 'nominal', seed: int = 0, faults: Sequence[Fault] = ()):
        estimator, active = EkfParameters.load().of_robot(robot), next(iter(controllers))
        self.simulator = Simulator(plant, SimulatorParameters.load(), conditions=conditions,
                                   seed=seed)
        self.supervisor = Supervisor(SupervisorParameters.load(), robot, HoverController(robot),
                                     tuple(dict.fromkeys((*registry.names(), active))))
        self.supervisor.select(active)
        self.refusals: list[str] = []
        self.ending = ''
        self._estimator = ErrorStateEkf(estimator, robot.gravity)
        self._gyroscope_noise, self._errors = estimator.imu.gyroscope_noise, robot.sensors
        self._recorder, self._faults = recorder, tuple(faults)
        self._check_target = TargetChecks(robot).why_not
        self._processes = Processes(self.simulator.tick, self.supervisor)
        self._other_target: Target | None = None     # of a fault
        self._accepts_other = False
        self._timers = {name: ComputeTimer(c.period) for name, c in controllers.items()}
        self._every = {name: max(1, round(c.period / self.simulator.tick))
                       for name, c in controllers.items()}
        self._hosts = {name: ControllerHost(name, c, self._timers[name].call)
                       for name, c in controllers.items()}
        self._joints = self._command = self._estimated = None
        self._ticks = 0
        self._state_name = self._recorded_state = ''
        self._health = ALL_HEALTHY
        self._crashed = False
        self._began = 0.0       # of the task, simulated time

    @property
    def controller_error(self) -> str:
        """The last exception of each controller with their number, or ''."""
        return '; '.join(f'{host.error}, {host.errors} times' for host in self._hosts.values()
                         if host.errors)

    def fly(self, task: Task, progress: Callable[[float], None] = lambda part: None) -> bool:
        """
        Take off and fly the task; ``progress`` is called with its completed fraction, 0 to 1.

        Returns:
            whether the robot was airborne to the end.

        Raises:
            ParameterError, RunError: no take-off.

        """
        with collector_off():
            self.take_off()
            return self._play(task, progress)

    def _play(self, task, progress):
        self._began = self.simulator.time
        player = TaskPlayer(task, self._began)
        self.start_faults()
        reported = self.simulator.time
        while True:
            truth = self.simulator.truth
            moment = player.update(self.simulator.time, truth.position, truth.quaternion)
            if moment.target is not None:
                self.aim(moment.target)
                battery = self.simulator.battery
                if battery.charge < SWAP_CHARGE or self.supervisor.battery_low:
                    battery.reset()
            if moment.changed:
                self.simulator.set_wrench(moment.force_world, moment.torque_body)
                self.simulator.set_payload(moment.payload)
                self._recorder.write('disturbance', Wrench(
                    self.simulator.time, moment.force_world, moment.torque_body))
            if moment.finished or self._crashed:
                break
            self.step()
            if self.simulator.time - reported >= COMPUTE_REPORT:
                reported += COMPUTE_REPORT
                self._report_compute()
                progress(min(1.0, (self.simulator.time - player.start) / task.duration))
        self._report_compute()
        progress(1.0)
        return not (self._crashed or moment.lost or self.simulator.truth.broken)

    def start_faults(self) -> None:
        """Start the time of the faults."""
        if self._faults:
            self.simulator.set_faults([fault for fault in self._faults if not fault.is_process])
            self._processes.set_faults([fault for fault in self._faults if fault.is_process],
                                       self.simulator.time)

    def aim(self, target: Target) -> None:
        """Set the target in force."""
        for host in self._hosts.values():
            host.target = target
        self._recorder.write_target(target)

    @property
    def now(self) -> float:
        """Time on the flight computer's clock [s]."""
        return self.simulator.time + self._processes.clock_step

    def take_off(self) -> None:
        """
        Arm and climb until a controller flies.

        Raises:
            ParameterError: the active controller raised an exception.
            RunError: no take-off.

        """
        while self.simulator.time < SETTLE_TIME or (
                self._estimator.status != 'tracking' and self.simulator.time < START_TIMEOUT):
            self._step_before_flight()
        answer = self.supervisor.arm(self.simulator.time)
        if not answer:
            raise RunError(answer.text)
        while self.supervisor.state != 'flying':
            self._step_before_flight()
            if self.simulator.time > TAKEOFF_TIMEOUT or self.supervisor.state == 'disarmed':
                events = list(dict.fromkeys(     # the newest first, each once
                    event.text for event in reversed(self.supervisor.events)))
                raise RunError(f'no take-off within {TAKEOFF_TIMEOUT:g} s, supervisor in '
                               f"'{self.supervisor.state}' ({'; '.join(events[2::-1])})")

    def _step_before_flight(self):
        self.step()
        if error := self._hosts[self.supervisor.active].error:
            raise ParameterError(error)

    def step(self) -> Frame:
        """Run one tick of the simulator and of every process that is due in it."""
        simulator, processes = self.simulator, self._processes
        frame = processes.frame(simulator.step())
        self._ticks += 1
        now = frame.time
        self._sense(frame)
        estimate = self._estimator.estimate
        new = estimate is not None and estimate.stamp != self._estimated
        if new and self._joints is not None:
            self._estimated = estimate.stamp    # each estimate is sent once
            state = processes.estimate(State.join(estimate, self._joints, self._command))
            if state is not None and self._estimator.status != 'lost':
                processes.send('on_state', state)
                self._control(state, now)
                self._recorder.write('odom', Odom.of(state, *(
                    (pose_covariance(estimate), twist_covariance(estimate, self._gyroscope_noise))
                    if self._recorder.keeps_covariances else ())))
        for late in processes.requests(None, now):
            self._request(self.supervisor.active, late, now)
        if not processes.supervisor_waits:
            self._execute(self.supervisor.update(now), now)
            self._note_state(now)
        return frame

    def _execute(self, command, now):
        if command is None:
            self._command = None
        elif self._command is None or command.stamp > self._command.stamp \
                or command.stamp < self._command.stamp - CLOCK_SET_BACK:
            self._command = command
            self.simulator.command(replace(
                command, stamp=command.stamp - self._processes.clock_step))
            self._recorder.write('command', command, now)

    def _sense(self, frame):
        recorder, send, now = self._recorder, self._processes.send, frame.time
        recorder.write('ground_truth/odom', Odom.of(frame.truth))
        if frame.mocap is not None:
            self._estimator.pose(frame.mocap)
            send('on_mocap', frame.mocap.stamp, frame.mocap.position, frame.mocap.quaternion)
            recorder.write('mocap/pose', frame.mocap, now)
        if frame.joints is not None:
            self._joints = joints = frame.joints.corrected(self._errors)
            send('on_joints', joints.stamp, joints.position, joints.velocity)
            recorder.write('joint_states', frame.joints, now)
        if frame.battery is not None:
            send('on_battery', frame.battery.voltage)
            recorder.write('battery_state', frame.battery)
        if frame.imu is not None:
            imu = frame.imu
            self._estimator.imu(imu)
            send('on_imu', imu.stamp, imu.specific_force, imu.angular_velocity)
            recorder.write('imu/data_raw', imu)
        if frame.rotors is not None:
            send('on_rotors', frame.rotors.stamp, frame.rotors.speed)
        for name, text in self._processes.bridges.items():
            send('on_actuators', name, text, now)

    def _control(self, state, now):
        """Step the controllers that are due."""
        supervisor = self.supervisor
        for name, host in self._hosts.items():
            host.on_estimate(state)
            host.override = supervisor.target_override
            if supervisor.health is not self._health:
                host.on_health(supervisor.health)
            if self._ticks % self._every[name]:
                continue
            command = host.step(state, self._target_of_fault(host))
            if name == supervisor.active:
                for passed in self._processes.requests(command, now):
                    self._request(name, passed, now)
            elif command is not None:
                self._request(name, command, now)
        self._health = supervisor.health

    def _request(self, name, command, now):
        self._recorder.write(f'{name}/command', command, now)
        self._processes.send('on_command', name, command, now)

    def _target_of_fault(self, host):
        """Return the accepted target of a fault, which replaces that of the task, or None."""
        if self.supervisor.target_override is not None:
            return None
        other = self._processes.target(host.target_in_force)
        if other is None:
            self._other_target = None
        elif self._other_target is None:
            self._other_target = other
            active = self._hosts[self.supervisor.active]
            reason = self._check_target(other) or active.too_far(other, self.now)
            self._accepts_other = not reason
            self.refusals += [reason] if reason else []
        return self._other_target if self._accepts_other else None

    def _note_state(self, now):
        reported = self.supervisor.reported_state
        name = self.supervisor.state if self.supervisor.state != 'flying' else reported
        if reported != self._recorded_state:
            self._recorded_state = reported
            self._recorder.write('supervisor/state', reported, now)
            for host in self._hosts.values():
                reason = host.on_mode(reported, self.now)
                self.refusals += [reason] if reason else []
        if name != self._state_name:
            if self._state_name.startswith(('flying', 'fallback')) \
                    and name in ('landing', 'emergency_stop', 'disarmed'):
                last = [e.text for e in self.supervisor.events][-1:]
                self.ending = (f'{name} at {self.simulator.time - self._began:.1f} s: '
                               f'{last[0] if last else "unknown"}')
            if self._state_name.startswith(('flying', 'fallback', 'landing')) \
                    and name in ('disarmed', 'emergency_stop'):
                self._crashed = True
            self._state_name = name

    def _report_compute(self):
        for name, timer in self._timers.items():
            self._recorder.write_compute(self.simulator.time, name, **timer.summary())

