"""
The motor board's link at 200 Hz: ``python benchmarks/board_bus.py [--seconds 10]``.

The emulated board runs in a process of its own, the driver in this one. Printed are

- rate: what the loop reached, and cycles later than half a period;
- send: from the call of ``send()`` until the last byte is written;
- rotor target: from the same call until the emulated board has the new target;
- CPU of the driver (its thread included) and of the emulated board, in % of one core.

``--sweep`` adds the speed of the thrust map alone.
"""

import argparse
from dataclasses import replace
import json
import multiprocessing
from pathlib import Path
import time
import timeit

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from beetle_omni_ros.drivers.motor_board import MotorBoard
from beetle_omni_ros.drivers.motor_board_parameters import MotorBoardParameters
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard

PERIOD = 0.005          # [s]
TARGETS = {'send p99 [ms]': 2.0, 'CPU driver [%]': 15.0}


def emulate(pipe):
    """Serve an emulated board until told to stop; then tell when which target came."""
    with EmulatedMotorBoard() as board:
        arrivals = []
        board.on_target = lambda now, values: arrivals.append((values[0], now))
        pipe.send(board.port)
        pipe.recv()
        begin, cpu = time.monotonic(), time.process_time()
        pipe.recv()
        share = (time.process_time() - cpu) / (time.monotonic() - begin)
        pipe.send((arrivals, share, board.refused))


def fly(port, pipe, seconds):
    """Send targets at 200 Hz; return the times of each and the driver's CPU."""
    board = MotorBoard(replace(MotorBoardParameters.load(), port=port))
    with board:
        missing = board.wait_ready(5)
        if missing:
            raise SystemExit(missing)
        assert board.arm().accepted
        pipe.send('begin')
        cycles, rng = round(seconds / PERIOD), np.random.default_rng(0)
        thrusts = rng.uniform(2, 15, (cycles, 4))
        begin, cpu, sent = time.monotonic(), time.process_time(), []
        for k in range(cycles):
            time.sleep(max(0.0, begin + k * PERIOD - time.monotonic()))
            start = time.monotonic()
            result = board.send(thrusts[k], time.time())
            sent.append((start, time.monotonic(), board._last_stamp[1], result.sent))
            if k % 4 == 0:
                board.poll()
        share = (time.process_time() - cpu) / (time.monotonic() - begin)
        link = board.poll().link
    return sent, share, link, begin


def quantiles(name, seconds):
    """Median, 99 % and maximum [ms] under ``name``."""
    values = 1e3 * np.asarray(seconds)
    return {f'{name} median [ms]': np.median(values), f'{name} p99 [ms]': np.quantile(values, .99),
            f'{name} max [ms]': values.max()}


def measure(seconds):
    """One flight; returns name -> number."""
    context = multiprocessing.get_context('spawn')
    here, there = context.Pipe()
    process = context.Process(target=emulate, args=(there,), daemon=True)
    process.start()
    sent, share, link, begin = fly(here.recv(), here, seconds)
    here.send('end')
    arrivals, board_share, refused = here.recv()
    process.join(5)
    arrived = dict(arrivals)
    late = [start - (begin + k * PERIOD) > PERIOD / 2 for k, (start, *_) in enumerate(sent)]
    delays = [arrived[stamp] - start for start, _, stamp, _ in sent if stamp in arrived]
    return {
        'rate [Hz]': (len(sent) - 1) / (sent[-1][0] - sent[0][0]), 'late cycles': sum(late),
        'not sent': sum(not ok for *_, ok in sent), 'not arrived': len(sent) - len(delays),
        **quantiles('send', [end - start for start, end, *_ in sent]),
        **quantiles('rotor target', delays),
        'CPU driver [%]': 100 * share, 'CPU emulated board [%]': 100 * board_share,
        'packets lost to us': link.received.lost, 'refused by the board': sum(refused.values()),
        **{f'refused: {reason}': count for reason, count in refused.items()}}


def sweep():
    """Time of the thrust map [us]."""
    thrust_map = MotorBoard().thrust_map
    thrust = np.array([5.0, 7.0, 9.0, 11.0])
    times = timeit.repeat(lambda: thrust_map.command(thrust, 23.4), number=1000, repeat=5)
    return {'thrust map [us]': 1e3 * min(times)}


def main():
    """Measure and print a table."""
    arguments = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    arguments.add_argument('--seconds', type=float, default=10)
    arguments.add_argument('--sweep', action='store_true', help='the thrust map alone, too')
    arguments.add_argument('--json', type=Path, help='file for the numbers')
    given = arguments.parse_args()
    measured = {**measure(given.seconds), **(sweep() if given.sweep else {})}
    table = Table('motor board', 'measured', 'target')
    for name, value in measured.items():
        table.add_row(escape(name), f'{value:.3g}' if name != 'rate [Hz]' else f'{value:.2f}',
                      f'{TARGETS[name]:g}' if name in TARGETS else '')
    Console().print(table)
    if given.json:
        given.json.write_text(json.dumps({k: float(v) for k, v in measured.items()}, indent=1))


if __name__ == '__main__':
    main()
