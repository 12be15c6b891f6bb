"""
The generic discrepancy: what a model may lack that no catalogue entry describes.

Relative changes of each rotor's thrust and forces along the axes of the world are linear in
features of the motion. The features have no mean, because a constant factor of thrusts and a
constant force are catalogue entries.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.model.parameters import RobotParameters

BODY = ('force_x', 'force_y', 'force_z', 'torque_x', 'torque_y', 'torque_z')
WAVES = 6               # random features
LATE = 0.5              # [s] before: half of the filters of velocities, which look ahead
LEAN = 0.3              # [rad] scale of the tilt of the body


def discrepancies(flights: Sequence) -> list[np.ndarray]:
    """
    Slopes (N, C, 7, P) of the channels by the weights of the discrepancy, of each flight.

    They are those by the thrust of each rotor and by world forces, relative to hover thrust and
    weight. ``flights`` have ``robot``, ``channels``, ``motion`` and ``time`` [s] of N samples.
    """
    made, features = [], [_features_of(flight.motion, flight.time) for flight in flights]
    mean = np.concatenate(features).mean(axis=0)
    for flight, own in zip(flights, features, strict=True):
        robot, turn = flight.robot, Rotation.from_quat(flight.motion['quaternion']).as_matrix()
        acting = np.zeros((len(own), 6, 7))
        acting[..., :4] = of_thrusts(robot, flight.motion['tilt'])[1] * robot.hover_thrust
        acting[:, :3, 4:] = turn.transpose(0, 2, 1) * robot.gravity
        slopes = acting[..., None] * (own - mean)[:, None, None]
        # A force linear in velocity is the form of drag; as a discrepancy it would replace drag.
        slopes[:, :, 4:, :3] = 0
        made.append(placed(slopes, flight.channels))
    return made


def _features_of(motion, time):
    """(N, P) velocity in the body, its tilt, place and time [min], of order one, and cosines."""
    rotation = Rotation.from_quat(motion['quaternion']).as_matrix()
    velocity = np.einsum('nji,nj->ni', rotation, motion['velocity'])
    plain = np.concatenate([velocity, rotation[:, 2, :2] / LEAN, motion['position'],
                            time[:, None] / 60], axis=1)
    rng = np.random.default_rng(0)
    along = (plain - plain.mean(axis=0)) @ rng.normal(size=(plain.shape[1], WAVES))
    return np.concatenate([plain, np.cos(along + rng.uniform(0, 2 * np.pi, WAVES))], axis=1)


def of_thrusts(robot: RobotParameters, tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (N, 4, 3) of thrusts; force and torque channels (N, 6, 4) by a newton of each."""
    axes = robot.thrust_directions(tilt)
    turning = np.cross(robot.rotors.positions, axes) / robot.inertia
    return axes, np.concatenate([axes / robot.mass, turning], axis=2).transpose(0, 2, 1)


def placed(slopes: np.ndarray, channels: Sequence[str]) -> np.ndarray:
    """Slopes (N, 6, ...) of forces and torques as those of all channels (N, C, ...)."""
    made = np.zeros((len(channels), len(slopes), *slopes.shape[2:]))
    for own, name in zip(made, channels, strict=True):
        if name in BODY:
            own[:] = slopes[:, BODY.index(name)]
    return made.swapaxes(0, 1)


def laws(flights: Sequence) -> tuple[list[np.ndarray], list[slice]]:
    """
    Slopes (N, 6, P) of each flight by laws of thrusts, forces and torques; weights of each group.

    With weights of RMS one, thrusts change by themselves, forces by the weight, torques by the
    weight at the arm of a rotor. ``flights`` of one robot are as of :func:`discrepancies`.
    """
    made: list[list[np.ndarray]] = [[] for _ in flights]
    for group in zip(*(_causes(flight) for flight in flights), strict=True):
        for own, (slopes, _), x in zip(made, group, _waves([x for _, x in group]), strict=True):
            own.append(np.einsum('ncs,nsp->ncp', slopes, x) if x.ndim == 3 else
                       (slopes[..., None] * x[:, None, None]).reshape(*slopes.shape[:2], -1))
    edges = np.cumsum([0, *(part.shape[2] for part in made[0])])
    return [np.concatenate(own, axis=2) for own in made], list(map(slice, edges, edges[1:]))


def _waves(parts):
    """Features (N, ..., P) of flights and cosines of random directions, with an RMS of one."""
    size, rng = parts[0].shape[-1], np.random.default_rng(0)
    directions, phase = rng.normal(size=(size, WAVES)), rng.uniform(0, 2 * np.pi, WAVES)
    for count in (0, WAVES):
        waves = [np.cos(np.sqrt(2 / size) * x @ directions + phase)[..., :count] for x in parts]
        parts = [np.concatenate(both, axis=-1) for both in zip(parts, waves, strict=True)]
        every = np.concatenate([x.reshape(-1, size + count) for x in parts])
        parts = [(x - every.mean(axis=0)) / np.maximum(every.std(axis=0), 1e-9) for x in parts]
    return [x / np.sqrt(size + WAVES) for x in parts]


def _causes(flight):
    """
    Slopes (N, 6, S) by sources, with features of each (N, S, P) for one law, or of all (N, P).

    Present velocities and loads may be answers to the noise of forces. Those before are not.
    """
    robot, motion, time = flight.robot, flight.motion, flight.time[:, None] / 60
    before = np.maximum(np.arange(len(time)) - round(LATE / flight.period), 0)
    velocity, rate, place, load = (
        motion[name][before] for name in ('velocity', 'rate', 'position', 'thrust'))
    turn, places = Rotation.from_quat(motion['quaternion']).as_matrix(), robot.rotors.positions
    axes, thrusts = of_thrusts(robot, motion['tilt'])
    flow = np.einsum('nji,nj->ni', turn[before], velocity)
    hubs = flow[:, None] + np.cross(rate[:, None], places)
    along = (hubs * axes[before]).sum(axis=2)
    across = np.linalg.norm(hubs - along[..., None] * axes[before], axis=2)
    # of each rotor, and of the next ones around the body
    tilts = [own(np.roll(motion['tilt'], -k, 1)) for own in (np.sin, np.cos) for k in range(4)]
    height = place[:, 2:] + turn[before, 2] @ np.transpose(places)
    body, world = np.zeros((2, len(time), 6, 6))
    body[:] = robot.gravity * np.diag([1, 1, 1, *robot.mass * np.linalg.norm(
        places[0]) / robot.inertia])
    world[:, :3, :3] = turn.transpose(0, 2, 1) * robot.gravity
    state = np.concatenate([flow, turn[:, 2], rate, time], axis=1)
    thrusts, world = thrusts * motion['thrust'][:, None], world[..., :3]
    return [(thrusts, np.stack([along, across, load], axis=2)), (thrusts, np.stack(tilts, axis=2)),
            (thrusts, np.stack([height, (axes @ turn[:, 2, :, None])[..., 0]], axis=2)),
            (thrusts, state), (body, state), (world, velocity[..., None]),
            (world, np.concatenate([place, time], axis=1))]
