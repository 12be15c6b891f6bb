"""
Speed of training compared with the loop of rsl-rl: ``python benchmarks/environment.py``.

The environment's steps, the rollout and the update run as captured graphs on a GPU. Rollout and
update of rsl-rl are its own functions on the same robots, networks and samples; its rollout steps
the environment without captured graphs.
"""

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
from beetle_omni_ros.train.environment import TiltableQuadrotorEnv
from beetle_omni_ros.train.parameters import TrainParameters
from beetle_omni_ros.train.runner import Runner

TARGET, ROBOTS = 10e6, (4096, 16384)    # environment steps a second
GRAPH_STEPS = 100       # of the environment in one captured graph
ROBOT, DEVICE = RobotParameters.load(), 'cuda'


def seconds(function: Callable, repeats: int) -> float:
    """Median time of a call, after one call to warm up."""
    times = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        function()
        torch.cuda.synchronize()
        times.append(time.perf_counter() - begin)
    return statistics.median(times[1:])


def with_robots(robots: int) -> TrainParameters:
    """Shipped parameters with another number of robots."""
    parameters = TrainParameters.load()
    return replace(parameters, ppo=replace(parameters.ppo, robots=robots))


def environment_rate(robots: int) -> float:
    """Steps a second, summed over robots."""
    env = TiltableQuadrotorEnv(with_robots(robots), ROBOT, DEVICE)
    action = torch.zeros(robots, 8, device=DEVICE)
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
    return robots * GRAPH_STEPS / seconds(graph.replay, 5)


def made_runner(robots: int, graphs: bool) -> Runner:
    """Make a training without output files."""
    runner = Runner(with_robots(robots), ROBOT, None, DEVICE, graphs=graphs)
    runner.apply_schedule(0.0)
    return runner


def ours(robots: int) -> dict[str, float]:
    """Seconds of one iteration's rollout and update."""
    runner = made_runner(robots, True)
    return {'rollout': seconds(runner.alg.collect, 5),
            'update': seconds(runner.alg.learn_batch, 5)}


def rsl_rls(robots: int) -> dict[str, float]:
    """Measure rsl-rl's own functions likewise."""
    runner = made_runner(robots, False)
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

    return {'rollout': seconds(rollout, 2),
            'update': seconds(lambda: PPO.update(alg), 3)}


def main():
    """Measure and print; status 1 if the environment misses its target."""
    if not torch.cuda.is_available():
        sys.exit('environment.py: expected a GPU')
    torch.set_float32_matmul_precision('high')
    print(f'{torch.cuda.get_device_name(DEVICE)}, torch {torch.__version__}')
    rates = {size: environment_rate(size) for size in ROBOTS}
    for size, rate in rates.items():
        print(f'environment, {size} robots: {rate / 1e6:.3g} million steps/s, required '
              f'{TARGET / 1e6:g}')
    ppo = TrainParameters.load().ppo
    robots = ppo.robots
    table = Table('', *(Column(name, justify='right') for name in (
        'rollout', 'update', 'both', 'samples/s')),
        title=f'one iteration, {robots} robots x {ppo.steps} steps [ms]')
    for name, measured in (('ours', ours), ('rsl-rl', rsl_rls)):
        rollout, update = measured(robots).values()
        table.add_row(name, *(f'{1e3 * value:.1f}' for value in (
            rollout, update, rollout + update)), f'{robots * ppo.steps / (rollout + update):.2e}')
    Console(width=100).print(table)
    sys.exit(min(rates.values()) < TARGET)


if __name__ == '__main__':
    main()
