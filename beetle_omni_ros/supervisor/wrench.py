"""Detection of a lost rotor or contact by unexplained forces and torques."""

from math import exp, expm1, sqrt

import numpy as np

from beetle_omni_ros.model.allocation import ActuatorHealth, Allocator, ROTORS
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import Responses
from beetle_omni_ros.supervisor.way import inclination

LONGEST = 0.05          # [s] between two IMU samples; a longer gap resets the filters
TINY = 1e-12            # squared difference of two models that are equal
FILTER = 0.03           # [s] of forces and torques
FORCE_NOISE = 0.6       # [m/s^2] 99 % of published flights are below 1, half below 0.2
TORQUE_NOISE = 6.0      # [rad/s^2] 99 % are below 11, half below 3
LEAST_THRUST = 1.5      # [N] smallest thrust for a decision: a fifth of the hover thrust
EVIDENCE = 3.0          # [-] smallest residual for a decision, in units of these noises
EXPLAINED = 0.6         # [-] smallest share of its square that one rotor explains
SHARE = 0.5             # [-] missing share of the thrust of a lost rotor
TIME = 0.05             # [s] until it is named, if the ESC telemetry also shows a loss
TIME_ALONE = 0.3        # [s] otherwise; fast moves under published conditions look similar for up
                        # to 0.12 s
# A lasting loss, e.g. of a broken propeller. Chosen on 18 minutes of healthy flight, in which no
# rotor met share, explained and evidence together, and on losses of 30 to 50 %.
STEADY_FILTER = 0.5     # [s] a fast turn takes as long
STEADY_EVIDENCE = 2.0   # [-] half of a healthy flight with effects is above, but then no single
                        # rotor explains it
STEADY_EXPLAINED = 0.8  # [-]
STEADY_SHARE = 0.35     # [-] 20 % are harmless; a landing from upside down with an unnoticed loss
                        # of 40 % failed
STEADY_TIME = 1.0       # [s] two time constants of the filter
BETWEEN = 0.05          # [s] between two updates of this filter

NEAR_GROUND = 0.3       # [m] above the standing height; a robot on its side or back is lower
IMPACT = 2.0            # [-] times the largest rotor acceleration of 26 m/s^2; a touchdown at 0.3
                        # m/s gives up to 48
AFTER_HIT = 1.0         # [s] after an impact, in which a push at any height is contact
SUPPORT = 0.35          # [-] of the weight; healthy flights near the ground stay below 0.2
SUPPORT_TIME = 0.15     # [s]
USUAL = 1.0             # [s] time constant of the learnt steady push in the air
TIPPED, LOW = 0.5, 0.12     # [rad], [m] above the standing height: it touches the floor


class WrenchWatch:
    """
    Compares accelerometer and gyroscope with the wrench of the commanded thrusts.

    The thrusts follow their commands with the rotors' lag and point along the measured tilts.
    Model and measurement pass the same first-order filter. The residual is the smallest between
    those with the shortest and with the longest lag that the robot file allows. Weighted by that
    of healthy flights, it is fitted by another thrust vector of each rotor, one at a time. A
    vector near zero is a lost rotor. A second, slower filter finds a smaller loss that lasts, as
    of a broken propeller: averaged over a manoeuvre the residual of a healthy robot is small.

    Attributes:
        lost: the rotor (0 to 3) that is missing, or None.
        impact: largest specific force of the last sample beyond the rotors' reach [m/s^2], or 0.
        supported: 4 bool, rotors that are also slow by their ESC; set by the caller.
        thrust: (2, 4) modelled thrusts with the shortest and with the longest lag [N].
        unexplained: (3,) filtered force that neither the rotors nor another thrust vector of one
            rotor explains, in base_link [m/s^2].

    """

    def __init__(self, robot: RobotParameters, allocator: Allocator):
        self._inertia = robot.inertia.tolist()
        self._lags = np.array(Responses.of(robot).rotor_lag)[:, None]
        self._impact = IMPACT * ROTORS * robot.rotors.thrust_max / allocator.mass
        units = np.concatenate([np.full(3, allocator.mass), robot.inertia])
        self._weights = 1 / np.repeat([FORCE_NOISE, TORQUE_NOISE], 3)
        # (8, 6): weighted accelerations by each rotor's thrust along and across its arm
        self._model = (allocator.matrix / units[:, None] * self._weights[:, None]).T.copy()
        self._bases = [self._model[2 * i:2 * i + 2].T for i in range(ROTORS)]
        self._fits = [np.linalg.pinv(basis) for basis in self._bases]
        self.reset()

    def reset(self) -> None:
        """Reset, with stopped rotors."""
        # The first of two rows is that of the shortest lag.
        self.thrust = np.zeros((2, ROTORS))
        self._stamp: float | None = None
        self.supported = [False] * ROTORS
        self._measured, self._vectors = np.zeros(6), np.zeros((2, 2 * ROTORS))
        self._steady, self._steady_vectors = np.zeros(6), np.zeros((2, 2 * ROTORS))
        self._waited = self.impact = 0.0
        self.unexplained = np.zeros(3)
        self._lost_for, self._weak_for = [0.0] * ROTORS, [0.0] * ROTORS
        self.lost: int | None = None

    def on_imu(self, stamp: float, force: np.ndarray, rate: np.ndarray, tilt: np.ndarray | None,
               thrust: np.ndarray, health: ActuatorHealth) -> None:
        """
        Receive specific force (3,) [m/s^2] and rate (3,) [rad/s] in base_link.

        If the measured tilts (4,) [rad] are unknown, only an impact can be detected. The commanded
        thrusts (4,) [N] of lost rotors count as zero.
        """
        dt = LONGEST + 1 if self._stamp is None else stamp - self._stamp
        if dt <= 0:
            return
        size = sqrt(force.dot(force))
        commanded = thrust if all(health.rotors) else np.where(health.rotors, thrust, 0.0)
        if dt > LONGEST or tilt is None:
            self.reset()
            self.thrust = np.array([commanded] * 2)
        else:
            self._compare(force, rate, tilt, commanded, dt)
        self._stamp, self._rate = stamp, rate
        self.impact = size if size > self._impact else 0.0

    def _compare(self, force, rate, tilt, commanded, dt):
        """Update the filters, and judge."""
        self.thrust -= np.expm1(-dt / self._lags) * (commanded - self.thrust)
        # Torque by the gyroscope over inertia; numpy is slower here.
        (x, y, z), (i, j, k), (a, b, c) = rate.tolist(), self._inertia, self._rate.tolist()
        measured = np.array([*force.tolist(),
                             (x - a) / dt + (y * (k * z) - z * (j * y)) / i,
                             (y - b) / dt + (z * (i * x) - x * (k * z)) / j,
                             (z - c) / dt + (x * (j * y) - y * (i * x)) / k])
        vectors = np.empty((2, ROTORS, 2))
        vectors[:, :, 0] = np.cos(tilt) * self.thrust
        vectors[:, :, 1] = np.sin(tilt) * self.thrust
        gain = 1 - exp(-dt / FILTER)
        self._measured += gain * (measured * self._weights - self._measured)
        self._vectors += gain * (vectors.reshape(2, -1) - self._vectors)
        self._waited += dt
        if self._waited >= BETWEEN:
            gain = -expm1(-self._waited / STEADY_FILTER)
            self._steady += gain * (self._measured - self._steady)
            self._steady_vectors += gain * (self._vectors - self._steady_vectors)
            weak, _ = self._judged(self._steady_vectors, self._steady, STEADY_EVIDENCE,
                                   STEADY_EXPLAINED, STEADY_SHARE)
            self._weak_for = _counted(self._weak_for, weak, self._waited)
            self._waited = 0.0
        lost, self.unexplained = self._judged(self._vectors, self._measured, EVIDENCE, EXPLAINED,
                                              SHARE)
        self._lost_for = _counted(self._lost_for, lost, dt)
        self.lost = next((rotor for rotor, (lost, weak, slow) in enumerate(zip(
            self._lost_for, self._weak_for, self.supported))
            if lost >= (TIME if slow else TIME_ALONE) or weak >= STEADY_TIME), None)

    def _judged(self, vectors, measured, evidence, explained, share):
        """Which rotor lacks a share of its thrust, or None, and the unexplained force (3,)."""
        # Thrust vectors of lags between the two are close to a line: a first-order lag is a point
        # on a half circle from 1 to 0, and the line cuts off at most 8 % of the circle for lags of
        # one to three.
        lost = None
        residuals = measured - vectors.dot(self._model)
        change = residuals[0] - residuals[1]
        part = min(1.0, max(0.0, -residuals[1].dot(change) / (change.dot(change) + TINY)))
        rest = residual = residuals[1] + part * change
        size = float(residual.dot(residual))
        if size > evidence**2:
            left = [residual - basis @ (fit @ residual)
                    for basis, fit in zip(self._bases, self._fits)]
            i = int(np.argmin([one @ one for one in left]))
            modelled = (vectors[1] + part * (vectors[0] - vectors[1]))[2 * i:2 * i + 2]
            length = float(np.hypot(*modelled))
            if left[i] @ left[i] < (1 - explained) * size and length > LEAST_THRUST:
                true = float(np.hypot(*(modelled + self._fits[i] @ residual)))
                lost, rest = i if true < (1 - share) * length else None, left[i]
        return lost, rest[:3] / self._weights[:3]


def _counted(times, rotor, dt):
    """Times for which each rotor was named [s], which decrease while it is not."""
    return [max(0.0, time + (dt if k == rotor else -dt)) for k, time in enumerate(times)]


class ContactWatch:
    """Ground contact and crash: ``reason`` is '' until the robot is treated as on the ground."""

    def __init__(self, gravity: float):
        self._gravity = gravity
        self._for, self.reason, self._usual, self._since_hit = 0.0, '', 0.0, np.inf

    def update(self, dt: float, height: float | None, wrench: WrenchWatch) -> None:
        """
        Update with the result of one IMU sample.

        Near the ground, by the height of base_link above its height on the ground [m], an impact
        or a push is sufficient. At other heights, which may be wrong, both are required: after a
        collision in the air there is no further push.
        """
        push = sqrt(wrench.unexplained.dot(wrench.unexplained)) / self._gravity
        near = height is None or height <= NEAR_GROUND
        self._since_hit = 0.0 if wrench.impact else self._since_hit + dt
        hit = self._since_hit < AFTER_HIT
        if not near and not hit:
            self._for = 0.0
            self._usual += min(1.0, dt / USUAL) * (push - self._usual)
            return
        if wrench.impact and near:
            self.reason = f'impact of {wrench.impact:.0f} m/s^2'
        carried = (height is not None or hit) and push > SUPPORT + self._usual
        self._for = self._for + dt if carried else 0.0
        if self._for >= SUPPORT_TIME and not self.reason:
            self.reason = f'{push:.1f} of the weight are carried by something else'

    def on_pose(self, quaternion: np.ndarray, height: float | None) -> None:
        """Detect a crash by MoCap alone, if there is no IMU; ``height`` as in :meth:`update`."""
        if height is not None and height < LOW and inclination(quaternion) > TIPPED:
            self.reason = 'tipped over at the floor'
