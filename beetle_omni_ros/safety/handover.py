"""Transition between the commands of two controllers without a jump."""

import numpy as np

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.safety.parameters import HandoverParameters


class Handover:
    """
    Limits the rate of the command after a change of the controller.

    A controller on standby has similar commands, but in a large turn the commands may differ. The
    limit ends when the new command is reached, or after ``time``.

    Args:
        parameters: rates and time.

    """

    def __init__(self, parameters: HandoverParameters):
        self._parameters = parameters
        self._left = 0.0

    def start(self) -> None:
        """Begin after a change of the controller."""
        self._left = self._parameters.time

    def stop(self) -> None:
        """End the limit, because stamps cannot be compared after a change of the clock."""
        self._left = 0.0

    def limit(self, asked: Command, in_force: Command | None) -> Command:
        """Return ``asked``, limited to the permitted change from ``in_force``."""
        if self._left <= 0 or in_force is None:
            return asked
        step = asked.stamp - in_force.stamp
        if step <= 0:       # a command for this state was already executed
            return in_force
        self._left -= step
        tilt = _towards(asked.tilt, in_force.tilt, step * self._parameters.tilt_rate)
        thrust = _towards(asked.thrust, in_force.thrust, step * self._parameters.thrust_rate)
        if np.array_equal(tilt, asked.tilt) and np.array_equal(thrust, asked.thrust):
            self.stop()
        return Command(asked.stamp, tilt, thrust)


def _towards(goal, start, reach):
    return np.clip(goal, start - reach, start + reach)
