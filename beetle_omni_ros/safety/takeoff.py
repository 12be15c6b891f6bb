"""Takeoff: joints to their hover angles, then a climb by the hover controller."""

from dataclasses import replace

import numpy as np

from beetle_omni_ros.control.base import Command, Fallback, State
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.safety.levelling import Way
from beetle_omni_ros.safety.parameters import TakeoffParameters
from beetle_omni_ros.safety.ramp import Ramp

LEVEL_RATE = 0.5  # [rad/s] rate at which an inclination of the ground is levelled
AIRBORNE = 0.05   # [m] of rise; below it the reaction to a fault is motors off


class Takeoff:
    """
    One takeoff, stepped by the supervisor.

    Args:
        parameters: speeds and patience.
        allocator: for the joint angles to align to.
        hover: the controller that climbs.
        state: where it starts.

    Attributes:
        failure: '' or the reason of an abort.
        done: whether the height is reached.
        airborne: whether it has left the ground.

    """

    def __init__(self, parameters: TakeoffParameters, allocator: Allocator, hover: Fallback,
                 state: State):
        self._parameters, self._hover = parameters, hover
        self._start = state
        self._tilt = np.clip(state.tilt, -allocator.tilt_limit, allocator.tilt_limit)
        self._goal_tilt = allocator.hover(state.quaternion, self._tilt).tilt
        self._ramp: Ramp | None = None
        self._aligned_for = 0.0
        self._climbed_for = 0.0
        self.failure, self.done, self.airborne = '', False, False
        hover.reset()

    def step(self, state: State, in_force: Command | None, dt: float) -> Command:
        """The command for the present time."""
        self.airborne |= bool(state.position[2] > self._start.position[2] + AIRBORNE)
        if self._ramp is None:
            return self._align(state, dt)
        self._climbed_for += dt
        self._judge(state, self._ramp.duration)
        self._hover.observe(state, free=self.airborne)
        return self._hover.step(state, self._ramp)

    @property
    def target(self) -> np.ndarray:
        """(3,) position at its end [m]."""
        height = self._parameters.height
        rise = max(height - self._start.position[2], self._parameters.clearance)
        return self._start.position + np.array([0.0, 0.0, rise])

    def clock_went_back(self, by: float) -> None:
        """Continue the climb after the clock was set back by ``by`` [s]."""
        if self._ramp is not None:
            self._ramp = replace(self._ramp, stamp=self._ramp.stamp - by)

    def _align(self, state, dt):
        p = self._parameters
        reach = p.align_rate * dt
        self._tilt = self._tilt + np.clip(self._goal_tilt - self._tilt, -reach, reach)
        self._aligned_for += dt
        error = np.abs(state.tilt - self._goal_tilt)
        if error.max() < p.align_tolerance and np.array_equal(self._tilt, self._goal_tilt):
            level = rotations.from_rpy(0.0, 0.0, rotations.to_rpy(state.quaternion)[2])
            way = Way.straight(state.quaternion, level, LEVEL_RATE)
            self._ramp = Ramp(state.stamp, self._start.position, way, 0.0,
                              self.target[2] - self._start.position[2], p.speed, p.acceleration)
        elif self._aligned_for > p.align_patience:
            k = int(error.argmax())
            self.failure = f'gimbal{k + 1} is {error[k]:.2f} rad from its place after ' \
                           f'{p.align_patience:g} s (joint_bridge_node)'
        return Command(state.stamp, self._tilt, np.zeros(4))

    def _judge(self, state, duration: float):
        p, over = self._parameters, self._climbed_for - duration
        if over < 0:
            return
        near = np.linalg.norm(state.position - self.target) < p.position_tolerance
        if near and np.linalg.norm(state.velocity) < p.speed_tolerance:
            self.done = True
        elif over > p.patience:
            # In the air, off target: the hand-over follows. On the ground: abort.
            self.done = self.airborne
            if not self.airborne:
                self.failure = f'still on the ground {p.patience:g} s after the climb'
