"""
Speed of environment, rollout and update in training, compared with the loop of rsl-rl.

    python benchmarks/environment.py [--device cuda] [--robots 4096,16384] [--json FILE]

On a GPU the environment's steps, the rollout and the update run as captured graphs. Rollout and
update of rsl-rl are its own functions on the same robots, networks and samples; its rollout steps
the environment without captured graphs. On a CPU the sizes are small, without a target speed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
import json
from pathlib import Path
import statistics
import sys
import time

from rich.console import Console
from rich.table import Table
from rsl_rl.algorithms import PPO
import torch

from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.train.environment import TiltableQuadrotorEnv
from beetle_omni_ros.train.parameters import TrainParameters
from beetle_omni_ros.train.runner import choose_device, Runner

TARGET = 10e6                  # environment steps a second, on a GPU
GPU_ROBOTS, CPU_ROBOTS = '4096,16384', '64,1024'
CPU_PPO_ROBOTS = 64            # of rollout and update on a CPU
GRAPH_STEPS = 100              # of the environment in one captured graph
ROBOT = RobotParameters.load()


def seconds(function: Callable, device: str, repeats: int) -> float:
    """Median time of a call, after one call to warm up."""
    times = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        function()
        if device.startswith('cuda'):
            torch.cuda.synchronize()
        times.append(time.perf_counter() - begin)
    return statistics.median(times[1:])


def with_robots(robots: int) -> TrainParameters:
    """Shipped parameters with another number of robots."""
    parameters = TrainParameters.load()
    return replace(parameters, ppo=replace(parameters.ppo, robots=robots))


def environment_rate(robots: int, device: str) -> float:
    """Steps a second, summed over robots."""
    env = TiltableQuadrotorEnv(with_robots(robots), ROBOT, device)
    action = torch.zeros(robots, 8, device=device)
    if not device.startswith('cuda'):
        return robots / seconds(lambda: env.advance(action), device, 20)
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):      # compilers
            env.advance(action)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        for _ in range(GRAPH_STEPS):
            env.advance(action)
    return robots * GRAPH_STEPS / seconds(graph.replay, device, 5)


def made_runner(robots: int, device: str, graphs: bool) -> Runner:
    """Make a training without output files."""
    runner = Runner(with_robots(robots), ROBOT, None, device, graphs=graphs)
    runner.apply_schedule(0.0)
    return runner


def ours(robots: int, device: str) -> dict[str, float]:
    """Seconds of one iteration's rollout and update."""
    runner = made_runner(robots, device, device.startswith('cuda'))
    return {'rollout': seconds(runner.alg.collect, device, 5),
            'update': seconds(runner.alg.learn_batch, device, 5)}


def rsl_rls(robots: int, device: str) -> dict[str, float]:
    """Measure rsl-rl's own functions likewise."""
    runner = made_runner(robots, device, False)
    alg, env = runner.alg, runner.env

    def rollout():
        alg.storage.clear()
        seen = env.get_observations()
        with torch.inference_mode():
            for _ in range(runner.parameters.ppo.steps):
                env.advance(alg.act(seen.clone()))
                seen = env.get_observations()
                alg.process_env_step(seen, env.reward, env.done,
                                     {'time_outs': env.timeout.float()})
            alg.compute_returns(seen)

    return {'rollout': seconds(rollout, device, 2),
            'update': seconds(lambda: PPO.update(alg), device, 3)}


def show(results: dict, console: Console) -> None:
    """Print what was measured."""
    console.print(f"{results['device']}, torch {results['torch']}")
    for robots, rate in results['environment'].items():
        console.print(f'environment, {robots} robots: {rate / 1e6:.3g} million steps/s')
    table = Table(title=f"one iteration, {results['robots']} robots x {results['steps']} steps "
                        '[ms]')
    for column in ('', 'rollout', 'update', 'both', 'samples/s'):
        table.add_column(column, justify='right' if column else 'left')
    for name in ('ours', 'rsl_rl'):
        rollout, update = results[name]['rollout'], results[name]['update']
        samples = results['robots'] * results['steps'] / (rollout + update)
        table.add_row(name.replace('_', '-'), *(f'{1e3 * value:.1f}' for value in (
            rollout, update, rollout + update)), f'{samples:.2e}')
    console.print(table)


def main():
    """Measure and print; status 1 if the environment misses its target on a GPU."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--device', default='auto')
    parser.add_argument('--robots', help='sizes of the environment')
    parser.add_argument('--json', type=Path, help='file for the numbers')
    given = parser.parse_args()
    try:
        device = choose_device(given.device)
        gpu = device.startswith('cuda')
        sizes = [int(size) for size in (given.robots or (GPU_ROBOTS if gpu else CPU_ROBOTS)
                                        ).split(',')]
    except (ParameterError, ValueError) as error:
        print(f'benchmarks/environment.py: error: {error}', file=sys.stderr)
        sys.exit(2)
    torch.set_float32_matmul_precision('high')
    if not gpu:
        torch.set_num_threads(1)    # several threads wait for each other on a shared computer
    ppo = TrainParameters.load().ppo
    robots = ppo.robots if gpu else CPU_PPO_ROBOTS
    results = {'device': torch.cuda.get_device_name(device) if gpu else 'CPU, one thread',
               'torch': torch.__version__,
               'environment': {size: environment_rate(size, device) for size in sizes},
               'robots': robots, 'steps': ppo.steps, 'ours': ours(robots, device),
               'rsl_rl': rsl_rls(robots, device)}
    show(results, Console(width=100))
    if given.json:
        given.json.write_text(json.dumps(results, indent=1) + '\n')
    met = all(rate >= TARGET for rate in results['environment'].values())
    if gpu:
        print(f'target of the environment: {TARGET / 1e6:g} million steps/s: '
              + ('met' if met else 'missed'))
    sys.exit(1 if gpu and not met else 0)


if __name__ == '__main__':
    main()
