"""
Terms of the reward; the weights are :class:`train.parameters.RewardWeights`.

Published terms follow the publication's reward table, with two changes. The thrust limitation
penalises thrust beyond the limits; as printed, the term would reward full thrust. The orientation
error is the geodesic angle, because a difference of Euler angles is discontinuous. Terms that the
parameters mark "own" are additions.
"""

from dataclasses import fields

import torch

from beetle_omni_ros.train.parameters import RewardWeights

TERMS = tuple(entry.name for entry in fields(RewardWeights)
              if entry.name not in ('termination', 'scale'))
SINKING_LIMIT = 0.4    # [m] largest penalty, for any depth


def terms(*, position_error, attitude_error, speed, rate, tilt, tilt_rate, previous_tilt_rate,
          thrust, tilt_command, thrust_command, previous_tilt_command, previous_thrust_command,
          z_axis, target_z_axis, depth, tilt_limit, thrust_limit) -> dict[str, torch.Tensor]:
    """
    Name of ``TERMS`` -> (N,) value without weight, of N robots after one step.

    The errors (N,) are distance [m] and geodesic angle [rad] to the target, speed [m/s] and rate
    [rad/s] (N,) are norms, depth (N,) is that below both start and target [m], not negative.
    Tilts [rad], tilt rates [rad/s] and thrusts after the lag [N] are (N, 4). So are the commands,
    the output of the policy before limits, and the previous ones, which are limited. The axes of
    body and target (N, 3) are in world.
    """
    p, angle = position_error, attitude_error
    at_position = (p < 0.02) & (speed < 0.02)
    at_pose = (p < 0.02) & (angle < 0.05) & (speed < 0.02) & (rate < 0.02)
    over = (thrust_command - thrust_limit).clamp(min=0)
    under = (-thrust_command).clamp(min=0)
    uneven = thrust_command - thrust_command.mean(-1, keepdim=True)
    near_pose = torch.exp(-p / 0.1 - angle / 0.1)
    tilt_change = ((tilt_command - previous_tilt_command) ** 2).sum(-1)
    thrust_change = ((thrust_command - previous_thrust_command) ** 2).sum(-1)
    # Small for a few centimetres, which any quick move sinks. It saturates, because otherwise an
    # early end of the episode would pay.
    sunk = (depth / SINKING_LIMIT) ** 2
    return {
        'position': torch.tanh(p / 0.6),
        'pose': (1 - torch.tanh(angle / 2)) * (1 - torch.tanh(p / 2)),
        'reach_position': at_position * (torch.exp(-p / 0.02) + torch.exp(-speed / 0.02)),
        'reach_pose': at_pose * (torch.exp(-p / 0.02) + torch.exp(-speed / 0.02)
                                 + torch.exp(-2 * angle / 0.05) + torch.exp(-2 * rate / 0.02)),
        'linear_velocity': (torch.exp(0.6 * speed.clamp(max=4.0)) - 1) ** 2,
        'angular_velocity': (torch.exp(0.4 * rate.clamp(max=6.0)) - 1) ** 2,
        'joint_limit': (tilt_command.abs() - tilt_limit).clamp(min=0).sum(-1),
        'thrust_limit': (over ** 2 + under ** 2).sum(-1),
        'joint_action_rate': tilt_change,
        'thrust_action_rate': thrust_change,
        'thrust_power': (thrust ** 2).sum(-1),
        'joint_acceleration': ((tilt_rate - previous_tilt_rate) ** 2).sum(-1),
        'z_axis_align': ((z_axis - target_z_axis).norm(dim=-1) > 1.5).float(),
        'thrust_allocation': (uneven ** 2).sum(-1) * z_axis[:, 2] ** 2,
        'attitude': angle / torch.pi,
        'near_position': torch.exp(-p / 0.1),
        'near_attitude': torch.exp(-angle / 0.15),
        'near_pose': near_pose,
        'exact_pose': torch.exp(-p / 0.02 - angle / 0.03),
        'joint_winding': (tilt.abs() - torch.pi).clamp(min=0).sum(-1),
        'hover_tilt_rate': near_pose * tilt_change,
        'hover_thrust_rate': near_pose * thrust_change,
        'sinking': SINKING_LIMIT * sunk / (1 + sunk)}
