"""
Task metrics of a policy in the training environment, for many robots at once.

This is a quick independent measurement during training. The reference is ``beetle_omni
evaluate``, with the multibody plant, the estimator and the floor.
"""

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import torch

from beetle_omni_ros.robot import dynamics as model
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.train import batch
from beetle_omni_ros.train.environment import TiltableQuadrotorEnv
from beetle_omni_ros.train.parameters import (
    RandomParameters,
    StartParameters,
    STRATA,
    TrainParameters,
)

SEGMENT = 8.0                       # [s] duration of a pose; windows of the task metrics [s]
AT_TARGET, ON_THE_WAY = (7.0, 7.5), (1.0, 7.0)
# Latencies of the simulated robot, and the conditions of the publication's table.
NOMINAL = {'command_latency': [0.010, 0.010], 'velocity_latency': [0.0, 0.0],
           'tilt_latency': [0.010, 0.010], 'actuator_spread': [0.0, 0.0]}
PUBLISHED = {'command_latency': [0.005, 0.015], 'velocity_latency': [0.015, 0.025],
             'tilt_latency': [0.005, 0.010], 'carried_share': 1.0, 'noise_power': 0.0,
             'actuator_spread': [0.0, 0.0]}
DISTURBANCES = ('force_share', 'strong_share', 'payload_share', 'push_share')


def conditions(name: str, random: RandomParameters) -> RandomParameters:
    """Randomisation of 'nominal', 'published', or 'measured': nominal with drawn actuators."""
    if name == 'published':
        own = {key: np.array(value) if isinstance(value, list) else value
               for key, value in PUBLISHED.items()}
        return replace(random, **own, **dict.fromkeys(DISTURBANCES, 0.0))
    zero = {entry.name: 0.0 for entry in fields(RandomParameters)
            if isinstance(getattr(random, entry.name), float)}
    zero.update(push_period=1.0, thrust_sag=random.thrust_sag)
    own = {key: np.array(value) for key, value in NOMINAL.items()}
    if name == 'measured':
        own['actuator_spread'] = np.array([1.0, 1.0])
    return replace(random, **zero, **own)


def assess(mean: Callable[[torch.Tensor], torch.Tensor], parameters: TrainParameters,
           robot: RobotParameters, device='cpu', name: str = 'nominal', robots: int = 1024,
           segments: int = 3) -> dict[str, float]:
    """
    Fly a policy from pose to pose.

    Args:
        mean: function from (N, 33 or 39) observations to (N, 8) actions.
        parameters: parameters of its training.
        robot: nominal robot.
        device: torch device.
        name: of :func:`conditions`.
        robots: N.
        segments: poses for each robot, after a first one that does not count.

    Returns:
        means U_*, L_* of robots never lost, fraction of poses reached, fraction of robots lost,
        command change in the U windows, fraction of joints at a stop there, mean thrust, and the
        99 and 99.9 % quantiles of the depth of moves below start and target.

    """
    start = StartParameters(**{**dict.fromkeys(STRATA, 0.0), 'hold': 1.0}, other_branch=0.0)
    episode = replace(
        parameters.episode, duration=1e6, hold_targets=0.0, replay_share=0.0, trim_share=1.0,
        target_time=np.array([SEGMENT, SEGMENT]), region=np.array([4.0, 4.0, 1.4]))
    env = TiltableQuadrotorEnv(replace(
        parameters, ppo=replace(parameters.ppo, robots=robots), episode=episode,
        start=start,
        random=conditions(name, parameters.random)),
        robot, device, compiled=False)
    env.state['age'].zero_()
    env.state['target_left'].fill_(round(SEGMENT / batch.PERIOD))
    return _fly(mean, env, segments)


@torch.no_grad()
def _fly(mean, env, segments):
    length = round(SEGMENT / batch.PERIOD)
    windows = {'U': tuple(round(t / batch.PERIOD) for t in AT_TARGET),
               'L': tuple(round(t / batch.PERIOD) for t in ON_THE_WAY)}
    shape = (segments + 1, env.num_envs)
    sums = {key: torch.zeros(shape, device=env.device)
            for key in ('U_position', 'U_attitude', 'L_position', 'L_attitude')}
    change = torch.zeros(2, device=env.device)
    lost = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    stopped = torch.zeros(1, device=env.device)
    depth, thrust = torch.zeros(shape, device=env.device), torch.zeros(1, device=env.device)
    for segment in range(segments + 1):
        for step in range(length):
            before = env.state['previous'].clone()
            env.advance(mean(env.observation))
            s = env.state
            lost |= env.done
            position = (s['x'][:, :3] - s['target_position']).norm(dim=-1)
            attitude = batch.geodesic(batch.matrix(s['x'][:, model.QUATERNION]),
                                      batch.matrix(s['target_attitude']))
            for key, (first, end) in windows.items():
                if first <= step + 1 < end:
                    sums[f'{key}_position'][segment] += position / (end - first)
                    sums[f'{key}_attitude'][segment] += attitude / (end - first)
            depth[segment] = torch.maximum(depth[segment], s['floor'][:, 0] - s['x'][:, 2])
            thrust += s['x'][:, model.THRUST].mean() / (length * (segments + 1))
            if segment and windows['U'][0] <= step + 1 < windows['U'][1]:
                delta = (s['previous'] - before) ** 2
                change += torch.stack((delta[:, :4].mean(), delta[:, 4:].mean()))
                stopped += (s['x'][:, model.TILT].abs() > 3.9).float().mean()
    kept = {key: value[1:][:, ~lost] for key, value in sums.items()}
    count = segments * (windows['U'][1] - windows['U'][0])
    reached = (kept['U_position'] < 0.10) & (kept['U_attitude'] < np.radians(10))
    result = {'reached': float(reached.sum() / (segments * env.num_envs)),
              'lost': float(lost.float().mean()),
              'tilt_change_rad': float((change[0] / count).sqrt()),
              'thrust_change_N': float((change[1] / count).sqrt()),
              'at_stop': float(stopped / count), 'thrust_N': float(thrust),
              'depth_p99_m': float(depth[1:].quantile(0.99, interpolation='nearest')),
              'depth_p999_m': float(depth[1:].quantile(0.999, interpolation='nearest'))}
    for key, value in kept.items():
        mean = float(value.mean())
        result |= {f'{key}_deg': float(np.degrees(mean))} if key.endswith('attitude') \
            else {f'{key}_m': mean}
    return {key: value for key, value in result.items() if np.isfinite(value)}
