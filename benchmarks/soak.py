"""
Growth of memory, threads and files in a long flight: ``python benchmarks/soak.py [--minutes 60]``.

Flies the whole ROS graph with recorder and both buses. Every 10 s, memory, threads and open files
of each process are read from /proc. After a warm-up, a line is fitted to the memory. Exit status 1
if a process grows by more than 5 MB an hour, has more threads or files at the end than after the
warm-up, or died, or if the flight ended early.

The capacity of the pack is raised to last for the flight. The bag is deleted.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict, dataclass
import json
import os
from pathlib import Path
import shutil
import sys
import tempfile
import time

import numpy as np
from rich.console import Console
from rich.table import Table
import yaml

from beetle_omni_ros.control.targets import COLUMNS
from beetle_omni_ros.control.tasks import POSE_DURATION, WAYPOINTS
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.ros.clients import Operator
from beetle_omni_ros.ros.graph import (
    bridge_parameters,
    BRIDGES,
    confine,
    Graph,
    reserved_domain,
)

PERIOD = 10.0           # s between two samples
WARM_UP = 0.2           # share of the flight before the fit, at least:
WARM_UP_LEAST = 180.0   # s; buffers and caches fill in the first minutes
LIMIT = 5.0             # MB an hour
CAPACITY = 1000.0       # Ah
READY, LANDING = 300.0, 30.0     # s
MEGA = 1 / 1024         # of a kB of /proc


@dataclass(frozen=True)
class Sample:
    """Memory, threads and files of one process at one time."""

    t: float            # s since the take-off
    memory: float       # MB, resident
    threads: int
    files: int


def read_sample(pid: int, t: float) -> Sample | None:
    """Read a sample of a process; None if it has ended."""
    place = Path(f'/proc/{pid}')
    try:
        status = dict(line.split(':', 1) for line in
                      (place / 'status').read_text().splitlines() if ':' in line)
        return Sample(t, float(status['VmRSS'].split()[0]) * MEGA, int(status['Threads']),
                      len(os.listdir(place / 'fd')))
    except (OSError, KeyError):
        return None


def growth(process: str, samples: list[Sample], warm_up: float) -> dict | None:
    """Fit the samples after ``warm_up`` [s]; None for fewer than three."""
    kept = [sample for sample in samples if sample.t >= warm_up]
    if len(kept) < 3:
        return None
    t, memory = np.array([[sample.t, sample.memory] for sample in kept]).T
    slope, start = np.polyfit(t - t[0], memory, 1)
    first, last = kept[0], kept[-1]
    return {'process': process, 'memory_start_MB': float(start),
            'memory_end_MB': float(start + slope * (t[-1] - t[0])),
            'memory_MB_per_hour': float(3600 * slope),
            'threads_start': first.threads, 'threads_end': last.threads,
            'files_start': first.files, 'files_end': last.files,
            'grows': not 3600 * slope <= LIMIT or last.threads > first.threads
            or last.files > first.files}


def make_graph(folder: Path, number: int, minutes: float) -> Graph:
    """Make the graph of ``fly`` in ``folder``, with a larger pack."""
    simulator = yaml.safe_load(share_path('params/simulator.yaml').read_text())
    simulator['/**/sim_node']['ros__parameters']['battery_capacity'] = CAPACITY
    (folder / 'simulator.yaml').write_text(yaml.safe_dump(simulator))
    count = int(60 * minutes / POSE_DURATION) + 2
    rows = [','.join(f'{v:g}' for v in WAYPOINTS[k % len(WAYPOINTS)]) for k in range(count)]
    (folder / 'poses.csv').write_text('\n'.join([','.join(COLUMNS), *rows]) + '\n')
    parameters = {
        'recorder_node': {'bag': str(folder / 'bag')},
        'sim_node': {'simulator_file': str(folder / 'simulator.yaml')},
        'ekf_node': {}, 'nmpc_node': {}, 'rl_node': {}, 'supervisor_node': {},
        'reference_node': {'task': str(folder / 'poses.csv')}}
    for node, values in bridge_parameters(folder, {}).items():
        parameters[node] = {**parameters.get(node, {}), **values}
    return Graph(parameters, folder, number)


def take_off(operator: Operator, bridges: list[str]) -> None:
    """Take off as soon as the graph is ready; RunError on failure."""
    operator.required = bridges
    operator.expect('starting', lambda: operator.ready and not operator.waits_for(bridges), READY)
    operator.take_off()


def watch(graph: Graph, operator: Operator, seconds: float, say: Callable[[str], None]
          ) -> tuple[dict[str, list[Sample]], str]:
    """Sample every process for the time; return samples and the reason of an early end or ''."""
    samples: dict[str, list[Sample]] = {name: [] for name in graph.processes}
    begin = time.monotonic()
    due = begin
    while (now := time.monotonic()) < begin + seconds:
        if now >= due:
            due += PERIOD
            for name, process in graph.processes.items():
                sample = read_sample(process.pid, now - begin)
                if sample:
                    samples[name].append(sample)
            say(f'{(now - begin) / 60:.1f} min: ' + ', '.join(
                f'{name} {taken[-1].memory:.1f} MB' for name, taken in samples.items() if taken))
        operator.spin(0.2)
        if graph.dead():
            return samples, '; '.join(f'{name} died ({how})' for name, how in
                                      graph.dead().items())
        if not operator.state.startswith(('flying', 'fallback')):
            return samples, f"the supervisor was in '{operator.states[-1]}' after " \
                            f'{now - begin:.0f} s'
    return samples, ''


def soak(minutes: float, console: Console) -> dict:
    """Fly, sample, land and stop; return the results."""
    confine()
    folder = Path(tempfile.mkdtemp(prefix='soak_'))
    operator, graph, ended = None, None, 'no take-off'
    samples: dict[str, list[Sample]] = {}
    try:
        with reserved_domain() as number:
            try:
                graph = make_graph(folder, number, minutes)
                graph.start()
                operator = Operator(number)
                take_off(operator, [node for node in graph.nodes if node in BRIDGES])
                samples, ended = watch(graph, operator, 60 * minutes, console.log)
                operator.call('land')
                operator.wait(lambda: operator.state in ('disarmed', 'emergency_stop'), LANDING)
            finally:
                stubborn = graph.stop() if graph else []
                if operator:
                    operator.close()
        bag_mb = sum(file.stat().st_size for file in (folder / 'bag').glob('*')) / 1e6
        for line in graph.warnings()[:20]:
            console.print(line, markup=False, highlight=False, style='yellow')
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    warm_up = max(WARM_UP * 60 * minutes, WARM_UP_LEAST)
    found = [growth(name, taken, warm_up) for name, taken in samples.items()]
    return {'minutes': minutes, 'warm_up_s': warm_up, 'limit_MB_per_hour': LIMIT,
            'ended_early': ended, 'killed': stubborn, 'bag_MB': bag_mb,
            'processes': [one for one in found if one],
            'samples': {name: [asdict(one) for one in taken] for name, taken in samples.items()}}


def print_table(result: dict, console: Console) -> None:
    """Print a row for each process."""
    table = Table('process', 'memory [MB]', 'slope [MB/h]', 'threads', 'files', 'grows')
    for one in result['processes']:
        table.add_row(
            one['process'], f"{one['memory_start_MB']:.1f} to {one['memory_end_MB']:.1f}",
            f"{one['memory_MB_per_hour']:+.2f}",
            f"{one['threads_start']} to {one['threads_end']}",
            f"{one['files_start']} to {one['files_end']}", 'yes' if one['grows'] else 'no')
    console.print(table)
    console.print(f"after {result['warm_up_s']:.0f} s of warm-up; bag {result['bag_MB']:.0f} MB")
    if result['ended_early']:
        console.print(f"ended early: {result['ended_early']}", style='red')


def main(arguments: list[str] | None = None) -> int:
    """Fly and print the growth; status 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--minutes', type=float, default=60.0, help='of flight')
    parser.add_argument('--json', type=Path, help='file for the numbers')
    given = parser.parse_args(arguments)
    console = Console()
    result = soak(given.minutes, console)
    print_table(result, console)
    if given.json:
        given.json.write_text(json.dumps(result, indent=1) + '\n')
    failed = result['ended_early'] or result['killed'] or not result['processes'] or any(
        one['grows'] for one in result['processes'])
    return int(bool(failed))


if __name__ == '__main__':
    sys.exit(main())
