"""
The next flight of `gap --next` against random poses: ``python benchmarks/gap_next.py --seed 0``.

A plant with one hidden effect flies a task that shows little. If `gap` leaves its flight open, the
plant flies the written task, and seven random poses of the same length. Both times `gap` gets both
flights. A case that the first flight decides is drawn again. The same command continues a run.
"""

import argparse
from collections import namedtuple
from functools import partial
from pathlib import Path

from formulas import attempted, described, fly, hidden, swept
import numpy as np
from rich.console import Console
from rich.markdown import Markdown
from scipy.stats import binomtest

from beetle_omni_ros.flight.experiment import Experiments
from beetle_omni_ros.identify.flights.command import gap_results
from beetle_omni_ros.identify.flights.next_flight import OPEN
from beetle_omni_ros.model.files import write_json

STEPS = 'steps'     # of 0.15 m between level poses
FIRST = {
    'random2': ['mass', 'thrust_coefficient', *['rotor_lag'] * 2, *['command_latency'] * 3,
                'centre_of_mass', 'voltage_sag', 'tilt_thrust_loss'],
    'hover': ['mass', 'thrust_coefficient', 'rotor_lag', 'rotor_drag', 'tilt_thrust_loss',
              'voltage_sag'],
    STEPS: [*['mass'] * 4, *['thrust_coefficient'] * 4]}
ALL = [(first, effect) for first, effects in FIRST.items() for effect in effects]
HEADER = 'x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n'
DRAWS = 6           # of a plant until its first flight is open
Case = namedtuple('Case', 'name key cost first effect number seed')


def case_of(seed, number):
    """Case with this number."""
    first, effect = ALL[number % len(ALL)]
    return Case(f'{number} {first} {effect}', '', 1, first, effect, number, seed)


def examined(case, folder):
    """What `gap` finds after the written task and after random poses."""
    rng, task = np.random.default_rng([case.seed, 3, case.number]), case.first
    base, robot = described([case.effect], folder)
    if task == STEPS:
        task = folder / 'steps.csv'
        task.write_text(HEADER + ''.join(f'{x},0,{z},0,0,0\n' for x, z in (
            (0, 1), (0.15, 1), (0, 1), (0, 1.15), (0, 1))))
    found = partial(gap_results, robot=robot, console=Console(quiet=True))
    for draw in range(DRAWS):
        own = folder / str(draw)
        own.mkdir()
        plant, (old,), *_ = hidden([case.effect], base, 'nmpc', [task], rng, own)
        result = found([old], next_task=own / 'next.yaml', experiments=Experiments)
        if result['verdict'] in OPEN and (own / 'next.yaml').is_file():
            break
    else:
        return {'open': False, 'decided': draw + 1, 'verdict': result['verdict']}
    row = {'open': True, 'decided': draw, 'truth': plant.effects,
           'probability': result['next_flight']['probability']}
    for name, second in ('next', own / 'next.yaml'), ('random', 'random7'):
        bag, seed = own / name, int(rng.integers(2**31))
        after = found([old, bag]) if fly('nmpc', base, plant, second, seed, bag) \
            else {'verdict': 'lost', 'effects': []}
        named = [effect['names'] for effect in after['effects']]
        row[name] = {'verdict': after['verdict'], 'named': named,
                     'right': named == [[case.effect]],
                     'wrong': any(case.effect not in names for names in named)}
    return row


def line(case, row, kept=False):
    """Text about one case."""
    if 'failure' in row or not row['open']:
        return f"{case.name}: {row.get('failure', 'the first flights decide')}"
    return f'{case.name}: ' + '; '.join(
        f"{name} {row[name]['verdict']} {', '.join(map(' or '.join, row[name]['named']))}"
        f"{' WRONG' * row[name]['wrong']}" for name in ('next', 'random')) \
        + f", {row['probability']:.2f} expected, {row['cpu_s']:.0f} s"


def table(rows):
    """Markdown table of the cases by their first flight."""
    lines = ['| first flight | cases | after `--next` | wrong | after random poses | wrong |',
             '|---' * 6 + '|']
    for first in (*FIRST, 'all'):
        own = [row for row in rows if row['first'] == first or first == 'all']
        cells = []
        for name in ('next', 'random'):
            right = sum(row[name]['right'] for row in own)
            low, high = binomtest(right, len(own)).proportion_ci() if own else (0, 1)
            cells += [f'{right} [{low:.2f}, {high:.2f}]',
                      f"{sum(row[name]['wrong'] for row in own)}"]
        lines.append(f"| {first} | {len(own)} | {' | '.join(cells)} |")
    return '\n'.join(lines)


def main():
    """Examine the cases and print how many are right."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--cases', type=int, default=len(ALL))
    parser.add_argument('--jobs', type=int, help='at a time (every core)')
    parser.add_argument('--out', type=Path, default=Path('runs_out/gap_next.json'),
                        help='results; finished cases are kept in a folder beside it')
    given, console = parser.parse_args(), Console(width=140)
    cases = [case_of(given.seed, number) for number in range(given.cases)]
    rows = [{'case': case.name, 'first': case.first, **row} for case, row in zip(cases, swept(
        partial(attempted, examined), cases, given, console, line), strict=True)]
    console.print(Markdown(table([row for row in rows if row.get('open')])))
    write_json(given.out, {'seed': given.seed, 'cases': rows})


if __name__ == '__main__':
    main()
