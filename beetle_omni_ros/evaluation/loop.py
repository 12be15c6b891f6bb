"""
One flight in one process: plant, sensors, estimator, controllers and supervisor.

The same parts as in the ROS graph, joined by function calls in the order in which messages
would arrive: a tick of the simulator makes readings, the estimator takes them in, every
second tick the controllers answer the estimate, the supervisor selects and checks, and the
actuators execute the command after its delay. Nothing depends on wall time, so that a seed
gives the same numbers every time.
"""

from __future__ import annotations

from collections.abc import Callable

from beetle_omni_ros.control.base import Controller, PoseTarget, State, Target
from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.odometry import pose_covariance, twist_covariance
from beetle_omni_ros.evaluation.compute import collector_off, ComputeTimer
from beetle_omni_ros.runs.tasks import Task, TaskPlayer
from beetle_omni_ros.safety.supervisor import Supervisor
from beetle_omni_ros.sim.simulator import Simulator

TAKEOFF_TIMEOUT = 30.0   # [s] of simulated time before a flight that does not start is given up
COMPUTE_REPORT = 1.0     # [s] between two records of compute times, as the nodes report
SWAP_CHARGE = 0.3         # [-] a pack below this is swapped at the next target, or once warned of
SETTLE_TIME = 0.5        # [s] on the ground before arming, in which the estimator starts


class FlightError(RuntimeError):
    """The flight could not begin; the text says what kept it on the ground."""


class FlightLoop:
    """
    Flies one task.

    Args:
        simulator: the world.
        estimator: the EKF.
        controllers: name -> controller; each is stepped, the supervisor selects.
        supervisor: with the active controller selected.
        recorder: takes ``write_*`` calls (LogRecorder, BagWriter or both).
        gyroscope_noise: of one sample, for the covariance of the recorded twist [rad/s].

    """

    def __init__(self, simulator: Simulator, estimator: ErrorStateEkf,
                 controllers: dict[str, Controller], supervisor: Supervisor, recorder,
                 gyroscope_noise: float):
        """See the class."""
        self._gyroscope_noise = gyroscope_noise
        self._simulator, self._estimator = simulator, estimator
        self._controllers, self._supervisor, self._recorder = controllers, supervisor, recorder
        self._timers = {name: ComputeTimer(c.period) for name, c in controllers.items()}
        self._every = {name: max(1, round(c.period / simulator.tick))
                       for name, c in controllers.items()}
        self._target: Target | None = None
        self._hold: Target | None = None
        self._joints = self._battery = self._command = None
        self._ticks = 0
        self._state_name = ''
        self._crashed = False
        self._ending = ''

    @property
    def compute(self) -> dict[str, dict]:
        """Controller -> summary of its CPU times."""
        return {name: timer.summary() for name, timer in self._timers.items()}

    @property
    def ending(self) -> str:
        """When and why the supervisor ended the flight before its task, in words, or ''."""
        return self._ending

    def fly(self, task: Task, progress: Callable[[float], None] = lambda part: None) -> bool:
        """
        Take off, fly the task, stop.

        Args:
            task: what to fly.
            progress: called with the part of the task flown, 0 to 1.

        Returns:
            whether the robot stayed in the air to the end.

        Raises:
            FlightError: it did not take off.

        """
        with collector_off():
            self._take_off()
            return self._play(task, progress)

    def _play(self, task, progress):
        player = TaskPlayer(task, self._simulator.time)
        reported = self._simulator.time
        while True:
            truth = self._simulator.truth
            moment = player.update(self._simulator.time, truth.position, truth.quaternion)
            if moment.target is not None:
                self._target = moment.target
                self._recorder.write_target(moment.target)
                if self._simulator.charge < SWAP_CHARGE or self._supervisor.vehicle.battery_low:
                    self._simulator.swap_battery()
            if moment.changed:
                self._simulator.set_wrench(moment.force_world, moment.torque_body)
                self._simulator.set_payload(moment.payload)
                self._recorder.write_wrench(self._simulator.time, moment.force_world,
                                            moment.torque_body)
            if moment.finished or self._crashed:
                break
            self._tick()
            if self._simulator.time - reported >= COMPUTE_REPORT:
                reported += COMPUTE_REPORT
                self._report_compute()
                progress(min(1.0, (self._simulator.time - player.start) / task.duration))
        self._report_compute()
        progress(1.0)
        return not (self._crashed or moment.lost)

    def _take_off(self):
        while self._simulator.time < SETTLE_TIME:
            self._tick()
        answer = self._supervisor.arm(self._simulator.time)
        if not answer:
            raise FlightError(answer.text)
        while self._supervisor.state != 'flying':
            self._tick()
            if self._simulator.time > TAKEOFF_TIMEOUT or self._supervisor.state == 'disarmed':
                events = [event.text for event in self._supervisor.events]
                raise FlightError(f'no take-off within {TAKEOFF_TIMEOUT:g} s, supervisor in '
                                  f"'{self._supervisor.state}' ({'; '.join(events[-3:])})")

    def _tick(self):
        simulator, recorder, supervisor = self._simulator, self._recorder, self._supervisor
        frame = simulator.step()
        self._ticks += 1
        now = frame.time
        self._sense(frame)
        estimate = self._estimator.estimate
        if estimate is not None and self._joints is not None:
            state = self._state(estimate)
            supervisor.on_state(state, self._estimator.status)
            self._control(state, now)
            covariances = () if not recorder.keeps_covariances else (
                pose_covariance(estimate), twist_covariance(estimate, self._gyroscope_noise))
            recorder.write_odom(estimate.stamp, estimate.position, estimate.quaternion,
                                estimate.velocity, estimate.angular_velocity, *covariances)
        command = supervisor.update(now)
        if command is None:
            self._command = None
        elif self._command is None or command.stamp > self._command.stamp:
            self._command = command
            simulator.command(command)
            recorder.write_command(command.stamp, command.tilt, command.thrust, received=now)
        self._note_state(now)

    def _sense(self, frame):
        recorder, supervisor, now = self._recorder, self._supervisor, frame.time
        truth = frame.truth
        recorder.write_truth(truth.stamp, truth.position, truth.quaternion, truth.velocity,
                             truth.angular_velocity)
        if frame.mocap is not None:
            self._estimator.pose(frame.mocap)
            supervisor.on_mocap(frame.mocap.stamp, frame.mocap.position, frame.mocap.quaternion)
            recorder.write_mocap(frame.mocap.stamp, frame.mocap.position, frame.mocap.quaternion,
                                 received=now)
        if frame.joints is not None:
            self._joints = joints = frame.joints
            recorder.write_joints(joints.stamp, joints.position, joints.velocity, joints.effort,
                                  received=now)
        if frame.battery is not None:
            supervisor.on_battery(frame.battery.voltage)
            recorder.write_battery(frame.battery.stamp, frame.battery.voltage,
                                   frame.battery.current)
        if frame.imu is not None:
            imu = frame.imu
            self._estimator.imu(imu)
            supervisor.on_imu(imu.stamp, imu.specific_force, imu.angular_velocity)
            recorder.write_imu(imu.stamp, imu.specific_force, imu.angular_velocity)

    def _state(self, estimate):
        joints = self._joints
        return State(estimate.stamp, estimate.position, estimate.velocity, estimate.quaternion,
                     estimate.angular_velocity, joints.position, joints.velocity, joints.stamp,
                     self._command)

    def _control(self, state, now):
        """Step whoever is due; without a target yet, hold the pose of the take-off's end."""
        if self._target is None and not self._state_name.startswith('flying'):
            self._hold = PoseTarget(state.position, state.quaternion, state.stamp)
        for name, controller in self._controllers.items():
            if self._ticks % self._every[name]:
                continue
            target = self._target if self._target is not None else self._hold
            command = self._timers[name].call(controller.step, state, target)
            self._recorder.write_request(name, command.stamp, command.tilt, command.thrust,
                                         received=now)
            self._supervisor.on_command(name, command, now)

    def _note_state(self, now):
        name = self._supervisor.state
        if name == 'flying':
            name = f'flying:{self._supervisor.active}'
        if name != self._state_name:
            if self._state_name.startswith(('flying', 'fallback')) \
                    and name in ('landing', 'emergency_stop', 'disarmed'):
                said = [e.text for e in self._supervisor.events][-1:]
                self._ending = f'{name} at {now:.1f} s: {said[0] if said else "unknown"}'
            if self._state_name.startswith(('flying', 'fallback', 'landing')) \
                    and name in ('disarmed', 'emergency_stop'):
                self._crashed = True
            if name in ('disarmed', 'emergency_stop'):
                for controller in self._controllers.values():
                    controller.reset()
            self._state_name = name
            self._recorder.write_state(now, name)

    def _report_compute(self):
        for name, summary in self.compute.items():
            self._recorder.write_compute(self._simulator.time, name, **summary)

