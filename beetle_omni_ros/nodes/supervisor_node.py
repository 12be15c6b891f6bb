"""ROS node of the supervisor, between the controllers and the actuators."""

from dataclasses import dataclass

import numpy as np
from std_srvs.srv import Trigger

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import State
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.messages.conversions import take_known_joints
from beetle_omni_ros.messages.values import HealthReport, TargetOverride
from beetle_omni_ros.nodes.node import ERROR, FlightNode, IDENTITY, new_identity, OK, WARN
from beetle_omni_ros.robot.allocation import ALL_HEALTHY
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import NAMES, parameter, ParameterError
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.supervisor import DISARMED, FALLBACK, FLYING, STOPPED, Supervisor

WATCH_PERIOD = 0.01     # s between checks for silent inputs
SENSOR_AGE = 0.2        # s, the descent without estimator uses no older sample
LEVELS = {FALLBACK: WARN, STOPPED: ERROR}


@dataclass(frozen=True, kw_only=True)
class SupervisorNodeParameters(SupervisorParameters):
    """Parameters of supervisor_node: the supervisor's parameters, controllers and files."""

    controllers: NAMES = parameter(
        tuple(registry.standing_by()), read_only=True,
        doc='controllers that may be active: registered names, or FILE.py:Class')
    robot_file: str = parameter('', doc='robot file; empty: the shipped one', read_only=True)
    supervisor_file: str = parameter(
        '', doc='supervisor file; empty: the shipped params/supervisor.yaml', read_only=True)


class SupervisorNode(FlightNode):
    """
    Publishes command, the only topic that actuators execute, and supervisor/state (latched).

    Services ~/arm, ~/disarm, ~/land and ~/emergency_stop; the parameter controller selects the
    active controller, also in flight.
    """

    real_time = True

    def __init__(self):
        super().__init__('supervisor_node', SupervisorNodeParameters, 'params/supervisor.yaml',
                         'supervisor_file', self._changed, changeable=('controller',))
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
        self._state = ''
        self._publisher = self.publisher('command')
        self._identity = new_identity('supervisor_node')
        self._identities = self.publisher(IDENTITY)
        self._identities.publish(self._identity)
        self._states = self.publisher('supervisor/state')
        self._targets = self.publisher('supervisor/target')
        self._actuators = self.publisher('supervisor/actuators')
        self._override, self._health = None, ALL_HEALTHY
        self._listen()
        for name in ('arm', 'disarm', 'land', 'emergency_stop'):
            self.create_service(Trigger, f'~/{name}', self._request(name))
        self.health.report('supervisor', self._supervisor_status)
        self.create_timer(WATCH_PERIOD, self._update, clock=self.flight_clock)
        self._update()

    def waits_for(self):
        """Return the missing sensors and the arming."""
        return f'{super().waits_for()}; then for ~/arm'

    def _listen(self):
        supervisor = self._supervisor
        self.listen('odom', self._on_odom)
        self.listen('joint_states', self._on_joints, read=take_known_joints, max_age=SENSOR_AGE)
        self.listen('imu/data_raw', lambda s: supervisor.on_imu(
            s.stamp, s.specific_force, s.angular_velocity), max_age=SENSOR_AGE)
        self.listen('mocap/pose', lambda s: supervisor.on_mocap(
            s.stamp, s.position, s.quaternion), max_age=SENSOR_AGE)
        self.listen('rotor_states', lambda r: supervisor.on_rotors(r.stamp, r.speed),
                    stale_after=None)
        self.listen('battery_state', lambda battery: supervisor.on_battery(battery.voltage))
        for name in self._controllers:
            self.listen(f'{name}/command', self._on_command(name), stale_after=None)
        for name in ('joint', 'rotor'):
            self.follow(f'{name}_bridge/state', self._on_bridge(name))

    def _changed(self, new):
        answer = self._supervisor.select(new.controller, self.now())
        self._publish_states()
        if not answer:
            raise ParameterError(f"key 'controller': {answer.text}")

    def _request(self, name):
        def handle(_, response):
            answer = getattr(self._supervisor, name)(self.now())
            self._update()
            response.success, response.message = bool(answer), answer.text
            return response
        return handle

    def _on_joints(self, joints):
        joints = joints.corrected(self._sensors)
        if not np.isnan(joints.position).any():
            self._joints = joints
        self._supervisor.on_joints(joints.stamp, joints.position, joints.velocity)

    def _on_odom(self, odom):
        if self._joints is None:
            return
        self._supervisor.on_state(State.join(odom, self._joints))
        if self._supervisor.state not in (DISARMED, FLYING):
            self._update()      # the fallback controller answers each estimate

    def _on_command(self, name):
        def handle(command):
            supervisor = self._supervisor
            accepted = supervisor.on_command(name, command, self.now())
            if accepted and name == supervisor.active and supervisor.state == FLYING:
                self._update()      # at once, not at the next timer
        return handle

    def _on_bridge(self, name):
        def handle(text):
            self._supervisor.on_actuators(name, text, self.now())
            self._update()
        return handle

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
        state = supervisor.reported_state
        if state != self._state:
            self._state = state
            self._states.publish(state)
        if supervisor.target_override is not self._override:
            self._override = supervisor.target_override
            self._targets.publish(TargetOverride.of(self._override))
        if supervisor.health is not self._health:
            self._health = supervisor.health
            self._actuators.publish(HealthReport(self.now(), self._health))
        for event in supervisor.events:
            self.log_line(event.severity, event.text)
        supervisor.events.clear()

    def _supervisor_status(self):
        supervisor = self._supervisor
        values = supervisor.diagnostics()
        for name, at in supervisor.faults.items():
            values[f'fault.{name}'] = f'{at:.3f}'     # [s]: six digits are too few for a stamp
        level = LEVELS.get(supervisor.state, WARN if supervisor.faults else OK)
        named = ', '.join(supervisor.faults)
        return level, f'{self._state}; faults: {named}' if named else self._state, values
