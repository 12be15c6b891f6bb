"""The interface between the flight stack and a controller."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf, sqrt
from pathlib import Path
import sysconfig
import traceback
from typing import Any, Protocol

import numpy as np

from beetle_omni_ros.model.allocation import ActuatorHealth, NO_ZEROS
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
