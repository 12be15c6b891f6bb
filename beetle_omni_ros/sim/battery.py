"""Model of the battery: rest voltage by charge, internal resistance, thrust limit."""

from bisect import bisect_right
from math import sqrt

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.parameters import PackParameters


class Battery:
    """
    Charge, voltage and current of one battery.

    Attributes:
        charge: charge as a fraction of a full battery.
        voltage: voltage under the present load [V].
        extra_resistance: additional resistance of a bad contact or cell [ohm].
        current: drawn current [A], positive.
        drawn: charge drawn since the reset [A h].

    """

    def __init__(self, robot: RobotParameters, pack: PackParameters):
        self._pack = pack
        self._resistance = robot.battery.resistance
        self._levels = pack.charge_levels.tolist()
        self._rest_voltages = (robot.battery.full_voltage * pack.relative_voltages).tolist()
        rows = sorted(robot.rotors.map, key=lambda row: row.voltage)
        self._map_voltages = [row.voltage for row in rows]
        self._map_thrusts = [row.thrust_max for row in rows]
        self._thrust_max = robot.rotors.thrust_max
        self.reset()

    def reset(self) -> None:
        """Set the initial charge and no load."""
        self.charge = self._pack.initial_charge
        self.extra_resistance = 0.0
        self.current = self.drawn = 0.0
        self.voltage = self.rest_voltage

    @property
    def rest_voltage(self) -> float:
        """Open-circuit voltage [V]."""
        return _interpolate(self._levels, self._rest_voltages, min(1.0, max(0.0, self.charge)))

    def step(self, thrust: np.ndarray, duration: float) -> None:
        """Supply the power for ``thrust`` (4,) [N] during ``duration`` [s]."""
        pack = self._pack
        power = pack.idle_power + pack.rotor_power * sum(
            f * sqrt(f) for f in thrust.tolist() if f > 0)
        rest = self.rest_voltage
        # power = V (rest - V) / R, limited to the largest power, which is at V = rest / 2
        resistance = self._resistance + self.extra_resistance
        self.voltage = 0.5 * (rest + sqrt(max(0.0, rest * rest - 4 * resistance * power)))
        self.current = power / self.voltage
        if resistance:
            self.current = min(self.current, (rest - self.voltage) / resistance)
        self.drawn += self.current * duration / 3600
        self.charge = max(0.0, self.charge - self.current * duration / (3600 * pack.capacity))

    @property
    def thrust_limit(self) -> float:
        """
        Largest thrust of a rotor at the present voltage [N].

        It is interpolated between the voltages of the rotor map, and extrapolated below the
        lowest. Without a map it is the limit of the robot.
        """
        if not self._map_voltages:
            return self._thrust_max
        if len(self._map_voltages) == 1:
            return min(self._thrust_max, self._map_thrusts[0])
        limit = _interpolate(self._map_voltages, self._map_thrusts,
                             min(self.voltage, self._map_voltages[-1]))
        return min(self._thrust_max, max(0.0, limit))


def _interpolate(xs, ys, x):
    """Piecewise linear interpolation with linear extrapolation."""
    k = min(max(bisect_right(xs, x) - 1, 0), len(xs) - 2)
    return ys[k] + (ys[k + 1] - ys[k]) * (x - xs[k]) / (xs[k + 1] - xs[k])
