"""What actor and critic see of a batch of robots: :mod:`control.observation`, many at once."""

from __future__ import annotations

import torch

from beetle_omni_ros.robot import dynamics as model
from beetle_omni_ros.train import batch


class Signals:
    """
    The estimated state as the policy gets it: late, biased and noisy.

    Args:
        random: :class:`train.parameters.RandomParameters`.
        s: environment state.
        draw: random numbers.

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
        wrong = bias[:, 3:6] + scale * draw.around(r.attitude_noise, 3)
        self.rotation = batch.matrix(batch.product(
            x[:, model.QUATERNION], batch.from_rotation_vector(wrong)))
        now = torch.cat((batch.turned_back(batch.matrix(x[:, model.QUATERNION]),
                                           x[:, model.VELOCITY]), x[:, model.RATE]), -1)
        ahead = s['carried'] * s['delays'][:, 2:3]
        motion = carried_on(torch.cat((now[:, None], s['past_motion']), 1),
                            s['delays'][:, 2:3], ahead)
        self.velocity = motion[:, :3] + bias[:, 6:9] + scale * draw.around(r.velocity_noise, 3)
        # A trend through two noisy readings: the newer one counts 1 + a times, the older one -a.
        louder = ((1 + ahead / PERIOD) ** 2 + (ahead / PERIOD) ** 2).sqrt()
        self.rate = motion[:, 3:] + bias[:, 9:12] + scale * louder * draw.around(r.rate_noise, 3)
        tilts = torch.cat((x[:, None, model.TILT], s['past_tilt']), 1)
        self.tilt = late(tilts, s['delays'][:, 3:4]) + bias[:, 12:16] \
            + scale * draw.around(r.tilt_noise, 4)


PERIOD = 0.01   # s between two entries of a history


def late(history: torch.Tensor, delay: torch.Tensor) -> torch.Tensor:
    """
    Value ``delay`` ago, linear between the entries of a history.

    Args:
        history: (N, H, K), newest first, one control period apart.
        delay: (N, 1) [s], at most (H - 1) periods.

    """
    back = delay / PERIOD
    weights = (1 - (back - torch.arange(history.shape[1], device=history.device)).abs()).clamp(0)
    return (history * weights[:, :, None]).sum(1)


def carried_on(history: torch.Tensor, delay: torch.Tensor, ahead: torch.Tensor) -> torch.Tensor:
    """
    Value ``delay`` ago, carried on for ``ahead`` by its change over the period before.

    So the estimator treats a rate that turns out old (:class:`estimation.mounting.Mounting`),
    there by a line through three readings in 10 ms.

    Args:
        history: (N, H, K), newest first, one control period apart.
        delay: (N, 1) [s], at most (H - 2) periods.
        ahead: (N, 1) [s].

    """
    value = late(history, delay)
    return value + ahead / PERIOD * (value - late(history, delay + PERIOD))


def actor_observation(signals: Signals, s, previous_action, estimate=None, draw=None):
    """(N, 33) observation, or (N, 39) with the parameters of the disturbance estimate."""
    target = batch.matrix(s['target_attitude'])
    blocks = [signals.velocity, signals.rate,
              batch.turned_back(signals.rotation, s['target_position'] - signals.position),
              signals.rotation[:, :, 0], signals.rotation[:, :, 2], target[:, :, 0],
              target[:, :, 2], signals.tilt, previous_action]
    if estimate is not None:
        wrong = s['bias'][:, 16:22] + s['noise'] * torch.cat(
            (draw.around(estimate.force_noise, 3), draw.around(estimate.torque_noise, 3)), -1)
        blocks += [batch.turned_back(signals.rotation, s['estimate'][:, :3]) + wrong[:, :3],
                   s['estimate'][:, 3:] + wrong[:, 3:]]
    return torch.cat(blocks, -1)


def critic_observation(s, previous_action, torque_ratio, memory: bool = False):
    """(N, 41) true state with the rotors' reaction torques and thrusts; + 6 with memory."""
    x = s['x']
    rotation, target = batch.matrix(x[:, model.QUATERNION]), batch.matrix(s['target_attitude'])
    thrust = x[:, model.THRUST]
    blocks = [batch.turned_back(rotation, x[:, model.VELOCITY]), x[:, model.RATE],
              batch.turned_back(rotation, s['target_position'] - x[:, model.POSITION]),
              rotation[:, :, 0], rotation[:, :, 2], target[:, :, 0], target[:, :, 2],
              x[:, model.TILT], torque_ratio * thrust, thrust, previous_action]
    if memory:
        blocks += [batch.turned_back(rotation, s['estimate'][:, :3]), s['estimate'][:, 3:]]
    return torch.cat(blocks, -1)
