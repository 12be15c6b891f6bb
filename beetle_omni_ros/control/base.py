"""The interface between the flight stack and a controller, and the host that steps one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf, isfinite, sqrt
from pathlib import Path
import sysconfig
from time import thread_time
import traceback
from typing import Any, Protocol

import numpy as np

from beetle_omni_ros.model.allocation import ActuatorHealth, ALL_HEALTHY, NO_ZEROS, ROTORS
from beetle_omni_ros.model.mode import FLYING, Mode
from beetle_omni_ros.model.rotations import BodyState

AT_REST = np.zeros(3)           # velocity of a pose
AT_REST.flags.writeable = False
# Folders of the package, of installed packages and of Python itself.
LIBRARIES = (str(Path(__file__).resolve().parents[1]),
             *(sysconfig.get_path(name) for name in ('purelib', 'platlib', 'stdlib')), '<frozen')


@dataclass(frozen=True)
class Command:
    """Targets of the actuators, computed by a controller."""

    stamp: float            # of the state estimate from which it was computed [s]
    tilt: np.ndarray        # (4,) tilt joint targets [rad]
    thrust: np.ndarray      # (4,) rotor thrust targets [N]


@dataclass(slots=True, eq=False)
class State(BodyState):
    """The estimated state, input of a controller: a BodyState with the tilt joints."""

    tilt: np.ndarray            # (4,) latest measured tilt angles [rad]
    tilt_velocity: np.ndarray   # (4,) their rates [rad/s]
    tilt_stamp: float           # capture time of ``tilt`` [s]
    command: Command | None = None      # last executed one, of any controller; None: none yet

    @classmethod
    def join(cls, estimate: BodyState, joints: Any, command: Command | None = None) -> State:
        """Join the estimate, the measured joints and the command in force."""
        return cls(estimate.stamp, estimate.position, estimate.velocity, estimate.quaternion,
                   estimate.angular_velocity, joints.position, joints.velocity, joints.stamp,
                   command)


@dataclass(frozen=True)
class Reference:
    """One sample of a target: pose in world, linear velocity in world, body rates."""

    position: np.ndarray
    quaternion: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray

    def at(self, time: float) -> Reference:
        """Itself, at any time: a reference is also a target."""
        return self


@dataclass(frozen=True)
class PoseTarget(Reference):
    """
    A pose to reach and hold, at rest.

    Attributes:
        position: (3,) in world [m].
        quaternion: (4,) body to world (x, y, z, w), unit.
        stamp: when it was issued [s].

    """

    velocity: np.ndarray = field(init=False, default_factory=lambda: AT_REST)
    angular_velocity: np.ndarray = field(init=False, default_factory=lambda: AT_REST)
    stamp: float = 0.0

    def delayed(self, time: float) -> PoseTarget:
        """Return the target with its time moved by ``time`` [s]."""
        return replace(self, stamp=self.stamp + time)

    def same_pose(self, other: PoseTarget) -> bool:
        """Whether another target is the same pose."""
        return self.position.tolist() == other.position.tolist() \
            and self.quaternion.tolist() == other.quaternion.tolist()


@dataclass(frozen=True)
class TrajectoryTarget:
    """
    A time-parameterised reference; its first and last pose are held before and after it.

    Attributes:
        times: (N,) increasing absolute times [s].
        positions: (N, 3) in world [m].
        quaternions: (N, 4) body to world.
        velocities: (N, 3) in world [m/s].
        angular_velocities: (N, 3) in the reference's body frame [rad/s].
        stamp: when it was issued [s].

    """

    times: np.ndarray
    positions: np.ndarray
    quaternions: np.ndarray
    velocities: np.ndarray
    angular_velocities: np.ndarray
    stamp: float = 0.0

    def delayed(self, time: float) -> TrajectoryTarget:
        """Return the target with its times moved by ``time`` [s]."""
        return replace(self, stamp=self.stamp + time, times=self.times + time)

    def at(self, time: float) -> Reference:
        """The reference at ``time``: faster than :meth:`sample` of one time."""
        own = self.times
        k = min(max(int(own.searchsorted(time, side='right')) - 1, 0), len(own) - 2)
        s = min(max(float((time - own[k]) / (own[k + 1] - own[k])), 0.0), 1.0)
        first, second = self.quaternions[k], self.quaternions[k + 1]
        quaternion = (1 - s) * first + (s if first @ second >= 0 else -s) * second
        quaternion /= sqrt(quaternion @ quaternion)
        position = (1 - s) * self.positions[k] + s * self.positions[k + 1]
        if not own[0] < time < own[-1]:
            return Reference(position, quaternion, AT_REST, AT_REST)
        return Reference(
            position, quaternion, (1 - s) * self.velocities[k] + s * self.velocities[k + 1],
            (1 - s) * self.angular_velocities[k] + s * self.angular_velocities[k + 1])

    def sample(self, times: np.ndarray) -> Reference:
        """
        References at (M,) times, each field with M rows.

        Normalised linear interpolation of quaternions is, at the spacing of the samples of a
        trajectory, a slerp to 1e-6 rad.
        """
        own = self.times
        k = np.clip(np.searchsorted(own, times, side='right') - 1, 0, len(own) - 2)
        s = np.clip((times - own[k]) / (own[k + 1] - own[k]), 0.0, 1.0)[:, None]
        first, second = self.quaternions[k], self.quaternions[k + 1]
        same = np.where(np.sum(first * second, axis=1, keepdims=True) < 0, -1.0, 1.0)
        quaternion = (1 - s) * first + s * same * second
        quaternion /= np.sqrt(np.sum(quaternion * quaternion, axis=1, keepdims=True))
        moving = ((times > own[0]) & (times < own[-1]))[:, None]
        return Reference(
            (1 - s) * self.positions[k] + s * self.positions[k + 1], quaternion,
            moving * ((1 - s) * self.velocities[k] + s * self.velocities[k + 1]),
            moving * ((1 - s) * self.angular_velocities[k] + s * self.angular_velocities[k + 1]))


Target = PoseTarget | TrajectoryTarget


class Controller(Protocol):
    """
    A function of state and target with internal memory.

    ``step`` is called once every ``period`` [s] with a new, finite state. A ``step`` that raises
    sends no command for this state. It is also called for a controller on standby, so that this
    controller can take over without a jump; ``state.command`` is the executed command.

    Optional members of a controller:

    - ``diagnostics() -> dict``: health of the last step and since reset, for operators and logs;
    - ``set_health(health)``, if it can fly with failed actuators;
    - ``reach``: largest distance to a target [m], see :func:`reach_of`;
    - ``guidance``: text for result tables, names the functions that modify its targets.

    :mod:`control.registry` builds a controller from a class and defines its name.
    """

    period: float

    def reset(self) -> None:
        """Reset the memory to the state before the first step."""

    def step(self, state: State, target: Target) -> Command:
        """One command for one state."""


class Fallback(Controller, Protocol):
    """A controller that the supervisor uses for takeoff, fallback and landing."""

    def step(self, state: State, target: Any) -> Command:
        """One command for one state; the target only needs ``at``."""

    def observe(self, state: State, free: bool = True) -> None:
        """Update estimates while another controller is active, unless ``free`` is False."""

    def set_health(self, health: ActuatorHealth) -> None:
        """Fly with what is left."""


def corrected(state: State, health: ActuatorHealth) -> State:
    """A state with true tilts, computed from a state with encoder readings."""
    if health.zeros == NO_ZEROS:
        return state
    command = state.command
    if command is not None:
        command = replace(command, tilt=health.true(command.tilt))
    return replace(state, tilt=health.true(state.tilt), command=command)


def error_text(error: Exception) -> str:
    """An exception in one line, with the file and line of the last frame outside libraries."""
    if isinstance(error, SyntaxError) and error.filename:   # no frame is in the file
        return f'{type(error).__name__}: {error.msg} ({Path(error.filename).name}:{error.lineno})'
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(LIBRARIES)] or frames
    at = f' ({Path(own[-1].filename).name}:{own[-1].lineno})' if own else ''
    return f"{type(error).__name__}: {' '.join(str(error).split())}{at}"


def guidance_of(controller: Controller) -> str:
    """Text that names the functions that modify the targets of a controller; 'none' for none."""
    return getattr(controller, 'guidance', '') or 'none'


def reach_of(controller: Any) -> float:
    """Largest distance to a target of a controller [m]; inf if it has none."""
    return float(getattr(controller, 'reach', inf))


class ControllerHost:
    """
    Steps one controller for the supervisor.

    Before the first target it holds the pose at which the controller became active. A controller
    that is not active is stepped too, so that it can take over without a jump. ``took`` gets the
    CPU time of each step [s], ``report`` the text of each error.

    Attributes:
        target: target of the operator or the task, or None.
        override: target of the supervisor, which replaces it, or None.
        mode: state of the supervisor.
        errors: number of exceptions; ``error`` is the last one in one line.

    """

    def __init__(self, name: str, controller: Controller,
                 took: Callable[[float], None] = lambda seconds: None,
                 report: Callable[[str], None] = lambda text: None):
        self.controller = controller
        self.target: Target | None = None
        self.override: Target | None = None
        self.errors, self.error = 0, ''
        self._name, self._took, self._report = name, took, report
        self._hold: Target | None = None
        self._position: np.ndarray | None = None
        self._health = ALL_HEALTHY
        self.mode = Mode()

    @property
    def active(self) -> bool:
        """Whether the controller flies."""
        return self.mode.controller == self._name

    @property
    def target_in_force(self) -> Target | None:
        """Target of the next step; None before the first estimate."""
        return self.override or self.target or self._hold

    def on_mode(self, mode: Mode, now: float) -> str:
        """
        Follow the supervisor; motors that stop reset the controller and its targets.

        Returns:
            why the target is dropped at the takeover from another controller, or ''.

        """
        before, self.mode = self.mode, mode
        if mode.motors_off and before.state != mode.state:
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

    def on_estimate(self, estimate: BodyState) -> None:
        """Take the pose of each estimate."""
        self._position = estimate.position
        if self.target is None and (self._hold is None or self.mode.state != FLYING):
            self._hold = PoseTarget(estimate.position, estimate.quaternion, estimate.stamp)

    def too_far(self, target: Target, now: float) -> str:
        """Why a target at ``now`` [s] is out of reach from the last estimate, or ''."""
        if self._position is None:
            return ''
        away = float(np.linalg.norm(target.at(now).position - self._position))
        reach = reach_of(self.controller)
        return '' if away <= reach else (f'{away:.4g} m from the robot, expected at most '
                                         f'{reach:g} m: the reach of the controller')

    def step(self, state: State) -> Command | None:
        """Command to the target in force; None for a state that is not finite."""
        if not isfinite(sum(sum(part.tolist()) for part in (
                state.position, state.velocity, state.quaternion, state.angular_velocity,
                state.tilt, state.tilt_velocity))):
            return None
        state, target = corrected(state, self._health), self.target_in_force
        began = thread_time()   # wall time would include other programs
        try:
            result: Any = self.controller.step(state, target)  # type: ignore[arg-type]
        except Exception as error:
            return self._failed('step', f'raised {error_text(error)}')
        self._took(thread_time() - began)
        if isinstance(result, Command) and all(getattr(part, 'shape', None) == (ROTORS,)
                                               for part in (result.tilt, result.thrust)):
            return result
        return self._failed('step', f'returned {str(result)[:100]}, expected a Command with two '
                            f'arrays of {ROTORS}')

    def call(self, method: str, *arguments: Any) -> Any:
        """
        Call another of the controller's methods if it has it; None after an error.

        In a process with other nodes, an exception would end the supervisor, too.
        """
        function = getattr(self.controller, method, None)
        if function is None:
            return None
        try:
            return function(*arguments)
        except Exception as error:
            return self._failed(method, f'raised {error_text(error)}')

    def _failed(self, method, text):
        """Count and report an error; returns None."""
        self.errors, self.error = self.errors + 1, f"controller '{self._name}': {method} {text}"
        self._report(self.error)
