"""
The batched training environment: thousands of robots that fly from target to target.

The physics is the robot's own model (:mod:`train.model`). Observations are those of
:func:`control.policy.observed`, delayed and noisy as on the robot. A step does not synchronise
with the host, so that a whole rollout can be captured as one CUDA graph.
"""

import numpy as np
from tensordict import TensorDict
import torch

from beetle_omni_ros.control import guidance
from beetle_omni_ros.control.policy_file import PolicyContract
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.train import batch, rewards
from beetle_omni_ros.train.model import (
    ARM,
    CENTRE,
    GAIN,
    INERTIA,
    MASS,
    module_reaction,
    nominal_body,
    Physics,
)
from beetle_omni_ros.train.parameters import TrainParameters
from beetle_omni_ros.train.starts import (
    MISSED_ATTITUDE,
    MISSED_DEPTH,
    MISSED_POSITION,
    Replays,
    spread,
    Starts,
)

SUBSTEPS = 4        # of the physics in a period
FORCE_BANDWIDTH, TORQUE_BANDWIDTH = 3.0, 4.0    # [rad/s] of the controller's estimate
NUMBERS = 176       # random numbers for each robot and step
REACHED_POSITION, REACHED_ATTITUDE = 0.10, 0.17453    # [m], [rad] limits of the task metrics


class TiltableQuadrotorEnv:
    """
    N robots in one tensor program; its step is compiled on a GPU, or as ``compiled`` says.

    Attributes:
        state: name -> (N, ...) tensor, all quantities that persist between steps.
        weights: (R,) reward weights in the order of ``rewards.TERMS``, on the device. They may
            change between steps, as may ``severity``.
        severity: () factor on forces, payloads and pushes.

    """

    def __init__(self, parameters: TrainParameters, robot: RobotParameters,
                 device: torch.device | str = 'cpu', compiled: bool | None = None):
        self.cfg, self.robot, self.device = parameters, robot, torch.device(device)
        self.num_envs, self.num_actions = parameters.ppo.robots, model.INPUT_SIZE
        self.max_episode_length = round(parameters.episode.duration / batch.PERIOD)
        self.physics = Physics(robot, batch.PERIOD, SUBSTEPS, device)
        contract = PolicyContract.default(robot, parameters.memory)
        self.scale = self._tensor(contract.action_scale)
        self.offset = self._tensor(contract.action_offset)
        limit, rotors = robot.joints.position_limit, robot.rotors
        self._low = self._tensor([-limit] * 4 + [rotors.thrust_min] * 4)
        self._high = self._tensor([limit] * 4 + [rotors.thrust_max] * 4)
        self._torque_ratio = self._tensor(-np.array(rotors.spin) * rotors.torque_to_thrust_ratio)
        self._starts = Starts(parameters, robot, self.num_envs, self.device)
        self.severity = self._starts.severity
        self._module_moment = module_reaction(robot)['mass_moment'] if robot.multibody else 0.0
        self._axes = self._tensor(robot.tilt_axes)
        self._sideways = self._tensor(np.cross(robot.tilt_axes, [0.0, 0.0, 1.0]))
        self._rotors = self._tensor(rotors.positions)
        self._nominal = self._tensor(nominal_body(robot))
        self.base_weights = self._tensor([getattr(parameters.reward, name)
                                          for name in rewards.TERMS]) * parameters.reward.scale
        self.weights = self.base_weights.clone()
        numbers = self._numbers()
        # clones, because equal initial entries must not share memory
        self.state = {name: value.clone()
                      for name, value in self._starts.draw(batch.Draw(numbers)).items()}
        age = torch.rand(self.num_envs, device=self.device) * self.max_episode_length
        self.state['age'] = age.floor()
        self._replays = Replays(self.state, parameters.episode.replay_share,
                                parameters.episode.target_time[1] / batch.PERIOD)
        # sums since the last reading: targets finished, reached, errors, rewards, ends
        self.tally = torch.zeros(8 + len(rewards.TERMS), device=self.device)
        self._finish = self._after_physics
        if compiled if compiled is not None else self.device.type == 'cuda':
            self._finish = torch.compile(self._after_physics, fullgraph=True, dynamic=False)
        if parameters.memory:
            self.state['estimate'] = self._outside(self.state)
        self.observation, self.critic = self._observe(self.state, batch.Draw(numbers[:, 138:]))
        self.reward = torch.zeros(self.num_envs, device=self.device)
        self.done, self.timeout = self.reward > 0, self.reward > 0

    def _tensor(self, values):
        return torch.tensor(np.asarray(values, dtype=float), dtype=torch.float32,
                            device=self.device)

    def _numbers(self):
        return torch.rand(self.num_envs, NUMBERS, device=self.device)

    def get_observations(self) -> TensorDict:
        """Observation groups 'actor' (N, 33 or 39) and 'critic' (N, 47 or 59)."""
        return TensorDict({'actor': self.observation, 'critic': self.critic},
                          batch_size=[self.num_envs], device=self.device)

    def advance(self, actions: torch.Tensor) -> None:
        """One period of all robots; sets observation, critic, reward, done, timeout."""
        requested = self.offset + self.scale * actions
        command = torch.clamp(requested, self._low, self._high)
        s, limit = self.state, self._thrust_limit()
        given = tuple(torch.cat((c[:, :4], torch.minimum(c[:, 4:], limit)), -1)
                      for c in (command, s['previous'], s['older']))
        x = self.physics.advance(s['x'], given, s['delays'][:, :2], s['wrench'], s['body'])
        new, *results, tally = self._finish(s, x, requested, command, self._numbers(),
                                            self.weights)
        torch._foreach_copy_([s[name] for name in new], list(new.values()))
        for own, result in zip((self.observation, self.critic, self.reward, self.done,
                                self.timeout), results):
            own.copy_(result)
        self.tally.add_(tally)

    def _thrust_limit(self):
        """(N, 1) largest thrust that the pack allows under the present load [N]."""
        load = (self.state['x'][:, model.THRUST].clamp(min=0) ** 1.5).sum(-1, keepdim=True)
        beyond = (load - 4 * self.robot.hover_thrust ** 1.5).clamp(min=0)
        return (self.state['thrust_limit'] - self.cfg.random.thrust_sag * beyond).clamp(min=0)

    def _after_physics(self, s, x, requested, command, numbers, weights):
        """Push, reward, end of the episode, new targets, reset and observation."""
        draw, limits = batch.Draw(numbers), self.cfg.episode
        x = self._push(s, x, draw)
        rotation, target = batch.matrix(x[:, model.QUATERNION]), batch.matrix(s['target_attitude'])
        inputs = self._reward_inputs(s, x, requested, rotation, target)
        distance, angle = inputs['position_error'], inputs['attitude_error']
        made = rewards.terms(**inputs)
        terms = torch.stack([made[name] for name in rewards.TERMS], -1)
        broken = ~torch.isfinite(x).all(-1)
        calm = s['disturbed'][:, 0] < 0.5
        died = broken | (distance > limits.position_limit) \
            | (inputs['speed'] > limits.velocity_limit) | (inputs['rate'] > limits.rate_limit)
        reward = torch.where(broken, 0.0, terms @ weights) \
            + died * (self.cfg.reward.termination * self.cfg.reward.scale)
        age = s['age'] + 1
        timeout = (age >= self.max_episode_length) & ~died
        done = died | timeout
        due = (s['target_left'] <= 1) & ~done
        reached = (distance < REACHED_POSITION) & (angle < REACHED_ATTITUDE)
        finished = due & calm & (s['source'] < 0)
        tally = torch.cat([torch.stack([
            finished.sum(), (finished & reached).sum(), (finished * distance).sum(),
            (finished * angle).sum(), reward.sum(), died.sum(), timeout.sum(),
            torch.ones_like(reward).sum()]),
            torch.where(broken[:, None], 0.0, terms).sum(0)])
        new = self._continued(s, x, command, age, inputs['depth'])
        missed = calm & ((died & ~broken) | due & (
            (distance > MISSED_POSITION) | (angle > MISSED_ATTITUDE)
            | (new['deepest'] > MISSED_DEPTH)))
        new = self._retarget(new, due, rotation, draw)
        self._replays.step(s, new, self._starts.draw(draw),
                           {'due': due, 'done': done, 'missed': missed}, draw)
        if self.cfg.memory:     # the estimate of a real robot has settled before its first target
            new['estimate'] = torch.where(done[:, None], self._outside(new), new['estimate'])
        observation, critic = self._observe(new, draw)
        return new, observation, critic, reward, done, timeout, tally

    def _push(self, s, x, draw):
        r = self.cfg.random
        push = draw.chance(s['pushed'] * (batch.PERIOD / r.push_period))
        # uniform, with the standard deviation of the parameters
        kick = torch.cat((draw.around(3 ** 0.5 * r.push_velocity, 3),
                          draw.around(3 ** 0.5 * r.push_rate, 3)), -1) * push * self.severity
        return torch.cat((x[:, model.POSITION], x[:, model.VELOCITY] + kick[:, :3],
                          x[:, model.QUATERNION], x[:, model.RATE] + kick[:, 3:], x[:, 13:]), -1)

    def _reward_inputs(self, s, x, requested, rotation, target):
        return {
            'position_error': (x[:, model.POSITION] - s['target_position']).norm(dim=-1),
            'attitude_error': batch.geodesic(rotation, target),
            'speed': x[:, model.VELOCITY].norm(dim=-1), 'rate': x[:, model.RATE].norm(dim=-1),
            'tilt': x[:, model.TILT], 'tilt_rate': x[:, model.TILT_RATE],
            'previous_tilt_rate': s['x'][:, model.TILT_RATE], 'thrust': x[:, model.THRUST],
            'tilt_command': requested[:, :4], 'thrust_command': requested[:, 4:],
            'previous_tilt_command': s['previous'][:, :4],
            'previous_thrust_command': s['previous'][:, 4:],
            'z_axis': rotation[:, :, 2], 'target_z_axis': target[:, :, 2],
            'depth': (s['floor'][:, 0] - x[:, 2]).clamp(min=0),
            'tilt_limit': self.robot.joints.position_limit,
            'thrust_limit': self.robot.rotors.thrust_max}

    def _continued(self, s, x, command, age, depth):
        """State after a step without resets and new targets."""
        new = dict(s)
        old = batch.matrix(s['x'][:, model.QUATERNION])
        motion = torch.cat((batch.transpose_product(old, s['x'][:, model.VELOCITY]),
                            s['x'][:, model.RATE]), -1)
        new.update(
            x=x, previous=command, older=s['previous'], age=age,
            target_left=s['target_left'] - 1, deepest=torch.maximum(s['deepest'], depth),
            past_motion=torch.cat((motion[:, None], s['past_motion'][:, :3]), 1),
            past_tilt=torch.cat((s['x'][:, None, model.TILT], s['past_tilt'][:, :1]), 1),
            trim=self._trim(s, x))
        if self.cfg.memory:
            new['estimate'] = self._disturbance_estimate(s, new)
        return new

    def _trim(self, s, x):
        """(N, 6) shift of the target, as :class:`control.guidance.Trimming`."""
        rate = guidance.TRIM_RATE * batch.PERIOD
        way = s['target_position'] - x[:, model.POSITION] - s['bias'][:, 0:3]
        seen = batch.product(x[:, model.QUATERNION],
                             batch.from_rotation_vector(s['bias'][:, 3:6]))
        turn = batch.small_turn(batch.matrix(seen), batch.matrix(s['target_attitude']))
        steady = (way.norm(dim=-1) <= guidance.NEAR_DISTANCE) \
            & (turn.norm(dim=-1) <= guidance.NEAR_ANGLE) \
            & (x[:, model.VELOCITY].norm(dim=-1) <= guidance.SLOW) \
            & (x[:, model.RATE].norm(dim=-1) <= guidance.SLOW_TURN)
        made = s['trim'] + rate * s['trimmed'] * steady[:, None] * torch.cat((way, turn), -1)
        parts = [part * (limit / part.norm(dim=-1, keepdim=True).clamp(min=limit))
                 for part, limit in zip(
                     made.split(3, -1), (guidance.TRIM_DISTANCE, guidance.TRIM_ANGLE))]
        return torch.cat(parts, -1)

    def _disturbance_estimate(self, s, new):
        """Disturbance estimate (N, 6): the wrench outside the nominal model, through a lag."""
        # The estimator compares the measured motion with the effect of the present commands on the
        # nominal robot. A delayed rate gives an error: the difference of the delayed, extrapolated
        # change of rate and the present change.
        x, old, body = new['x'], s['x'], new['body']
        changes = (x[:, model.VELOCITY] - old[:, model.VELOCITY],
                   x[:, model.RATE] - old[:, model.RATE])
        beyond = self._outside(new) + torch.cat((
            (self._nominal[MASS] - body[:, MASS]) / batch.PERIOD * changes[0],
            ((self._nominal[INERTIA] - body[:, INERTIA]) * changes[1]
             + body[:, INERTIA] * self._delay_error(s, x)) / batch.PERIOD), -1)
        lag = torch.full_like(beyond, FORCE_BANDWIDTH * batch.PERIOD)
        lag[:, 3:] = TORQUE_BANDWIDTH * batch.PERIOD
        return s['estimate'] + lag * (beyond - s['estimate'])

    def _outside(self, s):
        """(N, 6) force in world and torque in body outside the nominal model, at rest."""
        x, body = s['x'], s['body']
        rotation, tilt, thrust = batch.matrix(x[:, model.QUATERNION]), x[:, model.TILT], \
            x[:, model.THRUST]
        mass, weight = body[:, MASS], torch.zeros_like(s['wrench'][:, :3])
        weight[:, 2] = -self.robot.gravity
        turned = torch.sin(tilt)[:, :, None] * self._sideways     # (N, 4, 3)
        directions = turned.clone()
        directions[:, :, 2] += torch.cos(tilt)
        leaned = directions.sum(1)
        leaned[:, 2] -= 4
        centre = body[:, CENTRE] - self._module_moment / mass * leaned
        pull = batch.transpose_product(rotation, weight * mass)
        more = (body[:, GAIN] - self._nominal[GAIN])[:, :, None] * thrust[:, :, None] * directions
        # With longer arms the torque also grows by the whole thrust.
        levers = (body[:, ARM] * body[:, GAIN] - self._nominal[GAIN])[:, :, None] \
            * thrust[:, :, None] * torch.linalg.cross(self._rotors.expand_as(directions),
                                                      directions)
        force = s['wrench'][:, :3] + (mass - self._nominal[MASS]) * weight \
            + (rotation * more.sum(1)[:, None]).sum(-1)
        torque = s['wrench'][:, 3:] + torch.linalg.cross(centre, pull) + levers.sum(1) \
            + (self._torque_ratio[:, None] * more).sum(1)
        return torch.cat((force, torque), -1)

    @staticmethod
    def _delay_error(s, x):
        """(N, 3) change of the delayed body rate over the last step, minus the true change."""
        rates = torch.cat((x[:, None, model.RATE], s['x'][:, None, model.RATE],
                           s['past_motion'][:, :, 3:]), 1)
        changes = rates[:, :-1] - rates[:, 1:]
        delay = s['delays'][:, 2:3]
        return batch.extrapolated(changes, delay, s['extrapolated'] * delay) - changes[:, 0]

    def _retarget(self, new, due, rotation, draw):
        target = self._starts.target(draw, new['x'][:, model.POSITION],
                                     new['x'][:, model.QUATERNION])
        changed = new | {name: torch.where(spread(due, value), value, new[name])
                         for name, value in target.items()}
        way = changed['target_position'] - new['target_position']
        turn = batch.geodesic(batch.matrix(changed['target_attitude']),
                              batch.matrix(new['target_attitude']))
        near = (way.norm(dim=-1) <= guidance.NEAR_DISTANCE) & (turn <= guidance.NEAR_ANGLE)
        changed['trim'] = new['trim'] * near[:, None]
        # A strong force comes and goes with the targets, because a robot also meets it in flight.
        for name, other in (('wrench', 'other_wrench'), ('other_wrench', 'wrench')):
            changed[name] = torch.where(spread(due, new[name]), new[other], new[name])
        return changed

    def _observe(self, s, draw):
        previous_action, memory = (s['previous'] - self.offset) / self.scale, self.cfg.memory
        return batch.actor_observation(self.cfg.random, s, previous_action, memory, draw), \
            batch.critic_observation(s, previous_action, self._torque_ratio, memory)

    def read_tally(self) -> dict[str, float]:
        """Averages since the last call, which then restart; waits for the device."""
        count, reached, far, turned, reward, deaths, over, steps, *terms = self.tally.tolist()
        self.tally.zero_()
        targets, each = max(count, 1.0), max(steps, 1.0)
        return {'targets': count, 'success_rate': reached / targets,
                'position_error_m': far / targets,
                'attitude_error_deg': float(np.degrees(turned / targets)), 'reward': reward / each,
                'deaths': deaths, 'episodes': deaths + over, 'steps': steps,
                **{f'reward/{name}': value / each * getattr(self.cfg.reward, name)
                   for name, value in zip(rewards.TERMS, terms)}}
