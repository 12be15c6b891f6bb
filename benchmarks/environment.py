"""
Speed of environment, rollout and update in training, compared with the loop of rsl-rl.

    python benchmarks/environment.py [--device cuda]

On a GPU the environment's steps, the rollout and the update run as captured graphs. Rollout and
update of rsl-rl are its own functions on the same robots, networks and samples; its rollout steps
the environment without captured graphs. On a CPU the sizes are small, without a target speed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
import statistics
import sys
import time

from rich.console import Console
from rich.table import Column, Table
from rsl_rl.algorithms import PPO
import torch

from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.train.environment import TiltableQuadrotorEnv
from beetle_omni_ros.train.parameters import TrainParameters
from beetle_omni_ros.train.runner import choose_device, Runner

TARGET = 10e6                  # environment steps a second, on a GPU
GPU_ROBOTS, CPU_ROBOTS = (4096, 16384), (64, 1024)
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


def main():
    """Measure and print; status 1 if the environment misses its target on a GPU."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--device', default='auto')
    try:
        device = choose_device(parser.parse_args().device)
    except ParameterError as error:
        parser.error(str(error))
    gpu = device.startswith('cuda')
    torch.set_float32_matmul_precision('high')
    if not gpu:
        torch.set_num_threads(1)    # several threads wait for each other on a shared computer
    print(f"{torch.cuda.get_device_name(device) if gpu else 'CPU, one thread'}, "
          f'torch {torch.__version__}')
    missed = False
    for size in GPU_ROBOTS if gpu else CPU_ROBOTS:
        rate = environment_rate(size, device)
        missed = missed or gpu and rate < TARGET
        print(f'environment, {size} robots: {rate / 1e6:.3g} million steps/s'
              + f', required {TARGET / 1e6:g}' * gpu)
    ppo = TrainParameters.load().ppo
    robots = ppo.robots if gpu else CPU_PPO_ROBOTS
    table = Table('', *(Column(name, justify='right') for name in (
        'rollout', 'update', 'both', 'samples/s')),
        title=f'one iteration, {robots} robots x {ppo.steps} steps [ms]')
    for name, measured in (('ours', ours), ('rsl-rl', rsl_rls)):
        rollout, update = measured(robots, device).values()
        table.add_row(name, *(f'{1e3 * value:.1f}' for value in (
            rollout, update, rollout + update)), f'{robots * ppo.steps / (rollout + update):.2e}')
    Console(width=100).print(table)
    sys.exit(missed)


if __name__ == '__main__':
    main()
