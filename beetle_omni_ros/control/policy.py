"""A trained policy as a controller."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.control.base import Command, PoseTarget, Reference, State, Target
from beetle_omni_ros.control.disturbance import DisturbanceEstimator, DisturbanceParameters
from beetle_omni_ros.control.gravity import ApparentGravity
from beetle_omni_ros.control.guidance import Guidance
from beetle_omni_ros.control.matching import ModelMatching
from beetle_omni_ros.control.policy_file import PolicyNetwork
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.rotations import entries
from beetle_omni_ros.model.schema import parameter, ParameterFile

DEFAULT = 'policies/rl.onnx'
LATEST = 10             # steps within which a command is reported as the executed command
COMMAND_DELAY = 0.01    # [s] from the state stamp to the actuators, for the disturbance estimate
# An action beyond is a fault: it is sent to the supervisor unchanged; smaller ones are clipped to
# the limits of the actuators, as in training (100: 25 rad, 50 N).
ACTION_LIMIT = 100.0


@dataclass(frozen=True, kw_only=True)
class PolicyParameters(ParameterFile, file='rl.yaml'):
    """Policy file and guidance."""

    policy: str = parameter(DEFAULT, doc="ONNX file, in the package's share or any path")
    matching: bool = parameter(
        True, doc='fly another robot than that of the training by model matching')
    latency: float = parameter(
        DisturbanceParameters().latency, doc='largest additional delay of commands, and of joint '
        'feedback, that is estimated and predicted; 0: none', unit='s', low=0, high=0.2)
    reach: float = parameter(6.5, doc='a target farther from the robot is refused', unit='m',
                             low=0.5, high=1000)
    without: str = parameter('', doc="layers of the guidance that are off: names with commas, or "
                             "'all'")


class PolicyController:
    """
    The learnt controller; ParameterError if its file is missing, broken, or does not fit.

    Its previous action is the executed command, of any controller, so that it can take over from
    another controller. :mod:`control.guidance` modifies pose targets.
    """

    Parameters = PolicyParameters

    def __init__(self, robot: RobotParameters, parameters: PolicyParameters | None = None):
        p = parameters or PolicyParameters.load()
        self.network = PolicyNetwork(p.policy, robot)
        self.contract = contract = self.network.contract
        trained = contract.trained_robot(robot)
        self._matching: ModelMatching | None = None
        self._estimator: DisturbanceEstimator | None = None
        latency = p.latency
        if p.matching and trained is not robot:
            self._matching = ModelMatching(trained, robot, COMMAND_DELAY, LATEST, latency)
            latency = 0.0
        self.name, self.period, self.reach = contract.name, 1 / contract.rate_hz, p.reach
        self._scale, self._offset = contract.action_scale, contract.action_offset
        tilt, rotors = robot.joints.position_limit, robot.rotors
        self._limits = [(-tilt, tilt)] * 4 + [(rotors.thrust_min, rotors.thrust_max)] * 4
        self._hover = [robot.hover_thrust] * 4
        if contract.memory or latency:
            # The disturbance of another robot is its difference from that of the training.
            self._estimator = DisturbanceEstimator(
                trained, DisturbanceParameters(latency=latency), COMMAND_DELAY)
        self._gravity = ApparentGravity(robot.mass * robot.gravity)
        # A policy with memory observes the force, and model matching has another estimate.
        without = p.without + ',gravity' * (contract.memory or not self._estimator)
        self._guidance = Guidance(robot.tilt_axes, without)
        self._weighs = 'gravity' in self._guidance.layers
        self.guidance = self._guidance.text
        self.reset()

    def reset(self) -> None:
        """Reset the last commands, the estimate and all counts."""
        self._steps = self._faults = self._cut = 0
        self._guidance.reset()
        self._gravity.reset()
        self._latest: deque[list[float]] = deque(maxlen=LATEST)
        if self._estimator:
            self._estimator.reset()
        if self._matching:
            self._matching.reset()

    def step(self, state: State, target: Target) -> Command:
        """One command for one state."""
        self._steps += 1
        if self._matching:
            state = self._matching.observed(state)
        if self._estimator:
            state = self._estimator.ahead(state)
            if self._weighs:
                self._gravity.update(self._estimator.disturbance[:3])
        scale = [1.0] * 4 + [self._gravity.scale] * 4
        command = state.command
        executed = command and command.tilt.tolist() + command.thrust.tolist()
        if isinstance(target, PoseTarget):      # in charge: the executed command is a latest one
            target = self._guidance.target(state, target, executed in self._latest)
        before = executed or state.tilt.tolist() + self._hover
        observation = observed(*self._gravity.seen(state, target.at(state.stamp)), [
            (v / g - o) / s for v, g, o, s in zip(before, scale, self._offset, self._scale)])
        if self._estimator and self.contract.memory:
            observation += disturbed(state, self._estimator.disturbance)
        action = self.network(observation)
        values = [g * (s * a + o) for a, g, o, s in zip(action, scale, self._offset, self._scale)]
        if not all(low <= v <= high for v, (low, high) in zip(values, self._limits)):
            if all(-ACTION_LIMIT <= a <= ACTION_LIMIT for a in action):     # false for NaN
                values = [min(max(v, low), high) for v, (low, high) in zip(values, self._limits)]
                self._cut += 1
            else:
                self._faults += 1
        self._latest.append(values)
        own = Command(state.stamp, np.array(values[:4]), np.array(values[4:]))
        return self._matching.sent(own) if self._matching else own

    def diagnostics(self) -> dict[str, float | int | str]:
        """Counts since reset, and the disturbance estimates of a policy with memory."""
        values: dict[str, float | int | str] = {
            'policy': self.contract.name, 'steps': self._steps,
            'faulty_actions': self._faults, 'steps_at_a_limit': self._cut,
            **self._guidance.diagnostics()}
        known = self._matching or self._estimator
        if known:
            values['latency_estimate_s'] = known.latency
        if self._estimator and self.contract.memory:
            d = self._estimator.disturbance
            values['force_estimate_N'] = float(np.linalg.norm(d[:3]))
            values['torque_estimate_Nm'] = float(np.linalg.norm(d[3:6]))
        return values


# Plain floats below: on vectors of three, numpy's calls cost ten times the arithmetic.


def observed(state: State, reference: Reference, previous_action) -> list[float]:
    """
    Observation (33) in the blocks of :data:`policy_file.OBSERVATIONS`, in SI units.

    All vectors are in base_link, so that they do not depend on position, and on heading only by
    the attitude columns. ``previous_action`` (8,) is the executed command as an action.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = entries(*state.quaternion.tolist())
    ax, bx, cx, ay, by, cy, az, bz, cz = entries(*reference.quaternion.tolist())
    px, py, pz = (reference.position - state.position).tolist()
    vx, vy, vz = (state.velocity - reference.velocity).tolist()
    wx, wy, wz = state.angular_velocity.tolist()
    p, q, r = reference.angular_velocity.tolist()
    if p or q or r:     # the reference's rates, to world and from there to base_link
        p, q, r = ax * p + bx * q + cx * r, ay * p + by * q + cy * r, az * p + bz * q + cz * r
        wx -= xx * p + yx * q + zx * r
        wy -= xy * p + yy * q + zy * r
        wz -= xz * p + yz * q + zz * r
    return [xx * vx + yx * vy + zx * vz, xy * vx + yy * vy + zy * vz,
            xz * vx + yz * vy + zz * vz, wx, wy, wz,
            xx * px + yx * py + zx * pz, xy * px + yy * py + zy * pz,
            xz * px + yz * py + zz * pz,
            xx, yx, zx, xz, yz, zz, ax, ay, az, cx, cy, cz,
            *state.tilt.tolist(), *previous_action]


def disturbed(state: State, disturbance: np.ndarray) -> list[float]:
    """Force and torque (6) in base_link, of a disturbance (10,) with its force in world."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = entries(*state.quaternion.tolist())
    fx, fy, fz, *torque = disturbance[:6].tolist()
    return [xx * fx + yx * fy + zx * fz, xy * fx + yy * fy + zy * fz,
            xz * fx + yz * fy + zz * fz, *torque]
