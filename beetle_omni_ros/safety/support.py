"""Share of the weight that the rotors carry, for the detection of the ground."""

from math import exp

import numpy as np

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import Allocator, ROTORS

BASELINE_TIME = 2.0             # [s] time constant of the ratio of specific force and thrust
BASELINE_RANGE = (0.7, 1.4)     # largest ratio to the model; a larger one is a disturbance
LEAST_THRUST = 0.3              # [weights] the ratio is not used with less thrust


class SupportGauge:
    """
    Share of the weight that the rotors do not carry, from commands and accelerometer.

    The true thrust differs from the model by several percent. The ratio of specific force to
    commanded thrust is therefore learnt in free flight and kept constant while landing.
    """

    def __init__(self, allocator: Allocator, gravity: float, time_constant: float):
        self._allocator, self._gravity, self._lag = allocator, gravity, time_constant
        self._baseline = 1.0
        self.thrust = 0.0     # modelled thrust along world up, in weights
        self.lift = 0.0       # the same, corrected by the baseline
        self._thrusts = np.zeros(ROTORS)    # modelled thrust of each rotor [N]
        # The last command and its force: a controller is slower than the supervisor.
        self._command: Command | None = None
        self._force = np.zeros(3)

    def update(self, command: Command | None, quaternion: np.ndarray, dt: float,
               specific_force_up: float | None, learn: bool) -> None:
        """Update in one tick."""
        now, share = 0.0, 1.0 - exp(-dt / self._lag)
        self._thrusts += share * ((0.0 if command is None else command.thrust) - self._thrusts)
        if command is not None:
            if command is not self._command:
                self._command = command
                self._force, _ = self._allocator.wrench(command.tilt, command.thrust)
            now = float(rotations.up(quaternion).dot(self._force)) \
                / (self._allocator.mass * self._gravity)
        self.thrust += share * (now - self.thrust)
        if learn and specific_force_up is not None and self.thrust > LEAST_THRUST:
            low, high = BASELINE_RANGE
            ratio = min(max(specific_force_up / self._gravity / self.thrust, low), high)
            self._baseline += min(1.0, dt / BASELINE_TIME) * (ratio - self._baseline)
        self.lift = self._baseline * self.thrust

    def motion(self, tilt: np.ndarray, inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Accelerations of the body by the rotors, from the model.

        Args:
            tilt: (4,) true [rad].
            inertia: (3,) of the body [kg m^2].

        Returns:
            specific force (3,) [m/s^2] and angular acceleration (3,) [rad/s^2], in base_link.

        """
        force, torque = self._allocator.wrench(tilt, self._thrusts)
        return self._baseline * force / self._allocator.mass, torque / inertia

    def support(self, specific_force_up: float | None) -> float:
        """Share of the weight that the rotors do not carry."""
        felt = 1.0 if specific_force_up is None else specific_force_up / self._gravity
        return felt - self.lift
