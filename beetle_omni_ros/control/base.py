"""The whole contract between the flight stack and a controller."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from beetle_omni_ros.robot import rotations

ROTORS = 4


@dataclass(frozen=True)
class Command:
    """
    What a controller asks of the actuators.

    Attributes:
        stamp: time of the state estimate that it answers [s].
        tilt: (4,) tilt joint targets [rad].
        thrust: (4,) rotor thrust targets [N].

    """

    stamp: float
    tilt: np.ndarray
    thrust: np.ndarray


@dataclass(frozen=True)
class State:
    """
    The estimated state that a controller acts on.

    Attributes:
        stamp: time of the estimate [s].
        position: (3,) base_link in world [m].
        velocity: (3,) of base_link, expressed in world [m/s].
        quaternion: (4,) body to world, (x, y, z, w), unit.
        angular_velocity: (3,) in base_link [rad/s].
        tilt: (4,) latest measured tilt angles [rad].
        tilt_velocity: (4,) their rates [rad/s].
        tilt_stamp: capture time of ``tilt`` [s].
        command: the command in force (of whichever controller), or None before the first.

    """

    stamp: float
    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    angular_velocity: np.ndarray
    tilt: np.ndarray
    tilt_velocity: np.ndarray
    tilt_stamp: float
    command: Command | None = None


@dataclass(frozen=True)
class Reference:
    """One sample of a target: pose in world, linear velocity in world, body rates."""

    position: np.ndarray
    quaternion: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray


@dataclass(frozen=True)
class PoseTarget:
    """
    A pose to reach and hold.

    Attributes:
        position: (3,) in world [m].
        quaternion: (4,) body to world (x, y, z, w), unit.
        stamp: when it was issued [s].

    """

    position: np.ndarray
    quaternion: np.ndarray
    stamp: float = 0.0

    def at(self, time: float) -> Reference:
        """The reference at ``time``: the same pose at rest."""
        return Reference(self.position, self.quaternion, np.zeros(3), np.zeros(3))


@dataclass(frozen=True)
class TrajectoryTarget:
    """
    A time-parameterised reference; before its start and after its end the end poses hold.

    Attributes:
        times: (N,) increasing absolute times [s].
        positions: (N, 3) in world [m].
        quaternions: (N, 4) body to world.
        velocities: (N, 3) in world [m/s].
        angular_velocities: (N, 3) in the reference's body frame [rad/s].

    """

    times: np.ndarray
    positions: np.ndarray
    quaternions: np.ndarray
    velocities: np.ndarray
    angular_velocities: np.ndarray
    stamp: float = field(default=0.0)

    def at(self, time: float) -> Reference:
        """The reference at ``time``, interpolated between samples (slerp for attitude)."""
        times = self.times
        if time <= times[0] or time >= times[-1]:
            end = 0 if time <= times[0] else -1
            return Reference(self.positions[end], self.quaternions[end], np.zeros(3), np.zeros(3))
        k = int(np.searchsorted(times, time, side='right')) - 1
        s = (time - times[k]) / (times[k + 1] - times[k])
        relative = rotations.log(rotations.multiply(
            rotations.conjugate(self.quaternions[k]), self.quaternions[k + 1]))
        return Reference(
            (1 - s) * self.positions[k] + s * self.positions[k + 1],
            rotations.multiply(self.quaternions[k], rotations.exp(s * relative)),
            (1 - s) * self.velocities[k] + s * self.velocities[k + 1],
            (1 - s) * self.angular_velocities[k] + s * self.angular_velocities[k + 1])


Target = PoseTarget | TrajectoryTarget


class Controller(Protocol):
    """
    A function of state and target; whatever differs between controllers is inside.

    ``step`` is called once every ``period`` with a fresh state and must not raise on
    finite input. A standby controller is stepped as well, so that it can take over
    without a jump; the command in force stands in ``state.command``.
    """

    name: str
    period: float

    def reset(self) -> None:
        """Forget all memory, as before the first step."""

    def step(self, state: State, target: Target) -> Command:
        """One command for one state."""

    def diagnostics(self) -> dict[str, float | int | str]:
        """Health of the last step and since reset, for operators and logs."""
