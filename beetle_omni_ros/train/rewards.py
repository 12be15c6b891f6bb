"""
Terms of the reward; the weights are :class:`train.parameters.RewardWeights`.

Published terms follow the publication's reward table, with two changes. The thrust limitation
penalises thrust beyond the limits; as printed, the term would reward full thrust. The orientation
error is the geodesic angle, because a difference of Euler angles is discontinuous. Terms that the
parameters mark "own" are additions.
"""

from dataclasses import fields
from typing import NamedTuple

import torch

from beetle_omni_ros.train.parameters import RewardWeights

TERMS = tuple(entry.name for entry in fields(RewardWeights)
              if entry.name not in ('termination', 'scale'))
SINKING_LIMIT = 0.3    # [m] largest penalty, for any depth


class RewardInputs(NamedTuple):
    """Quantities of N robots after one step."""

    position_error: torch.Tensor             # (N,) distance to the target [m]
    attitude_error: torch.Tensor             # (N,) geodesic angle to the target [rad]
    speed: torch.Tensor                      # (N,) [m/s]
    rate: torch.Tensor                       # (N,) norm of the body rate [rad/s]
    tilt: torch.Tensor                       # (N, 4) [rad]
    tilt_rate: torch.Tensor                  # (N, 4) [rad/s]
    previous_tilt_rate: torch.Tensor         # (N, 4) one step before [rad/s]
    thrust: torch.Tensor                     # (N, 4) after the lag [N]
    tilt_command: torch.Tensor               # (N, 4) output of the policy before limits [rad]
    thrust_command: torch.Tensor             # (N, 4) output of the policy before limits [N]
    previous_tilt_command: torch.Tensor      # (N, 4) limited command of the step before [rad]
    previous_thrust_command: torch.Tensor    # (N, 4) limited command of the step before [N]
    z_axis: torch.Tensor                     # (N, 3) body z axis in world
    target_z_axis: torch.Tensor              # (N, 3) z axis of the target in world
    depth: torch.Tensor                      # (N,) below both start and target [m], not negative
    tilt_limit: float                        # travel of the joints [rad]
    thrust_limit: float                      # largest thrust [N]


def terms(m: RewardInputs) -> dict[str, torch.Tensor]:
    """Name of ``TERMS`` -> (N,) value without weight."""
    p, angle = m.position_error, m.attitude_error
    at_position = (p < 0.02) & (m.speed < 0.02)
    at_pose = (p < 0.02) & (angle < 0.05) & (m.speed < 0.02) & (m.rate < 0.02)
    over = (m.thrust_command - m.thrust_limit).clamp(min=0)
    under = (-m.thrust_command).clamp(min=0)
    uneven = m.thrust_command - m.thrust_command.mean(-1, keepdim=True)
    near_pose = torch.exp(-p / 0.1 - angle / 0.1)
    tilt_change = ((m.tilt_command - m.previous_tilt_command) ** 2).sum(-1)
    thrust_change = ((m.thrust_command - m.previous_thrust_command) ** 2).sum(-1)
    # Small for a few centimetres, which any quick move sinks. It saturates, because otherwise an
    # early end of the episode would pay.
    depth = (m.depth / SINKING_LIMIT) ** 2
    return {
        'position': torch.tanh(p / 0.6),
        'pose': (1 - torch.tanh(angle / 2)) * (1 - torch.tanh(p / 2)),
        'reach_position': at_position * (torch.exp(-p / 0.02) + torch.exp(-m.speed / 0.02)),
        'reach_pose': at_pose * (torch.exp(-p / 0.02) + torch.exp(-m.speed / 0.02)
                                 + torch.exp(-2 * angle / 0.05) + torch.exp(-2 * m.rate / 0.02)),
        'linear_velocity': (torch.exp(0.6 * m.speed.clamp(max=4.0)) - 1) ** 2,
        'angular_velocity': (torch.exp(0.4 * m.rate.clamp(max=6.0)) - 1) ** 2,
        'joint_limit': (m.tilt_command.abs() - m.tilt_limit).clamp(min=0).sum(-1),
        'thrust_limit': (over ** 2 + under ** 2).sum(-1),
        'joint_action_rate': tilt_change,
        'thrust_action_rate': thrust_change,
        'thrust_power': (m.thrust ** 2).sum(-1),
        'joint_acceleration': ((m.tilt_rate - m.previous_tilt_rate) ** 2).sum(-1),
        'z_axis_align': ((m.z_axis - m.target_z_axis).norm(dim=-1) > 1.5).float(),
        'thrust_allocation': (uneven ** 2).sum(-1) * m.z_axis[:, 2] ** 2,
        'attitude': angle / torch.pi,
        'near_position': torch.exp(-p / 0.1),
        'near_attitude': torch.exp(-angle / 0.15),
        'near_pose': near_pose,
        'exact_pose': torch.exp(-p / 0.02 - angle / 0.03),
        'joint_winding': (m.tilt.abs() - torch.pi).clamp(min=0).sum(-1),
        'hover_tilt_rate': near_pose * tilt_change,
        'hover_thrust_rate': near_pose * thrust_change,
        'sinking': SINKING_LIMIT * depth / (1 + depth)}
