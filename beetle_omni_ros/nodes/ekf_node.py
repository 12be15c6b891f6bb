"""ROS node of the state estimator."""

from dataclasses import dataclass

from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.estimation.state import pose_covariance, twist_covariance
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.nodes.node import ERROR, FlightNode, OK, WARN
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import parameter

SENSOR_AGE = 0.2        # s, an older sample is of a stuck driver or another clock


@dataclass(frozen=True, kw_only=True)
class EkfNodeParameters(EkfParameters):
    """Parameters of ekf_node: the estimator's parameters and the files."""

    robot_file: str = parameter('', doc='robot file; empty: the shipped one', read_only=True)
    ekf_file: str = parameter(
        '', doc='estimator file to start from; empty: the shipped params/ekf.yaml',
        read_only=True)


class EkfNode(FlightNode):
    """Publishes odom for every IMU sample, corrected by MoCap poses at their capture time."""

    real_time = True

    def __init__(self):
        super().__init__('ekf_node', EkfNodeParameters, 'params/ekf.yaml', 'ekf_file')
        robot = RobotParameters.load(self.parameters.robot_file or None)
        self._ekf = ErrorStateEkf(self.parameters.of_robot(robot), robot.gravity)
        self._status = self._ekf.status
        self._publisher = self.publisher('odom')
        self.listen('imu/data_raw', self._on_imu, max_age=SENSOR_AGE)
        self.listen('mocap/pose', self._on_pose, max_age=SENSOR_AGE)
        self.health.track_compute(1 / self.parameters.imu.rate)
        self.health.report('estimator', self._estimator_status)

    def _on_pose(self, sample):
        self.timed(self._ekf.pose, sample)

    def _on_imu(self, sample):
        accepted = self.timed(self._ekf.imu, sample)
        status = self._ekf.status
        if status != self._status:
            self.get_logger().info(f'{self._status} -> {status}')
            self._status = status
        # A lost estimate is not published: the readers detect the missing messages.
        if accepted and status in ('tracking', 'dead_reckoning'):
            self._publish(self._ekf.estimate)

    def _publish(self, estimate):
        self._publisher.publish(Odom.of(
            estimate, pose_covariance(estimate),
            twist_covariance(estimate, self.parameters.imu.gyroscope_noise)))

    def _estimator_status(self):
        level = {'tracking': OK, 'dead_reckoning': WARN, 'lost': ERROR}
        values = {f'rejected: {reason}': count for reason, count in self._ekf.rejected.items()}
        return level.get(self._status, OK), self._status, values
