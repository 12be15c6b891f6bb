"""Arming, selection, checks and fallback between the controllers and the actuators."""

from __future__ import annotations

from dataclasses import dataclass

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
import numpy as np
from sensor_msgs.msg import BatteryState, Imu, JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import State
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.nodes import convert, health, qos, runner, targets
from beetle_omni_ros.nodes.command_source import new_identity, TOPIC
from beetle_omni_ros.nodes.node import FlightNode
from beetle_omni_ros.robot.actuator_health import ALL_WELL
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import NAMES, parameter, ParameterError
from beetle_omni_ros.safety.events import ERROR, WARNING
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.supervisor import DISARMED, FALLBACK, FLYING, STOPPED, Supervisor

WATCH_PERIOD = 0.01     # s between looks at what is silent
SENSOR_AGE = 0.2        # s, the descent without estimator uses nothing older
LEVELS = {FALLBACK: health.WARN, STOPPED: health.ERROR}


@dataclass(frozen=True, kw_only=True)
class SupervisorNodeParameters(SupervisorParameters):
    """Parameters of supervisor_node: the supervisor's own and the robot."""

    controllers: NAMES = parameter(
        tuple(registry.standing_by()), read_only=True,
        doc='those that may be active: registered names, or package.module:Class')
    robot_file: str = parameter('', doc='robot file; empty: the shipped one', read_only=True)
    supervisor_file: str = parameter(
        '', doc='file to start from; empty: the shipped params/supervisor.yaml', read_only=True)


class SupervisorNode(FlightNode):
    """
    Publishes command, the only topic that actuators obey, and supervisor/state (latched).

    Services ~/arm, ~/disarm, ~/land and ~/emergency_stop; the parameter controller selects
    the active controller, also in flight.
    """

    real_time = True

    def __init__(self):
        """Begin disarmed."""
        super().__init__('supervisor_node', SupervisorNodeParameters, 'params/supervisor.yaml',
                         'supervisor_file', self._changed, changeable=('controller',))
        robot = RobotParameters.load(self.parameters.robot_file or None)
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
        self._publisher = self.create_publisher(JointState, 'command', qos.COMMAND)
        self._identity = new_identity('supervisor_node')
        self._identities = self.create_publisher(String, TOPIC, qos.LATCHED)
        self._identities.publish(String(data=self._identity))
        self._states = self.create_publisher(String, 'supervisor/state', qos.LATCHED)
        self._targets = self.create_publisher(MultiDOFJointTrajectory, 'supervisor/target',
                                              qos.LATCHED)
        self._actuators = self.create_publisher(JointState, 'supervisor/actuators', qos.LATCHED)
        self._wish, self._healthy = None, ALL_WELL
        self._listen()
        for name in ('arm', 'disarm', 'land', 'emergency_stop'):
            self.create_service(Trigger, f'~/{name}', self._request(name))
        self.health.report('supervisor', self._supervisor_status)
        self.create_timer(WATCH_PERIOD, self._update, clock=self.flight_clock)
        self._update()

    def waits_for(self):
        """The sensors, the operator."""
        return f'{super().waits_for()}; then for ~/arm'

    def _listen(self):
        supervisor = self._supervisor
        self.listen(Odometry, 'odom', convert.odom, self._on_odom, qos.ESTIMATE)
        self.listen(JointState, 'joint_states', convert.known_joints, self._on_joints,
                    max_age=SENSOR_AGE)
        self.listen(Imu, 'imu/data_raw', convert.imu_sample, lambda s: supervisor.on_imu(
            s.stamp, s.specific_force, s.angular_velocity), max_age=SENSOR_AGE)
        self.listen(PoseStamped, 'mocap/pose', convert.pose_sample, lambda s: supervisor.on_mocap(
            s.stamp, s.position, s.quaternion), max_age=SENSOR_AGE)
        self.listen(JointState, 'rotor_states', convert.rotors,
                    lambda told: supervisor.on_rotors(told.stamp, told.speed), stale_after=None)
        self.listen(BatteryState, 'battery_state', convert.battery,
                    lambda b: supervisor.on_battery(b.voltage))
        for name in self._controllers:
            self.listen(JointState, f'{name}/command', convert.command, self._on_command(name),
                        qos.COMMAND, stale_after=None)
        for name in ('joint', 'rotor'):
            self.create_subscription(String, f'{name}_bridge/state', self._on_bridge(name),
                                     qos.LATCHED)

    def _changed(self, new):
        answer = self._supervisor.select(new.controller, self.now())
        self._tell()
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
        if not np.isnan(joints.position).any():
            self._joints = joints
        self._supervisor.on_joints(joints.stamp, joints.position, joints.velocity)

    def _on_odom(self, odom):
        joints = self._joints
        if joints is None:
            return
        self._supervisor.on_state(State(
            odom.stamp, odom.position, odom.velocity, odom.quaternion, odom.angular_velocity,
            joints.position, joints.velocity, joints.stamp))
        if self._supervisor.state not in (DISARMED, FLYING):
            self._update()      # hover answers each estimate, as a controller does

    def _on_command(self, name):
        def handle(command):
            supervisor = self._supervisor
            accepted = supervisor.on_command(name, command, self.now())
            if accepted and name == supervisor.active and supervisor.state == FLYING:
                self._update()      # on with it at once, not at the next look
        return handle

    def _on_bridge(self, name):
        def handle(message):
            self._supervisor.on_actuators(name, message.data, self.now())
            self._update()
        return handle

    def _update(self):
        supervisor = self._supervisor
        command = supervisor.update(self.now())
        # The same command is not repeated: its age tells the actuators that nothing new came.
        if command is not None and (command.stamp, supervisor.source) != self._sent:
            self._sent = (command.stamp, supervisor.source)
            self._publisher.publish(convert.command_message(command, self._identity))
        self._tell()

    def _tell(self):
        supervisor = self._supervisor
        state = supervisor.told
        if state != self._state:
            self._state = state
            self._states.publish(String(data=state))
        if supervisor.wish is not self._wish:
            self._wish = supervisor.wish
            self._targets.publish(targets.wish_message(self._wish))
        if supervisor.health is not self._healthy:
            self._healthy = supervisor.health
            self._actuators.publish(convert.health_message(self.now(), self._healthy))
        for event in supervisor.events:
            self._log(event)
        supervisor.events.clear()

    def _log(self, event):
        # One call for each severity: rclpy ties a severity to the line of the call.
        logger = self.get_logger()
        if event.severity == ERROR:
            logger.error(event.text)
        elif event.severity == WARNING:
            logger.warning(event.text)
        else:
            logger.info(event.text)

    def _supervisor_status(self):
        supervisor = self._supervisor
        told = supervisor.diagnostics()
        for name, at in supervisor.faults.items():
            told[f'fault.{name}'] = f'{at:.3f}'     # [s]: six digits of a stamp tell nothing
        level = LEVELS.get(supervisor.state, health.WARN if supervisor.faults else health.OK)
        named = ', '.join(supervisor.faults)
        return level, f'{self._state}; faults: {named}' if named else self._state, told


def main(args=None):
    """Run the node."""
    runner.main(SupervisorNode, args)


if __name__ == '__main__':
    main()
