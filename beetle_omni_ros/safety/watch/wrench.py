"""Detection of a lost rotor or contact by unexplained forces and torques."""

from collections import deque
from math import exp, expm1, sqrt

import numpy as np

from beetle_omni_ros.robot.allocation import ActuatorHealth, Allocator, ROTORS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.servo import Responses
from beetle_omni_ros.safety.watch.parameters import ContactLimits, RotorLimits

LONGEST = 0.05          # [s] between two IMU samples; a longer gap resets the filters
AFTER_HIT = 1.0         # [s] after an impact, in which a push at any height is contact
SPAN, LONGEST_TRACK = 3, 0.12   # poses of either velocity; [s] of both
USUAL = 1.0             # [s] time constant of the learnt steady push in the air
BETWEEN = 0.05          # [s] between two updates of the slower filter
TINY = 1e-12            # squared difference of two models that are equal


class WrenchWatch:
    """
    Compares accelerometer and gyroscope with the wrench of the commanded thrusts.

    The thrusts follow their commands with the rotors' lag and point along the measured tilts.
    Model and measurement pass the same first-order filter. The residual is the smallest between
    those with the shortest and with the longest lag that the robot file allows. Weighted by that
    of healthy flights, it is fitted by another thrust vector of each rotor, one at a time. A
    vector near zero is a lost rotor, one of about the same length a tilt that differs from its
    encoder. A second, slower filter finds a smaller loss that lasts, as of a broken propeller:
    averaged over a manoeuvre the residual of a healthy robot is small.

    Args:
        rotor: thresholds of a lost rotor.
        contact: thresholds of contact.
        robot: nominal robot.
        allocator: of the robot.

    Attributes:
        lost: the rotor (0 to 3) that is missing, or None.
        slipped: (joint 0 to 3, true tilt less encoder [rad]) of a tilt that differs, or None.
        impact: largest specific force of the last sample beyond the rotors' reach [m/s^2], or 0.
        supported: (4,) bool, rotors that are also slow by their ESC; set by the caller.
        unexplained: (3,) filtered force that neither the rotors nor another thrust vector of one
            rotor explains, in base_link [m/s^2].

    """

    def __init__(self, rotor: RotorLimits, contact: ContactLimits, robot: RobotParameters,
                 allocator: Allocator):
        self._p, self._contact, self._allocator = rotor, contact, allocator
        self._inertia = robot.inertia.tolist()
        self._lags = np.array(Responses.of(robot).rotor_lag)[:, None]
        self._reach = ROTORS * robot.rotors.thrust_max / allocator.mass
        self._units = np.concatenate([np.full(3, allocator.mass), robot.inertia])
        self._weights = 1 / np.repeat([rotor.force_noise, rotor.torque_noise], 3)
        # (8, 6): weighted accelerations by each rotor's thrust along and across its arm
        self._model = (allocator.matrix / self._units[:, None] * self._weights[:, None]).T.copy()
        self._bases = [self._model[2 * i:2 * i + 2].T for i in range(ROTORS)]
        self._fits = [np.linalg.pinv(basis) for basis in self._bases]
        self.reset()

    def reset(self) -> None:
        """Reset, with stopped rotors."""
        # The first of two rows is that of the shortest lag.
        self._thrust = np.zeros((2, ROTORS))
        self._stamp: float | None = None
        self.supported = np.zeros(ROTORS, dtype=bool)
        self._measured, self._vectors = np.zeros(6), np.zeros((2, 2 * ROTORS))
        self._steady, self._steady_vectors = np.zeros(6), np.zeros((2, 2 * ROTORS))
        self._waited = 0.0
        self.forget()
        self.impact = 0.0
        self.unexplained = np.zeros(3)

    def forget(self) -> None:
        """Suspect no rotor."""
        self._lost_for, self._slipped_for = np.zeros(ROTORS), np.zeros(ROTORS)
        self._weak_for = np.zeros(ROTORS)
        self._suspects = False
        self.lost: int | None = None
        self.slipped: tuple[int, float] | None = None

    def on_imu(self, stamp: float, force: np.ndarray, rate: np.ndarray, tilt: np.ndarray | None,
               thrust: np.ndarray, health: ActuatorHealth) -> None:
        """
        Receive one IMU sample.

        Args:
            stamp: [s].
            force: (3,) specific force in base_link [m/s^2].
            rate: (3,) angular rate in base_link [rad/s].
            tilt: (4,) measured [rad], None: unknown, and only an impact can be detected.
            thrust: (4,) commanded [N].
            health: of the actuators, as known.

        """
        dt = LONGEST + 1 if self._stamp is None else stamp - self._stamp
        if dt <= 0:
            return
        self._stamp = stamp
        size = sqrt(force.dot(force))
        self.impact = size if size > self._contact.impact * self._reach else 0.0
        commanded = thrust if all(health.rotors) else np.where(health.rotors, thrust, 0.0)
        if dt > LONGEST or tilt is None:
            impact = self.impact
            self.reset()
            self._thrust, self._stamp, self._rate = np.array([commanded] * 2), stamp, rate
            self.impact = impact
            return
        self._thrust -= np.expm1(-dt / self._lags) * (commanded - self._thrust)
        measured = np.array(force.tolist() + self._angular_acceleration(rate.tolist(), dt))
        self._rate = rate
        vectors = np.empty((2, ROTORS, 2))
        vectors[:, :, 0] = np.cos(tilt) * self._thrust
        vectors[:, :, 1] = np.sin(tilt) * self._thrust
        gain = 1 - exp(-dt / self._contact.filter)
        self._measured += gain * (measured * self._weights - self._measured)
        self._vectors += gain * (vectors.reshape(2, -1) - self._vectors)
        self._waited += dt
        if self._waited >= BETWEEN:
            self._judge_steady(self._waited)
            self._waited = 0.0
        self._judge(dt)

    def _angular_acceleration(self, rate, dt):
        """Torque by the gyroscope over inertia, three floats; numpy is slower here."""
        (x, y, z), (i, j, k), (a, b, c) = rate, self._inertia, self._rate.tolist()
        return [(x - a) / dt + (y * (k * z) - z * (j * y)) / i,
                (y - b) / dt + (z * (i * x) - x * (k * z)) / j,
                (z - c) / dt + (x * (j * y) - y * (i * x)) / k]

    def _judge_steady(self, dt):
        """Count the time for which a rotor has lost a smaller share."""
        p = self._p
        gain = -expm1(-dt / p.steady_filter)
        self._steady += gain * (self._measured - self._steady)
        self._steady_vectors += gain * (self._vectors - self._steady_vectors)
        vectors, residual = self._closest(self._steady_vectors, self._steady)
        size = float(residual @ residual)
        weak = np.zeros(ROTORS, dtype=bool)
        if size > p.steady_evidence**2:
            i, rest = self._culprit(residual)
            length = float(np.hypot(*vectors[i]))
            true = vectors[i] + self._fits[i] @ residual
            weak[i] = rest @ rest < (1 - p.steady_explained) * size \
                and length > p.least_thrust \
                and float(np.hypot(*true)) < (1 - p.steady_share) * length
        self._weak_for = self._counted(self._weak_for, weak, dt)

    def _closest(self, vectors, measured):
        """
        Thrust vectors (4, 2) [N] between two lags that explain most, and the residual (6,).

        Vectors of lags between are close to a line: a first-order lag is a point on a half circle
        from 1 to 0, and the line cuts off at most 8 % of the circle for lags of one to three.
        """
        residuals = measured - vectors.dot(self._model)
        change = residuals[0] - residuals[1]
        share = min(1.0, max(0.0, -residuals[1].dot(change) / (change.dot(change) + TINY)))
        return ((vectors[1] + share * (vectors[0] - vectors[1])).reshape(ROTORS, 2),
                residuals[1] + share * change)

    def _culprit(self, residual):
        """The rotor (0 to 3) that explains most of a weighted residual, and the rest of it."""
        left = [residual - basis @ (fit @ residual)
                for basis, fit in zip(self._bases, self._fits)]
        i = int(np.argmin([rest @ rest for rest in left]))
        return i, left[i]

    def _judge(self, dt):
        """The rotor whose thrust vector explains the residual, and this vector."""
        p = self._p
        vectors, residual = self._closest(self._vectors, self._measured)
        size = float(residual.dot(residual))
        self.unexplained = residual[:3] / self._weights[:3]
        self.lost = self._first(self._weak_for >= p.steady_time)
        if size <= p.least_evidence**2 and not self._suspects:
            return
        lost, slipped = np.zeros(ROTORS, dtype=bool), np.zeros(ROTORS, dtype=bool)
        angle = 0.0
        if size > p.least_evidence**2:
            i, rest = self._culprit(residual)
            modelled = vectors[i]
            length = float(np.hypot(*modelled))
            if rest @ rest < (1 - p.explained) * size and length > p.least_thrust:
                true = modelled + self._fits[i] @ residual
                share = float(np.hypot(*true)) / length
                angle = float(np.arctan2(modelled[0] * true[1] - modelled[1] * true[0],
                                         modelled @ true))
                lost[i] = share < 1 - p.share
                slipped[i] = abs(share - 1) < p.share and abs(angle) > p.slip
                self.unexplained = rest[:3] / self._weights[:3]
        self._lost_for = self._counted(self._lost_for, lost, dt)
        self._slipped_for = self._counted(self._slipped_for, slipped, dt)
        self._suspects = bool(self._lost_for.any() or self._slipped_for.any())
        at_once = self._first(self._lost_for >= np.where(self.supported, p.time, p.time_alone))
        self.lost = self.lost if at_once is None else at_once
        joint = self._first(self._slipped_for >= p.slip_time)
        self.slipped = None if joint is None or not slipped[joint] else (joint, angle)

    @staticmethod
    def _counted(times, suspect, dt):
        return np.where(suspect, times + dt, np.maximum(0.0, times - dt))

    @staticmethod
    def _first(named):
        return int(np.argmax(named)) if named.any() else None


class ContactWatch:
    """
    Ground contact and crash, near the ground.

    Args:
        limits: thresholds.
        gravity: [m/s^2].

    Attributes:
        reason: '' or the reason why the robot is treated as on the ground.

    """

    def __init__(self, limits: ContactLimits, gravity: float):
        self._limits, self._gravity = limits, gravity
        self.reset()

    def reset(self) -> None:
        """Begin anew."""
        self._for, self.reason, self._usual, self._since_hit = 0.0, '', 0.0, np.inf
        self._track: deque = deque(maxlen=2 * SPAN + 1)

    def update(self, dt: float, height: float | None, wrench: WrenchWatch) -> None:
        """
        Update with the result of one IMU sample.

        Near the ground an impact or a push is sufficient. At other heights, which may be wrong,
        both are required: after a collision in the air there is no further push.

        Args:
            dt: since the one before [s].
            height: of base_link above its height on the ground [m], None if unknown.
            wrench: of the same sample.

        """
        push = sqrt(wrench.unexplained.dot(wrench.unexplained)) / self._gravity
        near = height is None or height <= self._limits.near_ground
        self._since_hit = 0.0 if wrench.impact else self._since_hit + dt
        hit = self._since_hit < AFTER_HIT
        if not near and not hit:
            self._for = 0.0
            self._usual += min(1.0, dt / USUAL) * (push - self._usual)
            return
        if wrench.impact and near:
            self.reason = f'impact of {wrench.impact:.0f} m/s^2'
        carried = (height is not None or hit) and push > self._limits.support + self._usual
        self._for = self._for + dt if carried else 0.0
        if self._for >= self._limits.time and not self.reason:
            self.reason = f'{push:.1f} of the weight are carried by something else'

    def on_pose(self, stamp: float, position: np.ndarray, height: float | None) -> None:
        """
        Detect a bump from MoCap only, if there is no IMU.

        Args:
            stamp: [s].
            position: (3,) in world [m].
            height: as in :meth:`update`.

        """
        track = self._track
        track.append((stamp, position))
        if len(track) < 2 * SPAN + 1 or track[-1][0] - track[0][0] > LONGEST_TRACK:
            return
        (t, a), (u, b), (v, c) = track[0], track[SPAN], track[-1]
        change = float(np.linalg.norm((c - b) / (v - u) - (b - a) / (u - t)))
        if height is not None and height <= self._limits.near_ground \
                and change > self._limits.bump:
            self.reason = f'velocity changed by {change:.1f} m/s at once'
