"""
The flight as a Gymnasium environment: the agent is the active controller of the whole stack.

Sensors, estimator, supervisor and actuators are those of `evaluate`. Needs the extra ``gym``::

    env = FlightEnv()
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
"""

from queue import SimpleQueue
from threading import Thread

import gymnasium
from gymnasium.spaces import Box
import numpy as np

from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.control.base import Command, State, Target
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.control.policy import observed
from beetle_omni_ros.control.policy_file import OBSERVATIONS, RATE_HZ, THRUST_SCALE, TILT_SCALE
from beetle_omni_ros.control.tasks import pose_target, random_poses
from beetle_omni_ros.flight.loop import FlightLoop
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.mode import FLYING
from beetle_omni_ros.model.parameters import RobotParameters

NAME = 'agent'


class _Landed(BaseException):
    """Ends the thread of a flight that its environment has left."""


class _Agent:
    """Controller that asks the environment for each command; hovers until it is in charge."""

    name, period = NAME, 1.0 / RATE_HZ

    def __init__(self, robot: RobotParameters):
        self._hover, self.in_charge = HoverController(robot), False
        self.asked: SimpleQueue[tuple[State, Target] | None] = SimpleQueue()
        self.answers: SimpleQueue[Command | None] = SimpleQueue()

    def reset(self) -> None:
        self._hover.reset()

    def step(self, state: State, target: Target) -> Command:
        if not self.in_charge:
            return self._hover.step(state, target)
        self.asked.put((state, target))
        if (command := self.answers.get()) is None:
            raise _Landed
        return command


class FlightEnv(gymnasium.Env):
    """
    Fly to a pose: 33 observations and 8 actions, those of the controller `rl`, at 100 Hz.

    The observation is computed from the estimate. The reward is minus the true distance [m] minus
    the true angle [rad] to the target. The episode terminates when the supervisor takes the
    command from the agent, and is truncated after ``duration``.

    Args:
        robot: robot of estimator and supervisor; None: the shipped one.
        plant: simulated robot; None: as ``robot``.
        conditions: 'nominal' or 'published'.
        duration: of an episode [s].

    """

    metadata = {'render_modes': []}

    def __init__(self, robot: RobotParameters | None = None,
                 plant: RobotParameters | None = None, conditions: str = 'nominal',
                 duration: float = 8.0):
        self._robot = robot or RobotParameters.load()
        self._plant, self._conditions, self.duration = plant or self._robot, conditions, duration
        self._scale = np.repeat([TILT_SCALE, THRUST_SCALE], 4)
        self._offset = np.repeat([0.0, self._robot.hover_thrust], 4)
        size = sum(block['size'] for block in OBSERVATIONS[:-2])      # without disturbance
        self.observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        joints, rotors = self._robot.joints, self._robot.rotors
        lowest = np.repeat([-joints.position_limit, rotors.thrust_min], 4)
        highest = np.repeat([joints.position_limit, rotors.thrust_max], 4)
        self.action_space = Box(*(((limit - self._offset) / self._scale).astype(np.float32)
                                  for limit in (lowest, highest)))
        self._thread: Thread | None = None

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """
        Take off and begin an episode.

        ``options['pose']`` is the target x, y, z [m], roll, pitch, yaw [deg]; default: random.
        """
        super().reset(seed=seed)
        self.close()
        pose = (options or {}).get('pose')
        self._pose = random_poses(1, self.np_random)[0] if pose is None else np.asarray(pose)
        self._agent, self._steps = _Agent(self._robot), 0
        self._flight = FlightLoop(
            self._robot, self._plant, {NAME: self._agent}, LogRecorder({}),
            conditions=self._conditions, seed=int(self.np_random.integers(2**31)))
        self._flight.take_off()
        self._flight.aim(pose_target(self._pose))
        self._agent.in_charge = True
        self._thread = Thread(target=self._fly, args=(self._flight, self._agent), daemon=True)
        self._thread.start()
        self._given = self._agent.asked.get()
        return self._observation(), self._info()

    def step(self, action):
        """
        Apply an action (8,) until the controller is asked again.

        Tilts are 0.25 rad and thrusts 0.5 N for 1, about the hover thrust, as those of `rl`.
        """
        state, _ = self._given
        values = self._offset + self._scale * np.asarray(action, dtype=float)
        self._agent.answers.put(Command(state.stamp, values[:4], values[4:]))
        self._steps += 1
        given = self._agent.asked.get()
        if terminated := given is None:
            self._thread = None
        else:
            self._given = given
        info = self._info()
        reward = -info['position_error_m'] - info['attitude_error_rad']
        truncated = self._steps >= round(self.duration * RATE_HZ)
        return self._observation(), reward, terminated, truncated, info

    def close(self) -> None:
        """End the present flight."""
        if self._thread is not None:
            self._agent.answers.put(None)
            self._thread.join()
            self._thread = None

    @staticmethod
    def _fly(flight, agent):
        try:
            while flight.supervisor.state == FLYING:
                flight.step()
        except _Landed:
            return
        agent.asked.put(None)

    def _observation(self):
        state, target = self._given
        command = state.command
        before = (np.concatenate((command.tilt, command.thrust)) - self._offset) / self._scale
        return np.array(observed(state, target.at(state.stamp), before), dtype=np.float32)

    def _info(self):
        truth, target = self._flight.simulator.truth, pose_target(self._pose)
        return {'position_error_m': float(np.linalg.norm(truth.position - target.position)),
                'attitude_error_rad': float(rotations.geodesic_angle(
                    truth.quaternion, target.quaternion))}
