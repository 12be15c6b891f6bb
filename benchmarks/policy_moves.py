"""
Loss of height and errors of a policy in thousands of moves between random poses.

    python benchmarks/policy_moves.py [--robots 2048] [--moves 5] [--seed 0] [--without PART ...]

Rare failures need more moves than flights of the whole simulation give in an hour. Therefore the
robots of the training environment fly: one rigid body without estimator and floor. Each robot has
its own guidance, as on board, which gets the true state. `--without` omits parts of the guidance
(unwinding, routing, easing, trimming). Poses have the distribution of random100. The first move
of each robot is not counted. Needs torch, rsl-rl-lib and onnx (the `train` extra).
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path

from joblib import delayed, Parallel
import numpy as np
import onnx
from rich.console import Console
from rich.progress import track
from rich.table import Column, Table
import torch

from beetle_omni_ros.bags.log import geodesic_angles
from beetle_omni_ros.control.base import Command, PoseTarget, State
from beetle_omni_ros.control.guidance import Guidance, LAYERS
from beetle_omni_ros.control.policy import PolicyParameters
from beetle_omni_ros.control.policy_file import find, PolicyNetwork, session
from beetle_omni_ros.control.tasks import pose_target, random_poses
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.train.environment import TiltableQuadrotorEnv
from beetle_omni_ros.train.parameters import RandomParameters, StartParameters, TrainParameters

SEGMENT, AT_TARGET, ON_THE_WAY = 750, (700, 750), (100, 700)    # steps of 10 ms
DEPTHS, HEIGHT = (0.15, 0.25, 0.4), 0.3      # [m] counted: below start and target; above ground
REACHED = (0.1, np.radians(10))
PART = 512      # robots of one piece of work


def batched(path: Path) -> Callable[[np.ndarray], np.ndarray]:
    """(N, 8) actions of (N, 33 or 39) observations, by a policy file for a single one."""
    graph = onnx.load(path)
    for value in (*graph.graph.input, *graph.graph.output):
        value.type.tensor_type.shape.dim[0].dim_param = 'robots'
    del graph.graph.value_info[:]
    network = session(graph.SerializeToString())
    return lambda observations: network.run(None, {'observation': observations})[0]


def environment(robots: int, memory: bool, robot: RobotParameters):
    """Robots that start in hover, with external targets and the simulated robot's latencies."""
    p = TrainParameters.load()
    still = {entry.name: 0.0 for entry in fields(StartParameters)}
    certain = {entry.name: 0.0 for entry in fields(RandomParameters)
               if isinstance(getattr(p.random, entry.name), float)}
    env = TiltableQuadrotorEnv(replace(
        p, memory=memory, ppo=replace(p.ppo, robots=robots),
        episode=replace(p.episode, duration=1e6, hold_targets=0.0, replay_share=0.0,
                        target_time=np.array([1e3, 1e3]), position_limit=99.0),
        start=StartParameters(**{**still, 'hold': 1.0}),
        random=replace(p.random, **{
            **certain, 'push_period': 1.0, 'thrust_sag': p.random.thrust_sag},
            command_latency=[0.01, 0.01], velocity_latency=[0.0, 0.0],
            tilt_latency=[0.01, 0.01], actuator_spread=[0.0, 0.0])), robot, compiled=False)
    env.state['age'].zero_()
    env.state['target_left'].fill_(1e6)
    return env


def show(env, guided: Sequence[Guidance], targets: Sequence[PoseTarget], stamp: float) -> None:
    """Put the target from guidance of each robot into the environment."""
    s = env.state
    x = s['x'].double().numpy()
    given = s['previous'].double().numpy()
    position, attitude = np.empty((len(targets), 3)), np.empty((len(targets), 4))
    for i, (guidance, target) in enumerate(zip(guided, targets)):
        state = State(stamp, x[i, model.POSITION], x[i, model.VELOCITY], x[i, model.QUATERNION],
                      x[i, model.RATE], x[i, model.TILT], x[i, model.TILT_RATE], stamp,
                      Command(stamp, given[i, :4], given[i, 4:]))
        shown = guidance.target(state, target)
        position[i], attitude[i] = shown.position, shown.quaternion
    s['target_position'].copy_(torch.from_numpy(position))
    s['target_attitude'].copy_(torch.from_numpy(attitude))


@torch.no_grad()
def fly_part(path: Path, robots: int, memory: bool, without: str, moves: int,
             seed: int) -> dict[str, np.ndarray]:
    """
    Fly some of the robots on one core: one move that is not counted and then ``moves``.

    Returns:
        name -> (moves, N): errors in the windows of the task metrics [m], [rad], depth below
        start and target and lowest height [m]; and `lost` (N,), robots that were reset.

    """
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    robot, policy = RobotParameters.load(), batched(path)
    env = environment(robots, memory, robot)
    guided = [Guidance(robot.tilt_axes, without) for _ in range(robots)]
    poses = random_poses(robots * (moves + 2), seed).reshape(moves + 2, robots, 6)
    env.state['x'][:, model.POSITION] = torch.from_numpy(poses[0, :, :3]).float()
    result = {name: np.zeros((moves + 1, robots)) for name in (
        'U_position', 'U_attitude', 'L_position', 'L_attitude', 'depth', 'lowest')}
    lost = np.zeros(robots, dtype=bool)
    for k in range(moves + 1):
        targets = [pose_target(pose) for pose in poses[k + 1]]
        place = np.array([target.position for target in targets])
        attitude = np.array([target.quaternion for target in targets])
        low = np.full(robots, np.inf)
        floor = np.minimum(place[:, 2], env.state['x'][:, 2].numpy())
        for step in range(SEGMENT):
            show(env, guided, targets, 0.01 * (k * SEGMENT + step))
            env.advance(torch.from_numpy(policy(env.observation.numpy())))
            lost |= env.done.numpy()
            x = env.state['x'].double().numpy()
            low = np.minimum(low, x[:, 2])
            for name, (first, end) in (('U', AT_TARGET), ('L', ON_THE_WAY)):
                if first <= step < end:
                    share = 1 / (end - first)
                    result[f'{name}_position'][k] += share * np.linalg.norm(
                        x[:, :3] - place, axis=1)
                    result[f'{name}_attitude'][k] += share * geodesic_angles(
                        x[:, model.QUATERNION], attitude)
        result['depth'][k], result['lowest'][k] = floor - low, low
    return {**{name: values[1:] for name, values in result.items()}, 'lost': lost}


def summary(flown: dict[str, np.ndarray]) -> dict[str, float]:
    """Means and counts of robots that were never lost."""
    kept = {name: values[:, ~flown['lost']].ravel() for name, values in flown.items()
            if name != 'lost'}
    reached = (kept['U_position'] < REACHED[0]) & (kept['U_attitude'] < REACHED[1])
    counts = {'moves': len(reached), 'robots_lost': int(flown['lost'].sum()),
              'missed': int((~reached).sum())}
    for name in ('U_position', 'U_attitude', 'L_position', 'L_attitude'):
        mean = float(kept[name].mean())
        counts.update({f'{name}_deg': np.degrees(mean)} if 'attitude' in name
                      else {f'{name}_m': mean})
    counts.update({f'deeper_than_{limit}_m': int((kept['depth'] > limit).sum())
                   for limit in DEPTHS})
    counts.update({f'below_{HEIGHT}_m': int((kept['lowest'] < HEIGHT).sum()),
                   'deepest_m': float(kept['depth'].max()),
                   'lowest_m': float(kept['lowest'].min())})
    return counts


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--robots', type=int, default=2048)
    parser.add_argument('--moves', type=int, default=5, help='of each robot that count')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--without', nargs='*', choices=LAYERS, default=[])
    parser.add_argument('--jobs', type=int, default=-1, help='processes; -1: one for each core')
    given = parser.parse_args()
    path = PolicyParameters.load().policy
    contract = PolicyNetwork(path, RobotParameters.load()).contract
    sizes = [min(PART, given.robots - first) for first in range(0, given.robots, PART)]
    seeds = np.random.SeedSequence(given.seed).generate_state(len(sizes))
    parts = Parallel(n_jobs=given.jobs, return_as='generator')(
        delayed(fly_part)(find(path), size, contract.memory, ','.join(given.without),
                          given.moves, int(seed)) for size, seed in zip(sizes, seeds))
    parts = list(track(parts, 'flying', len(sizes), console=Console(stderr=True), transient=True))
    result = summary({name: np.concatenate([part[name] for part in parts], axis=-1)
                      for name in parts[0]})
    table = Table('', Column('', justify='right'), title=f'{contract.name}, seed {given.seed}'
                  + ''.join(f', without {part}' for part in given.without))
    for name, value in result.items():
        table.add_row(name, f'{value:.4g}')
    Console().print(table)


if __name__ == '__main__':
    main()
