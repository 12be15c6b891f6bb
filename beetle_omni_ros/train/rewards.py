"""
Terms of the reward, one function each; the weights are :class:`train.parameters.RewardWeights`.

Published terms follow the publication's reward table, with two changes. The thrust limitation
penalises thrust beyond the limits; as printed, the term would reward full thrust. The orientation
error is the geodesic angle, because a difference of Euler angles is discontinuous. Terms that the
parameters mark "own" are additions.
"""

from typing import NamedTuple

import torch

SINKING_LIMIT = 0.3    # [m] largest penalty, for any depth


class RewardInputs(NamedTuple):
    """
    Quantities of N robots after one step.

    Attributes:
        position_error: (N,) distance to the target [m].
        attitude_error: (N,) geodesic angle to the target [rad].
        speed: (N,) [m/s].
        rate: (N,) norm of the body rate [rad/s].
        tilt: (N, 4) [rad].
        tilt_rate: (N, 4) [rad/s].
        previous_tilt_rate: (N, 4) one step before [rad/s].
        thrust: (N, 4) after the lag [N].
        tilt_command: (N, 4) output of the policy before limits [rad].
        thrust_command: (N, 4) output of the policy before limits [N].
        previous_tilt_command: (N, 4) limited command of the step before [rad].
        previous_thrust_command: (N, 4) limited command of the step before [N].
        z_axis: (N, 3) body z axis in world.
        target_z_axis: (N, 3) z axis of the target in world.
        depth: (N,) depth below both start and target [m], not negative.
        tilt_limit: travel of the joints [rad].
        thrust_limit: largest thrust [N].

    """

    position_error: torch.Tensor
    attitude_error: torch.Tensor
    speed: torch.Tensor
    rate: torch.Tensor
    tilt: torch.Tensor
    tilt_rate: torch.Tensor
    previous_tilt_rate: torch.Tensor
    thrust: torch.Tensor
    tilt_command: torch.Tensor
    thrust_command: torch.Tensor
    previous_tilt_command: torch.Tensor
    previous_thrust_command: torch.Tensor
    z_axis: torch.Tensor
    target_z_axis: torch.Tensor
    depth: torch.Tensor
    tilt_limit: float
    thrust_limit: float


def position(m: RewardInputs) -> torch.Tensor:
    """Distance, saturated."""
    return torch.tanh(m.position_error / 0.6)


def pose(m: RewardInputs) -> torch.Tensor:
    """Closeness in position and attitude."""
    return (1 - torch.tanh(m.attitude_error / 2)) * (1 - torch.tanh(m.position_error / 2))


def reach_position(m: RewardInputs) -> torch.Tensor:
    """At rest at the position."""
    reached = (m.position_error < 0.02) & (m.speed < 0.02)
    return reached * (torch.exp(-m.position_error / 0.02) + torch.exp(-m.speed / 0.02))


def reach_pose(m: RewardInputs) -> torch.Tensor:
    """At rest at the pose."""
    reached = (m.position_error < 0.02) & (m.attitude_error < 0.05) \
        & (m.speed < 0.02) & (m.rate < 0.02)
    return reached * (torch.exp(-m.position_error / 0.02) + torch.exp(-m.speed / 0.02)
                      + torch.exp(-2 * m.attitude_error / 0.05) + torch.exp(-2 * m.rate / 0.02))


def linear_velocity(m: RewardInputs) -> torch.Tensor:
    """Speed, up to 4 m/s."""
    return (torch.exp(0.6 * m.speed.clamp(max=4.0)) - 1) ** 2


def angular_velocity(m: RewardInputs) -> torch.Tensor:
    """Body rate, up to 6 rad/s."""
    return (torch.exp(0.4 * m.rate.clamp(max=6.0)) - 1) ** 2


def joint_limit(m: RewardInputs) -> torch.Tensor:
    """Tilt commands beyond the stops."""
    return (m.tilt_command.abs() - m.tilt_limit).clamp(min=0).sum(-1)


def thrust_limit(m: RewardInputs) -> torch.Tensor:
    """Thrust commands outside the rotors' range."""
    over = (m.thrust_command - m.thrust_limit).clamp(min=0)
    under = (-m.thrust_command).clamp(min=0)
    return (over ** 2 + under ** 2).sum(-1)


def joint_action_rate(m: RewardInputs) -> torch.Tensor:
    """Change of the tilt commands."""
    return ((m.tilt_command - m.previous_tilt_command) ** 2).sum(-1)


def thrust_action_rate(m: RewardInputs) -> torch.Tensor:
    """Change of the thrust commands."""
    return ((m.thrust_command - m.previous_thrust_command) ** 2).sum(-1)


def thrust_power(m: RewardInputs) -> torch.Tensor:
    """Effort of the rotors."""
    return (m.thrust ** 2).sum(-1)


def joint_acceleration(m: RewardInputs) -> torch.Tensor:
    """Change of the joint rates."""
    return ((m.tilt_rate - m.previous_tilt_rate) ** 2).sum(-1)


def z_axis_align(m: RewardInputs) -> torch.Tensor:
    """Body z axis opposite to the target's."""
    return ((m.z_axis - m.target_z_axis).norm(dim=-1) > 1.5).float()


def thrust_allocation(m: RewardInputs) -> torch.Tensor:
    """Uneven thrusts, weighted by the level component of the attitude."""
    uneven = m.thrust_command - m.thrust_command.mean(-1, keepdim=True)
    return (uneven ** 2).sum(-1) * m.z_axis[:, 2] ** 2


def attitude(m: RewardInputs) -> torch.Tensor:
    """Orientation error; its slope does not vanish far from the target, unlike that of 'pose'."""
    return m.attitude_error / torch.pi


def near_position(m: RewardInputs) -> torch.Tensor:
    """Closeness in position within a decimetre, where the published terms are flat."""
    return torch.exp(-m.position_error / 0.1)


def near_attitude(m: RewardInputs) -> torch.Tensor:
    """Closeness in attitude within 0.15 rad."""
    return torch.exp(-m.attitude_error / 0.15)


def near_pose(m: RewardInputs) -> torch.Tensor:
    """Closeness in position and attitude, within a decimetre and 0.1 rad."""
    return torch.exp(-m.position_error / 0.1 - m.attitude_error / 0.1)


def exact_pose(m: RewardInputs) -> torch.Tensor:
    """Closeness within centimetres and degrees."""
    return torch.exp(-m.position_error / 0.02 - m.attitude_error / 0.03)


def joint_winding(m: RewardInputs) -> torch.Tensor:
    """Joint angles beyond half a turn, from which a joint may reach a stop."""
    return (m.tilt.abs() - torch.pi).clamp(min=0).sum(-1)


def hover_tilt_rate(m: RewardInputs) -> torch.Tensor:
    """Change of the tilt commands near the target."""
    return near_pose(m) * joint_action_rate(m)


def hover_thrust_rate(m: RewardInputs) -> torch.Tensor:
    """Change of the thrust commands near the target."""
    return near_pose(m) * thrust_action_rate(m)


def sinking(m: RewardInputs) -> torch.Tensor:
    """
    Depth below both start and target, where a floor may be.

    It is small for a few centimetres, which any quick move sinks. It saturates, because otherwise
    an early end of the episode would pay.
    """
    squared = (m.depth / SINKING_LIMIT) ** 2
    return SINKING_LIMIT * squared / (1 + squared)


TERMS = {term.__name__: term for term in (
    position, pose, reach_position, reach_pose, linear_velocity, angular_velocity, joint_limit,
    thrust_limit, joint_action_rate, thrust_action_rate, thrust_power, joint_acceleration,
    z_axis_align, thrust_allocation, attitude, near_position, near_attitude, near_pose,
    exact_pose, joint_winding, hover_tilt_rate, hover_thrust_rate, sinking)}


def terms(inputs: RewardInputs) -> torch.Tensor:
    """(N, R) values without weights, columns in the order of ``TERMS``."""
    return torch.stack([term(inputs) for term in TERMS.values()], -1)
