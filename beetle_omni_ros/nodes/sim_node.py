"""The simulated robot in real time: sensors out, commands in."""

from __future__ import annotations

from dataclasses import dataclass, replace
import time

from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import BatteryState, Imu, JointState

from beetle_omni_ros.nodes import convert, health, qos, runner
from beetle_omni_ros.nodes.node import FlightNode
from beetle_omni_ros.nodes.pacing import Pacing
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import parameter
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.simulator import Simulator

COMMAND_AGE = 0.1       # s, older commands are not executed


@dataclass(frozen=True, kw_only=True)
class SimNodeParameters:
    """Parameters of sim_node."""

    robot_file: str = parameter(
        '', doc='robot file that is true in the simulation; empty: the shipped one',
        read_only=True)
    simulator_file: str = parameter(
        '', doc='simulator file; empty: the shipped one', read_only=True)
    conditions: str = parameter('nominal', choices=('nominal', 'published'), read_only=True,
                                doc='randomisation of plant and sensors')
    seed: int = parameter(0, doc='of every random number', low=0, high=2**31 - 1,
                          read_only=True)
    actuators: str = parameter('direct', choices=('direct',), read_only=True,
                               doc='how commands reach the plant')
    payload: float = parameter(0.0, doc='mass attached below the body', unit='kg', low=0, high=2)


class SimNode(FlightNode):
    """Steps the simulator on the steady clock, stamps its readings in ROS time."""

    real_time = True

    def __init__(self):
        """Build the plant at rest on the ground."""
        super().__init__('sim_node', SimNodeParameters, on_change=self._changed)
        given = self.parameters
        self._robot = RobotParameters.load(given.robot_file or None)
        self._simulator = Simulator(
            self._robot, SimulatorParameters.load(given.simulator_file or None),
            conditions=given.conditions, seed=given.seed)
        self._simulator.set_payload(given.payload)
        self._pacing = Pacing(self._simulator.tick, time.monotonic, self.now)
        self._latency = health.Distribution()
        self._publish_to = {
            'mocap': self.create_publisher(PoseStamped, 'mocap/pose', qos.SENSOR),
            'imu': self.create_publisher(Imu, 'imu/data_raw', qos.SENSOR),
            'truth': self.create_publisher(Odometry, 'ground_truth/odom', qos.ESTIMATE),
            'joints': self.create_publisher(JointState, 'joint_states', qos.SENSOR),
            'battery': self.create_publisher(BatteryState, 'battery_state', qos.SENSOR)}
        self.listen(JointState, 'command', convert.command, self._on_command, qos.COMMAND,
                    max_age=COMMAND_AGE)
        self.listen(WrenchStamped, 'disturbance', convert.wrench, self._on_wrench, qos.EVENT,
                    stale_after=None)
        self.health.track_compute(self._simulator.tick)
        self.health.report('pacing', self._pacing_status)
        self.health.report('latency', self._latency_status)
        self.create_timer(self._simulator.tick, self._on_timer, clock=self.steady_clock)

    def _changed(self, new):
        self._simulator.set_payload(new.payload)
        self.get_logger().info(f'payload {new.payload:g} kg')

    def _on_timer(self):
        for _ in range(self._pacing.due()):
            self._publish(self.timed(self._simulator.step))

    def _publish(self, frame):
        epoch, publish_to = self._pacing.epoch, self._publish_to
        # What is old already goes first, so that the estimate that the IMU sample triggers has it.
        if frame.mocap is not None:
            publish_to['mocap'].publish(convert.pose_message(
                epoch + frame.mocap.stamp, frame.mocap.position, frame.mocap.quaternion))
        if frame.joints is not None:
            publish_to['joints'].publish(convert.joint_message(
                epoch + frame.joints.stamp, frame.joints.position, frame.joints.velocity,
                frame.joints.effort))
        if frame.imu is not None:
            publish_to['imu'].publish(convert.imu_message(
                replace(frame.imu, stamp=epoch + frame.imu.stamp)))
        truth = frame.truth
        publish_to['truth'].publish(convert.odometry_message(
            epoch + truth.stamp, truth.position, truth.velocity, truth.quaternion,
            truth.angular_velocity))
        if frame.battery is not None:
            publish_to['battery'].publish(convert.battery_message(
                epoch + frame.battery.stamp, frame.battery.voltage, frame.battery.current,
                self._robot.battery.cells))

    def _on_command(self, command):
        self._latency.add(self.now() - command.stamp)
        if self._pacing.started:
            self._simulator.command(replace(command, stamp=command.stamp - self._pacing.epoch))

    def _on_wrench(self, wrench):
        self._simulator.set_wrench(wrench.force, wrench.torque)

    def _pacing_status(self):
        pacing = self._pacing
        level = health.WARN if pacing.lost_ticks else health.OK
        return level, f'{pacing.lost_ticks} ticks lost', {
            'ticks': pacing.ticks, 'lost_ticks': pacing.lost_ticks,
            'clock_steps': pacing.clock_steps, 'simulated_s': self._simulator.time}

    def _latency_status(self):
        times = self._latency
        return health.OK, 'stamp of the answered IMU sample to the arrival of its command', {
            'median_ms': 1e3 * times.quantile(0.5), 'p99_ms': 1e3 * times.quantile(0.99),
            'max_ms': 1e3 * times.max, 'count': times.count}


def main(args=None):
    """Run the node."""
    runner.main(SimNode, args)


if __name__ == '__main__':
    main()
