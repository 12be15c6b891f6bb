"""What a node and the in-process loop do around a controller: targets, health, reset, errors."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from typing import Any

import numpy as np

from beetle_omni_ros.control.base import (
    Command,
    Controller,
    corrected,
    error_text,
    PoseTarget,
    reach_of,
    ROTORS,
    State,
    Target,
)
from beetle_omni_ros.robot.allocation import ActuatorHealth, ALL_HEALTHY

MOTORS_OFF = ('disarmed', 'emergency_stop')     # states of the supervisor


def direct(function: Callable, *arguments: Any) -> Any:
    """Call a function."""
    return function(*arguments)


class ControllerHost:
    """
    Steps one controller for the supervisor.

    Before the first target it holds the pose at which the controller became active. A controller
    that is not active is stepped too, so that it can take over without a jump. An exception of the
    controller means no command for this state, and the supervisor falls back.

    Args:
        name: name of the controller.
        controller: the controller.
        timed: called with ``step`` and its arguments; returns the result.
        report: called with the text of each error.

    Attributes:
        controller: the argument.
        target: target of the operator or the task, or None.
        override: target of the supervisor, which replaces it, or None.
        mode: state of the supervisor, 'flying:NAME' while the controller NAME is active.
        errors: number of exceptions.
        error: the last one in one line, or ''.

    """

    def __init__(self, name: str, controller: Controller,
                 timed: Callable[..., Any] = direct,
                 report: Callable[[str], None] = lambda text: None):
        self.controller = controller
        self.target: Target | None = None
        self.override: Target | None = None
        self.errors, self.error = 0, ''
        self._name, self._timed, self._report = name, timed, report
        self._hold: Target | None = None
        self._position: np.ndarray | None = None
        self._health = ALL_HEALTHY
        self.mode, self._own_mode = '', f'flying:{name}'

    @property
    def active(self) -> bool:
        """Whether the controller flies."""
        return self.mode == self._own_mode

    @property
    def target_in_force(self) -> Target | None:
        """Target of the next step; None before the first estimate."""
        return self.override or self.target or self._hold

    def on_mode(self, mode: str, now: float) -> str:
        """
        Follow the supervisor; motors that stop reset the controller and its targets.

        Returns:
            why the target is dropped at the takeover from another controller, or ''.

        """
        state, before = mode.partition(':')[0], self.mode
        self.mode = mode
        if state in MOTORS_OFF and before.partition(':')[0] != state:
            self.call('reset')
            self._hold = self.override = None
        if not self.active or mode == before or self.target is None:
            return ''
        reason = self.too_far(self.target, now)     # accepted for the controller before
        if reason:
            self.target = self._hold = None
        return reason

    def on_health(self, health: ActuatorHealth) -> None:
        """Take the health of the actuators, for this object and the controller."""
        self._health = health
        self.call('set_health', health)

    def on_estimate(self, estimate: Any) -> None:
        """Take position (3,), quaternion (4,) and stamp of each estimate."""
        self._position = estimate.position
        if self.target is None and (self._hold is None or not self.mode.startswith('flying')):
            self._hold = PoseTarget(estimate.position, estimate.quaternion, estimate.stamp)

    def too_far(self, target: Target, now: float) -> str:
        """Why a target at ``now`` [s] is out of reach from the last estimate, or ''."""
        if self._position is None:
            return ''
        away = float(np.linalg.norm(target.at(now).position - self._position))
        reach = reach_of(self.controller)
        return '' if away <= reach else (f'{away:.4g} m from the robot, expected at most '
                                         f'{reach:g} m: the reach of the controller')

    def step(self, state: State, target: Target | None = None) -> Command | None:
        """
        Command for a state, to ``target`` or the target in force.

        None after an exception, and for a state that is not finite.
        """
        if not isfinite(sum(sum(part.tolist()) for part in (
                state.position, state.velocity, state.quaternion, state.angular_velocity,
                state.tilt, state.tilt_velocity))):
            return None
        return self.call('step', corrected(state, self._health), target or self.target_in_force,
                         run=self._timed, flaw=flaw)

    def call(self, method: str, *arguments: Any, run: Callable[..., Any] = direct,
             flaw: Callable[[Any], str] = lambda result: '') -> Any:
        """
        Call the controller's ``method`` if it has one; returns its result.

        In a process with other nodes, an exception would end the supervisor, too. It is reported,
        and None is returned, like for a result with a flaw.
        """
        function = getattr(self.controller, method, None)
        if function is None:
            return None
        try:
            result = run(function, *arguments)
            text = flaw(result)
        except Exception as error:
            text = f'raised {error_text(error)}'
        if not text:
            return result
        self.errors, self.error = self.errors + 1, f"controller '{self._name}': {method} {text}"
        self._report(self.error)
        return None


def flaw(command: object) -> str:
    """Why the result of a controller's ``step`` is no command, or ''."""
    if not isinstance(command, Command):
        return f'returned {type(command).__name__}, expected control.base.Command'
    for part in ('tilt', 'thrust'):
        shape = getattr(getattr(command, part), 'shape', None)
        if shape != (ROTORS,):
            return (f'returned a command whose {part} is '
                    f"{f'of shape {shape}' if shape is not None else 'no array'}, expected a "
                    f'numpy array of {ROTORS}')
    return ''
