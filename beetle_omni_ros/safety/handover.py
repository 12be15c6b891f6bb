"""From one controller's command to the next one's without a jump."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.safety.parameters import HandoverParameters


class Handover:
    """
    Limits how fast the command changes after somebody else took over.

    A controller that follows along has little to jump, but in the middle of a large turn two of
    them may well disagree. Once the command has caught up with what is asked for, or after
    ``time``, the controller has its way again.

    Args:
        parameters: rates and time.

    """

    def __init__(self, parameters: HandoverParameters):
        self._parameters = parameters
        self._left = 0.0

    def start(self) -> None:
        """Somebody else takes over."""
        self._left = self._parameters.time

    def stop(self) -> None:
        """Stamps cannot be compared any more: let everything through."""
        self._left = 0.0

    def limit(self, asked: Command, in_force: Command | None) -> Command:
        """Give ``asked``, or as much of it as may be executed after ``in_force``."""
        if self._left <= 0 or in_force is None:
            return asked
        step = asked.stamp - in_force.stamp
        if step <= 0:       # an answer to a state that another controller has answered already
            return in_force
        self._left -= step
        tilt = _towards(asked.tilt, in_force.tilt, step * self._parameters.tilt_rate)
        thrust = _towards(asked.thrust, in_force.thrust, step * self._parameters.thrust_rate)
        if np.array_equal(tilt, asked.tilt) and np.array_equal(thrust, asked.thrust):
            self.stop()
        return Command(asked.stamp, tilt, thrust)


def _towards(goal, start, reach):
    return np.clip(goal, start - reach, start + reach)
