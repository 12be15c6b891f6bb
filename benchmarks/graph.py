"""
CPU and latency of the ROS graph: ``python benchmarks/graph.py [--seconds 24]``.

Flies poses in real time, once with all nodes in one process and once with a process for
each, and prints for both

- CPU: user and system time of all node processes (simulator and recorder included) while
  the task is flown, in % of one core;
- latency: from the stamp of an IMU sample, which the simulator sets as it publishes it, to
  the arrival of the command that answers it at the actuators, in the simulator's callback.
"""

import argparse
import json
from pathlib import Path
import sys
import tempfile

from rich.console import Console
from rich.table import Table

from beetle_omni_ros.nodes.fly import run_fly

TARGETS = {'cpu_percent': 60.0, 'latency_p99_ms': 5.0}   # of the composed graph
COLUMNS = {'cpu_percent': 'CPU [%]', 'latency_median_ms': 'median [ms]',
           'latency_p99_ms': '99 % [ms]', 'latency_max_ms': 'max [ms]'}
POSES = ['0,0,1,0,0,0', '0.5,0,1,30,0,0', '0,0.5,1.2,0,-25,45']
POSE_SECONDS = 8


def measure(folder: Path, composed: bool, seconds: float) -> dict:
    """Fly once; return what was measured."""
    rows = [POSES[k % len(POSES)] for k in range(max(1, round(seconds / POSE_SECONDS)))]
    task, result = folder / 'poses.csv', folder / f'{composed}.json'
    task.write_text('\n'.join(['x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg', *rows]) + '\n')
    status = run_fly(task=str(task), composed=composed, json_path=result,
                     console=Console(quiet=True))
    if status or not result.exists():
        sys.exit(f"flight with {'one process' if composed else 'separate processes'} failed "
                 f'(status {status})')
    return json.loads(result.read_text())['meta']['graph']


def main():
    """Measure both arrangements and print a table."""
    arguments = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    arguments.add_argument('--seconds', type=float, default=24, help='flight time of each')
    arguments.add_argument('--json', type=Path, help='file for the numbers')
    given = arguments.parse_args()
    table = Table('arrangement', *COLUMNS.values())
    measured = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, composed in (('one process', True), ('separate processes', False)):
            measured[name] = measure(Path(folder), composed, given.seconds)
            table.add_row(name, *(f'{measured[name][key]:.2f}' for key in COLUMNS))
    table.add_row('target (one process)', *(f'{TARGETS[key]:g}' if key in TARGETS else ''
                                            for key in COLUMNS))
    Console().print(table)
    if given.json:
        given.json.write_text(json.dumps(measured, indent=1) + '\n')


if __name__ == '__main__':
    main()
