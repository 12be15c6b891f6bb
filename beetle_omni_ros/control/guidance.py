"""The pose targets that a policy is shown, one way of moving them after the other."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.routing import Routing, RoutingParameters
from beetle_omni_ros.control.trimming import Trimming, TrimmingParameters
from beetle_omni_ros.control.turning import Turning, TurningParameters
from beetle_omni_ros.control.unwinding import Unwinding, UnwindingParameters


class GuidanceParameters(Protocol):
    """What the parameters of a policy say about its guidance."""

    unwinding: UnwindingParameters
    routing: RoutingParameters
    turning: TurningParameters
    trimming: TrimmingParameters


class Guidance:
    """
    Through level for who is stuck, else round joint stops; without dives; without steady errors.

    Args:
        parameters: of each.
        axes: (4, 3) unit tilt axes in base_link.

    """

    def __init__(self, parameters: GuidanceParameters, axes: np.ndarray):
        self._unwinding = Unwinding(parameters.unwinding, axes)
        self._routing = Routing(parameters.routing, axes)
        self._turning = Turning(parameters.turning)
        self._trimming = Trimming(parameters.trimming)

    def reset(self) -> None:
        """Forget the target and all that was found on the way to it."""
        for part in (self._unwinding, self._routing, self._turning, self._trimming):
            part.reset()

    def target(self, state: State, given: PoseTarget, in_charge: bool = True) -> PoseTarget:
        """
        The pose target that the policy is to see.

        Args:
            state: of the robot.
            given: the target.
            in_charge: whether the robot is flying by this policy.

        """
        aim = self._unwinding.target(state, given)
        if aim is given:
            aim = self._routing.target(state, given)
        shown = self._turning.target(state, given, aim)
        if shown is given:
            return self._trimming.target(state, given, in_charge)
        self._trimming.reset()      # on its way elsewhere; joints may come back wound otherwise
        return shown

    def diagnostics(self) -> dict[str, int]:
        """Counts since the last reset."""
        return {'unwound': self._unwinding.attempts, 'routed': self._routing.routed}
