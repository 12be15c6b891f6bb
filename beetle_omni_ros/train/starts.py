"""
Random initial states, targets and differences between robots, and replay of missed targets.

A trained policy misses about one target in a thousand, too few to improve it. A fraction of the
episodes therefore begins with the state at the start of a missed target, until it is flown well:
prioritised sampling of initial states, similar to that of steps in T. Schaul et al., Prioritized
experience replay (2016).
"""

from functools import cache

import numpy as np
import torch

from beetle_omni_ros.model.allocation import Allocator
from beetle_omni_ros.model.degraded import sphere
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.train import batch, model
from beetle_omni_ros.train.parameters import STRATA, TrainParameters

NEAR_POSITION, NEAR_ANGLE = 0.3, 0.6   # [m], [rad] of a target near the present pose
MOVING_SPEED, MOVING_RATE = 1.5, 3.0   # [m/s], [rad/s] largest of a moving start, each axis
# Places of damping and lag among the drawn quantities of the actuators.
_DAMPING, _LAG = (slice(part.start - model.ACTUATORS.start, part.stop - model.ACTUATORS.start)
                  for part in (model.DAMPING, model.LAG))
DRAWN = 2048    # robots from the measured intervals, of which the robots of the training are made
LONGEST_DELAY = 2 * batch.PERIOD    # [s] of the stored commands and tilts
DIRECTIONS = 200     # of up in the body, for the thrust that a robot needs to hover
FULL_THRUST = 0.95   # of the largest thrust, which the most demanding attitude may need
LEAST = 0.2     # smallest drawn quantity of an actuator, as a fraction of the smallest measured
PAYLOAD_DEPTH = 0.08                   # [m] below base_link, as in the simulated plant
MISSED_POSITION, MISSED_ATTITUDE = 0.10, 0.10     # [m], [rad] at the end of a target's time
MISSED_DEPTH = 0.15                               # [m] below both start and target, in between
FULL = 0.01          # fraction of the robots with a stored state at which all replays happen
FORGET_FLOWN, FORGET_MISSED = 0.5, 0.1            # probability of deletion after a replay


@cache
def drawn_actuators(robot_file: str, seed: int) -> np.ndarray:
    """(DRAWN, 23) actuators and delays of robots from the intervals of a file; takes seconds."""
    measured, rng = RobotParameters.load(robot_file), np.random.default_rng(seed)
    return np.array([[*model.actuators(one), *one.command_delays] for one in (
        measured.drawn(rng) for _ in range(DRAWN))])


def latencies(parameters: TrainParameters, robot: RobotParameters) -> list[list[float]]:
    """Ranges of the delays of tilt and thrust commands, of the velocity and of the tilts [s]."""
    r, (tilt, thrust) = parameters.random, robot.command_delays
    made = []
    for name, span, more in (('tilt commands', r.command_latency, tilt),
                             ('thrust commands', r.command_latency, thrust),
                             ('velocity', r.velocity_latency, 0.0),
                             ('joint feedback', r.tilt_latency, robot.sensors.encoder_delay)):
        made.append([max(float(t) + more, 0.0) for t in span])
        if more and made[-1][1] > LONGEST_DELAY + 1e-9:
            raise ParameterError(f'effects: {name} are up to {1e3 * made[-1][1]:g} ms late, '
                                 f'the training environment stores {1e3 * LONGEST_DELAY:g} ms')
    return made


class Starts:
    """
    Random initial states of N robots; the stratum of a robot follows from its index.

    Attributes:
        severity: () factor on forces and payloads of new robots, set by the schedule.
        stratum: (N,) index into ``STRATA`` of each robot.

    """

    def __init__(self, parameters: TrainParameters, robot: RobotParameters, count: int, device):
        self._p, self._robot, self._device, self._count = parameters, robot, device, count

        def tensor(values):
            return torch.tensor(np.asarray(values, dtype=float), dtype=torch.float32,
                                device=device)

        shares = np.array([getattr(parameters.start, name) for name in STRATA])
        edges = np.cumsum(shares) / shares.sum()
        # interleaved, so that any part of the batch contains all strata
        place = (np.arange(count) * 0.6180339887498949 + 0.5) % 1.0
        stratum = np.searchsorted(edges, place, side='right').clip(0, len(STRATA) - 1)
        self._is = {name: torch.tensor(stratum == k, device=device)[:, None]
                    for k, name in enumerate(STRATA)}
        self.stratum = stratum
        self._inverse = tensor(Allocator(robot).inverse[:, :3])
        self._weight = tensor([0.0, 0.0, model.nominal_body(robot)[0] * robot.gravity])
        self._body = tensor(model.nominal_body(robot))
        self._region = tensor(parameters.episode.region)
        self._rotors = torch.arange(4, device=device)
        _, thrusts = Allocator(robot).upright(sphere(DIRECTIONS))
        self._least_gain = float(thrusts.max() / (FULL_THRUST * robot.rotors.thrust_max)) \
            / model.nominal_body(robot)[0]
        self.severity = torch.ones((), device=device)
        self._limit = float(robot.joints.position_limit)
        # plain floats, because a compiler takes numpy scalars for tensors of the host
        self._target_time = [float(t) / batch.PERIOD for t in parameters.episode.target_time]
        r = parameters.random
        self._latencies = latencies(parameters, robot)
        self._spread = [float(share) for share in r.actuator_spread]
        self._nominal = tensor([*model.actuators(robot), *robot.command_delays])
        self._drawn = tensor(drawn_actuators(r.actuators, parameters.seed))
        self._least = LEAST * torch.minimum(self._drawn.min(0).values, self._nominal)
        self._thrust_limit = [float(t) for t in r.thrust_limit]

    def draw(self, d: batch.Draw) -> dict[str, torch.Tensor]:
        """States of N new robots, with every entry of the environment's state."""
        attitude = d.attitude()
        hovering = self._is['hover'] | self._is['hold'] | self._is['moving']
        tilt, thrust = self._hover(d, attitude)
        third = torch.floor(d.uniform(4) * 3) - 1
        wound = torch.where(self._is['wound'], 1.0, torch.where(
            self._is['wound_back'], -1.0, torch.where(self._is['mixed'], third, 0.0)))
        tilt = torch.where(hovering, tilt, torch.pi * wound)
        thrust = torch.where(hovering, thrust, self._robot.hover_thrust)
        moving = self._is['moving']
        velocity = moving * d.around(MOVING_SPEED, 3)
        rate = moving * d.around(MOVING_RATE, 3)
        zeros = torch.zeros_like(tilt)
        x = torch.cat((zeros[:, :3], velocity, attitude, rate, tilt, zeros, thrust), -1)
        body_velocity = batch.transpose_product(batch.matrix(attitude), velocity)
        motion = torch.cat((body_velocity, rate), -1)
        command = torch.cat((tilt, thrust), -1)
        state = {'x': x, 'previous': command, 'older': command,
                 'past_motion': motion[:, None].expand(-1, 4, -1),
                 'past_tilt': tilt[:, None].expand(-1, 2, -1),
                 'age': torch.zeros_like(tilt[:, 0]), 'trim': torch.zeros_like(x[:, :6])}
        state.update(self.target(d, x[:, :3], attitude))
        state['target_attitude'] = torch.where(self._is['hold'], attitude,
                                               state['target_attitude'])
        state.update(self._randomisation(d))
        state['trimmed'] = d.chance(self._p.episode.trim_share).float()
        return {name: value.contiguous() for name, value in state.items()}

    def _hover(self, d, attitude):
        """Tilts and thrusts that hold the robot at an attitude, some joints a turn further."""
        pull = batch.transpose_product(batch.matrix(attitude),
                                       self._weight.expand(self._count, 3))
        parts = (pull @ self._inverse.T).unflatten(-1, (4, 2))
        tilt = torch.atan2(parts[:, :, 1], parts[:, :, 0])
        turned = tilt - 2 * torch.pi * torch.sign(tilt)
        other = (d.uniform(4) < self._p.start.other_branch) & (turned.abs() < self._limit - 0.05)
        return torch.where(other, turned, tilt), parts.norm(dim=-1)

    def target(self, d: batch.Draw, position: torch.Tensor, attitude: torch.Tensor) -> dict:
        """New targets for robots at a pose, a fraction of them near it."""
        e = self._p.episode
        near = d.chance(e.hold_targets)
        offset, angle = d.uniform(3, -1.0, 1.0), d.around(1.0, 3)
        place = torch.where(near, position + NEAR_POSITION * offset, 0.5 * self._region * offset)
        turned = batch.product(attitude, batch.from_rotation_vector(NEAR_ANGLE * angle))
        free = d.attitude()
        # the heading of a free attitude, because robots hover level more often than at any other
        level = torch.nn.functional.normalize(free * free.new_tensor([1.0, 0.0, 0.0, 1.0]), dim=-1)
        free = torch.where(d.chance(e.level_targets), level, free)
        target = torch.where(near, turned, free)
        return {'target_position': place, 'target_attitude': target,
                'target_left': torch.floor(d.uniform(1, *self._target_time))[:, 0],
                'floor': torch.minimum(place[:, 2:], position[:, 2:]),
                'deepest': torch.zeros_like(place[:, 2])}

    def _actuators(self, d):
        """
        Quantities of servos and rotors (N, 21), and delays by effects beyond the nominal (N, 2).

        A robot lies on the line from the nominal one to one of the robots drawn from the measured
        intervals, also somewhat beyond both; with one place for its servos, one for its rotors.
        """
        drawn = self._drawn[(d.uniform(1)[:, 0] * len(self._drawn)).long()]
        servo, rotor = d.uniform(2, *self._spread).split(1, -1)
        share = torch.cat((servo.expand(-1, drawn.shape[1] - 3), rotor, servo, rotor), -1)
        made = torch.maximum(self._nominal + share * (drawn - self._nominal), self._least)
        slower = 1 + d.around(self._p.random.lag_scale, 2)
        made[:, _DAMPING] *= slower[:, :1]
        made[:, _LAG] *= slower[:, 1:]
        return made[:, :-2], made[:, -2:] - self._nominal[-2:]

    def _randomisation(self, d):
        r = self._p.random
        body = self._body.expand(self._count, -1)
        load = self.severity * d.chance(r.payload_share) * d.uniform(1, 0.0, r.payload)
        mass = body[:, 0:1] * (1 + d.around(r.mass_scale, 1))
        arm = body[:, model.ARM] * (1 + d.around(r.arm_scale, 1))
        weak = d.chance(r.weak_share) & (torch.floor(4 * d.uniform(1)) == self._rotors)
        gain = body[:, model.GAIN] * (1 + d.around(r.thrust_scale, 1)) \
            * (1 - weak * d.uniform(1, 0.0, r.weak_loss))
        # Other robots cannot hover at every attitude.
        gain = torch.maximum(gain, self._least_gain * mass)
        inertia = body[:, 1:4] * (1 + d.around(r.inertia_scale, 3))
        centre = body[:, 4:7] + d.around(r.centre_of_mass, 3)
        down = torch.cat((torch.zeros_like(centre[:, :2]), -PAYLOAD_DEPTH * load), -1)
        total = mass + load
        centre = (mass * centre + down) / total
        forced = d.chance(r.force_share)
        strong = d.chance(r.strong_share)
        usual = torch.cat((d.around(r.force, 3), d.around(r.torque, 3)), -1)
        usual = self.severity * forced * usual
        thrust = d.uniform(1, 0.0, r.strong_force) * d.direction()
        force = self.severity * strong * (self._weight - thrust)
        wrench = usual + torch.cat((force, torch.zeros_like(force)), -1)
        noise = d.uniform(1) ** r.noise_power
        bias = noise * torch.cat((
            d.around(r.position_bias, 3), d.around(r.attitude_bias, 3),
            d.around(r.velocity_bias, 3), d.around(r.rate_bias, 3), d.around(r.tilt_bias, 4),
            d.around(r.estimated_force_bias, 3), d.around(r.estimated_torque_bias, 3)), -1)
        quantities, later = self._actuators(d)
        delays = torch.cat([d.uniform(1, *span) for span in self._latencies], -1)
        delays = torch.cat(((delays[:, :2] + later).clamp(0.0, LONGEST_DELAY),
                            delays[:, 2:]), -1)
        pushed = d.chance(r.push_share)
        extrapolated = d.chance(r.carried_share).float()
        disturbed = (forced | strong | pushed | (load > 0)).float()
        return {'thrust_limit': d.uniform(1, *self._thrust_limit),
                'body': torch.cat((total, inertia, centre, quantities, arm, gain), -1),
                'wrench': wrench,
                'other_wrench': usual,
                'noise': noise, 'bias': bias, 'delays': delays, 'extrapolated': extrapolated,
                'pushed': pushed.float(),
                'disturbed': disturbed, 'estimate': torch.zeros_like(wrench)}


class Replays:
    """
    Store with one place for each robot; its content is in the environment's state.

    Args:
        state: (N, ...) tensors by name, to which the entries of the store are added:
            'target_start' and 'stored' (N, K), 'filled' and 'source' (N,).
        share: largest fraction of the new episodes that begin with a stored state.
        steps: duration of a replayed target in steps.

    """

    def __init__(self, state: dict[str, torch.Tensor], share: float, steps: float):
        self._parts = {name: value.shape[1:] for name, value in state.items()}
        self._share, self._steps = share, steps
        packed = self._packed(state)
        state |= {'target_start': packed, 'stored': packed.clone(),
                'filled': torch.zeros_like(packed[:, 0]),
                'source': torch.full_like(packed[:, 0], -1.0)}

    def _packed(self, state):
        return torch.cat([state[name].reshape(len(state[name]), -1) for name in self._parts], -1)

    def unpacked(self, packed: torch.Tensor) -> dict[str, torch.Tensor]:
        """States (N, ...) by name, from stored ones (N, K)."""
        sizes = [shape.numel() for shape in self._parts.values()]
        return {name: part.reshape(-1, *shape)
                for (name, shape), part in zip(self._parts.items(), packed.split(sizes, -1))}

    def step(self, s: dict, new: dict, fresh: dict, ends: dict, draw: batch.Draw) -> None:
        """
        Store missed states, delete flown ones, and choose the robots that begin with a stored one.

        Args:
            s: state before the step.
            new: state after the step, with new targets; completed, with robots reset.
            fresh: new robots.
            ends: (N,) bool 'due' (time of the target is over), 'done' (end of the episode),
                'missed' (target or robot lost, if this can be judged).
            draw: three random numbers for each robot.

        """
        over, replayed = ends['due'] | ends['done'], s['source'] >= 0
        chance, pick, choice = draw.uniform(3).unbind(-1)
        judged = replayed & (ends['due'] | ends['missed'])
        drop = judged & (chance < torch.where(ends['missed'], FORGET_MISSED, FORGET_FLOWN))
        place = s['source'].clamp(min=0).long()
        dropped = torch.zeros_like(s['filled']).scatter_add(0, place, drop.float())
        keep = ends['missed'] & ~replayed
        stored = torch.where(keep[:, None], s['target_start'], s['stored'])
        filled = torch.where(keep, 1.0, torch.where(dropped > 0, 0.0, s['filled']))
        upto = filled.cumsum(0)
        count = upto[-1]
        share = self._share * (count / (FULL * len(filled))).clamp(max=1.0)
        chosen = ends['done'] & (choice < share)
        place = torch.searchsorted(upto, pick * count, right=True).clamp(max=len(filled) - 1)
        again = self.unpacked(stored[place])
        again['age'] = torch.zeros_like(again['age'])
        again['target_left'] = torch.full_like(again['target_left'], self._steps)
        for name in self._parts:
            start = torch.where(spread(chosen, again[name]), again[name], fresh[name])
            new[name] = torch.where(spread(ends['done'], start), start, new[name])
        source = torch.where(chosen, place.float(), torch.where(over, -1.0, s['source']))
        new.update(stored=stored, filled=filled, source=source, target_start=torch.where(
            over[:, None], self._packed(new), s['target_start']))


def spread(mask: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Mask (N,) shaped to select rows of ``like`` (N, ...)."""
    return mask.view(-1, *[1] * (like.dim() - 1))
