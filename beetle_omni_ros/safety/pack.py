"""Thrust limit of a sagging pack, from its voltage under load."""

import numpy as np

from beetle_omni_ros.robot.allocation import Allocator, ROTORS
from beetle_omni_ros.robot.degraded import sphere
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.thrust_map import ThrustMap

DIRECTIONS = 200        # of up in the body, with a computed hover load, 14 deg apart
STEPS = 500             # between no and full thrust, for the thrust of all rotors together
LEAST = 1.0             # [V] a smaller reading is that of a disconnected sensor
TIME = 0.2              # [s] three readings; full thrust in a manoeuvre is shorter


class PackWatch:
    """
    A pack is weak if its voltage allows less thrust than the most demanding attitude needs.

    A rotor draws power with thrust to the power of 1.5, so the voltage under load is ``V = rest -
    drop * load / V`` with the load being the sum of those powers. With the highest voltage of the
    flight as ``rest``, a reading gives ``drop``, and this the thrust of all rotors together.

    Args:
        robot: nominal robot.
        allocator: of the robot.
        rotor_map: thrust limits by voltage.

    Attributes:
        limit: thrust that all rotors can give at the same time [N], None while the pack is strong
            enough; it only falls.

    """

    def __init__(self, robot: RobotParameters, allocator: Allocator, rotor_map: ThrustMap):
        self._map, self._thrust_max = rotor_map, robot.rotors.thrust_max
        _, thrusts = allocator.upright(sphere(DIRECTIONS))
        self._need = min(float(thrusts.max()), self._thrust_max)
        self.reset()

    def reset(self) -> None:
        """Reset for a new flight, perhaps with another pack."""
        self.limit: float | None = None
        self._rest, self._read_at, self._weak_for = 0.0, -np.inf, 0.0

    def on_voltage(self, stamp: float, voltage: float, thrust: np.ndarray) -> None:
        """Receive a reading [V] under modelled thrusts (4,) [N]."""
        since, self._read_at = min(stamp - self._read_at, 1.0), stamp
        if since <= 0 or voltage < LEAST:
            return
        self._rest = max(self._rest, voltage)
        allowed, load = float(self._map.thrust_limit_below(voltage)), float((thrust ** 1.5).sum())
        self._weak_for = self._weak_for + since if allowed < self._need else 0.0
        if self.limit is not None:
            self.limit = min(self.limit, allowed)
        elif self._weak_for > TIME and load > 0:
            self.limit = min(allowed, self._together(voltage * (self._rest - voltage) / load))

    def _together(self, drop):
        """Thrust [N] that all rotors can give at the same time."""
        thrusts = np.linspace(0.0, self._thrust_max, STEPS)
        # V (rest - V) = drop * load; beyond the pack's largest power V is half of rest.
        voltages = 0.5 * (self._rest + np.sqrt(np.maximum(
            self._rest ** 2 - 4 * drop * ROTORS * thrusts ** 1.5, 0.0)))
        return float(thrusts[self._map.thrust_limit_below(voltages) >= thrusts].max())
