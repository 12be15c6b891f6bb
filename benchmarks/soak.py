"""
Growth of memory, threads and files in a long flight: ``python benchmarks/soak.py [--minutes 60]``.

Flies the whole ROS graph with recorder and both buses. Every 10 s, memory, threads and open files
of each process are read from /proc. After a warm-up, a line is fitted to the memory. Exit status 1
if a process grows by more than 5 MB an hour, has more threads or files at the end than after the
warm-up, or died, or if the flight ended early.

The capacity of the pack is raised to last for the flight. The bag is deleted.
"""

import argparse
from collections.abc import Callable
import os
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
import time

import numpy as np
from rich.console import Console
from rich.table import Table
import yaml

from beetle_omni_ros.control.targets import COLUMNS
from beetle_omni_ros.control.tasks import POSE_DURATION, WAYPOINTS
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.ros.clients import Operator
from beetle_omni_ros.ros.graph import BRIDGES, confine, Graph, plan, reserved_domain

PERIOD = 10.0           # s between two samples
WARM_UP = 0.2           # share of the flight before the fit, at least:
WARM_UP_LEAST = 180.0   # s; buffers and caches fill in the first minutes
LIMIT = 5.0             # MB an hour
CAPACITY = 1000.0       # Ah
READY, LANDING = 300.0, 30.0     # s
MEGA = 1 / 1024         # of a kB of /proc


def read_sample(pid: int) -> tuple[float, int, int] | None:
    """Resident memory [MB], threads and open files of a process; None if it has ended."""
    place = Path(f'/proc/{pid}')
    try:
        status = dict(line.split(':', 1) for line in
                      (place / 'status').read_text().splitlines() if ':' in line)
        return (float(status['VmRSS'].split()[0]) * MEGA, int(status['Threads']),
                len(os.listdir(place / 'fd')))
    except (OSError, KeyError):
        return None


def growth(samples: list[tuple], warm_up: float) -> tuple[list[str], bool] | None:
    """Row of a process after ``warm_up`` [s], and whether it grows; None for too few samples."""
    kept = [sample for sample in samples if sample[0] >= warm_up]
    if len(kept) < 3:
        return None
    t, memory = np.array(kept).T[:2]
    slope, start = np.polyfit(t - t[0], memory, 1)
    (*_, threads, files), (*_, more_threads, more_files) = kept[0], kept[-1]
    return [f'{start:.1f} to {start + slope * (t[-1] - t[0]):.1f}', f'{3600 * slope:+.2f}',
            f'{threads} to {more_threads}', f'{files} to {more_files}'], bool(
                not 3600 * slope <= LIMIT or more_threads > threads or more_files > files)


def make_graph(folder: Path, number: int, minutes: float) -> Graph:
    """Make the graph of ``fly`` in ``folder``, with a larger pack."""
    simulator = yaml.safe_load(share_path('params/simulator.yaml').read_text())
    simulator['/**/sim_node']['ros__parameters']['battery_capacity'] = CAPACITY
    (folder / 'simulator.yaml').write_text(yaml.safe_dump(simulator))
    count = int(60 * minutes / POSE_DURATION) + 2
    rows = [','.join(f'{v:g}' for v in WAYPOINTS[k % len(WAYPOINTS)]) for k in range(count)]
    (folder / 'poses.csv').write_text('\n'.join([','.join(COLUMNS), *rows]) + '\n')
    nodes, _ = plan(ports=str(folder), task=str(folder / 'poses.csv'), bag=str(folder / 'bag'))
    nodes['sim_node']['simulator_file'] = str(folder / 'simulator.yaml')
    return Graph(nodes, folder, number)


def watch(graph: Graph, operator: Operator, seconds: float, say: Callable[[str], None]
          ) -> tuple[dict[str, list[tuple]], str]:
    """Sample every process for the time; return samples and the reason of an early end or ''."""
    samples: dict[str, list[tuple]] = {name: [] for name in graph.processes}
    begin = due = time.monotonic()
    while (now := time.monotonic()) < begin + seconds:
        if now >= due:
            due += PERIOD
            for name, process in graph.processes.items():
                if sample := read_sample(process.pid):
                    samples[name].append((now - begin, *sample))
            say(f'{(now - begin) / 60:.1f} min: ' + ', '.join(
                f'{name} {taken[-1][1]:.1f} MB' for name, taken in samples.items() if taken))
        operator.spin(0.2)
        if dead := graph.dead():
            return samples, '; '.join(f'{name} died ({how})' for name, how in dead.items())
        if not operator.state.startswith(('flying', 'fallback')):
            return samples, f"the supervisor was in '{operator.states[-1]}' after " \
                            f'{now - begin:.0f} s'
    return samples, ''


def soak(minutes: float, console: Console) -> bool:
    """Fly, sample, land, stop and print a row for each process; return whether one fails."""
    confine()
    operator, graph = None, None
    with TemporaryDirectory(prefix='soak_') as place, reserved_domain() as number:
        folder = Path(place)
        try:
            graph = make_graph(folder, number, minutes)
            graph.start()
            operator = Operator(number)
            bridges = operator.required = [node for node in graph.nodes if node in BRIDGES]
            operator.expect('starting', lambda: operator.ready
                            and not operator.waits_for(bridges), READY)
            operator.take_off()
            samples, ended = watch(graph, operator, 60 * minutes, console.log)
            operator.call('land')
            operator.wait(lambda: operator.state in ('disarmed', 'emergency_stop'), LANDING)
        finally:
            stubborn = graph.stop() if graph else []
            if operator:
                operator.close()
        size = sum(file.stat().st_size for file in (folder / 'bag').glob('*')) / 1e6
        for line in graph.warnings()[:20]:
            console.print(line, markup=False, highlight=False, style='yellow')
    warm_up = max(WARM_UP * 60 * minutes, WARM_UP_LEAST)
    found = {name: one for name, taken in samples.items() if (one := growth(taken, warm_up))}
    table = Table('process', 'memory [MB]', 'slope [MB/h]', 'threads', 'files', 'grows')
    for name, (row, grows) in found.items():
        table.add_row(name, *row, 'yes' if grows else 'no')
    console.print(table)
    console.print(f'after {warm_up:.0f} s of warm-up; bag {size:.0f} MB')
    for text in filter(None, (*(f'{name} had to be killed' for name in stubborn), ended)):
        console.print(text, style='red')
    return bool(ended or stubborn or not found or any(grows for _, grows in found.values()))


def main() -> int:
    """Fly and print the growth; status 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--minutes', type=float, default=60.0, help='of flight')
    return int(soak(parser.parse_args().minutes, Console()))


if __name__ == '__main__':
    sys.exit(main())
