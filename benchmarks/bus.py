"""
Loop rate, latency and CPU of both actuator drivers: `python benchmarks/bus.py`.

Each driver runs at 200 Hz in this process against its emulated device in a process of its own.
"to last byte" is the time from the call that takes a command until its last byte is written,
"to rotor target" until the emulated board receives it; CPU is that of this process, including the
threads of the driver. --faults adds runs with each fault of the servo bus. With --wire the answers
of servos take the time of 1 Mbit/s. If permitted, all processes have the lowest real-time
priority, as the nodes do.
"""

import argparse
from contextlib import closing
from dataclasses import replace
import json
import multiprocessing
import os
from pathlib import Path
import sys
import time
import timeit

import numpy as np
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from beetle_omni_ros.drivers.device_parameters import (  # noqa: E402
    MotorBoardParameters,
    ServoBusParameters,
)
from beetle_omni_ros.drivers.motor_board import MotorBoard  # noqa: E402
from beetle_omni_ros.drivers.servo_bus import ServoBus  # noqa: E402
from beetle_omni_ros.robot.parameters import RobotParameters  # noqa: E402

PERIOD = 0.005          # [s]
POLL_TICKS = 2          # of the motor board, as rotor_bridge_node does
# Both bridges together may need 30 %; benchmarks/graph.py measures the nodes.
TARGETS = {'to last byte [ms]': 'p99 2', 'missed cycles': '0', 'CPU [%]': '15'}
FAULTS = (('servo 3 silent from 1 s to 2 s', 'silent 3', 'silent'),
          ('all silent from 1 s to 2 s', 'silent 1 2 3 4', 'silent'),
          ('servo 2 restarts at 1 s', 'reboot 1', 'silent'),
          ('unplugged from 1 s to 2 s', 'unplug', 'replug'))


def serve_servos(pipe, wire):
    """Run the emulated servos; obey lines until an empty one."""
    from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus
    with EmulatedServoBus(motion=RobotParameters.load().joints, timing=wire) as emulated:
        pipe.send(emulated.port)
        while words := pipe.recv().split():
            word, *rest = words
            if word == 'silent':
                emulated.faults.silent = set(map(int, rest))
            elif word == 'reboot':
                emulated.reboot(int(rest[0]))
            else:
                {'unplug': emulated.unplug, 'replug': emulated.replug}[word]()


def serve_board(pipe):
    """Run the emulated board until a message; then send the arrival times of the targets."""
    from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard
    with EmulatedMotorBoard() as board:
        arrivals = []
        board.on_target = lambda now, values: arrivals.append((values[0], now))
        pipe.send(board.port)
        pipe.recv()
        pipe.send((arrivals, board.refused))


class Device:
    """An emulated device in its own process, with its serial ``port``."""

    def __init__(self, serve, *arguments):
        context = multiprocessing.get_context('spawn')
        self.pipe, there = context.Pipe()
        self._process = context.Process(target=serve, args=(there, *arguments), daemon=True)
        self._process.start()
        self.port = self.pipe.recv()

    def sender(self, text):
        """Return a function that sends ``text`` to the device."""
        return lambda: self.pipe.send(text)

    def close(self):
        """Wait for the end of the process."""
        self._process.join(5)


def run(tick, seconds, script=()):
    """
    Call ``tick(k, elapsed)`` at 200 Hz; periods without a call are missed cycles.

    Args:
        tick: one cycle.
        seconds: [s].
        script: functions to call, as (time [s], function) in order of time.

    Returns:
        rate [Hz], missed cycles, CPU of this process as a share of a core.

    """
    script, missed, ticks = list(script), 0, 0
    began, cpu = time.monotonic(), time.process_time()
    due = began
    while due - began < seconds:
        if script and due - began >= script[0][0]:
            script.pop(0)[1]()
        tick(ticks, due - began)
        ticks += 1
        due += PERIOD
        late = time.monotonic() - due
        if late > 0:
            skipped = int(late / PERIOD) + 1
            missed += skipped
            due += skipped * PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
    elapsed = time.monotonic() - began
    return {'rate [Hz]': ticks / elapsed, 'missed cycles': missed,
            'CPU [%]': 100 * (time.process_time() - cpu) / elapsed}


def quantiles(seconds):
    """Median, 99 % and maximum [ms]."""
    values = 1e3 * np.asarray(seconds)
    return {'median': float(np.median(values)), 'p99': float(np.quantile(values, 0.99)),
            'max': float(values.max())}


def servo_loop(bus, seconds, script=()):
    """One run of the servo bus: write, read, one step of upkeep in each cycle."""
    stages = {'to last byte': [], 'read': [], 'upkeep': [], 'cycle': []}
    lost = np.zeros(4, int)

    def tick(_, elapsed):
        goals = 2 * np.sin(np.pi * elapsed + np.arange(4))
        marks = [time.perf_counter()]
        bus.write_goals(goals)
        marks.append(time.perf_counter())
        np.add(lost, ~bus.read().valid, out=lost)
        marks.append(time.perf_counter())
        bus.upkeep()
        marks.append(time.perf_counter())
        for stage, spent in zip(stages.values(), [*np.diff(marks), marks[-1] - marks[0]]):
            stage.append(spent)

    measured = run(tick, seconds, script)
    for name, spent in stages.items():
        measured[f'{name} [ms]'] = quantiles(spent)
    return {**measured, 'readings lost': int(lost.sum())}


def measure_servos(seconds, wire, faults):
    """Title -> numbers of the servo bus: healthy and, if requested, with each fault."""
    device = Device(serve_servos, wire)
    bus = ServoBus(replace(ServoBusParameters.load(), port=device.port),
                   RobotParameters.load().joints)
    try:
        bus.open()
        bus.configure()
        bus.enable()
        found = {'servo bus': servo_loop(bus, seconds)}
        for title, begin, end in FAULTS if faults else ():
            found[title] = servo_loop(bus, 3.0, [(1.0, device.sender(begin)),
                                                 (2.0, device.sender(end))])
            bus.take_events()
    finally:
        bus.close()
        device.sender('')()
        device.close()
    return found


def measure_board(seconds):
    """Numbers of the motor board: one target in each cycle, telemetry polled as the node does."""
    device = Device(serve_board)
    sent, thrusts = [], np.random.default_rng(0).uniform(2, 15, (1000, 4))
    with closing(MotorBoard(replace(MotorBoardParameters.load(), port=device.port),
                            RobotParameters.load())) as board:
        board.open()
        time.sleep(1)
        if not (answer := board.start(True).wait()).accepted:
            raise SystemExit(answer.reason)

        def tick(k, _):
            begin = time.monotonic()
            result = board.send(thrusts[k % 1000], time.time())
            sent.append((begin, time.monotonic(), board._last_stamp[1], not result.reason))
            if k % POLL_TICKS == 0:
                board.poll()

        measured = run(tick, seconds)
        lost = board.link()['lost']
        device.sender('end')()
        arrivals, refused = device.pipe.recv()
    device.close()
    arrived = dict(arrivals)
    delays = [arrived[stamp] - begin for begin, _, stamp, _ in sent if stamp in arrived]
    command = thrusts[0]
    return {**measured, 'to last byte [ms]': quantiles([end - begin for begin, end, *_ in sent]),
            'to rotor target [ms]': quantiles(delays),
            'not sent': sum(not ok for *_, ok in sent), 'not arrived': len(sent) - len(delays),
            'refused by the board': sum(refused.values()), 'packets lost to us': lost,
            'thrust map [us]': 1e3 * min(timeit.repeat(
                lambda: board.thrust_map.command(command, 23.4), number=1000, repeat=3))}


def main():
    """Measure and print a table; write the numbers to a file if requested."""
    arguments = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    arguments.add_argument('--seconds', type=float, default=10, help='for each driver')
    arguments.add_argument('--wire', action='store_true', help='servos answer at 1 Mbit/s')
    arguments.add_argument('--faults', action='store_true', help='the servo bus with each fault')
    arguments.add_argument('--json', type=Path, help='file for the numbers')
    given = arguments.parse_args()
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except (OSError, AttributeError):
        print('without real-time priority: not permitted here')
    found = {'motor board': measure_board(given.seconds),
             **measure_servos(given.seconds, given.wire, given.faults)}
    for title, numbers in found.items():
        table = Table(title, 'median', 'p99', 'max', 'target')
        for name, value in numbers.items():
            values = value.values() if isinstance(value, dict) else (value,)
            cells = [f'{number:.4g}' for number in values] + [''] * (3 - len(values))
            table.add_row(name.replace('[', r'\['), *cells, TARGETS.get(name, ''))
        Console().print(table)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))


if __name__ == '__main__':
    main()
