"""
Error-state EKF: IMU prediction and MoCap correction at capture time.

The guard checks the inputs, and a track is one hypothesis of the motion. The first track, or a new
one after a long dropout or a lasting jump, is a candidate until enough poses agree with it and the
IMU. This includes gravity: an IMU with wrong axes or units predicts another motion.
"""

from bisect import bisect_right
from collections import deque
from operator import attrgetter

import numpy as np

from beetle_omni_ros.estimation.inputs import DELAY_LIMIT, GAP, InputGuard, NoiseMonitor
from beetle_omni_ros.estimation.model import ErrorStateModel, MEASUREMENTS
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.estimation.state import Estimate, Node, POSITION, propagate, SAME_INSTANT
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.readings import ImuReading, PoseReading
from beetle_omni_ros.model.rotations import geodesic_angle

DEAD_RECKONING, LOST = 0.1, 20.0    # [s] without an accepted pose until these states
WITHOUT_POSES = 0.15        # [s] until markers do not define the attitude; a MoCap has 10 Hz
LOST_POSITION_STD = 5.0     # [m] of the position, each axis, above which the state is lost
ALIGNED = 0.8   # least cosine between residuals of one cause; 3 % of random pairs in 6-D reach it
START_POSES = 20    # in a row that must agree with the IMU before the first fix, and when lost
JUMP_POSES = 100    # that must agree with the IMU and each other before a jump is followed
JUMP_ATTITUDE = 0.35    # [rad] largest jump that is followed; the gyroscope rules out larger ones
# Poses that contradict the IMU, and not each other: number of the first, and the time [s] in which
# one suffices afterwards. Further steps from the last good pose are jumps of the MoCap: distance
# [m] and angle [rad], and their increase for each second since [m/s], [rad/s].
DOUBT_POSES, DOUBT_TIME = 3, 1.0
DISTANCE, ANGLE, SPEED, RATE = 0.05, 0.05, 2.0, 8.0
STAMP = attrgetter('stamp')
VELOCITY_KNOWN = 5  # poses after which the velocity is known, so that the time can be uncertain


def interpolate(stamp, before, after) -> tuple[np.ndarray, np.ndarray]:
    """Force and rate at ``stamp``, linear between two readings (stamp, force, rate)."""
    share = (stamp - before[0]) / (after[0] - before[0])
    return (before[1] + share * (after[1] - before[1]),
            before[2] + share * (after[2] - before[2]))


class Track:
    """
    States from the last correction, or from the largest age of a pose, to the newest reading.

    A pose is applied to the state at its capture time. The later readings are then replayed, so
    that the result is the same as without the delay.
    """

    def __init__(self, model: ErrorStateModel, first: Node, time_deviation: float):
        """Start with one state, whose time offset has a standard deviation [s]."""
        self._time_deviation = time_deviation
        self._model = model
        self.nodes = [first]
        self.last_fix = first.stamp
        self.fixes, self.reckons = 1, False

    def predict(self, stamp: float, force: np.ndarray, rate: np.ndarray) -> None:
        """Append the state at the next reading."""
        nodes = self.nodes
        nodes.append(propagate(nodes[-1], stamp, force, rate, self._model.gravity))
        while nodes[1].stamp < stamp - DELAY_LIMIT:
            del nodes[0]
            self._model.covariance(nodes[0])    # otherwise it would keep its predecessors
        if not self.reckons and stamp - self.last_fix > WITHOUT_POSES:
            self.reckons = True
            self._replay(self._model.without_marker_error(nodes[0]), nodes[1:])

    def _replay(self, first: Node, later: list[Node]) -> None:
        """Begin the history anew with a node, and predict it through the later readings."""
        self.nodes = [first]
        for node in later:
            self.nodes.append(propagate(self.nodes[-1], node.stamp, node.force, node.rate,
                                        self._model.gravity))

    def correct(self, stamp: float, position: np.ndarray, quaternion: np.ndarray,
                doubt_span: float = 0.0) -> bool:
        """
        Apply a pose at its capture time and replay the later readings.

        Args:
            stamp: capture time [s], not after the newest node; at least the oldest node's is used.
            position: (3,) of the marker body in world [m].
            quaternion: (4,) marker body to world.
            doubt_span: duration for which the IMU may have been wrong [s], 0: not at all.

        Returns:
            False if the pose fails the gate; the track is then unchanged.

        """
        nodes = self.nodes
        stamp = max(stamp, nodes[0].stamp)
        index = bisect_right(nodes, stamp + SAME_INSTANT, key=STAMP) - 1
        prior = nodes[index]
        if stamp - prior.stamp > SAME_INSTANT:
            after = nodes[index + 1]
            prior = propagate(prior, stamp, *interpolate(
                stamp, (prior.stamp, prior.force, prior.rate),
                (after.stamp, after.force, after.rate)), self._model.gravity)
        if doubt_span:
            prior = self._model.doubt(prior, doubt_span)
        posterior = self._model.correct(prior, position, quaternion)
        if posterior is None:
            return False
        self.fixes += 1
        if self.fixes == VELOCITY_KNOWN:
            self._model.add_time_uncertainty(posterior, self._time_deviation)
        self._replay(posterior, nodes[index + 1:])
        self.last_fix, self.reckons = stamp, False
        return True


class ErrorStateEkf:
    """Position, velocity, attitude and IMU biases of base_link, at any attitude."""

    def __init__(self, parameters: EkfParameters, gravity: float):
        """Construct the filter without a state; ``gravity`` [m/s^2] along world -z."""
        self._parameters = parameters
        self._model = ErrorStateModel(parameters, gravity)
        imu = parameters.imu
        self._axes = rotations.matrix(rotations.exp(imu.rotation))
        self._known_biases = imu.accelerometer_bias, imu.gyroscope_bias
        self.reset()

    def reset(self) -> None:
        """Return to the state before the first sample."""
        self._guard = InputGuard(self._parameters)
        self.rejected = self._guard.rejected    # reason -> number of inputs refused for it
        self._noise = NoiseMonitor(self._parameters.mocap)
        self._readings: deque = deque()     # (stamp, force, rate), base_link axes
        self._early: deque = deque()     # poses captured after the newest IMU sample
        self._track: Track | None = None
        self._candidate: Track | None = None
        self._estimate: Estimate | None = None
        self._good_pose: tuple | None = None    # last used one: stamp, position, quaternion
        self._contradictions, self._doubt_until = 0, -np.inf
        self._residual = np.zeros(MEASUREMENTS)     # of the last refused pose, in deviations

    @property
    def status(self) -> str:
        """'uninitialised', 'tracking', 'dead_reckoning' or 'lost' at the newest IMU sample."""
        if self._track is None:
            return 'uninitialised'
        newest = self._track.nodes[-1]
        age = newest.stamp - self._track.last_fix
        if age <= DEAD_RECKONING:
            return 'tracking'
        variance = max(np.diag(self._model.covariance(newest))[POSITION])
        if age > LOST or not variance <= LOST_POSITION_STD ** 2:
            return 'lost'
        return 'dead_reckoning'

    @property
    def estimate(self) -> Estimate | None:
        """State at the newest IMU sample; None while uninitialised."""
        if self._estimate is None and self._track is not None:
            self._estimate = self._model.estimate(self._track.nodes[-1], self._readings)
        return self._estimate

    def imu(self, sample: ImuReading) -> bool:
        """
        Predict to the stamp of a sample.

        Returns:
            False if it was refused; ``rejected`` counts the reason.

        """
        checked = self._guard.reading(sample)
        if checked is None and self._guard.clock_jumped:
            rejected = self.rejected
            self.reset()
            self.rejected.update(rejected)
            checked = self._guard.reading(sample)
        if checked is None:
            return False
        stamp, force, rate = checked
        reading = (stamp, self._axes.dot(force - self._known_biases[0]),
                   self._axes.dot(rate - self._known_biases[1]))
        self._estimate = None
        self._readings.append(reading)
        while self._readings[0][0] < stamp - DELAY_LIMIT:
            self._readings.popleft()
        for track in (self._track, self._candidate):
            if track is not None:
                track.predict(*reading)
        while self._early and self._early[0][0] <= stamp + SAME_INSTANT:
            self._apply(*self._early.popleft())
        return True

    def pose(self, sample: PoseReading) -> bool:
        """
        Correct the state at the capture time of a MoCap pose.

        A pose slightly ahead of the newest IMU sample is applied when the IMU has reached it.

        Returns:
            False if it was refused; ``rejected`` counts the reason.

        """
        checked = self._guard.pose(sample, self._readings[0][0] if self._readings else 0.0)
        if checked is None:
            return False
        self._noise.add(*checked)
        # to the clock of the IMU, by the estimate of the leading track
        leader = self._track or self._candidate
        offset = leader.nodes[-1].time_offset if leader is not None else 0.0
        stamp = max(checked[0] + offset, self._readings[0][0])
        if stamp > self._readings[-1][0] + SAME_INSTANT:
            self._early.append((stamp, *checked[1:]))
            return True
        return self._apply(stamp, *checked[1:])

    def _apply(self, stamp, position, quaternion) -> bool:
        self._estimate = None
        self._model.filter.R = self._noise.covariance
        track = self._track if self.status in ('tracking', 'dead_reckoning') else None
        candidate = self._candidate
        if track is not None:
            if track.correct(stamp, position, quaternion) \
                    or self._corrected_with_doubt(track, stamp, position, quaternion):
                self._candidate, self._contradictions = None, 0
                self._good_pose = stamp, position, quaternion
                return True
            self.rejected['outlier'] += 1
        if candidate is not None and candidate.correct(stamp, position, quaternion):
            if candidate.fixes >= (START_POSES if track is None else JUMP_POSES):
                before = (track or candidate).nodes[-1].quaternion
                if geodesic_angle(before, candidate.nodes[-1].quaternion) > JUMP_ATTITUDE:
                    self.rejected['attitude_jump'] += 1
                else:
                    self._track, self._candidate = candidate, None
            return track is None
        # The known biases are used once; if they contradict the poses, start without them.
        known = self._track.nodes[-1] if candidate is None and self._track is not None else None
        self._candidate = self._started(stamp, position, quaternion, known)
        if track is None and candidate is not None:
            self.rejected['inconsistent_start'] += 1
        return track is None and candidate is None

    def _corrected_with_doubt(self, track: Track, stamp, position, quaternion) -> bool:
        """Use a refused pose if the poses contradict the IMU but not each other."""
        # Such poses continue smoothly from the last good one, and their residuals have the same
        # direction. The residuals of poses that are only noisy do not.
        before, self._residual = self._residual, np.ravel(
            self._model.filter.y) / np.sqrt(np.diag(self._model.filter.R))
        lengths = float(np.linalg.norm(before) * np.linalg.norm(self._residual))
        aligned = float(before @ self._residual) > ALIGNED * lengths
        smooth = self._continues_smoothly(track, stamp, position, quaternion)
        self._contradictions = 0 if not smooth else self._contradictions + 1 if aligned else 1
        if not aligned:
            return False
        needed = 1 if stamp < self._doubt_until else DOUBT_POSES
        if self._contradictions < needed:
            return False
        self._doubt_until = stamp + DOUBT_TIME
        self.rejected['imu_contradicts'] += 1
        since = stamp - self._good_pose[0] if self._good_pose is not None else 0.0
        return track.correct(stamp, position, quaternion, doubt_span=since)

    def _continues_smoothly(self, track: Track, stamp, position, quaternion) -> bool:
        """Whether a pose continues smoothly from the last good one."""
        if self._good_pose is None:
            return False
        before, from_position, from_quaternion = self._good_pose
        dt = stamp - before
        if not 0 < dt <= GAP:
            return False
        node = track.nodes[-1]
        step = position - from_position - dt * node.velocity
        was, now = (rotations.multiply(q, self._model.marker_to_base)
                    for q in (from_quaternion, quaternion))
        turned = rotations.multiply(was, rotations.exp(dt * (node.rate - node.gyroscope_bias)))
        return float(np.linalg.norm(step)) < DISTANCE + SPEED * dt \
            and geodesic_angle(turned, now) < ANGLE + RATE * dt

    def _started(self, stamp, position, quaternion, known) -> Track:
        """Start a track at a pose, with the biases of ``known``, and predict it to now."""
        later = [reading for reading in self._readings if reading[0] > stamp + SAME_INSTANT]
        before = self._readings[len(self._readings) - len(later) - 1]
        force, rate = interpolate(stamp, before, later[0]) if later else (before[1], before[2])
        first = self._model.start(stamp, force, rate, position, quaternion, known)
        time_deviation = (self._parameters.imu.delay_std if known is None else
                          self._model.time_deviation(known))
        track = Track(self._model, first, time_deviation)
        for reading in later:
            track.predict(*reading)
        return track
