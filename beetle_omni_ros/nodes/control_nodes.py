"""ROS nodes of the control loop: state estimator, any registered controller, supervisor."""

from dataclasses import replace
from functools import partial
import math
import secrets

import numpy as np
from std_srvs.srv import Trigger

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import ControllerHost, guidance_of, MOTORS_OFF, PoseTarget, State
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.control.registry import ControllerEntry
from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.estimation.state import pose_covariance, twist_covariance
from beetle_omni_ros.messages.topics import TARGETS
from beetle_omni_ros.messages.values import MessageError, Odom
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.graph import NODES
from beetle_omni_ros.nodes.node import ERROR, FlightNode, IDENTITY, OK, WARN
from beetle_omni_ros.nodes.parameters import file_parameter
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import parameter, ParameterError
from beetle_omni_ros.runs.targets import TargetChecks
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.supervisor import DISARMED, FALLBACK, FLYING, STOPPED, Supervisor

SENSOR_AGE = 0.2        # s, an older sample is of a stuck driver or another clock
ODOM_AGE = 0.05         # s, no command answers an older estimate
JOINT_AGE = 0.1         # s
STEP_TOLERANCE = 0.0025     # s, half of the smallest interval between estimates
REPEAT = 1.0            # s between two log lines about a controller
WATCH_PERIOD = 0.01     # s between checks for silent inputs


# --- estimator ----------------------------------------------------------------------------------

class EkfNode(FlightNode):
    """Publishes odom for every IMU sample, corrected by MoCap poses at their capture time."""

    def __init__(self):
        super().__init__('ekf_node', EkfParameters, 'params/ekf.yaml', 'ekf_file',
                         robot_file=file_parameter())
        robot = RobotParameters.load(self.parameters.robot_file or None)
        self._ekf = ErrorStateEkf(self.parameters.of_robot(robot), robot.gravity)
        self._status = self._ekf.status
        self._publisher = wire.Publisher(self, 'odom')
        self.listen('imu/data_raw', self._on_imu, max_age=SENSOR_AGE)
        self.listen('mocap/pose', partial(self.timed, self._ekf.pose), max_age=SENSOR_AGE)
        self.track_compute(1 / self.parameters.imu.rate)
        self.report('estimator', self._estimator_status)

    def _on_imu(self, sample):
        accepted = self.timed(self._ekf.imu, sample)
        status = self._ekf.status
        if status != self._status:
            self.get_logger().info(f'{self._status} -> {status}')
            self._status = status
        # A lost estimate is not published: the readers detect the missing messages.
        if accepted and status in ('tracking', 'dead_reckoning'):
            estimate = self._ekf.estimate
            self._publisher.publish(Odom.of(
                estimate, pose_covariance(estimate),
                twist_covariance(estimate, self.parameters.imu.gyroscope_noise)))

    def _estimator_status(self):
        level = {'tracking': OK, 'dead_reckoning': WARN, 'lost': ERROR}
        values = {f'rejected: {reason}': count for reason, count in self._ekf.rejected.items()}
        return level.get(self._status, OK), self._status, values


# --- controllers --------------------------------------------------------------------------------

class ControllerNode(FlightNode):
    """
    Steps a controller once a period, triggered by the estimate; see ControllerHost.

    Commands go to '<name>/command'. An exception of the controller is logged and reported in
    diagnostics.
    """

    def __init__(self, entry: ControllerEntry):
        more = {} if f'{entry.name}_node' in NODES else {'controller': parameter(
            entry.reference, doc='controller that this node runs')}
        super().__init__(f'{entry.name}_node', entry.parameter_class, entry.parameters_file,
                         f'{entry.name}_file', robot_file=file_parameter(), **more)
        self._entry = entry
        robot = RobotParameters.load(self.parameters.robot_file or None)
        controller = entry.make(
            robot, parameters=self.parameters if entry.parameter_class else None)
        self._host = ControllerHost(entry.name, controller, self.took, partial(
            self.get_logger().error, throttle_duration_sec=REPEAT))
        self._checks, self._sensors = TargetChecks(robot), robot.sensors
        self._joints = self._command = None
        self._last_step = 0.0
        self._reported_errors = 0
        self._publisher = wire.Publisher(self, f'{entry.name}/command')
        self.listen('odom', self._on_odom, max_age=ODOM_AGE)
        self.listen('joint_states', self._on_joints, max_age=JOINT_AGE)
        self.listen('command', partial(setattr, self, '_command'), expected=False)
        for topic in TARGETS:
            self.listen(topic, self._on_target, expected=False)
        wire.subscribe(self, 'supervisor/state', self._on_mode)
        wire.subscribe(self, 'supervisor/target', partial(setattr, self._host, 'override'))
        wire.subscribe(self, 'supervisor/actuators', self._host.on_health)
        self.track_compute(controller.period)
        self.report('controller', self._controller_status)

    def _on_joints(self, joints):
        if not np.isnan(joints.position).any():     # a bridge has lost a servo for the moment
            self._joints = joints.corrected(self._sensors)

    def _check_target(self, target, published):
        # The age counts at publication: a latched target stays valid for a node that starts
        # later. Publication times are system time, so simulated stamps have no age.
        then = None if self.simulated or math.isnan(published) else published
        reason = self._checks.why_not(target, then) or (
            self._host.too_far(target, self.now()) if self._host.active else '')
        if reason:
            raise MessageError(reason, 'cannot be flown')

    def _on_target(self, target, published):
        self._check_target(target, published)
        now = self.now()
        if target.stamp == 0.0:     # `ros2 topic pub` sets no stamp: valid from now on
            target = replace(target, stamp=now, **(
                {} if isinstance(target, PoseTarget) else {'times': target.times + now}))
        elif target.stamp > now:    # a clock that is ahead must not make it outlast later targets
            target = replace(target, stamp=now)
        # Latched and volatile copies may overtake each other: the newest stamp counts, except
        # after the clock was set back.
        old = self._host.target
        if old is None or not target.stamp < old.stamp <= now:
            self._host.target = target

    def _on_mode(self, mode):
        if mode.partition(':')[0] in MOTORS_OFF:
            self._command = None
        if reason := self._host.on_mode(mode, self.now()):
            self.reject('target_pose', f'{reason}; the present pose is held',
                                 'cannot be flown')

    def _on_odom(self, odom):
        self._host.on_estimate(odom)
        since = odom.stamp - self._last_step        # < 0: the clock was set back
        if self._joints is None or 0 <= since < self._host.controller.period - STEP_TOLERANCE:
            return
        self._last_step = odom.stamp
        command = self._host.step(State.join(odom, self._joints, self._command))
        if command is not None:
            self._publisher.publish(command)

    def _controller_status(self):
        host, controller = self._host, self._host.controller
        report = host.call('diagnostics') or {}
        new, self._reported_errors = host.errors - self._reported_errors, host.errors
        values = {**report, 'guidance': guidance_of(controller)}
        if host.errors:
            values['errors'] = host.errors
        if new:
            return ERROR, host.error, values
        return OK, getattr(controller, 'name', self._entry.name), values


# --- supervisor ---------------------------------------------------------------------------------

class SupervisorNode(FlightNode):
    """
    Publishes command, the only topic that actuators execute, and supervisor/state (latched).

    Services ~/arm, ~/disarm, ~/land and ~/emergency_stop; the parameter controller selects the
    active controller, also in flight.
    """

    def __init__(self):
        controllers = parameter(
            registry.STANDING_BY,
            doc='controllers that may be active: registered names, or FILE.py:Class')
        super().__init__('supervisor_node', SupervisorParameters, 'params/supervisor.yaml',
                         'supervisor_file', self._changed, changeable=('controller',),
                         controllers=controllers, robot_file=file_parameter())
        robot = RobotParameters.load(self.parameters.robot_file or None)
        self._sensors = robot.sensors
        self._controllers = [registry.find(name).name if ':' in name else name
                             for name in self.parameters.controllers]
        if self.parameters.controller not in self._controllers:
            raise ParameterError(f"key 'controller': expected one of "
                                 f"{', '.join(self._controllers)}, found "
                                 f"'{self.parameters.controller}'")
        self._supervisor = Supervisor(self.parameters, robot, HoverController(robot),
                                      self._controllers)
        self._joints = None
        self._sent = (None, '')     # stamp and source of the last command
        self._publisher = wire.Publisher(self, 'command')
        self._identity = f'supervisor_node:{secrets.token_hex(4)}'      # of this run of the node
        self._identities = wire.Publisher(self, IDENTITY)
        self._identities.publish(self._identity)
        self._states = wire.Publisher(self, 'supervisor/state')
        self._targets = wire.Publisher(self, 'supervisor/target')
        self._actuators = wire.Publisher(self, 'supervisor/actuators')
        supervisor = self._supervisor
        self.listen('odom', self._on_odom)
        self.listen('joint_states', self._on_joints, max_age=SENSOR_AGE)
        self.listen('imu/data_raw', lambda s: supervisor.on_imu(
            s.stamp, s.specific_force, s.angular_velocity), max_age=SENSOR_AGE)
        self.listen('mocap/pose', lambda s: supervisor.on_mocap(
            s.stamp, s.position, s.quaternion), max_age=SENSOR_AGE)
        self.listen('rotor_states', lambda r: supervisor.on_rotors(r.stamp, r.speed),
                    expected=False)
        self.listen('battery_state', lambda battery: supervisor.on_battery(battery.voltage))
        for name in self._controllers:
            self.listen(f'{name}/command', partial(self._on_command, name), expected=False)
        for name in ('joint', 'rotor'):
            wire.subscribe(self, f'{name}_bridge/state', partial(self._on_bridge, name))
        for name in ('arm', 'disarm', 'land', 'emergency_stop'):
            self.create_service(Trigger, f'~/{name}', partial(self._on_request, name))
        self.report('supervisor', self._supervisor_status)
        self.create_timer(WATCH_PERIOD, self._update, clock=self.flight_clock)
        self._update()

    def _changed(self, new):
        answer = self._supervisor.select(new.controller, self.now())
        self._publish_states()
        if not answer:
            raise ParameterError(f"key 'controller': {answer.text}")

    def _on_request(self, name, _, response):
        answer = getattr(self._supervisor, name)(self.now())
        self._update()
        response.success, response.message = bool(answer), answer.text
        return response

    def _on_joints(self, joints):
        joints = joints.corrected(self._sensors)
        if not np.isnan(joints.position).any():
            self._joints = joints
        self._supervisor.on_joints(joints.stamp, joints.position, joints.velocity)

    def _on_odom(self, odom):
        if self._joints is None:
            return
        self._supervisor.on_state(State.join(odom, self._joints), self.now())
        if self._supervisor.state not in (DISARMED, FLYING):
            self._update()      # the fallback controller answers each estimate

    def _on_command(self, name, command):
        supervisor = self._supervisor
        accepted = supervisor.on_command(name, command, self.now())
        if accepted and name == supervisor.active and supervisor.state == FLYING:
            self._update()      # at once, not at the next timer

    def _on_bridge(self, name, text):
        self._supervisor.on_actuators(name, text, self.now())
        self._update()

    def _update(self):
        supervisor = self._supervisor
        command = supervisor.update(self.now())
        # A command is not repeated: the actuators detect missing commands by the age.
        if command is not None and (command.stamp, supervisor.source) != self._sent:
            self._sent = (command.stamp, supervisor.source)
            self._publisher.publish(command, self._identity)
        self._publish_states()

    def _publish_states(self):
        supervisor = self._supervisor
        self._states.update(supervisor.reported_state)
        self._targets.update(supervisor.target_override)
        self._actuators.update(supervisor.health)
        for event in supervisor.events:
            self.log_line(event.severity, event.text)
        supervisor.events.clear()

    def _supervisor_status(self):
        supervisor = self._supervisor
        level = {FALLBACK: WARN, STOPPED: ERROR}.get(
            supervisor.state, WARN if supervisor.faults else OK)
        named = ', '.join(supervisor.faults)
        state = self._states.value
        return level, f'{state}; faults: {named}' if named else state, \
            supervisor.diagnostics()
