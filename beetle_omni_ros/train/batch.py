"""Rotations, random numbers and observations of a batch in torch; rows are robots."""

import torch

from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model import rotations
from beetle_omni_ros.train.model import ARM, GAIN, MASS

PERIOD = 0.01   # [s] between two entries of a history


def matrix(quaternion: torch.Tensor) -> torch.Tensor:
    """Rotation matrices (N, 3, 3) of unit quaternions (N, 4), (x, y, z, w)."""
    return torch.stack(rotations.entries(*quaternion.unbind(-1)), -1).unflatten(-1, (3, 3))


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Quaternion product (N, 4), first ``b`` then ``a``."""
    return torch.stack(rotations.product(*a.unbind(-1), *b.unbind(-1)), -1)


def from_rotation_vector(vector: torch.Tensor) -> torch.Tensor:
    """Quaternions (N, 4) of rotation vectors (N, 3) [rad]."""
    half = 0.5 * vector.norm(dim=-1, keepdim=True)
    return torch.cat((0.5 * vector * torch.sinc(half / torch.pi), torch.cos(half)), -1)


def geodesic(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Angle (N,) [rad] between rotation matrices (N, 3, 3), accurate also for small angles."""
    relative = transpose_product(a, b)
    sine = small_turn(a, b).norm(dim=-1)
    cosine = 0.5 * (relative[:, 0, 0] + relative[:, 1, 1] + relative[:, 2, 2] - 1)
    return torch.atan2(sine, cosine)


def small_turn(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Rotation vectors (N, 3) [rad] from matrices a to b, in the axes of a, for small angles."""
    relative = transpose_product(a, b)
    return 0.5 * torch.stack((relative[:, 2, 1] - relative[:, 1, 2],
                              relative[:, 0, 2] - relative[:, 2, 0],
                              relative[:, 1, 0] - relative[:, 0, 1]), -1)


def transpose_product(rotation: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """R^T other for matrices (N, 3, 3) or vectors (N, 3), without a batched matrix product."""
    if other.dim() == 2:
        return (rotation * other[:, :, None]).sum(1)
    return (rotation[:, :, :, None] * other[:, :, None, :]).sum(1)


class Draw:
    """
    Source of random numbers, the columns of a tensor (N, K) of uniform numbers in [0, 1).

    A step then needs one random kernel, and a captured step gets new numbers.
    """

    def __init__(self, numbers: torch.Tensor):
        self._numbers, self._used = numbers, 0

    def uniform(self, size: int, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
        """(N, size) uniform in [low, high)."""
        first, self._used = self._used, self._used + size
        return low + (high - low) * self._numbers[:, first:self._used]

    def around(self, half_width: float, size: int) -> torch.Tensor:
        """(N, size) uniform in +-half_width."""
        return self.uniform(size, -half_width, half_width)

    def chance(self, probability: float | torch.Tensor) -> torch.Tensor:
        """(N, 1) bool, true with this probability, a number or (N, 1)."""
        return self.uniform(1) < probability

    def direction(self) -> torch.Tensor:
        """(N, 3) unit vectors, uniform on the sphere."""
        z, angle = self.around(1.0, 1), self.uniform(1, 0.0, 2 * torch.pi)
        flat = torch.sqrt(1 - z * z)
        return torch.cat((flat * torch.cos(angle), flat * torch.sin(angle), z), -1)

    def attitude(self) -> torch.Tensor:
        """
        (N, 4) quaternions, half uniform on SO(3), half with uniform axis and uniform angle.

        The first half follows K. Shoemake, Uniform random rotations (1992), the second the
        publication.
        """
        a, b, c = self.uniform(3).unbind(-1)
        low, high, tau = torch.sqrt(1 - a), torch.sqrt(a), 2 * torch.pi
        uniform = torch.stack((low * torch.sin(tau * b), low * torch.cos(tau * b),
                               high * torch.sin(tau * c), high * torch.cos(tau * c)), -1)
        z, flat = 2 * a - 1, 2 * torch.sqrt((1 - a) * a)
        half = 0.5 * torch.pi * (2 * c - 1)[:, None]
        axis = torch.stack((flat * torch.cos(tau * b), flat * torch.sin(tau * b), z), -1)
        axis_angle = torch.cat((axis * torch.sin(half), torch.cos(half)), -1)
        return torch.where(self.chance(0.5), uniform, axis_angle)


def sensed(random, s, draw):
    """
    Position, rotation, velocity, rate and tilts that the policy observes: delayed and noisy.

    The velocity is in base_link, as rate and tilt in the units of :mod:`robot.dynamics`. The
    rotations are matrices (N, 3, 3).
    """
    r, x, scale, bias = random, s['x'], s['noise'], s['bias']
    position = x[:, model.POSITION] + bias[:, 0:3] + scale * draw.around(r.position_noise, 3)
    error = bias[:, 3:6] + scale * draw.around(r.attitude_noise, 3)
    rotation = matrix(product(x[:, model.QUATERNION], from_rotation_vector(error)))
    now = torch.cat((transpose_product(matrix(x[:, model.QUATERNION]), x[:, model.VELOCITY]),
                     x[:, model.RATE]), -1)
    ahead = s['extrapolated'] * s['delays'][:, 2:3]
    motion = extrapolated(torch.cat((now[:, None], s['past_motion']), 1),
                          s['delays'][:, 2:3], ahead)
    velocity = motion[:, :3] + bias[:, 6:9] + scale * draw.around(r.velocity_noise, 3)
    # A trend through two noisy readings has the weights 1 + a and -a.
    gain = ((1 + ahead / PERIOD) ** 2 + (ahead / PERIOD) ** 2).sqrt()
    rate = motion[:, 3:] + bias[:, 9:12] + scale * gain * draw.around(r.rate_noise, 3)
    tilts = torch.cat((x[:, None, model.TILT], s['past_tilt']), 1)
    tilt = delayed(tilts, s['delays'][:, 3:4]) + bias[:, 12:16] \
        + scale * draw.around(r.tilt_noise, 4)
    return position, rotation, velocity, rate, tilt


def delayed(history: torch.Tensor, delay: torch.Tensor) -> torch.Tensor:
    """
    Value before ``delay`` (N, 1) [s], interpolated linearly between the entries of a history.

    These (N, H, K) are one control period apart, newest first.
    """
    back = delay / PERIOD
    weights = (1 - (back - torch.arange(history.shape[1], device=history.device)).abs()).clamp(0)
    return (history * weights[:, :, None]).sum(1)


def extrapolated(history: torch.Tensor, delay: torch.Tensor, ahead: torch.Tensor) -> torch.Tensor:
    """
    Value before ``delay``, extrapolated by ``ahead`` with its change over the preceding period.

    The estimator extrapolates delayed rates likewise (:class:`estimation.mounting.Mounting`),
    but with a line through three readings within 10 ms.
    """
    value = delayed(history, delay)
    return value + ahead / PERIOD * (value - delayed(history, delay + PERIOD))


def actor_observation(random, s, previous_action, memory, draw):
    """(N, 33) observation; with ``memory``, (N, 39) with the disturbance estimate."""
    position, rotation, velocity, rate, tilt = sensed(random, s, draw)
    trim = s['trim']
    target = matrix(product(s['target_attitude'], from_rotation_vector(trim[:, 3:])))
    blocks = [velocity, rate,
              transpose_product(rotation, s['target_position'] + trim[:, :3] - position),
              rotation[:, :, 0], rotation[:, :, 2], target[:, :, 0], target[:, :, 2], tilt,
              previous_action]
    if memory:
        error = s['bias'][:, 16:22] + s['noise'] * torch.cat(
            (draw.around(random.estimated_force_noise, 3),
             draw.around(random.estimated_torque_noise, 3)), -1)
        blocks += [transpose_product(rotation, s['estimate'][:, :3]) + error[:, :3],
                   s['estimate'][:, 3:] + error[:, 3:]]
    return torch.cat(blocks, -1)


def critic_observation(s, previous_action, torque_ratio, memory):
    """(N, 47) true state with torques and thrusts of the rotors and trim; + 12 with memory."""
    x = s['x']
    rotation, target = matrix(x[:, model.QUATERNION]), matrix(s['target_attitude'])
    thrust = x[:, model.THRUST]
    blocks = [transpose_product(rotation, x[:, model.VELOCITY]), x[:, model.RATE],
              transpose_product(rotation, s['target_position'] - x[:, model.POSITION]),
              rotation[:, :, 0], rotation[:, :, 2], target[:, :, 0], target[:, :, 2],
              x[:, model.TILT], torque_ratio * thrust, thrust, previous_action, s['trim']]
    if memory:
        blocks += [transpose_product(rotation, s['estimate'][:, :3]), s['estimate'][:, 3:],
                   s['body'][:, MASS], s['body'][:, ARM], s['body'][:, GAIN]]
    return torch.cat(blocks, -1)
