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
           'tilt_latency': [0.010, 0.010]}
PUBLISHED = {'command_latency': [0.005, 0.015], 'velocity_latency': [0.015, 0.025],
             'tilt_latency': [0.005, 0.010], 'carried_share': 1.0, 'noise_power': 0.0,
             'actuator_spread': [0.0, 0.0]}
DISTURBANCES = ('force_share', 'strong_share', 'payload_share', 'push_share')


def conditions(name: str, random: RandomParameters) -> RandomParameters:
    """Randomisation of 'nominal', 'published', or 'measured': nominal with drawn actuators."""
    if name == 'published':
        return replace(random, **PUBLISHED, **dict.fromkeys(DISTURBANCES, 0.0))
    zero = {entry.name: 0.0 for entry in fields(RandomParameters)
            if isinstance(getattr(random, entry.name), float)}
    zero.update(push_period=1.0, thrust_sag=random.thrust_sag)
    spread = [1.0, 1.0] if name == 'measured' else [0.0, 0.0]
    return replace(random, **zero, **NOMINAL, actuator_spread=spread)


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
    start = StartParameters(**dict.fromkeys(STRATA, 0.0) | {'hold': 1.0}, other_branch=0.0)
    episode = replace(
        parameters.episode, duration=1e6, hold_targets=0.0, replay_share=0.0, trim_share=1.0,
        target_time=np.array([SEGMENT, SEGMENT]), region=np.array([4.0, 4.0, 1.4]))
    env = TiltableQuadrotorEnv(replace(
        parameters, ppo=replace(parameters.ppo, robots=robots), episode=episode, start=start,
        random=conditions(name, parameters.random)), robot, device, compiled=False)
    env.state['age'].zero_()
    env.state['target_left'].fill_(round(SEGMENT / batch.PERIOD))
    return _fly(mean, env, segments)


@torch.no_grad()
def _fly(mean, env, segments):
    length = round(SEGMENT / batch.PERIOD)
    rows = []
    lost = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    for _ in range(length * (segments + 1)):
        before = env.state['previous'].clone()
        env.advance(mean(env.observation))
        s, x = env.state, env.state['x']
        lost |= env.done
        change = (s['previous'] - before) ** 2
        rows.append((
            (x[:, :3] - s['target_position']).norm(dim=-1),
            batch.geodesic(batch.matrix(x[:, model.QUATERNION]),
                           batch.matrix(s['target_attitude'])),
            s['floor'][:, 0] - x[:, 2], change[:, :4].mean(), change[:, 4:].mean(),
            (x[:, model.TILT].abs() > 3.9).float().mean(), x[:, model.THRUST].mean()))
    # (segments, length) or (segments, length, robots), without the first segment
    position, attitude, depth, tilt_change, thrust_change, stopped, thrust = (
        torch.stack(column).unflatten(0, (segments + 1, length))[1:] for column in zip(*rows))
    target, way = (slice(*(round(t / batch.PERIOD) - 1 for t in window))
                   for window in (AT_TARGET, ON_THE_WAY))
    deepest = depth.amax(1).clamp(min=0)
    result = {'lost': float(lost.float().mean()),
              'tilt_change_rad': float(tilt_change[:, target].mean().sqrt()),
              'thrust_change_N': float(thrust_change[:, target].mean().sqrt()),
              'at_stop': float(stopped[:, target].mean()), 'thrust_N': float(thrust.mean()),
              'depth_p99_m': float(deepest.quantile(0.99, interpolation='nearest')),
              'depth_p999_m': float(deepest.quantile(0.999, interpolation='nearest'))}
    for name, window in (('U', target), ('L', way)):
        distance, angle = (error[:, window].mean(1)[:, ~lost] for error in (position, attitude))
        result[f'{name}_position_m'] = float(distance.mean())
        result[f'{name}_attitude_deg'] = float(angle.mean().rad2deg())
        if name == 'U':
            reached = (distance < 0.10) & (angle < np.radians(10))
            result['reached'] = float(reached.sum() / (segments * env.num_envs))
    return {key: value for key, value in result.items() if np.isfinite(value)}
