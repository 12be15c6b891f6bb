"""
CPU and latency of the ROS graph: ``python benchmarks/graph.py [--seconds 24]``.

Flies poses in real time, without and with the bridges, and prints for each

- CPU: user and system time of all node processes (simulator and recorder included) while
  the task is flown, in % of one core;
- latency: from the stamp of an IMU sample, which the simulator sets as it publishes it, to
  the arrival of the command that answers it at the actuators, in the simulator's callback.

With the bridges the devices are emulated in the simulator's process, and the latency ends with the
last byte of the command to the motor board; the numbers of the bridges are printed too. A separate
timer process measures the delays of the machine: it has the same priority and only sleeps for
5 ms at a time during the flight.
"""

import argparse
from contextlib import contextmanager, suppress
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import threading
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.ros.fly import run_fly
from beetle_omni_ros.ros.graph import BRIDGES, BRIDGES_COMPOSED, COMPOSED
from beetle_omni_ros.ros.runner import use_real_time_priority

# actuators -> targets
ARRANGEMENTS = {
    'direct': {'cpu_percent': 60.0, 'latency_p99_ms': 5.0},
    'emulated': {'bridges_cpu_percent': 30.0, 'servos_missed_cycles': 0}}
ROWS = {'cpu_percent': 'CPU of all nodes [%]', 'latency_median_ms': 'latency, median [ms]',
        'latency_p99_ms': '99 %', 'latency_max_ms': 'max',
        'bridges_cpu_percent': 'CPU of the bridges [%]',
        'servos_cycles': 'servo bus: cycles', 'servos_missed_cycles': 'missed',
        'servos_latency_p99_ms': 'IMU sample to last byte, 99 % [ms]',
        'bare_cycles': 'bare timer: cycles', 'bare_missed_cycles': 'missed'}
PERIOD = 0.005     # s
POSES = ['0,0,1,0,0,0', '0.5,0,1,30,0,0', '0,0.5,1.2,0,-25,45']
POSE_SECONDS = 8


def measure(folder: Path, actuators: str, seconds: float) -> dict:
    """Fly once; return what was measured while the task was flown."""
    rows = [POSES[k % len(POSES)] for k in range(max(1, round(seconds / POSE_SECONDS)))]
    task, bag = folder / 'poses.csv', folder / f'bag_{actuators}'
    task.write_text('\n'.join(['x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg', *rows]) + '\n')
    samples, stop = [], threading.Event()       # (time [s], CPU of all nodes, of the bridges [s])
    sampler = threading.Thread(target=sample_cpu, args=(samples, stop))
    sampler.start()
    with bare_timer() as counted:
        status = run_fly(task=str(task), actuators=actuators, clock='system', bag=bag,
                         console=Console(quiet=True))
    stop.set()
    sampler.join()
    if status:
        sys.exit(f'flight with {actuators} failed (status {status})')
    log = read_bag(bag)
    t, *used = np.array(samples).T
    begin, end = log.targets[0].stamp, log.state_t[[s.state for s in log.states].index('landing')]
    found = {key: 100 * (np.interp(end, t, cpu) - np.interp(begin, t, cpu)) / (end - begin)
             for key, cpu in zip(('cpu_percent', 'bridges_cpu_percent'), used, strict=True)}
    newest = {status.name: status.values for status in log.diagnostics}
    for name, node in (('latency', 'rotor_bridge_node' if actuators == 'emulated' else 'sim_node'),
                       ('servos_latency', 'joint_bridge_node')):
        found |= {f'{name}_{key}': float(value)
                  for key, value in newest.get(f'{node}: latency', {}).items()}
    found |= {f'servos_{key}': int(newest['joint_bridge_node: bus'][key])
              for key in ('cycles', 'missed_cycles') if 'joint_bridge_node: bus' in newest}
    return {**found, **counted}


def sample_cpu(samples: list, stop: threading.Event) -> None:
    """Add the CPU time of the processes of nodes, ten times a second."""
    while not stop.wait(0.1):
        used = {COMPOSED: 0.0, BRIDGES_COMPOSED: 0.0}
        for file in Path('/proc/self/task').glob('*/children'):
            for pid in file.read_text().split():
                with suppress(OSError):
                    words = Path(f'/proc/{pid}/cmdline').read_text().split('\0')
                    stat = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
                    if COMPOSED in words:
                        used[BRIDGES_COMPOSED if BRIDGES[0] in words else COMPOSED] += (
                            int(stat[11]) + int(stat[12])) / os.sysconf('SC_CLK_TCK')
        samples.append((time.time(), sum(used.values()), used[BRIDGES_COMPOSED]))


@contextmanager
def bare_timer():
    """Run a timer in its own process; fill the dict with its counts at the end."""
    process = subprocess.Popen([sys.executable, __file__, '--bare-timer'],
                               stdout=subprocess.PIPE, text=True)
    counted = {}
    try:
        yield counted
    finally:
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=10)
    counted.update(json.loads(output))


def sleep_on():
    """Sleep until SIGINT; count periods that are late by more than half a period."""
    use_real_time_priority()
    due, cycles, missed = time.monotonic() + PERIOD, 0, 0
    try:
        while True:
            time.sleep(max(0.0, due - time.monotonic()))
            cycles += 1
            skipped = round(max(0.0, time.monotonic() - due) / PERIOD)
            missed += skipped
            due += (1 + skipped) * PERIOD
    except KeyboardInterrupt:
        print(json.dumps({'bare_cycles': cycles, 'bare_missed_cycles': missed}))


def main():
    """Measure the arrangements and print a table."""
    arguments = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    arguments.add_argument('--seconds', type=float, default=24, help='flight time of each')
    arguments.add_argument('--bare-timer', action='store_true', help=argparse.SUPPRESS)
    given = arguments.parse_args()
    if given.bare_timer:
        return sleep_on()
    with tempfile.TemporaryDirectory() as folder:
        measured = [measure(Path(folder), name, given.seconds) for name in ARRANGEMENTS]
    table = Table('', *ARRANGEMENTS)
    for key, text in ROWS.items():
        table.add_row(text, *(_cell(found.get(key), targets.get(key))
                              for found, targets in zip(measured, ARRANGEMENTS.values())))
    Console().print(table)


def _cell(value, target):
    if value is None:
        return ''
    text = str(value) if isinstance(value, int) else f'{value:.2f}'
    return text if target is None else f'{text} (target {target:g})'


if __name__ == '__main__':
    main()
