"""The flight stack as components: estimator, controllers and supervisor; their faults."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
import math
import secrets
from time import thread_time
from typing import Any

import numpy as np

from beetle_omni_ros.bags.messages import MessageError
from beetle_omni_ros.bags.topics import TARGETS
from beetle_omni_ros.control.base import (
    Command,
    Controller,
    corrected,
    error_text,
    guidance_of,
    PoseTarget,
    reach_of,
    State,
    Target,
)
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.control.targets import TargetChecks
from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.flight.component import Component, ERROR, IDENTITY, OK, WARN
from beetle_omni_ros.model.allocation import ALL_HEALTHY, ROTORS
from beetle_omni_ros.model.mode import FALLBACK, FLYING, Mode, STOPPED
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.faults import Schedule
from beetle_omni_ros.supervisor.interface import Answer, Event, INFO, SupervisorParameters
from beetle_omni_ros.supervisor.interface import ERROR as SEVERE
from beetle_omni_ros.supervisor.supervisor import Supervisor

# --- estimator -----------------------------------------------------------------------------------

SENSOR_AGE = 0.2        # [s] an older sample is of a stuck driver or another clock
PUBLISHED = ('tracking', 'dead_reckoning')      # a lost estimate is missed by its readers


class Estimator(Component):
    """Publishes odom for every IMU sample, corrected by MoCap poses at their capture time."""

    def __init__(self, parameters: EkfParameters, robot: RobotParameters):
        super().__init__('ekf_node')
        self.ekf = ErrorStateEkf(parameters.of_robot(robot), robot.gravity)
        self._status = self.ekf.status
        self.writes('odom')
        self.reads('imu/data_raw', self._on_imu, max_age=SENSOR_AGE)
        self.reads('mocap/pose', partial(self.timed, self.ekf.pose), max_age=SENSOR_AGE)
        self.track_compute(1 / parameters.imu.rate)
        self.report('estimator', self._estimator_status)

    def _on_imu(self, sample):
        accepted = self.timed(self.ekf.imu, sample)
        status = self.ekf.status
        if status != self._status:
            self.host.log(INFO, f'{self._status} -> {status}')
            self._status = status
        if accepted and status in PUBLISHED:
            self.send('odom', self.ekf.estimate)

    def _estimator_status(self):
        level = {'tracking': OK, 'dead_reckoning': WARN, 'lost': ERROR}
        values = {f'rejected: {reason}': count for reason, count in self.ekf.rejected.items()}
        return level.get(self._status, OK), self._status, values


# --- controllers ---------------------------------------------------------------------------------

ODOM_AGE = 0.05         # [s] no command answers an older estimate
JOINT_AGE = 0.1         # [s]
REPEAT = 1.0            # [s] between two log lines about a controller
STEP_TOLERANCE = 0.0025     # [s] half of the smallest interval between estimates
CANNOT_BE_FLOWN = 'cannot be flown'     # kind of a refused target


class ControllerComponent(Component):
    """
    Steps a controller once a period, triggered by the estimate.

    Before the first target it holds the pose at which the controller became active. A controller
    that is not active is stepped too, so that it can take over without a jump.

    Attributes:
        controller: what it steps.
        target: target of the operator or the task, or None.
        override: target of the supervisor, which replaces it, or None.
        errors: number of the controller's exceptions; ``error`` is the last one in one line.

    """

    def __init__(self, name: str, controller: Controller, robot: RobotParameters):
        super().__init__(f'{name}_node')
        self.controller, self._mode = controller, Mode()
        self.target: Target | None = None
        self.override: Target | None = None
        self.errors, self.error = 0, ''
        self._name, self._command_topic = name, f'{name}/command'
        self._checks, self._sensors = TargetChecks(robot), robot.sensors
        self._joints = self._command = self._hold = self._position = None
        self._health = ALL_HEALTHY
        self._last_step, self._quiet_until = -math.inf, -math.inf
        self._reported_errors = 0
        self.writes(self._command_topic)
        self.reads('odom', self._on_odom, max_age=ODOM_AGE)
        self.reads('joint_states', self._on_joints, max_age=JOINT_AGE)
        self.reads('command', partial(setattr, self, '_command'), expected=False)
        for topic in TARGETS:
            self.reads(topic, self._on_target, expected=False)
        self.follows('supervisor/state', self._on_mode)
        self.follows('supervisor/target', partial(setattr, self, 'override'))
        self.follows('supervisor/actuators', self._on_health)
        self.track_compute(controller.period)
        self.report('controller', self._controller_status)

    def _on_joints(self, joints):
        if not np.isnan(joints.position).any():     # a bridge has lost a servo for the moment
            self._joints = joints.corrected(self._sensors)

    def _on_health(self, health):
        self._health = health
        self._call('set_health', health)

    def _on_target(self, target, published):
        # The age counts at publication: a latched target stays valid for a node that starts
        # later. Publication times are system time, so simulated stamps have no age.
        then = None if self.host.simulated or math.isnan(published) else published
        now = self.host.now()
        reason = self._checks.why_not(target, then) or (
            self._too_far(target, now) if self._mode.controller == self._name else '')
        if reason:
            raise MessageError(reason, CANNOT_BE_FLOWN)
        if target.stamp == 0.0:     # `ros2 topic pub` sets no stamp: valid from now on
            target = target.delayed(now)
        elif target.stamp > now:    # a clock that is ahead must not make it outlast later targets
            target = replace(target, stamp=now)
        # Latched and volatile copies may overtake each other: the newest stamp counts, except
        # after the clock was set back.
        old = self.target
        if old is None or not target.stamp < old.stamp <= now:
            self.target = target

    def _too_far(self, target, now):
        """Why a target at ``now`` [s] is out of reach from the last estimate, or ''."""
        if self._position is None:
            return ''
        away = float(np.linalg.norm(target.at(now).position - self._position))
        reach = reach_of(self.controller)
        return '' if away <= reach else (f'{away:.4g} m from the robot, expected at most '
                                         f'{reach:g} m: the reach of the controller')

    def _on_mode(self, mode):
        """Follow the supervisor; motors that stop reset the controller and its targets."""
        before, self._mode = self._mode, mode
        if mode.motors_off:
            self._command = None
            if before.state != mode.state:
                self._call('reset')
                self._hold = self.override = None
        if mode.controller != self._name or mode == before or self.target is None:
            return
        if reason := self._too_far(self.target, self.host.now()):   # another one's target
            self.target = self._hold = None
            self.reject('target_pose', f'{reason}; the present pose is held', CANNOT_BE_FLOWN)

    def _on_odom(self, odom):
        self._position = odom.position
        if self.target is None and (self._hold is None or self._mode.state != FLYING):
            self._hold = PoseTarget(odom.position, odom.quaternion, odom.stamp)
        since = odom.stamp - self._last_step        # < 0: the clock was set back
        if self._joints is None or 0 <= since < self.controller.period - STEP_TOLERANCE:
            return
        self._last_step = odom.stamp
        command = self._step(State.join(odom, self._joints, self._command))
        if command is not None:
            self.send(self._command_topic, command)

    def _step(self, state):
        """Command to the target in force; None for a state that is not finite."""
        if not math.isfinite(sum(sum(part.tolist()) for part in (
                state.position, state.velocity, state.quaternion, state.angular_velocity,
                state.tilt, state.tilt_velocity))):
            return None
        target = self.override or self.target or self._hold
        state = corrected(state, self._health)
        began = thread_time()   # wall time would include other programs
        try:
            result = self.controller.step(state, target)
        except Exception as error:
            return self._failed('step', f'raised {error_text(error)}')
        self.took(thread_time() - began)
        if isinstance(result, Command) and all(getattr(part, 'shape', None) == (ROTORS,)
                                               for part in (result.tilt, result.thrust)):
            return result
        return self._failed('step', f'returned {str(result)[:100]}, expected a Command with two '
                            f'arrays of {ROTORS}')

    def _call(self, method, *arguments):
        """
        Call another of the controller's methods if it has it; None after an error.

        In a process with other nodes, an exception would end the supervisor, too.
        """
        function = getattr(self.controller, method, None)
        if function is None:
            return None
        try:
            return function(*arguments)
        except Exception as error:
            return self._failed(method, f'raised {error_text(error)}')

    def _failed(self, method, text):
        """Count an error and log it; returns None."""
        self.errors, self.error = self.errors + 1, f"controller '{self._name}': {method} {text}"
        if self.host.elapsed() >= self._quiet_until:
            self._quiet_until = self.host.elapsed() + REPEAT
            self.host.log(SEVERE, self.error)

    def _controller_status(self):
        report = self._call('diagnostics') or {}
        new, self._reported_errors = self.errors - self._reported_errors, self.errors
        values = {**report, 'guidance': guidance_of(self.controller)}
        if self.errors:
            values['errors'] = self.errors
        if new:
            return ERROR, self.error, values
        return OK, getattr(self.controller, 'name', self._name), values


# --- supervisor ----------------------------------------------------------------------------------

# [s] between checks while nothing triggers a step, and without a trigger until they begin. The
# triggers are commands in flight, otherwise estimates: steps do not depend on a timer's phase.
WATCH_PERIOD, WATCH_AFTER = 0.01, 0.015
REQUESTS = ('arm', 'disarm', 'land', 'emergency_stop')
BRIDGES = ('joint', 'rotor')


class SupervisorComponent(Component):
    """
    Publishes command, the only topic that actuators execute, and supervisor/state (latched).

    Services ~/arm, ~/disarm, ~/land and ~/emergency_stop; :meth:`select` selects the active
    controller, also in flight. ``on_event`` gets each event.
    """

    def __init__(self, parameters: SupervisorParameters, robot: RobotParameters,
                 controllers: Sequence[str], on_event: Callable[[Event], None] | None = None):
        super().__init__('supervisor_node')
        self._sensors, self._on_event = robot.sensors, on_event
        self.supervisor = supervisor = Supervisor(parameters, robot, HoverController(robot),
                                                  controllers)
        self._joints = None
        self._sent = (None, '')     # stamp and source of the last command
        self._triggered = -math.inf     # time of the last step by a message [s]
        self._identity_sent = f'supervisor_node:{secrets.token_hex(4)}'     # of this run
        self.writes('command', IDENTITY, 'supervisor/state', 'supervisor/target',
                    'supervisor/actuators')
        self.reads('odom', self._on_odom)
        self.reads('joint_states', self._on_joints, max_age=SENSOR_AGE)
        self.reads('imu/data_raw', lambda s: supervisor.inputs.on_imu(
            s.stamp, s.specific_force, s.angular_velocity), max_age=SENSOR_AGE)
        self.reads('mocap/pose', lambda s: supervisor.inputs.on_mocap(
            s.stamp, s.position, s.quaternion), max_age=SENSOR_AGE)
        self.reads('rotor_states', lambda r: supervisor.inputs.on_rotors(r.stamp, r.speed),
                   expected=False)
        self.reads('battery_state', lambda battery: supervisor.inputs.on_battery(battery.voltage))
        for name in controllers:
            self.reads(f'{name}/command', partial(self._on_command, name), expected=False)
        for name in BRIDGES:
            self.follows(f'{name}_bridge/state', partial(self._on_bridge, name))
        for name in REQUESTS:
            self.services[name] = partial(self.request, name)
        self.report('supervisor', self._supervisor_status)
        self.every(WATCH_PERIOD, self._watch)

    def start(self) -> None:
        """Publish identity and state."""
        self.send(IDENTITY, self._identity_sent)
        self.step()

    def select(self, controller: str) -> Answer:
        """Select another controller."""
        answer = self.supervisor.select(controller)
        self._publish_states()
        return answer

    def request(self, name: str) -> Answer:
        """Answer one of REQUESTS."""
        answer = getattr(self.supervisor, name)(self.host.now())
        self.step()
        return answer

    def _on_joints(self, joints):
        joints = joints.corrected(self._sensors)
        if not np.isnan(joints.position).any():
            self._joints = joints
        self.supervisor.inputs.on_joints(joints.stamp, joints.position, joints.velocity)

    def _on_odom(self, odom):
        if self._joints is None:
            return
        now = self.host.now()
        self.supervisor.inputs.on_state(State.join(odom, self._joints), now)
        if self.supervisor.state != FLYING:     # the fallback controller answers each estimate
            self._triggered = now
            self.step()

    def _watch(self):
        if not 0 <= self.host.now() - self._triggered < WATCH_AFTER:
            self.step()

    def _on_command(self, name, command):
        supervisor, now = self.supervisor, self.host.now()
        accepted = supervisor.inputs.on_command(name, command, now)
        if accepted and name == supervisor.active and supervisor.state == FLYING:
            self._triggered = now
            self.step()

    def _on_bridge(self, name, text):
        self.supervisor.inputs.bridges[name] = text
        self.step()

    def step(self) -> None:
        """Publish the command, if it is a new one, and changed states."""
        supervisor = self.supervisor
        command = supervisor.update(self.host.now())
        # A command is not repeated: the actuators detect missing commands by the age.
        if command is not None and (command.stamp, supervisor.source) != self._sent:
            self._sent = (command.stamp, supervisor.source)
            self.send('command', command, self._identity_sent)
        self._publish_states()

    def _publish_states(self):
        supervisor = self.supervisor
        self.update('supervisor/state', supervisor.mode)
        self.update('supervisor/target', supervisor.target_override)
        self.update('supervisor/actuators', supervisor.inputs.health)
        for event in supervisor.inputs.events:
            self.host.log(event.severity, event.text)
            if self._on_event:
                self._on_event(event)
        supervisor.inputs.events.clear()

    def _supervisor_status(self):
        supervisor = self.supervisor
        level = {FALLBACK: WARN, STOPPED: ERROR}.get(
            supervisor.state, WARN if supervisor.faults else OK)
        named = ', '.join(supervisor.faults)
        state = self.newest['supervisor/state']
        return level, f'{state}; faults: {named}' if named else state, supervisor.diagnostics()


class ProcessFaults(Schedule):
    """
    Faults of estimator, controllers, supervisor and bridges, updated in each tick.

    Attributes:
        clock_step: error of the flight computer's clock [s].
        supervisor_waits: whether the supervisor is not scheduled.

    """

    def __init__(self, tick: float):
        """``tick``: time between two updates [s]."""
        super().__init__(tick, np.random.SeedSequence(0))
        self.clock_step, self.supervisor_waits = 0.0, False
        self._bridges: dict[str, str] = {}      # bridge -> last reported state
        self._aimed = False     # whether the other target of a fault was published

    def update(self, now: float, truth: Any = None, held: np.ndarray | None = None) -> None:
        """Start and end the faults due at ``now`` [s]."""
        super().update(now, truth, held)
        self.clock_step = sum(self.each('clock'))
        self.supervisor_waits = bool(self.each('waits'))

    def passed(self, topic: str, value: Any, active: str, now: float) -> list:
        """Values that arrive ``now`` [s] on a topic; ``active`` is the active controller."""
        signal = {'odom': 'estimate', f'{active}/command': 'request'}.get(topic)
        return [value] if signal is None else self.through(signal, value, now)

    def messages(self, active: str, now: float) -> list[tuple[str, Any]]:
        """Messages (topic, value) that the faults cause by themselves in this tick."""
        caused: list[tuple[str, Any]] = [
            (f'{active}/command', late) for late in self.through('request', None, now)]
        for bridges in self.each('bridges'):
            for name, text in bridges.items():
                if self._bridges.get(name) != text:
                    self._bridges[name] = text
                    caused.append((f'{name}_bridge/state', text))
        targets = self.each('target')
        if targets and not self._aimed:
            caused.append(('target_pose', PoseTarget(*targets[0], stamp=now)))
        self._aimed = bool(targets)
        return caused
