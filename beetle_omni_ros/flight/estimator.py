"""The state estimator as a component."""

from functools import partial

from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.flight.component import Component, ERROR, OK, WARN
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.supervisor.events import INFO

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
