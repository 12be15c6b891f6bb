"""
Guidance: functions that modify the pose targets of a controller, one after the other.

A controller that is a function of the present state, like a policy, needs it for wound joints, for
dives in large turns and for steady errors. Guidance is optional: a controller may contain a
:class:`Guidance`, or may be wrapped by a :class:`Guided`.
"""

from collections import deque
from dataclasses import dataclass, fields

import numpy as np

from beetle_omni_ros.control.base import (
    Command,
    Controller,
    forward_health,
    PoseTarget,
    reach_of,
    State,
    Target,
)
from beetle_omni_ros.control.guidance.routing import Routing, RoutingParameters
from beetle_omni_ros.control.guidance.trimming import Trimming, TrimmingParameters
from beetle_omni_ros.control.guidance.turning import Turning, TurningParameters
from beetle_omni_ros.control.guidance.unwinding import Unwinding, UnwindingParameters
from beetle_omni_ros.robot.allocation import ActuatorHealth
from beetle_omni_ros.robot.schema import group, parameter, ParameterError, quoted

LATEST = 10     # steps within which a command is reported as the executed command
NONE = 'none'   # text for a controller without guidance
ALL = 'all'     # in place of the names of all layers


@dataclass(frozen=True, kw_only=True)
class GuidanceParameters:
    """Parameters of the guidance."""

    without: str = parameter('', doc="layers that are off: names with commas, or 'all'",
                             read_only=True)
    unwinding: UnwindingParameters = group(
        UnwindingParameters, 'through a level attitude where joints end at their stops')
    routing: RoutingParameters = group(
        RoutingParameters, 'round where the shortest turn ends at joint stops')
    turning: TurningParameters = group(
        TurningParameters, 'positions of targets during large rotations')
    trimming: TrimmingParameters = group(
        TrimmingParameters, 'the steady error at a target is taken off')

    def __post_init__(self):
        """Check the names of the layers that are off."""
        if unknown := self._off - {*LAYERS, ALL}:
            raise ParameterError(f"key 'without': expected {', '.join(LAYERS)} or {ALL}, found "
                                 f'{quoted(", ".join(sorted(unknown)))}')

    @property
    def _off(self):
        return {name.strip() for name in self.without.split(',')} - {''}

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the active layers."""
        return tuple(name for name in LAYERS if not self._off & {name, ALL})


LAYERS = tuple(entry.name for entry in fields(GuidanceParameters) if entry.name != 'without')


class Guidance:
    """
    Unwinding if the joints are stuck, otherwise routing; then turning and trimming.

    Args:
        parameters: of each.
        axes: (4, 3) unit tilt axes in base_link.

    Attributes:
        text: lists the active layers.

    """

    def __init__(self, parameters: GuidanceParameters, axes: np.ndarray):
        self._on = parameters.layers
        self.text = ', '.join(self._on) or NONE
        self._unwinding = Unwinding(parameters.unwinding, axes)
        self._routing = Routing(parameters.routing, axes)
        self._turning = Turning(parameters.turning)
        self._trimming = Trimming(parameters.trimming)

    def reset(self) -> None:
        """Reset the memory of the target and of all parts."""
        for part in (self._unwinding, self._routing, self._turning, self._trimming):
            part.reset()

    def target(self, state: State, given: PoseTarget, in_charge: bool = True) -> PoseTarget:
        """
        The modified pose target for the controller.

        Args:
            state: of the robot.
            given: the target.
            in_charge: whether this controller is active.

        """
        aim = self._unwinding.target(state, given) if 'unwinding' in self._on else given
        if aim is given and 'routing' in self._on:
            aim = self._routing.target(state, given)
        shown = self._turning.target(state, given, aim) if 'turning' in self._on else aim
        if shown is given and 'trimming' in self._on:
            return self._trimming.target(state, given, in_charge)
        self._trimming.reset()      # the joints may be wound differently afterwards
        return shown

    def diagnostics(self) -> dict[str, int]:
        """Counts since the last reset."""
        return {'unwound': self._unwinding.attempts, 'routed': self._routing.routed}


class Charge:
    """Detects whether the executed commands are those of one controller."""

    def __init__(self):
        self.reset()

    def reset(self) -> None:
        """Remove all stored commands."""
        self._latest: deque[list[float]] = deque(maxlen=LATEST)

    def gave(self, values: list[float]) -> None:
        """Store a command: tilts [rad], then thrusts [N]."""
        self._latest.appendleft(values)

    def holds(self, state: State) -> bool:
        """Whether the executed command is one of the latest commands."""
        command = state.command
        return command is not None and command.tilt.tolist() + command.thrust.tolist() \
            in self._latest


class Guided:
    """
    A controller with guidance around it: again a :class:`control.base.Controller`.

    Args:
        controller: any.
        guidance: which modifies its pose targets; trajectories are not modified.

    """

    def __init__(self, controller: Controller, guidance: Guidance):
        self._controller, self._guidance = controller, guidance
        self._charge = Charge()
        self.period, self.reach = controller.period, reach_of(controller)
        self.guidance = guidance.text

    def reset(self) -> None:
        """Reset controller and guidance."""
        self._charge.reset()
        self._guidance.reset()
        self._controller.reset()

    def step(self, state: State, target: Target) -> Command:
        """One command for one state."""
        if isinstance(target, PoseTarget):
            target = self._guidance.target(state, target, self._charge.holds(state))
        command = self._controller.step(state, target)
        self._charge.gave(command.tilt.tolist() + command.thrust.tolist())
        return command

    def set_health(self, health: ActuatorHealth) -> None:
        """Pass the health of the actuators to a controller that accepts it."""
        forward_health(self._controller, health)

    def diagnostics(self) -> dict[str, float | int | str]:
        """Diagnostics of the controller, and the counts of the guidance."""
        diagnostics = getattr(self._controller, 'diagnostics', dict)
        return {**diagnostics(), **self._guidance.diagnostics()}
