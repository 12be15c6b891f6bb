"""Observations of actor and critic for a batch of robots, as :func:`control.policy.observed`."""

import torch

from beetle_omni_ros.robot import dynamics as model
from beetle_omni_ros.train import batch


class Signals:
    """
    Estimated state as observed by the policy: delayed, biased and noisy.

    Args:
        random: :class:`train.parameters.RandomParameters`.
        s: environment state.
        draw: source of random numbers.

    Attributes:
        position: (N, 3) [m].
        rotation: (N, 3, 3).
        velocity: (N, 3) in base_link [m/s].
        rate: (N, 3) [rad/s].
        tilt: (N, 4) [rad].

    """

    def __init__(self, random, s, draw):
        r, x, scale, bias = random, s['x'], s['noise'], s['bias']
        self.position = x[:, model.POSITION] + bias[:, 0:3] \
            + scale * draw.around(r.position_noise, 3)
        error = bias[:, 3:6] + scale * draw.around(r.attitude_noise, 3)
        self.rotation = batch.matrix(batch.product(
            x[:, model.QUATERNION], batch.from_rotation_vector(error)))
        now = torch.cat((batch.transpose_product(batch.matrix(x[:, model.QUATERNION]),
                                                 x[:, model.VELOCITY]), x[:, model.RATE]), -1)
        ahead = s['extrapolated'] * s['delays'][:, 2:3]
        motion = extrapolated(torch.cat((now[:, None], s['past_motion']), 1),
                              s['delays'][:, 2:3], ahead)
        self.velocity = motion[:, :3] + bias[:, 6:9] + scale * draw.around(r.velocity_noise, 3)
        # A trend through two noisy readings has the weights 1 + a and -a.
        gain = ((1 + ahead / PERIOD) ** 2 + (ahead / PERIOD) ** 2).sqrt()
        self.rate = motion[:, 3:] + bias[:, 9:12] + scale * gain * draw.around(r.rate_noise, 3)
        tilts = torch.cat((x[:, None, model.TILT], s['past_tilt']), 1)
        self.tilt = delayed(tilts, s['delays'][:, 3:4]) + bias[:, 12:16] \
            + scale * draw.around(r.tilt_noise, 4)


PERIOD = 0.01   # [s] between two entries of a history


def delayed(history: torch.Tensor, delay: torch.Tensor) -> torch.Tensor:
    """
    Value before ``delay``, interpolated linearly between the entries of a history.

    Args:
        history: (N, H, K), newest first, one control period apart.
        delay: (N, 1) [s], at most (H - 1) periods.

    """
    back = delay / PERIOD
    weights = (1 - (back - torch.arange(history.shape[1], device=history.device)).abs()).clamp(0)
    return (history * weights[:, :, None]).sum(1)


def extrapolated(history: torch.Tensor, delay: torch.Tensor, ahead: torch.Tensor) -> torch.Tensor:
    """
    Value before ``delay``, extrapolated by ``ahead`` with its change over the preceding period.

    The estimator extrapolates delayed rates likewise (:class:`estimation.mounting.Mounting`),
    but with a line through three readings within 10 ms.

    Args:
        history: (N, H, K), newest first, one control period apart.
        delay: (N, 1) [s], at most (H - 2) periods.
        ahead: (N, 1) [s].

    """
    value = delayed(history, delay)
    return value + ahead / PERIOD * (value - delayed(history, delay + PERIOD))


def actor_observation(signals: Signals, s, previous_action, estimate=None, draw=None):
    """(N, 33) observation; with ``estimate``, (N, 39) with the disturbance estimate."""
    trim = s['trim']
    target = batch.matrix(batch.product(s['target_attitude'],
                                        batch.from_rotation_vector(trim[:, 3:])))
    blocks = [signals.velocity, signals.rate,
              batch.transpose_product(signals.rotation,
                                      s['target_position'] + trim[:, :3] - signals.position),
              signals.rotation[:, :, 0], signals.rotation[:, :, 2], target[:, :, 0],
              target[:, :, 2], signals.tilt, previous_action]
    if estimate is not None:
        error = s['bias'][:, 16:22] + s['noise'] * torch.cat(
            (draw.around(estimate.force_noise, 3), draw.around(estimate.torque_noise, 3)), -1)
        blocks += [batch.transpose_product(signals.rotation, s['estimate'][:, :3]) + error[:, :3],
                   s['estimate'][:, 3:] + error[:, 3:]]
    return torch.cat(blocks, -1)


def critic_observation(s, previous_action, torque_ratio, memory: bool = False):
    """(N, 47) true state with torques and thrusts of the rotors and trim; + 6 with memory."""
    x = s['x']
    rotation, target = batch.matrix(x[:, model.QUATERNION]), batch.matrix(s['target_attitude'])
    thrust = x[:, model.THRUST]
    blocks = [batch.transpose_product(rotation, x[:, model.VELOCITY]), x[:, model.RATE],
              batch.transpose_product(rotation, s['target_position'] - x[:, model.POSITION]),
              rotation[:, :, 0], rotation[:, :, 2], target[:, :, 0], target[:, :, 2],
              x[:, model.TILT], torque_ratio * thrust, thrust, previous_action, s['trim']]
    if memory:
        blocks += [batch.transpose_product(rotation, s['estimate'][:, :3]), s['estimate'][:, 3:]]
    return torch.cat(blocks, -1)
