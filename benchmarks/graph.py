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
from contextlib import contextmanager
import json
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time

from rich.console import Console
from rich.table import Table

from beetle_omni_ros.nodes.fly import run_fly
from beetle_omni_ros.nodes.runner import use_real_time_priority

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
    """Fly once; return what was measured."""
    rows = [POSES[k % len(POSES)] for k in range(max(1, round(seconds / POSE_SECONDS)))]
    task, result = folder / 'poses.csv', folder / 'result.json'
    task.write_text('\n'.join(['x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg', *rows]) + '\n')
    result.unlink(missing_ok=True)
    with bare_timer() as counted:
        status = run_fly(task=str(task), actuators=actuators, json_path=result,
                         console=Console(quiet=True))
    if status or not result.exists():
        sys.exit(f'flight with {actuators} failed (status {status})')
    return {**json.loads(result.read_text())['meta']['graph'], **counted}


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
    arguments.add_argument('--json', type=Path, help='file for the numbers')
    arguments.add_argument('--bare-timer', action='store_true', help=argparse.SUPPRESS)
    given = arguments.parse_args()
    if given.bare_timer:
        return sleep_on()
    table = Table('', *ARRANGEMENTS)
    measured = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ARRANGEMENTS:
            measured[name] = measure(Path(folder), name, given.seconds)
    for key, text in ROWS.items():
        table.add_row(text, *(_cell(measured[name].get(key), targets.get(key))
                              for name, targets in ARRANGEMENTS.items()))
    Console().print(table)
    if given.json:
        given.json.write_text(json.dumps(measured, indent=1) + '\n')


def _cell(value, target):
    if value is None:
        return ''
    text = str(value) if isinstance(value, int) else f'{value:.2f}'
    return text if target is None else f'{text} (target {target:g})'


if __name__ == '__main__':
    main()
