"""Thrust limit of a sagging pack, from its voltage under load."""

import numpy as np

from beetle_omni_ros.robot.allocation import Allocator, ROTORS
from beetle_omni_ros.robot.degraded import sphere
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.servo import Responses
from beetle_omni_ros.robot.thrust_map import ThrustMap

DIRECTIONS = 200        # of up in the body, with a computed hover load, 14 deg apart
STEPS = 500             # between no and full thrust, for the thrust of all rotors together
SURPRISE = 3.0          # [-] standard deviations beyond which a reading means a fault
LEAST = 1.0             # [V] a smaller reading is that of a disconnected sensor
UNKNOWN = 1.0           # [ohm W/N^1.5] initial value; a good pack has 0.4
NOISE = 0.02            # [V] twice that of the simulated sensor
LOAD_ERROR = 0.1        # [-] of the voltage drop: transients of thrust, delays, another propeller
DISCHARGE = 0.03        # [V/s^0.5] 0.25 V a minute: a pack that lasts 10 minutes
TIME = 0.2              # [s] two readings after the first


class PackWatch:
    """
    Separates open-circuit voltage and resistance of the pack while the load varies.

    A rotor draws power with thrust to the power of 1.5, so the voltage under load is ``V = rest -
    drop * load / V`` with the load being the sum of those powers. A Kalman filter estimates
    ``rest`` and ``drop``. Charge falls slowly. A reading far from the expected value means that a
    resistance (a contact, a cell) has changed.

    The pack is weak if it cannot hold every attitude: at some attitude the thrust at the voltage
    under load is less than required.

    Args:
        robot: nominal robot.
        allocator: of the robot.
        rotor_map: thrust limits by voltage.

    Attributes:
        limit: thrust that all rotors can give at the same time [N], None while the pack is strong
            enough.

    """

    def __init__(self, robot: RobotParameters, allocator: Allocator, rotor_map: ThrustMap):
        self._map = rotor_map
        self._lags = np.array(Responses.of(robot).rotor_lag)[:, None]
        self._thrust_max = robot.rotors.thrust_max
        _, thrusts = allocator.upright(sphere(DIRECTIONS))
        self._loads = _load(thrusts)
        self._needs = np.minimum(thrusts.max(axis=1), self._thrust_max)
        self.reset()

    def reset(self) -> None:
        """Reset for a new flight, perhaps with another pack."""
        self.limit: float | None = None
        # with the shortest and with the longest lag of the rotors
        self._thrusts, self._commanded_at = np.zeros((2, ROTORS)), -np.inf
        self._state = np.array([np.nan, 0.0])      # rest [V], drop [ohm W/N^1.5]
        self._covariance = np.diag([NOISE ** 2, UNKNOWN ** 2])
        self._read_at, self._weak_for = -np.inf, 0.0

    def on_command(self, stamp: float, thrust: np.ndarray) -> None:
        """Receive the commanded thrusts (4,) [N] from ``stamp`` [s] on."""
        since = max(0.0, stamp - self._commanded_at)
        self._thrusts -= np.expm1(-since / self._lags) * (thrust - self._thrusts)
        self._commanded_at = stamp

    def on_voltage(self, stamp: float, voltage: float) -> None:
        """Receive a reading [V]."""
        since, self._read_at = min(stamp - self._read_at, 1.0), stamp
        if since <= 0 or voltage < LEAST:
            return
        if np.isnan(self._state[0]):
            self._state[0] = voltage
        self._estimate(voltage, since)
        # A weak pack stays weak in the same flight, even if its voltage recovers.
        weak = bool(np.any(self._allowed(self._loads) < self._needs))
        self._weak_for = self._weak_for + since if weak else 0.0
        if self.limit is not None or self._weak_for > TIME:
            self.limit = self._together()

    def _estimate(self, voltage, since):
        """One step of the filter."""
        one, other = (_load(self._thrusts) / voltage).tolist()
        load, unsure = 0.5 * (one + other), 0.5 * abs(one - other)
        sensitivity = np.array([1.0, -load])
        self._covariance[0, 0] += DISCHARGE ** 2 * since
        noise = NOISE ** 2 + self._state[1] ** 2 * (
            (LOAD_ERROR * load) ** 2 + unsure ** 2)
        error = voltage - float(sensitivity @ self._state)
        variance = float(sensitivity @ self._covariance @ sensitivity) + noise
        if load > 0 and error ** 2 > SURPRISE ** 2 * variance:
            self._covariance[1, 1] += (error / load) ** 2
            variance = float(sensitivity @ self._covariance @ sensitivity) + noise
        gain = self._covariance @ sensitivity / variance
        self._state = np.maximum(self._state + gain * error, 0.0)
        self._covariance -= np.outer(gain, gain) * variance

    def _allowed(self, load):
        """Largest thrust of a rotor [N] at the voltage under loads [N^1.5]."""
        rest, drop = self._state
        # V (rest - V) = drop * load; beyond the pack's largest power V is half of rest.
        voltage = 0.5 * (rest + np.sqrt(np.maximum(rest * rest - 4 * drop * load, 0.0)))
        return self._map.thrust_limit_below(voltage)

    def _together(self):
        """Thrust [N] that all rotors can give at the same time."""
        thrusts = np.linspace(0.0, self._thrust_max, STEPS)
        return float(thrusts[self._allowed(ROTORS * thrusts ** 1.5) >= thrusts].max())


def _load(thrust):
    """Sum (...) of thrusts (..., 4) to the power of 1.5, proportional to electric power."""
    return (np.maximum(thrust, 0.0) ** 1.5).sum(axis=-1)
