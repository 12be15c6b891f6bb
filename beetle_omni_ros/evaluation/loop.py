"""
One flight in one process: plant, sensors, estimator, controllers and supervisor.

The parts are those of the ROS graph, called in the order in which messages would arrive. Nothing
depends on wall time, so that a seed determines all numbers.
"""

from __future__ import annotations

from array import array
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
import gc

import numpy as np

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
from beetle_omni_ros.messages.values import Diagnostic, Odom, Wrench
from beetle_omni_ros.robot.allocation import ALL_HEALTHY
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError, RunError
from beetle_omni_ros.runs.log import COMPUTE_KEYS, COMPUTE_STATUS, Recorder
from beetle_omni_ros.runs.targets import TargetChecks
from beetle_omni_ros.runs.tasks import Task, TaskPlayer
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.supervisor import Supervisor
from beetle_omni_ros.sim.faults import Fault, READINGS, Schedule
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


def compute_summary(times: Sequence[float], period: float) -> dict[str, float | int]:
    """Median, 99th percentile, maximum [ms], misses of ``period`` and number of ``times`` [s]."""
    used = 1e3 * np.array(times or [0.0])
    median, p99 = np.percentile(used, [50, 99]).tolist()
    return {'median': median, 'p99': p99, 'max': float(used.max()),
            'deadline_misses': int(np.sum(used > 1e3 * period)), 'count': len(times)}


class Waiting:
    """Takes the messages to a supervisor that is not scheduled: method -> newest messages."""

    def __init__(self):
        self.messages: dict[str, deque] = defaultdict(partial(deque, maxlen=QUEUE))

    def __getattr__(self, method):
        return lambda *message: self.messages[method].append(message)


class Processes:
    """
    Faults of estimator, controllers and supervisor.

    Attributes:
        schedule: faults; those of estimates, commands and targets are applied by the caller.
        clock_step: error of the flight computer's clock [s].
        inbox: supervisor, or what takes its messages while it is not scheduled.

    """

    def __init__(self, tick: float, supervisor: Supervisor):
        """``tick``: time between two calls of :meth:`frame` [s]."""
        self.schedule = Schedule(tick, np.random.SeedSequence(0))
        self.clock_step = 0.0
        self._supervisor = supervisor
        self.inbox: Supervisor | Waiting = supervisor
        self._reported: dict[str, str] = {}     # bridge -> last reported state

    def frame(self, frame: Frame) -> Frame:
        """Start a tick with faults; returns the frame with stamps of the computer's clock."""
        self.schedule.update(frame.time)
        self.clock_step = sum(self.schedule.each('clock'))
        waits, inbox = bool(self.schedule.each('waits')), self.inbox
        if waits and inbox is self._supervisor:
            self.inbox = Waiting()
        elif not waits and isinstance(inbox, Waiting):
            self.inbox = self._supervisor
            for method, messages in inbox.messages.items():
                for message in messages:
                    getattr(self._supervisor, method)(*message)
        shifted = {name: replace(reading, stamp=reading.stamp + self.clock_step)
                   for name in READINGS if (reading := getattr(frame, name)) is not None}
        frame = replace(frame, time=frame.time + self.clock_step, **shifted)
        for bridges in self.schedule.each('bridges'):
            for name, text in bridges.items():
                if self._reported.get(name) != text:
                    self._reported[name] = text
                    self.inbox.on_actuators(name, text, frame.time)
        return frame


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

    """

    def __init__(self, robot: RobotParameters, plant: RobotParameters,
                 controllers: dict[str, Controller], recorder: Recorder, *,
                 conditions: str = 'nominal', seed: int = 0, faults: Sequence[Fault] = ()):
        estimator = EkfParameters.load().of_robot(robot)
        self.simulator = Simulator(plant, SimulatorParameters.load(), conditions=conditions,
                                   seed=seed)
        self.supervisor = Supervisor(SupervisorParameters.load(), robot, HoverController(robot),
                                     tuple(controllers))
        self.supervisor.select(next(iter(controllers)))
        self.refusals: list[str] = []
        self._estimator = ErrorStateEkf(estimator, robot.gravity)
        self._gyroscope_noise, self._errors = estimator.imu.gyroscope_noise, robot.sensors
        self._recorder, self._faults = recorder, tuple(faults)
        self._check_target = TargetChecks(robot).why_not
        self._processes = Processes(self.simulator.tick, self.supervisor)
        self._other_target: Target | None = None     # of a fault
        self._accepts_other = False
        self._times = {name: array('d') for name in controllers}    # CPU [s]
        self._every = {name: max(1, round(c.period / self.simulator.tick))
                       for name, c in controllers.items()}
        self._hosts = {name: ControllerHost(name, c, self._times[name].append)
                       for name, c in controllers.items()}
        self._joints = self._command = self._estimated = None
        self._ticks = 0
        self._reported = ''
        self._health = ALL_HEALTHY
        self._crashed = False

    def fly(self, task: Task, progress: Callable[..., None] | None = None) -> bool:
        """
        Take off and fly the task; return whether the robot was airborne to the end.

        ``progress`` gets the fraction ``completed``, 0 to 1; the flight is interrupted if it
        returns true. ParameterError and RunError: no take-off.
        """
        simulator = self.simulator
        with collector_off():
            self.take_off()
            began = reported = simulator.time
            player = TaskPlayer(task, began)
            self.start_faults()
            while True:
                truth = simulator.truth
                over = player.update(simulator.time, truth.position, truth.quaternion)
                if player.target is not None:
                    self.aim(player.target)
                    if simulator.battery.charge < SWAP_CHARGE or self.supervisor.battery_low:
                        simulator.battery.reset()
                if player.changed:
                    segment = player.segment
                    simulator.wrench = np.r_[segment.force_world, segment.torque_body]
                    simulator.payload = segment.payload
                    self._recorder.write('disturbance', Wrench(
                        simulator.time, segment.force_world, segment.torque_body))
                over = over or self._crashed
                if not over:
                    self.step()
                if over or simulator.time - reported >= COMPUTE_REPORT:
                    reported += COMPUTE_REPORT
                    for controller, times in self._times.items():
                        summary = compute_summary(times, self._hosts[controller].controller.period)
                        self._recorder.write('diagnostics', [Diagnostic(
                            simulator.time, f'{controller}_node: {COMPUTE_STATUS}', 0, '',
                            {key: str(summary[name]) for key, name in COMPUTE_KEYS.items()})])
                    if progress and progress(completed=(simulator.time - began) / task.duration):
                        self._recorder.write_meta({'interrupted': True})
                        over = True
                if over:
                    break
        stayed = not (self._crashed or player.lost_level is not None or truth.broken)
        self._recorder.write_meta({'crashed': not stayed, 'controller_error': '; '.join(
            f'{host.error}, {host.errors} times' for host in self._hosts.values()
            if host.errors)})
        return stayed

    def start_faults(self) -> None:
        """Start the time of the faults."""
        self.simulator.set_faults([fault for fault in self._faults if not fault.is_process])
        self._processes.schedule.set([fault for fault in self._faults if fault.is_process],
                                     self.simulator.time)

    def aim(self, target: Target) -> None:
        """Set the target in force."""
        for host in self._hosts.values():
            host.target = target
        self._recorder.write('target_pose' if isinstance(target, PoseTarget) else
                             'target_trajectory', target)

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
        asked = False
        while self.supervisor.state != 'flying':
            self.step()
            if error := self._hosts[self.supervisor.active].error:
                raise ParameterError(error)
            now = self.simulator.time
            if asked and (now > TAKEOFF_TIMEOUT or self.supervisor.state == 'disarmed'):
                events = list(dict.fromkeys(     # the newest first, each once
                    event.text for event in reversed(self.supervisor.events)))
                raise RunError(f'no take-off within {TAKEOFF_TIMEOUT:g} s, supervisor in '
                               f"'{self.supervisor.state}' ({'; '.join(events[2::-1])})")
            if not asked and now >= SETTLE_TIME and (
                    self._estimator.status == 'tracking' or now >= START_TIMEOUT):
                asked = True
                answer = self.supervisor.arm(now)
                if not answer:
                    raise RunError(answer.text)

    def step(self) -> Frame:
        """Run one tick of the simulator and of every process that is due in it."""
        processes, recorder = self._processes, self._recorder
        frame = self.simulator.step()
        if not processes.schedule.empty:
            frame = processes.frame(frame)
        self._ticks += 1
        now = frame.time
        self._sense(frame)
        estimate, commands = self._estimator.estimate, {}
        new = estimate is not None and estimate.stamp != self._estimated
        if new and self._joints is not None:
            self._estimated = estimate.stamp    # each estimate is sent once
            for state in processes.schedule.through('estimate', State.join(
                    estimate, self._joints, self._command), 0.0):
                if self._estimator.status == 'lost':
                    continue
                processes.inbox.on_state(state, now)
                commands = self._control(state)
                recorder.write('odom', state if not recorder.keeps_covariances else Odom.of(
                    state, pose_covariance(estimate),
                    twist_covariance(estimate, self._gyroscope_noise)))
        active = self.supervisor.active
        arrived = processes.schedule.through('request', commands.pop(active, None), now)
        for name, command in [*((active, one) for one in arrived), *commands.items()]:
            recorder.write(f'{name}/command', command, now)
            processes.inbox.on_command(name, command, now)
        if isinstance(processes.inbox, Waiting):
            return frame
        command, last = self.supervisor.update(now), self._command
        if command is None or last is None \
                or not 0 <= last.stamp - command.stamp <= CLOCK_SET_BACK:
            self._command = command
            if command is not None:
                self.simulator.command(Command(
                    command.stamp - processes.clock_step, command.tilt, command.thrust))
                recorder.write('command', command, now)
        if self.supervisor.reported_state != self._reported:
            self._note_state(now)
        return frame

    def _sense(self, frame):
        recorder, inbox, now = self._recorder, self._processes.inbox, frame.time
        recorder.write('ground_truth/odom', frame.truth)
        if frame.mocap is not None:
            self._estimator.pose(frame.mocap)
            inbox.on_mocap(frame.mocap.stamp, frame.mocap.position, frame.mocap.quaternion)
            recorder.write('mocap/pose', frame.mocap, now)
        if frame.joints is not None:
            self._joints = joints = frame.joints.corrected(self._errors)
            inbox.on_joints(joints.stamp, joints.position, joints.velocity)
            recorder.write('joint_states', frame.joints, now)
        if frame.battery is not None:
            inbox.on_battery(frame.battery.voltage)
            recorder.write('battery_state', frame.battery)
        if frame.imu is not None:
            imu = frame.imu
            self._estimator.imu(imu)
            inbox.on_imu(imu.stamp, imu.specific_force, imu.angular_velocity)
            recorder.write('imu/data_raw', imu)
        if frame.rotors is not None:
            inbox.on_rotors(frame.rotors.stamp, frame.rotors.speed)

    def _control(self, state):
        """Step the controllers that are due; returns their commands."""
        supervisor, commands = self.supervisor, {}
        for name, host in self._hosts.items():
            host.on_estimate(state)
            host.override = supervisor.target_override
            if supervisor.health is not self._health:
                host.on_health(supervisor.health)
            if self._ticks % self._every[name]:
                continue
            command = host.step(state, self._target_of_fault(host) if self._faults else None)
            if command is not None:
                commands[name] = command
        self._health = supervisor.health
        return commands

    def _target_of_fault(self, host):
        """Return the accepted target of a fault, which replaces that of the task, or None."""
        if self.supervisor.target_override is not None:
            return None
        others = self._processes.schedule.each('target')
        if not others:
            self._other_target = None
        elif self._other_target is None:
            self._other_target = other = PoseTarget(*others[0], stamp=host.target_in_force.stamp)
            active = self._hosts[self.supervisor.active]
            reason = self._check_target(other) or active.too_far(other, self.now)
            self._accepts_other = not reason
            self.refusals += [reason] if reason else []
        return self._other_target if self._accepts_other else None

    def _note_state(self, now):
        """Tell controllers and recorder the new state of the supervisor."""
        reported, before = self.supervisor.reported_state, self._reported
        self._reported = reported
        self._recorder.write('supervisor/state', reported, now)
        for host in self._hosts.values():
            reason = host.on_mode(reported, now)
            self.refusals += [reason] if reason else []
        if before.startswith(('flying', 'fallback', 'landing')) \
                and self.supervisor.state in ('disarmed', 'emergency_stop'):
            self._crashed = True
